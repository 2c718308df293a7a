"""Measurement factors, one file each; NumPy and GTSAM only."""
