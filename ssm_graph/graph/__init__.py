"""The factor graph of a mission: first values, linearisation, elimination, marginals."""
