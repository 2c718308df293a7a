"""A camera and ranges to anchors at unknown places: a path and a map in metres.

`camera` holds the models; `tracking` follows points and the pose, `visual_map` keeps everything in
arrays, `bundle` adjusts it, `system` runs it all. `docs/visual-ranges.md` has the equations.
"""
