"""Logs of the Blueye X3."""
