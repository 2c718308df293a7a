"""Write the logs of the transcripts in ``docs``: ``python -m tests.make_foreign_logs DIR``.

One simulated mission of three minutes as others would have recorded it: ``logs`` with tables of
columns of their own, ``00000042.BIN`` of ArduPilot, ``dive`` as a bag of ROS 2, and a vehicle file
beside those that need one.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from ssm_graph.io.mission_folder.vehicle import vehicle_of, write_vehicle
from ssm_graph.mission.mission import Mission
from ssm_graph.simulation import scenario_config, simulate
from tests.rosbag_fixture import Ros, marine_bag, write_bag
from tests.unit.test_ardupilot import dataflash
from tests.unit.test_columns import forward_left_up

SEED = 77
DURATION_S = 180.0
VEHICLE = """\
format = 1
name = "trial"

[frames]
body = "FRD"

[imu]
instrument = "KVH 1775"
accel_bias_ug = 500.0

[dvl]
beam_azimuth_deg = [45, 135, 225, 315]
beam_janus_deg = 30.0
beam_noise_m_per_s = 0.01
lever_arm_m = [0.5, 0.0, 0.3]
mounting_rpy_deg = [0.5, -1.0, 2.0]
misalignment_sigma_deg = 0.5

[gnss]
lever_arm_m = [-0.3, 0.0, -0.6]
"""
"""Of the tables: what no column says. The page on tables shows it."""


def write_logs(folder: Path) -> None:
    """Write all three logs and their vehicle files."""
    demo = replace(scenario_config("demo"), duration_s=DURATION_S, seed=SEED)
    mission = simulate(demo).mission
    (folder / "logs").mkdir(parents=True)
    forward_left_up(folder / "logs", _plain(mission))
    (folder / "vehicle.toml").write_text(VEHICLE, encoding="utf-8")
    (folder / "00000042.BIN").write_bytes(dataflash(mission))
    ros = Ros()
    write_bag(folder / "dive", ros, marine_bag(mission, ros))
    (folder / "ros").mkdir()
    write_vehicle(folder / "ros", vehicle_of(mission))


def _plain(mission: Mission) -> Mission:
    """Return a mission whose pings are whole or not there, and whose fixes are equally good."""
    assert mission.gnss is not None
    is_whole = np.asarray(np.isfinite(mission.dvl.speed).all(axis=1))
    speed = np.where(is_whole[:, None], mission.dvl.speed, np.nan)
    sigma_enu = np.full_like(mission.gnss.sigma_enu, 2.0)
    return replace(
        mission,
        dvl=replace(mission.dvl, speed=speed),
        gnss=replace(mission.gnss, sigma_enu=sigma_enu),
    )


if __name__ == "__main__":
    write_logs(Path(sys.argv[1]))
