"""Telemetry logs of ground stations (.tlog): the same columns as a dataflash log, by pymavlink.

A record is eight bytes of Unix microseconds, most significant first, when it came, and a MAVLink
frame. Messages carry the vehicle's time since its start; each is put on the ground station's clock
by the least delay that any of them had, so that the jitter of the radio is left out.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import MissingExtraError
from ssm_graph.base.progress import teller
from ssm_graph.base.units import STANDARD_GRAVITY
from ssm_graph.io.ardupilot.dataflash import Columns

_HEADS: Final = (0xFD, 0xFE)
_LATEST_US: Final = 4_000_000_000_000_000
"""Unix microseconds of 2096."""
_EARLIEST_US: Final = 1_000_000_000_000_000
_MG: Final = 1e-3 * STANDARD_GRAVITY

_Read = Callable[[Any], tuple[float, ...]]
MESSAGES: Final[Mapping[str, tuple[str, tuple[str, ...], _Read]]] = {
    # By MAVLink's name: ours, the fields beside TimeUS, and how they are read.
    "HIGHRES_IMU": (
        "IMU",
        ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"),
        lambda m: (m.xgyro, m.ygyro, m.zgyro, m.xacc, m.yacc, m.zacc),
    ),
    "RAW_IMU": ("IMU", ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"), lambda m: _milli(m)),
    "SCALED_IMU": ("IMU", ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"), lambda m: _milli(m)),
    "SCALED_PRESSURE": ("BARO", ("Press",), lambda m: (100.0 * m.press_abs,)),
    "SCALED_PRESSURE2": ("BAR2", ("Press",), lambda m: (100.0 * m.press_abs,)),
    "GPS_RAW_INT": (
        "GPS",
        ("Status", "Lat", "Lng", "Alt", "HAcc", "VAcc", "HDop"),
        lambda m: (
            *(m.fix_type, 1e-7 * m.lat, 1e-7 * m.lon, 1e-3 * m.alt),
            *(1e-3 * getattr(m, "h_acc", 0), 1e-3 * getattr(m, "v_acc", 0), 0.01 * m.eph),
        ),
    ),
    "VISION_POSITION_DELTA": (
        "VISO",
        ("dt", "PosDX", "PosDY", "PosDZ", "conf"),
        lambda m: (1e-6 * m.time_delta_usec, *m.position_delta, m.confidence),
    ),
}


def is_telemetry(head: bytes) -> bool:
    """Return whether eight bytes of a time stand before a frame."""
    if len(head) < 9 or head[8] not in _HEADS:
        return False
    (stamp,) = struct.unpack_from(">Q", head)
    return bool(_EARLIEST_US < stamp < _LATEST_US)


def read_telemetry(data: bytes) -> tuple[dict[str, Columns], int]:
    """Return the messages by name, times in Unix microseconds, and how many bytes were skipped.

    Of several IMU messages the one with most rows is taken.

    Raises :class:`MissingExtraError` where pymavlink is not installed.
    """
    try:
        dialect = import_module("pymavlink.dialects.v20.ardupilotmega")
    except ImportError as error:
        raise MissingExtraError(
            "pymavlink", extra="ardupilot", purpose="reading telemetry logs"
        ) from error
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    rows: dict[str, list[tuple[float, ...]]] = {}
    at, skipped, tell = 0, 0, teller(len(data))
    while at + 9 <= len(data):
        size = _frame_size(data, at + 8)
        tell(at)
        message = None
        if is_telemetry(data[at : at + 9]) and size and at + 8 + size <= len(data):
            try:
                message = parser.decode(bytearray(data[at + 8 : at + 8 + size]))
            except Exception:  # of many kinds, for a frame that is none
                message = None
        if message is None:
            at, skipped = at + 1, skipped + 1
            continue
        kind = message.get_type()
        if kind in MESSAGES:
            stamp = float(struct.unpack_from(">Q", data, at)[0])
            rows.setdefault(kind, []).append((stamp, _own_us(message), *MESSAGES[kind][2](message)))
        at += 8 + size
    skipped += len(data) - at
    return _as_columns(rows), skipped


def _frame_size(data: bytes, at: int) -> int:
    """Return the length of a frame by its head, 0 for none."""
    if data[at] == 0xFE and at + 2 <= len(data):
        return data[at + 1] + 8
    if data[at] == 0xFD and at + 3 <= len(data):
        return data[at + 1] + 12 + (13 if data[at + 2] & 1 else 0)
    return 0


def _own_us(message: Any) -> float:
    """Return the vehicle's time since its start, microseconds; NaN where it tells none."""
    if message.get_type() == "VISION_POSITION_DELTA":  # of the sender, on another clock
        return float("nan")
    boot_ms = getattr(message, "time_boot_ms", None)
    return 1e3 * boot_ms if boot_ms is not None else float(message.time_usec)


def _as_columns(rows: Mapping[str, list[tuple[float, ...]]]) -> dict[str, Columns]:
    tables = {kind: np.array(of, np.float64) for kind, of in rows.items()}
    both = [t[:, 0] - t[:, 1] for t in tables.values() if np.isfinite(t[:, 1]).all()]
    boot_us = float(min(part.min() for part in both)) if both else 0.0
    found: dict[str, Columns] = {}
    for kind, table in sorted(tables.items(), key=lambda item: len(item[1])):
        name, fields, _ = MESSAGES[kind]
        known = np.isfinite(table[:, 1])
        columns: dict[str, NDArray[Any]] = {
            "TimeUS": np.where(known, table[:, 1] + boot_us, table[:, 0])
        }
        columns |= {field: table[:, 2 + i] for i, field in enumerate(fields)}
        found[name] = columns  # the largest of one name comes last
    return found


def _milli(message: Any) -> tuple[float, ...]:
    """Return gyros and accelerometers of mrad/s and mg as rad/s and m/s^2."""
    gyro = (message.xgyro, message.ygyro, message.zgyro)
    accel = (message.xacc, message.yacc, message.zacc)
    return (*(1e-3 * g for g in gyro), *(_MG * a for a in accel))
