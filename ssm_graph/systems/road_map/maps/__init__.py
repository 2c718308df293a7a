"""Maps of several formats as one neutral map."""
