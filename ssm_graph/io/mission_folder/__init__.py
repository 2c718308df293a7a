"""The mission folder: keys, tables, checks, reader and writer."""
