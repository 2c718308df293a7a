"""Messages and answers as JSON, one object a line, both ways: ``docs/live-protocols.md``."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from decimal import Context, Decimal
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import nearest_hint
from ssm_graph.base.frames import BodyAxes, turned
from ssm_graph.base.frozen import Vector
from ssm_graph.live.protocols.decoder import (
    RefusedError,
    flag,
    number,
    parse_object,
    reject_unknown,
    require,
    shown,
)
from ssm_graph.live.protocols.framed_decoder import FramedDecoder
from ssm_graph.live.protocols.framing import MAX_LENGTH, LineFramer
from ssm_graph.mission.navigation import Navigation
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import N_BEAMS, Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.limits import LON_RANGE_DEG
from ssm_graph.sensors.messages import Message

PLACE: Final = "json"
_EXACT = Context(prec=40)
_PI = Decimal("3.141592653589793238462643383279502884197169")
_RAD_PER_DEG = _EXACT.divide(_PI, Decimal(180))
_DIGITS = Context(prec=24)
"""As many digits as bring every angle back bit for bit."""
_DEG_PER_H = math.radians(1.0) / 3600.0
_MICRO_G = 9.80665e-6
_Beams = tuple[float, float, float, float]


KEYS: Final[dict[str, tuple[str, ...]]] = {
    "imu": ("type", "time_s", "gyro_rad_per_s", "accel_m_per_s2"),
    "dvl": ("type", "time_s", "beam_m_per_s", "sigma_m_per_s", "water_track"),
    "depth": ("type", "time_s", "depth_m"),
    "gnss": ("type", "time_s", "lat_deg", "lon_deg", "height_m", "sigma_m"),
}
"""Type of a message to its keys."""
_OPTIONAL: Final = frozenset({"sigma_m_per_s", "water_track"})


class JsonDecoder(FramedDecoder):
    """JSON lines to messages.

    Parameters
    ----------
    axes : body axes of the inertial vectors as they come.
    max_length : of a line, bytes.
    """

    def __init__(self, *, axes: BodyAxes = BodyAxes.FRD, max_length: int = MAX_LENGTH) -> None:
        super().__init__(PLACE)
        self._axes = axes
        self._framer = LineFramer(self._refuse, max_length=max_length)

    def _decode(self, text: str, arrival_s: float) -> list[Message]:  # noqa: ARG002
        """Messages carry their own time."""
        return [decode_message(text, axes=self._axes)]


def decode_message(line: str, *, axes: BodyAxes = BodyAxes.FRD) -> Message:
    """Return the message of one line; raise :class:`RefusedError` for all that is none."""
    fields = parse_object(line)
    kind = require(fields, "type")
    if not isinstance(kind, str) or kind not in KEYS:
        hint = nearest_hint(kind[:20], KEYS) if isinstance(kind, str) else "it is a text"
        raise RefusedError(f"unknown type {shown(kind)}; {hint}")
    reject_unknown(fields, KEYS[kind])
    for key in KEYS[kind]:
        if key not in _OPTIONAL:
            require(fields, key)
    if kind == "gnss":  # all digits of the angles count
        fields = parse_object(line, parse_float=Decimal)
    try:
        return _READERS[kind](fields, axes)
    except RefusedError as error:
        raise RefusedError(f"{kind}: {error}") from None


def encode_message(message: Message, *, axes: BodyAxes = BodyAxes.FRD) -> bytes:
    """Return one line that :class:`JsonDecoder` with the same axes turns into an equal message.

    A missing beam is null; a nominal sigma of a beam too. Numbers are written with all their
    digits, angles with 24.
    """
    if isinstance(message, ImuSample):
        gyro, accel = (turned(x, axes) for x in (message.gyro_b, message.accel_b))
        return _line(type="imu", time_s=message.time_s, gyro_rad_per_s=gyro, accel_m_per_s2=accel)
    if isinstance(message, Ping):
        sigma = {} if message.sigma is None else {"sigma_m_per_s": message.sigma}
        water = {"water_track": True} if message.is_water else {}
        return _line(
            type="dvl", time_s=message.time_s, beam_m_per_s=message.speed, **sigma, **water
        )
    if isinstance(message, DepthReading):
        return _line(type="depth", time_s=message.time_s, depth_m=message.depth)
    return _line(
        type="gnss",
        time_s=message.time_s,
        lat_deg=_degrees(message.lat),
        lon_deg=_degrees(message.lon),
        height_m=message.height,
        sigma_m=message.sigma_enu,
    )


def navigation_fields(navigation: Navigation) -> dict[str, Any]:
    """Return an answer with the units in the keys, in the terms of ``trajectory.csv``.

    What is not finite is None: position and sigmas before the first answer, the weight of a missing
    beam, the time since an aid before the first.
    """
    angles = np.degrees(navigation.roll_pitch_heading)
    angles[2] %= 360.0
    enu, rph, xyz = ("east", "north", "up"), ("roll", "pitch", "heading"), ("x", "y", "z")
    fields: dict[str, Any] = {
        "type": "navigation",
        "time_s": navigation.time_s,
        "lat_deg": math.degrees(navigation.lat),
        "lon_deg": math.degrees(navigation.lon),
        "height_m": navigation.height,
        **_spread("vel_{}_m_per_s", enu, navigation.velocity_enu),
        **_spread("{}_deg", rph, angles),
        **_spread("sigma_{}_m", enu, navigation.position_sigma_enu),
        **_spread("sigma_vel_{}_m_per_s", enu, navigation.velocity_sigma_enu),
        **_spread("sigma_{}_deg", rph, np.degrees(navigation.attitude_sigma)),
        **_spread("gyro_bias_{}_deg_per_h", xyz, navigation.gyro_bias / _DEG_PER_H),
        **_spread("accel_bias_{}_ug", xyz, navigation.accel_bias / _MICRO_G),
        "beam_weights": navigation.beam_weights.tolist(),
        "health": navigation.health.name,
        "reason": navigation.reason,
        "confidence": navigation.confidence,
        "bottom_lock": bool(navigation.bottom_lock),
        "since_aid_s": navigation.since_aid_s,
        "latency_s": navigation.latency_s,
    }
    return {key: _finite(value) for key, value in fields.items()}


def encode_navigation(navigation: Navigation) -> bytes:
    """Return :func:`navigation_fields` as one line of JSON."""
    return (json.dumps(navigation_fields(navigation), allow_nan=False) + "\n").encode("ascii")


def _spread(pattern: str, names: tuple[str, ...], values: Any) -> dict[str, float]:
    return {pattern.format(name): float(x) for name, x in zip(names, values, strict=True)}


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _line(**fields: str | float | Decimal | tuple[float, ...]) -> bytes:
    """Return a line of JSON that may hold decimals."""
    cells = [f'"{key}": {_cell(value)}' for key, value in fields.items()]
    return f"{{{', '.join(cells)}}}\n".encode("ascii")


def _cell(value: str | float | Decimal | tuple[float, ...]) -> str:
    if isinstance(value, Decimal):
        return str(value)
    plain = list(map(float, value)) if isinstance(value, tuple) else value
    return json.dumps(_finite(plain), allow_nan=False)


def _degrees(angle: float) -> Decimal:
    return _DIGITS.divide(Decimal(float(angle)), _RAD_PER_DEG)


def _radians(value: Any, *, key: str, range_deg: tuple[float, float]) -> float:
    """Return an angle in [-pi, pi]."""
    number(value, key=key, low=range_deg[0], high=range_deg[1])
    exact = Decimal(value) if isinstance(value, int) else value
    wrapped = _EXACT.subtract(exact, Decimal(360)) if exact > 180 else exact
    return float(_EXACT.multiply(wrapped, _RAD_PER_DEG))


def _list(value: Any, count: int, *, key: str) -> list[Any]:
    if not isinstance(value, list) or len(value) != count:
        raise RefusedError(f"{key}: expected a list of {count} numbers, got {shown(str(value))}")
    return value


def _vector(fields: dict[str, Any], key: str, *, low: float = -math.inf) -> Vector:
    x, y, z = (number(item, key=key, low=low) for item in _list(fields[key], 3, key=key))
    return x, y, z


def _beams(fields: dict[str, Any], key: str, *, low: float = -math.inf) -> _Beams:
    a, b, c, d = (
        math.nan if item is None else number(item, key=key, low=low)
        for item in _list(fields[key], N_BEAMS, key=key)
    )
    return a, b, c, d


def _time(fields: dict[str, Any]) -> float:
    return number(fields["time_s"], key="time_s")


def _imu(fields: dict[str, Any], axes: BodyAxes) -> Message:
    gyro, accel = _vector(fields, "gyro_rad_per_s"), _vector(fields, "accel_m_per_s2")
    return ImuSample(_time(fields), turned(gyro, axes), turned(accel, axes))


def _dvl(fields: dict[str, Any], _: BodyAxes) -> Message:
    has_sigma = "sigma_m_per_s" in fields
    sigma = _beams(fields, "sigma_m_per_s", low=_SMALLEST_SIGMA) if has_sigma else None
    is_water = "water_track" in fields and flag(fields, "water_track")
    return Ping(_time(fields), _beams(fields, "beam_m_per_s"), sigma, is_water=is_water)


def _depth(fields: dict[str, Any], _: BodyAxes) -> Message:
    return DepthReading(_time(fields), number(fields["depth_m"], key="depth_m"))


def _gnss(fields: dict[str, Any], _: BodyAxes) -> Message:
    return Fix(
        _time(fields),
        lat=_radians(fields["lat_deg"], key="lat_deg", range_deg=(-90.0, 90.0)),
        lon=_radians(fields["lon_deg"], key="lon_deg", range_deg=LON_RANGE_DEG),
        height=number(fields["height_m"], key="height_m"),
        sigma_enu=_vector(fields, "sigma_m", low=_SMALLEST_SIGMA),
    )


_SMALLEST_SIGMA = 1e-9
_READERS: Final[dict[str, Callable[[dict[str, Any], BodyAxes], Message]]] = {
    "imu": _imu,
    "dvl": _dvl,
    "depth": _depth,
    "gnss": _gnss,
}
