"""Live traffic: bytes of instruments to messages, answers to bytes, and the loop between them."""
