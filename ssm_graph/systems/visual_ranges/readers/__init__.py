"""Readers of recordings of a camera and ranges, in the layouts that people have them in."""
