"""The log of everything that a live estimator receives."""
