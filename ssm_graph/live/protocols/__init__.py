"""Bytes of instruments to messages and back."""
