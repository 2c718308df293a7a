"""Aids beside the beams: depth and GNSS, which count in full, and those that are weighted."""
