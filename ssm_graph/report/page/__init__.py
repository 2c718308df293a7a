"""A result as one page for a browser and for print, without network."""
