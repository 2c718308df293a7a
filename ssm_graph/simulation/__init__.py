"""Simulated missions with truth; shares no formula with the estimators."""
