"""Estimators over the whole graph."""
