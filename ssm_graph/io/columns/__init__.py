"""Columns of anyone, CSV, Parquet, MAT or HDF5, turned into a mission by a map of their names."""
