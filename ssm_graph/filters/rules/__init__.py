"""Update laws of the literature and ours: linear algebra, no instrument."""
