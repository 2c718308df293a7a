"""The factor graph of a mission: alignment, first values, linearisation, marginals."""
