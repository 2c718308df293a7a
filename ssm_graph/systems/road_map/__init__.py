"""A road vehicle finds its lane in an HD map, from one poor fix and what its camera sees.

Frames: ``w`` the plane of the map (x east, y north, m), ``b`` the vehicle (x forward, y left,
origin at the rear axle). A pose is (x, y, yaw); yaw is anticlockwise from x, rad.
"""
