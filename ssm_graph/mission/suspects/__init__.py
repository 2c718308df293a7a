"""Clocks, units and axes that a mission's own logs contradict."""
