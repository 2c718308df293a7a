"""What a mission folder may contain: sections, keys, limits and columns.

The limits do not judge an instrument: they are so wide that only a wrong unit leaves them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from typing import Final

from ssm_graph.io.mission_folder.aid_keys import AID_LIMITS, AID_SECTIONS, AID_TABLES
from ssm_graph.io.tables.settings import (
    FILE_KEY,
    LEVER_ARM_KEY,
    PLACE_KEYS,
    Key,
    optional_key,
    sigma_key,
)
from ssm_graph.io.tables.table import POSITION, POSITION_SIGMA, TIME, TableSpec
from ssm_graph.sensors.dvl import N_BEAMS
from ssm_graph.sensors.limits import DEEPEST_M, LARGEST_SPEED, LON_RANGE_DEG

FORMAT: Final = 1


class Stamp(Enum):
    """The instant of the averaging interval that an IMU time stamp names."""

    START = "start"
    MIDDLE = "middle"
    END = "end"


_LATE = optional_key(-10.0, 10.0, "the unit is seconds, not milliseconds")
_LATE_SIGMA = optional_key(0.0, 10.0, "the unit is seconds, not milliseconds")
_ARM_SIGMA = optional_key(0.0, 100.0, "the unit is metres")
_DRIFT: Final[Mapping[str, Key]] = {
    "drift_correlation_s": sigma_key(1e8, "the unit is seconds", required=False),
    "drift_white_share": sigma_key(1.0, "all of the noise is 1", required=False),
}
_WALK = "the unit is that of the data sheet"

SECTIONS: Final[Mapping[str, Mapping[str, Key]]] = {
    "frames": {"body": Key(shape=None)},
    "origin": PLACE_KEYS,
    "imu": {
        "file": FILE_KEY,
        "stamp": Key(shape=None),
        "gyro_random_walk_deg_per_sqrt_h": sigma_key(1e4, _WALK),
        "accel_random_walk_ug_per_sqrt_hz": sigma_key(1e7, _WALK),
        "gyro_bias_deg_per_h": sigma_key(1e6, _WALK),
        "accel_bias_ug": sigma_key(1e7, _WALK),
        "gyro_bias_walk_deg_per_h_per_sqrt_h": optional_key(0.0, 1e6, _WALK),
        "accel_bias_walk_ug_per_sqrt_h": optional_key(0.0, 1e7, _WALK),
    },
    "dvl": {
        "file": FILE_KEY,
        "beam_azimuth_deg": Key(shape=(N_BEAMS,), low=-360.0, high=360.0, required=False),
        "beam_janus_deg": Key(
            positive=True,
            high=45.0,
            required=False,
            hint="it is counted from the vertical; the horizontal angle is 90 minus this",
        ),
        "beam_vectors": Key(shape=(N_BEAMS, 3), required=False),
        "beam_noise_m_per_s": sigma_key(5.0, "the unit is m/s, not mm/s"),
        "lever_arm_m": LEVER_ARM_KEY,
        "mounting_rpy_deg": Key(shape=(3,), low=-360.0, high=360.0),
        "misalignment_sigma_deg": optional_key(0.0, 45.0, "the unit is degrees"),
        "scale_sigma": optional_key(0.0, 1.0, "1 percent is 0.01"),
        "time_offset_s": _LATE,
        "time_offset_sigma_s": _LATE_SIGMA,
        "scale_error": optional_key(-0.5, 0.5, "1 percent is 0.01"),
        "scale_walk_per_sqrt_h": optional_key(0.0, 1.0, "1 percent in an hour is 0.01"),
        "beam_scale_error": Key(
            shape=(N_BEAMS,), low=-0.5, high=0.5, required=False, hint="1 percent is 0.01"
        ),
        "beam_scale_sigma": optional_key(0.0, 1.0, "1 percent is 0.01"),
        "lever_arm_sigma_m": _ARM_SIGMA,
        "water_noise_m_per_s": sigma_key(5.0, "the unit is m/s, not mm/s", required=False),
        "drift_sigma_m_per_s": optional_key(0.0, 5.0, "the unit is m/s, not mm/s"),
        **_DRIFT,
    },
    "current": {
        "sigma_m_per_s": sigma_key(20.0, "the unit is m/s", required=False),
        "correlation_s": sigma_key(1e8, "the unit is seconds", required=False),
        "vertical_sigma_m_per_s": optional_key(0.0, 20.0, "the unit is m/s"),
    },
    "depth": {
        "file": FILE_KEY,
        "noise_m": sigma_key(1000.0),
        "lever_arm_m": LEVER_ARM_KEY,
        "offset_m": optional_key(-1000.0, 1000.0, "the unit is metres"),
        "offset_sigma_m": optional_key(0.0, 1000.0, "the unit is metres"),
    },
    "gnss": {
        "file": FILE_KEY,
        "lever_arm_m": LEVER_ARM_KEY,
        "lever_arm_sigma_m": _ARM_SIGMA,
        "time_offset_s": _LATE,
        "time_offset_sigma_s": _LATE_SIGMA,
        "drift_sigma_m": optional_key(0.0, 1000.0, "the unit is metres"),
        **_DRIFT,
    },
    **AID_SECTIONS,
    "initial": {
        "time_s": Key(),
        **PLACE_KEYS,
        "vel_enu_m_per_s": Key(shape=(3,), low=-50.0, high=50.0, hint="the unit is m/s"),
        "roll_deg": Key(low=-180.0, high=180.0),
        "pitch_deg": Key(low=-90.0, high=90.0),
        "heading_deg": Key(low=-180.0, high=360.0, hint="heading is clockwise from north"),
        "position_sigma_m": Key(shape=(3,), positive=True, high=1e7),
        "velocity_sigma_m_per_s": Key(shape=(3,), positive=True, high=1e3),
        "attitude_sigma_deg": Key(shape=(3,), positive=True, high=360.0),
    },
    "reference": {"file": FILE_KEY},
}
REQUIRED_SECTIONS: Final = ("frames", "imu", "dvl")
OPTIONAL_TABLES: Final = ("depth", "gnss", *AID_TABLES, "reference")

GYRO: Final = tuple(f"gyro_{axis}_rad_per_s" for axis in "xyz")
ACCEL: Final = tuple(f"accel_{axis}_m_per_s2" for axis in "xyz")
SPEED: Final = tuple(f"beam{beam}_m_per_s" for beam in range(1, N_BEAMS + 1))
SPEED_SIGMA: Final = tuple(f"beam{beam}_sigma_m_per_s" for beam in range(1, N_BEAMS + 1))
RANGE: Final = tuple(f"range{beam}_m" for beam in range(1, N_BEAMS + 1))
WATER_TRACK: Final = "water_track"
VELOCITY: Final = ("vel_east_m_per_s", "vel_north_m_per_s", "vel_up_m_per_s")
ATTITUDE: Final = ("roll_deg", "pitch_deg", "heading_deg")

_ABOVE_ZERO: Final = math.ulp(0.0)
LIMITS: Final[Mapping[str, tuple[float, float]]] = {
    **dict.fromkeys(GYRO, (-100.0, 100.0)),
    **dict.fromkeys(ACCEL, (-1e3, 1e3)),
    **dict.fromkeys(SPEED, (-LARGEST_SPEED, LARGEST_SPEED)),
    **dict.fromkeys(SPEED_SIGMA, (_ABOVE_ZERO, 1e3)),
    **dict.fromkeys(RANGE, (0.0, math.inf)),
    WATER_TRACK: (0.0, 1.0),
    "depth_m": (-DEEPEST_M, DEEPEST_M),
    "lat_deg": (-90.0, 90.0),
    "lon_deg": LON_RANGE_DEG,
    "height_m": (-DEEPEST_M, 20000.0),
    **dict.fromkeys(POSITION_SIGMA, (_ABOVE_ZERO, 1e7)),
    **dict.fromkeys(VELOCITY, (-100.0, 100.0)),
    **dict(zip(ATTITUDE, ((-360.0, 360.0), (-90.0, 90.0), (-360.0, 360.0)), strict=True)),
    **AID_LIMITS,
}
"""The least and the largest number that a column of a table can hold."""

TABLES: Final[Mapping[str, TableSpec]] = {
    "imu": TableSpec((TIME, *GYRO, *ACCEL)),
    "dvl": TableSpec((TIME, *SPEED), (*SPEED_SIGMA, *RANGE, WATER_TRACK), frozenset(SPEED)),
    "depth": TableSpec((TIME, "depth_m")),
    "gnss": TableSpec((TIME, *POSITION, *POSITION_SIGMA)),
    **AID_TABLES,
    "reference": TableSpec((TIME, *POSITION), (*VELOCITY, *ATTITUDE)),
}
