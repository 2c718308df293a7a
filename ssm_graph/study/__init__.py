"""Studies: many missions by many methods, in parallel, resumable, with the truth beside them."""
