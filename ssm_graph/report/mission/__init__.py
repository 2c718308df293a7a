"""Table and figure of one mission."""
