"""Border to the outside: mission folders in, result folders out, one file per format."""
