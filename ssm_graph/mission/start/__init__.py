"""The start of a mission from its data."""
