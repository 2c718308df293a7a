"""CSV and Parquet tables, TOML settings, files that grow, checkpoints."""
