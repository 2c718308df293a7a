"""Filters over one interface: the update rules of the literature, linear and in navigation."""
