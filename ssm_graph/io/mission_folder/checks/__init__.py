"""Checks whether a mission is physically possible."""
