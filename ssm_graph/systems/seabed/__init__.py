"""An underwater vehicle finds its place over a mapped seabed, from its DVL's ranges and its depth.

Frames: ``n`` the navigation frame of the mission; a place on the map is x east and y north of its
origin, m, a height above the ellipsoid, m. Yaw errors are clockwise from north, as headings are.
"""
