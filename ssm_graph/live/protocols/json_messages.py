"""Messages and answers as JSON, one object a line, both ways: ``docs/live-protocols.md``."""

from __future__ import annotations

import json
import math
from decimal import Context, Decimal
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import nearest_hint
from ssm_graph.base.frames import BodyAxes, turned
from ssm_graph.base.units import DEG_PER_H, DEGREE, MICRO_G
from ssm_graph.live.protocols.decoder import (
    Decoder,
    RefusedError,
    flag,
    number,
    parse_object,
    reject_unknown,
    require,
    shown,
)
from ssm_graph.live.protocols.framing import MAX_LENGTH, LineFramer
from ssm_graph.mission.navigation import Navigation
from ssm_graph.sensors.dvl import MOST_BEAMS
from ssm_graph.sensors.instrument import Column
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.registry import BY_MESSAGE, BY_SECTION, INSTRUMENTS

PLACE: Final = "json"
_EXACT = Context(prec=40)
_PI = Decimal("3.141592653589793238462643383279502884197169")
_RAD_PER_DEG = _EXACT.divide(_PI, Decimal(180))
_DIGITS = Context(prec=24)
"""As many digits as bring every angle back bit for bit."""
_COLUMNS: Final = {
    one.section: tuple((column.key, column) for column in one.columns if column.is_live)
    for one in INSTRUMENTS
    if one.message is not None
}
KEYS: Final = {
    kind: ("type", "time_s", *(key for key, _ in columns)) for kind, columns in _COLUMNS.items()
}
"""Type of a message to its keys."""
_REQUIRED: Final = {
    kind: ("time_s", *(key for key, column in columns if not column.optional))
    for kind, columns in _COLUMNS.items()
}
_HAS_UNITS: Final = {
    kind: any(column.unit != 1.0 for _, column in columns) for kind, columns in _COLUMNS.items()
}


class JsonDecoder(Decoder):
    """JSON lines to messages.

    Parameters
    ----------
    axes : body axes of the vectors as they come.
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
    columns = _COLUMNS[kind]
    for key in _REQUIRED[kind]:
        if key not in fields:
            require(fields, key)
    if _HAS_UNITS[kind]:  # all digits of the angles count
        fields = parse_object(line, parse_float=Decimal)
    try:
        time_s = number(fields["time_s"], key="time_s")
        given = {c.told_as: _read(fields[key], key, c, axes) for key, c in columns if key in fields}
    except RefusedError as error:
        raise RefusedError(f"{kind}: {error}") from None
    make = BY_SECTION[kind].message
    assert make is not None
    return make(time_s, **given)


def encode_message(message: Message, *, axes: BodyAxes = BodyAxes.FRD) -> bytes:
    """Return one line that :class:`JsonDecoder` with the same axes turns into an equal message.

    A missing beam is null; a nominal sigma of a beam too. Numbers are written with all their
    digits, angles with 24.
    """
    kind = BY_MESSAGE[type(message)].section
    cells: dict[str, Any] = {"type": kind, "time_s": message.time_s}
    for key, column in _COLUMNS[kind]:
        value = getattr(message, column.told_as)
        is_silent = value is None or value is False or value != value  # NaN
        if column.optional and is_silent:
            continue
        if column.is_body:
            value = turned(value, axes)
        if column.unit != 1.0:
            exact = _exact(column.unit)
            parts = value if column.over else (value,)
            digits = tuple(_DIGITS.divide(Decimal(float(part)), exact) for part in parts)
            value = digits if column.over else digits[0]
        cells[key] = value
    return _line(**cells)


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
        "protection_m": navigation.protection_m,
        "protection_up_m": navigation.protection_up_m,
        "witness_m": navigation.witness_m,
        "witness_up_m": navigation.witness_up_m,
        "witness_s": navigation.witness_s,
        **_spread("sigma_vel_{}_m_per_s", enu, navigation.velocity_sigma_enu),
        **_spread("sigma_{}_deg", rph, np.degrees(navigation.attitude_sigma)),
        **_spread("gyro_bias_{}_deg_per_h", xyz, navigation.gyro_bias / DEG_PER_H),
        **_spread("accel_bias_{}_ug", xyz, navigation.accel_bias / MICRO_G),
        "beam_weights": navigation.beam_weights.tolist(),
        "health": navigation.health.name,
        "reason": navigation.reason,
        "confidence": navigation.confidence,
        "bottom_lock": bool(navigation.bottom_lock),
        "since_aid_s": navigation.since_aid_s,
        "latency_s": navigation.latency_s,
        "innovation_ratios": dict(navigation.innovation_ratios),
    }
    return {key: _finite(value) for key, value in fields.items()}


def encode_navigation(navigation: Navigation, *, set_by_s: float = 0.0) -> bytes:
    """Return :func:`navigation_fields` as one line of JSON, stamped by the vehicle's clock.

    That is ``set_by_s`` ahead of the time of the run, which the line says: times of two answers
    can be told apart from a clock that was set between them.
    """
    fields = navigation_fields(navigation)
    fields |= {"time_s": navigation.time_s + set_by_s, "clock_set_by_s": set_by_s}
    return (json.dumps(fields, allow_nan=False) + "\n").encode("ascii")


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
    if isinstance(value, tuple) and isinstance(value[0], Decimal):
        return f"[{', '.join(map(str, value))}]"
    plain = list(map(float, value)) if isinstance(value, tuple) else value
    return json.dumps(_finite(plain), allow_nan=False)


def _exact(unit: float) -> Decimal:
    return _RAD_PER_DEG if unit == DEGREE else Decimal(repr(unit))


def _read(value: Any, key: str, column: Column, axes: BodyAxes) -> Any:
    """Return what a message says of one column, in SI units and axes forward-right-down."""
    if column.is_flag:
        return flag({key: value}, key)
    if not column.over and not column.is_many:
        return _numbers([value], key, column)[0]
    count = len(column.over)
    numbers = _numbers(
        _list(value, (1, MOST_BEAMS) if column.is_many else (count, count), key=key), key, column
    )
    return turned((numbers[0], numbers[1], numbers[2]), axes) if column.is_body else numbers


def _numbers(items: list[Any], key: str, column: Column) -> tuple[float, ...]:
    """Return numbers in SI units; what no such unit or no sigma can be is refused.

    Whether an instrument can mean a number that can be is for the intake to say.
    """
    missing = None if column.is_many else items  # which no item is
    if column.unit != 1.0:
        return tuple([math.nan if x is missing else _converted(x, key, column) for x in items])
    low = max(column.limits[0], 0.0) or -math.inf
    return tuple([math.nan if x is missing else number(x, key=key, low=low) for x in items])


def _converted(value: Any, key: str, column: Column) -> float:
    low, high = column.limits
    number(value, key=key, low=low, high=high)
    exact = Decimal(value) if isinstance(value, int) else value
    if column.wraps and exact > 180:
        exact = _EXACT.subtract(exact, Decimal(360))
    return float(_EXACT.multiply(exact, _exact(column.unit)))


def _list(value: Any, counts: tuple[int, int], *, key: str) -> list[Any]:
    least, most = counts
    if not isinstance(value, list) or not least <= len(value) <= most:
        words = f"{least} to {most}" if least < most else str(most)
        raise RefusedError(f"{key}: expected a list of {words} numbers, got {shown(str(value))}")
    return value
