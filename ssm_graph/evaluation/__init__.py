"""Comparison of trajectories with references, and honest statistics over many runs."""
