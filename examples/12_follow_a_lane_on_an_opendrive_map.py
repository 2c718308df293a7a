"""Left-hand traffic on an OpenDRIVE map with errors: find the lane, follow it, use it in GTSAM.

Run it as ``python examples/12_follow_a_lane_on_an_opendrive_map.py``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import gtsam
import numpy as np

from factors.lane_line import curve_covariance, lane_line_factor
from ssm_graph.systems.road_map.follow import follow
from ssm_graph.systems.road_map.hypotheses import apart
from ssm_graph.systems.road_map.locate import locate
from ssm_graph.systems.road_map.maps.read import read_map
from ssm_graph.systems.road_map.maps.road_map import LineKind
from ssm_graph.systems.road_map.refinement import Prior
from ssm_graph.systems.road_map.simulate import (
    DriveModel,
    damaged,
    driven,
    indices_of,
    random_route,
    simulate_drive,
)

LANE = """<lane id="{id}" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/>
          <roadMark sOffset="0" type="{mark}"/></lane>"""
MAP = f"""<OpenDRIVE><road id="1" length="420" rule="LHT" junction="-1"><planView>
  <geometry s="0" x="0" y="0" hdg="0" length="120"><line/></geometry>
  <geometry s="120" x="120" y="0" hdg="0" length="60"><arc curvature="0.015"/></geometry>
  <geometry s="180" x="172.2189" y="25.2260" hdg="0.9" length="240"><line/></geometry>
</planView><lanes><laneSection s="0">
  <left>{LANE.format(id=1, mark="broken")}{LANE.format(id=2, mark="solid")}</left>
  <center><lane id="0"><roadMark sOffset="0" type="solid"/></lane></center>
  <right>{LANE.format(id=-1, mark="solid")}</right>
</laneSection></lanes></road></OpenDRIVE>"""

with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "road.xodr"
    path.write_text(MAP)
    true_map = read_map(path)

# The vehicle has a map in which one boundary in five lies half a metre beside the true one.
rng = np.random.default_rng(7)
model = DriveModel(length_m=200.0, gyro_bias=np.radians(0.05))
truth = driven(random_route(true_map, model.length_m, rng), model, rng)
drive = simulate_drive("left-hand", truth, true_map, model, rng)
road_map = damaged(true_map, rng, missing=0.0, shifted=0.2, by_m=0.5)

found = locate(drive, road_map)
across, along, _ = apart(truth.at(found.track.time_s[-1:])[0], found.pose)
print(f"{found.verdict.name}: {found.reason}")
print(f"at the end off by {across:+.3f} m across, {along:+.2f} m along")

# From the first fix on, when little is known along the road, a window of pictures follows the lane.
sigma = np.array([15.0, 0.5, 0.03, 0.02, 0.002])  # along and across, yaw, scale, bias
turn = np.eye(5)
c, s = np.cos(found.first_fix[2]), np.sin(found.first_fix[2])
turn[:2, :2] = [[c, -s], [s, c]]
prior = Prior(np.array([*found.first_fix, 0.0, 0.0]), turn @ np.diag(sigma**-2.0) @ turn.T)
first_s = float(drive.chassis.time_s[0]) + found.first_fix_s
indices = indices_of(road_map)
way = follow(drive, prior, first_s, indices)
off = [apart(t, p)[0] for t, p in zip(truth.at(way.time_s), way.pose, strict=True)]
print(
    f"followed for {np.ptp(way.time_s):.0f} s: {np.sqrt(np.mean(np.square(off))):.3f} m rms across"
)

# A lane line of a picture half-way as a factor of a graph of your own, on its Pose2.
index, lines = indices[LineKind.LANE_LINE], drive.curves.kind == LineKind.LANE_LINE
row = np.flatnonzero(lines & (drive.curves.time_s >= way.time_s[len(way.time_s) // 2]))[:1]
pose = way.pose[np.searchsorted(way.time_s, drive.curves.time_s[row[0]])]
point_b = drive.curves.points(row, 8)[0]
c, s = np.cos(pose[2]), np.sin(pose[2])
foot = index.foot(pose[:2] + point_b @ np.array([[c, s], [-s, c]]))
spread = curve_covariance(point_b[:, 0], np.ones(8), offset=0.03, slope=4e-3, scatter=0.04)
graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
values.insert(0, gtsam.Pose2(*pose))
graph.add(
    lane_line_factor(
        0,
        point_b=point_b,
        foot=foot.x_y,
        normal=index.normal[foot.segment],
        covariance=spread,
    )
)
print(f"a lane line as a GTSAM factor: error {graph.error(values):.2f}")
