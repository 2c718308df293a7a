"""A vehicle finds its lane on a made-up road: simulate, locate, follow.

Run it as ``python examples/07_find_the_lane.py``.
"""

from __future__ import annotations

import numpy as np

from ssm_graph.systems.road_map.hypotheses import apart
from ssm_graph.systems.road_map.locate import locate
from ssm_graph.systems.road_map.maps.road_map import LineKind, Mark, RoadLine, RoadMap
from ssm_graph.systems.road_map.simulate import DriveModel, driven, simulate_drive

# A winding road of three lanes between kerbs, 300 m.
s = np.arange(0.0, 300.0, 1.0)
yaw = 0.9 * np.sin(s / 30.0)
centre = np.column_stack([np.cumsum(np.cos(yaw)), np.cumsum(np.sin(yaw))])
left = np.column_stack([-np.sin(yaw), np.cos(yaw)])
road_map = RoadMap(
    "winding road",
    (
        RoadLine("left kerb", LineKind.BOUNDARY, centre + 5.5 * left),
        RoadLine("right kerb", LineKind.BOUNDARY, centre - 6.0 * left),
        RoadLine("solid", LineKind.LANE_LINE, centre + 1.75 * left, Mark.SOLID),
        RoadLine("dashed", LineKind.LANE_LINE, centre - 1.75 * left, Mark.DASHED),
    ),
    lanes={},
)

# Drive along the right lane; the receiver is off by up to 20 m along each axis.
rng = np.random.default_rng(0)
model = DriveModel(length_m=120.0)
truth = driven((centre - 3.6 * left)[60:], model, rng)
drive = simulate_drive("example", truth, road_map, model, rng)

found = locate(drive, road_map)
across, along, turn = apart(truth.at(found.track.time_s[-1:])[0], found.pose)
print(f"{found.verdict.name}: {found.reason}")
print(f"lane known after {found.first_fix_s:.1f} s and {found.first_fix_m:.0f} m")
print(f"error across {across:+.3f} m, along {along:+.2f} m, yaw {np.degrees(turn):+.2f} deg")
print(f"sigma across {found.sigmas[0]:.3f} m, along {found.sigmas[1]:.2f} m")
