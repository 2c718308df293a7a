"""Live traffic: bytes of instruments to messages, answers to bytes; no sockets, no threads."""
