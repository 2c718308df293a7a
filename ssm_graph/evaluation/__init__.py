"""Errors, consistency and drift of an estimate against a reference."""
