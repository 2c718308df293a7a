"""Landmarks seen from a vehicle in the plane: its path, their places, and how well both are known.

`simulator` makes the runs of the study, `filters` go step by step, `smoother` solves a whole log
with a weight for every observation, `noise` learns the sigmas from it, `association` tells which
landmark was seen. Logs of one's own: `folder`; `docs/landmark-slam.md` has the equations.
"""
