"""A small valid mission: a straight, level run of 60 s, made without the simulation package."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ssm_graph.base.earth import EARTH_RATE, LocalFrame, normal_gravity
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import MICRO_G
from ssm_graph.io.mission_folder.folder import mission_tables
from ssm_graph.io.tables.files import write_table
from ssm_graph.mission.mission import InitialState, Mission, Reference
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import DvlLog, DvlMount, beams_from_angles
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog, ImuNoise

LAT, LON, HEIGHT = np.radians(45.7), np.radians(126.6), -20.0
HEADING = np.radians(63.4)
SPEED = 1.5
LENGTH_S = 60.0

TOML = """\
format = 1
name = "straight-run"

[frames]
body = "FRD"

[origin]
lat_deg = 45.7
lon_deg = 126.6
height_m = 0.0

[imu]
file = "imu.csv"
stamp = "end"
gyro_random_walk_deg_per_sqrt_h = 0.05
accel_random_walk_ug_per_sqrt_hz = 50.0
gyro_bias_deg_per_h = 0.5
accel_bias_ug = 100.0

[dvl]
file = "dvl.csv"
beam_azimuth_deg = [45, 135, 225, 315]
beam_janus_deg = 30.0
beam_noise_m_per_s = 0.005
lever_arm_m = [0.2, 0.0, 0.1]
mounting_rpy_deg = [0.0, 0.0, 0.0]

[depth]
file = "depth.csv"
noise_m = 0.05
lever_arm_m = [0.0, 0.0, 0.0]

[gnss]
file = "gnss.csv"
lever_arm_m = [0.0, 0.0, 0.0]

[initial]
time_s = 0.0
lat_deg = 45.7
lon_deg = 126.6
height_m = -20.0
vel_enu_m_per_s = [1.341, 0.672, 0.0]
roll_deg = 0.0
pitch_deg = 0.0
heading_deg = 63.4
position_sigma_m = [0.1, 0.1, 0.1]
velocity_sigma_m_per_s = [0.05, 0.05, 0.05]
attitude_sigma_deg = [0.06, 0.06, 0.3]

[reference]
file = "reference.csv"
"""


def write_example(folder: Path, *, suffix: str = ".csv") -> Path:
    """Write the mission as a user would: angles of the beams, few digits; return ``folder``."""
    for name, content in _example_files(suffix).items():
        (folder / name).write_bytes(content)
    return folder


@cache
def _example_files(suffix: str) -> dict[str, bytes]:
    with TemporaryDirectory() as made:
        folder = Path(made)
        for name, columns in mission_tables(make_mission()).items():
            digits = {"lat_deg": 9, "lon_deg": 9}
            rounded = {key: np.round(v, digits.get(key, 6)) for key, v in columns.items()}
            write_table(folder / f"{name}{suffix}", rounded)
        (folder / "mission.toml").write_text(TOML.replace(".csv", suffix), encoding="utf-8")
        return {path.name: path.read_bytes() for path in folder.iterdir()}


@cache
def make_mission() -> Mission:
    """Return the mission as values; every optional part is there."""
    rng = np.random.default_rng(0)
    frame = LocalFrame(float(LAT), float(LON), 0.0)
    seconds = np.arange(0.0, LENGTH_S + 0.5)
    lat, lon, height = _positions(frame, seconds)
    return Mission(
        name="straight-run",
        frame=frame,
        imu=_imu(rng),
        dvl=_dvl(rng, seconds[1:]),
        depth=DepthLog(
            sigma=0.05,
            time_s=seconds,
            depth=-height + rng.normal(scale=0.05, size=len(seconds)),
            lever_arm_b=np.zeros(3),
        ),
        gnss=GnssLog(
            time_s=seconds[::10],
            lat=lat[::10],
            lon=lon[::10],
            height=height[::10],
            sigma_enu=np.full((len(seconds[::10]), 3), 0.5),
            lever_arm_b=np.zeros(3),
        ),
        initial=_initial(),
        reference=Reference(
            time_s=seconds,
            lat=lat,
            lon=lon,
            height=height,
            velocity_enu=np.tile(_velocity_enu(), (len(seconds), 1)),
            roll_pitch_heading=np.tile([0.0, 0.0, HEADING], (len(seconds), 1)),
        ),
    )


def _velocity_enu() -> Array:
    return SPEED * np.array([np.sin(HEADING), np.cos(HEADING), 0.0])


def _positions(frame: LocalFrame, time_s: Array) -> tuple[Array, Array, Array]:
    return frame.geodetic_from_p_n(time_s[:, None] * _velocity_enu() + [0.0, 0.0, HEIGHT])


def _imu(rng: np.random.Generator) -> ImuLog:
    R_lb = R_lb_from_roll_pitch_heading(0.0, 0.0, HEADING)
    omega_ie_l = EARTH_RATE * np.array([0.0, np.cos(LAT), np.sin(LAT)])
    gravity = float(normal_gravity(LAT, HEIGHT))
    time_s = np.arange(1, round(20 * LENGTH_S) + 1) / 20.0
    noise = rng.normal(size=(2, len(time_s), 3))
    return ImuLog(
        start_s=0.0,
        noise=ImuNoise(1.5e-5, 50.0 * MICRO_G, 2.4e-6, 100.0 * MICRO_G, 1e-8, 1e-7),
        time_s=time_s,
        gyro_b=R_lb.T @ omega_ie_l + 1.5e-5 * np.sqrt(20.0) * noise[0],
        accel_b=np.array([0.0, 0.0, -gravity]) + 50.0 * MICRO_G * np.sqrt(20.0) * noise[1],
    )


def _dvl(rng: np.random.Generator, time_s: Array) -> DvlLog:
    beams = beams_from_angles(np.radians([45.0, 135.0, 225.0, 315.0]), np.radians(30.0))
    speed = beams @ [SPEED, 0.0, 0.0] + 0.005 * rng.normal(size=(len(time_s), 4))
    speed[7, 2] = np.nan
    return DvlLog(
        mount=DvlMount(
            beams_d=beams,
            R_bd=np.eye(3),
            lever_arm_b=np.array([0.2, 0.0, 0.1]),
            misalignment_sigma=0.01,
            scale_sigma=0.02,
            time_offset_s=0.1,
            time_offset_sigma_s=0.05,
        ),
        time_s=time_s,
        speed=speed,
        sigma=0.005 + 0.001 * rng.random(speed.shape),
        range_m=np.full(speed.shape, 12.0) + rng.random(speed.shape),
    )


def _initial() -> InitialState:
    return InitialState(
        time_s=0.0,
        lat=float(LAT),
        lon=float(LON),
        height=HEIGHT,
        roll=0.01,
        pitch=-0.02,
        heading=float(HEADING),
        velocity_enu=_velocity_enu(),
        position_sigma_enu=np.full(3, 0.1),
        velocity_sigma_enu=np.full(3, 0.05),
        attitude_sigma=np.array([0.001, 0.001, 0.005]),
    )
