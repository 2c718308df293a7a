"""What a mission folder may contain: sections, keys, limits and columns; how a section is read.

The limits do not judge an instrument: they are so wide that only a wrong unit leaves them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

import numpy as np

from ssm_graph.data import N_BEAMS, Array
from ssm_graph.errors import ConfigError, nearest_hint
from ssm_graph.io.tables import TableSpec

FORMAT: Final = 1
TOML_NAME: Final = "mission.toml"
_SHOWN: Final = 60


class BodyAxes(Enum):
    """Axes of the body quantities in the tables and of the lever arms."""

    FRD = "FRD"
    FLU = "FLU"
    RFU = "RFU"


class Stamp(Enum):
    """The instant of the averaging interval that an IMU time stamp names."""

    START = "start"
    MIDDLE = "middle"
    END = "end"


@dataclass(frozen=True, slots=True)
class Key:
    """One key of a section: what it holds and the range in which a value can be right."""

    shape: tuple[int, ...] | None = ()
    """() for a number, (3,) for three numbers, None for text."""
    low: float = -math.inf
    high: float = math.inf
    positive: bool = False
    """The value must be above zero."""
    required: bool = True
    hint: str = ""
    """What to try when the value is out of range."""

    @property
    def wanted(self) -> str:
        """The expected value in words."""
        if self.shape is None:
            return "a text in quotes"
        words = {(): "a number", (3,): "a list of 3 numbers"}
        text = words.get(self.shape, " lists of ".join(str(n) for n in self.shape) + " numbers")
        if self.positive:
            text += f" above 0 and up to {self.high:g}" if self.high < math.inf else " above 0"
        elif math.isfinite(self.low) and math.isfinite(self.high):
            text += f" from {self.low:g} to {self.high:g}"
        elif math.isfinite(self.low):
            text += f" not below {self.low:g}"
        return text


def _sigma(high: float, hint: str = "", *, required: bool = True) -> Key:
    return Key(positive=True, high=high, required=required, hint=hint)


def _optional(low: float, high: float, hint: str) -> Key:
    return Key(low=low, high=high, required=False, hint=hint)


_FILE = Key(shape=None)
_LEVER_ARM = Key(shape=(3,), low=-100.0, high=100.0, hint="lever arms are in metres")
_LAT = Key(low=-90.0, high=90.0, hint="are latitude and longitude swapped?")
_LON = Key(low=-180.0, high=360.0, hint="longitude is in degrees")
_HEIGHT = Key(low=-12000.0, high=20000.0, hint="height is in metres above the ellipsoid, up")
_LATE = _optional(-10.0, 10.0, "the unit is seconds, not milliseconds")
_LATE_SIGMA = _optional(0.0, 10.0, "the unit is seconds, not milliseconds")
_ARM_SIGMA = _optional(0.0, 100.0, "the unit is metres")
_WALK = "the unit is that of the data sheet"

SECTIONS: Final[Mapping[str, Mapping[str, Key]]] = {
    "frames": {"body": Key(shape=None)},
    "origin": {"lat_deg": _LAT, "lon_deg": _LON, "height_m": _HEIGHT},
    "imu": {
        "file": _FILE,
        "stamp": Key(shape=None),
        "gyro_random_walk_deg_per_sqrt_h": _sigma(1e4, _WALK),
        "accel_random_walk_ug_per_sqrt_hz": _sigma(1e7, _WALK),
        "gyro_bias_deg_per_h": _sigma(1e6, _WALK),
        "accel_bias_ug": _sigma(1e7, _WALK),
        "gyro_bias_walk_deg_per_h_per_sqrt_h": _optional(0.0, 1e6, _WALK),
        "accel_bias_walk_ug_per_sqrt_h": _optional(0.0, 1e7, _WALK),
    },
    "dvl": {
        "file": _FILE,
        "beam_azimuth_deg": Key(shape=(N_BEAMS,), low=-360.0, high=360.0, required=False),
        "beam_janus_deg": Key(
            positive=True,
            high=45.0,
            required=False,
            hint="it is counted from the vertical; the horizontal angle is 90 minus this",
        ),
        "beam_vectors": Key(shape=(N_BEAMS, 3), required=False),
        "beam_noise_m_per_s": _sigma(5.0, "the unit is m/s, not mm/s"),
        "lever_arm_m": _LEVER_ARM,
        "mounting_rpy_deg": Key(shape=(3,), low=-360.0, high=360.0),
        "misalignment_sigma_deg": _optional(0.0, 45.0, "the unit is degrees"),
        "scale_sigma": _optional(0.0, 1.0, "1 percent is 0.01"),
        "time_offset_s": _LATE,
        "time_offset_sigma_s": _LATE_SIGMA,
        "scale_error": _optional(-0.5, 0.5, "1 percent is 0.01"),
        "scale_walk_per_sqrt_h": _optional(0.0, 1.0, "1 percent in an hour is 0.01"),
        "beam_scale_error": Key(
            shape=(N_BEAMS,), low=-0.5, high=0.5, required=False, hint="1 percent is 0.01"
        ),
        "beam_scale_sigma": _optional(0.0, 1.0, "1 percent is 0.01"),
        "lever_arm_sigma_m": _ARM_SIGMA,
    },
    "depth": {
        "file": _FILE,
        "noise_m": _sigma(1000.0),
        "lever_arm_m": _LEVER_ARM,
        "offset_m": _optional(-1000.0, 1000.0, "the unit is metres"),
        "offset_sigma_m": _optional(0.0, 1000.0, "the unit is metres"),
    },
    "gnss": {
        "file": _FILE,
        "lever_arm_m": _LEVER_ARM,
        "lever_arm_sigma_m": _ARM_SIGMA,
        "time_offset_s": _LATE,
        "time_offset_sigma_s": _LATE_SIGMA,
    },
    "initial": {
        "time_s": Key(),
        "lat_deg": _LAT,
        "lon_deg": _LON,
        "height_m": _HEIGHT,
        "vel_enu_m_per_s": Key(shape=(3,), low=-50.0, high=50.0, hint="the unit is m/s"),
        "roll_deg": Key(low=-180.0, high=180.0),
        "pitch_deg": Key(low=-90.0, high=90.0),
        "heading_deg": Key(low=-180.0, high=360.0, hint="heading is clockwise from north"),
        "position_sigma_m": Key(shape=(3,), positive=True, high=1e7),
        "velocity_sigma_m_per_s": Key(shape=(3,), positive=True, high=1e3),
        "attitude_sigma_deg": Key(shape=(3,), positive=True, high=360.0),
    },
    "reference": {"file": _FILE},
}
REQUIRED_SECTIONS: Final = ("frames", "imu", "dvl")
OPTIONAL_TABLES: Final = ("depth", "gnss", "reference")

TIME: Final = "time_s"
GYRO: Final = tuple(f"gyro_{axis}_rad_per_s" for axis in "xyz")
ACCEL: Final = tuple(f"accel_{axis}_m_per_s2" for axis in "xyz")
SPEED: Final = tuple(f"beam{beam}_m_per_s" for beam in range(1, N_BEAMS + 1))
SPEED_SIGMA: Final = tuple(f"beam{beam}_sigma_m_per_s" for beam in range(1, N_BEAMS + 1))
RANGE: Final = tuple(f"range{beam}_m" for beam in range(1, N_BEAMS + 1))
POSITION: Final = ("lat_deg", "lon_deg", "height_m")
POSITION_SIGMA: Final = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
VELOCITY: Final = ("vel_east_m_per_s", "vel_north_m_per_s", "vel_up_m_per_s")
ATTITUDE: Final = ("roll_deg", "pitch_deg", "heading_deg")

LARGEST_SPEED: Final = 30.0
"""m/s, of any single beam speed: a number beyond it is a code."""
DEEPEST_M: Final = 12000.0
_ABOVE_ZERO: Final = math.ulp(0.0)
LIMITS: Final[Mapping[str, tuple[float, float]]] = {
    **dict.fromkeys(GYRO, (-100.0, 100.0)),
    **dict.fromkeys(ACCEL, (-1e3, 1e3)),
    **dict.fromkeys(SPEED, (-LARGEST_SPEED, LARGEST_SPEED)),
    **dict.fromkeys(SPEED_SIGMA, (_ABOVE_ZERO, 1e3)),
    **dict.fromkeys(RANGE, (0.0, math.inf)),
    "depth_m": (-DEEPEST_M, DEEPEST_M),
    "lat_deg": (-90.0, 90.0),
    "lon_deg": (-180.0, 360.0),
    "height_m": (-DEEPEST_M, 20000.0),
    **dict.fromkeys(POSITION_SIGMA, (_ABOVE_ZERO, 1e7)),
    **dict.fromkeys(VELOCITY, (-100.0, 100.0)),
    **dict(zip(ATTITUDE, ((-360.0, 360.0), (-90.0, 90.0), (-360.0, 360.0)), strict=True)),
}
"""The least and the largest number that a column of a table can hold."""

TABLES: Final[Mapping[str, TableSpec]] = {
    "imu": TableSpec((TIME, *GYRO, *ACCEL)),
    "dvl": TableSpec((TIME, *SPEED), (*SPEED_SIGMA, *RANGE), frozenset(SPEED)),
    "depth": TableSpec((TIME, "depth_m")),
    "gnss": TableSpec((TIME, *POSITION, *POSITION_SIGMA)),
    "reference": TableSpec((TIME, *POSITION), (*VELOCITY, *ATTITUDE)),
}


@dataclass(frozen=True, slots=True)
class Settings:
    """The checked values of one section, in the units of the file."""

    section: str
    """Its name; empty for the keys that stand above all sections."""
    values: Mapping[str, Any]
    file: str = TOML_NAME

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def text(self, key: str) -> str:
        """Return a text."""
        return str(self.values[key])

    def number(self, key: str) -> float:
        """Return a number; an optional one that is not given is zero."""
        return float(self.values.get(key, 0.0))

    def array(self, key: str) -> Array:
        """Return a list as an array."""
        return np.array(self.values[key], dtype=np.float64)

    def fault(self, key: str, text: str) -> ConfigError:
        """Return an error that names file, section and key."""
        section = f"[{self.section}] " if self.section else ""
        return ConfigError(f"{self.file} {section}{key}: {text}")


def read_settings(
    section: str, raw: object, *, file: str = TOML_NAME, may_miss: frozenset[str] = frozenset()
) -> Settings:
    """Check every key of a section against :data:`SECTIONS`.

    Parameters
    ----------
    section : its name.
    raw : what the file holds under that name.
    file : the file's name in messages.
    may_miss : required keys that this file can do without.
    """
    if not isinstance(raw, dict):
        raise ConfigError(f"{file} [{section}]: expected a section, got {shown(raw)}")
    known = SECTIONS[section]
    for key in raw:
        if key not in known:
            missing = [name for name in known if name not in raw]
            hint = nearest_hint(key, missing or known)
            raise ConfigError(f"{file} [{section}] {key}: unknown key; {hint}")
    for name, key in known.items():
        if key.required and name not in raw and name not in may_miss:
            raise ConfigError(
                f"{file} [{section}] {name}: the key is missing; expected {key.wanted}"
            )
    settings = Settings(section, {name: _plain(value) for name, value in raw.items()}, file)
    for name, value in settings.values.items():
        problem = _problem(known[name], value)
        if problem:
            tail = f"; {known[name].hint}" if known[name].hint and problem == "range" else ""
            raise settings.fault(
                name, f"expected {known[name].wanted}, got {shown(raw[name])}{tail}"
            )
    return settings


def shown(value: object) -> str:
    """Return a value as it is shown in a message, cut where it is long."""
    try:
        text = repr(value)
    except ValueError:  # an integer of more than 4300 digits
        text = "a number of very many digits"
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def _plain(value: Any) -> Any:
    """Return ints, also those in lists, as floats; an int too large for a float becomes inf."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value) if abs(value) < 10**300 else math.inf
    return value


def _problem(key: Key, value: Any) -> str:
    """Return "" for a good value, "type" or "range" for a bad one."""
    if key.shape is None:
        return "" if isinstance(value, str) and value.strip() else "type"
    numbers = _numbers(value, key.shape)
    if numbers is None or not all(math.isfinite(number) for number in numbers):
        return "type"
    low_ok = all(x > 0.0 for x in numbers) if key.positive else min(numbers) >= key.low
    return "" if low_ok and max(numbers) <= key.high else "range"


def _numbers(value: Any, shape: tuple[int, ...]) -> list[float] | None:
    """Return the numbers in nested lists of just this shape, else None."""
    if not shape:
        return [value] if isinstance(value, float) else None
    if not isinstance(value, list) or len(value) != shape[0]:
        return None
    parts = [_numbers(item, shape[1:]) for item in value]
    if any(part is None for part in parts):
        return None
    return [number for part in parts if part is not None for number in part]
