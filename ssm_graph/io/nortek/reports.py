"""What Nortek's packets say of speeds along beams, headings and inertial readings.

* Kinds 1B and 1D, a DVL off the ground and off the water: beams as floats with validity, figure of
  merit (an estimate of the standard deviation, m/s) and the velocity made of them.
* Kind 17, bottom track of an ADCP: beams as integers with a scale; whether they are beams, the
  configuration tells.
* Kinds B4 and BE, the three beams of a Nucleus; 82 its inertial unit, D2 its heading.

Layouts: Nortek, "Integrators Guide AD2CP" (as mhkit.dolfyn and a public driver of DVLs read it) and
its driver of the Nucleus.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.nortek.packets import NUCLEUS_FAMILY, Packet

DVL_BOTTOM, DVL_WATER, ADCP_BOTTOM = 0x1B, 0x1D, 0x17
NUCLEUS_BOTTOM, NUCLEUS_WATER, NUCLEUS_IMU, NUCLEUS_AHRS = 0xB4, 0xBE, 0x82, 0xD2
_DVL_HEAD: Final = 36
_ADCP_LEAST: Final = 78
_NUCLEUS_HEAD: Final = 36
_N_DVL, _N_NUCLEUS = 4, 3
_BEAM_COORDINATES: Final = 2
_BAD: Final = (-32768, -(2**31))
_WORST: Final = 9.0
"""m/s: larger figures of merit mean none."""


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """One measurement of speeds."""

    time_s: float
    """Unix s by the instrument's clock; of a Nucleus without a date, s since its start."""
    speed: Array
    """(B,) m/s as written, NaN where it is not valid."""
    sigma: Array
    """(B,) figures of merit, m/s, NaN where there is none."""
    distance: Array
    """(B,) m along each beam, NaN where there is none."""
    velocity: Array
    """(3,) x, y, z of the instrument as it made them, NaN where it did not."""
    is_water: bool = False
    heading: float = math.nan
    """rad, where the packet has a valid compass."""


def report_of(packet: Packet) -> Report | None:
    """Return what a packet says of speeds; None for another kind, or one that is too short.

    Raises :class:`ValueError` for bottom track that is not in beam coordinates.
    """
    if packet.family == NUCLEUS_FAMILY:
        if packet.kind in (NUCLEUS_BOTTOM, NUCLEUS_WATER):
            return _nucleus(packet)
        return None
    if packet.kind in (DVL_BOTTOM, DVL_WATER):
        return _dvl(packet)
    return _adcp(packet.data) if packet.kind == ADCP_BOTTOM else None


def _when(data: memoryview, at: int) -> float | None:
    """Return Unix seconds of a clock: years since 1900, months from 0; None for no date."""
    year, month, day, hour, minute, second, of_100_us = struct.unpack_from("<6BH", data, at)
    try:
        date = datetime(1900 + year, 1 + month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    return float(date.timestamp() + 1e-4 * of_100_us)


def _where(valid: int, first: int, values: Array) -> Array:
    """Return values (n,) with NaN where their bit, from ``first`` on, is not set."""
    bits = np.array([bool(valid >> (first + i) & 1) for i in range(len(values))])
    return np.where(bits & np.isfinite(values), values, np.nan)


def _dvl(packet: Packet) -> Report | None:
    data = packet.data
    n = _N_DVL
    if len(data) < _DVL_HEAD + 4 * 7 * n:
        return None
    time_s = _when(data, 6)
    if time_s is None:
        return None
    (valid,) = struct.unpack_from("<I", data, 20)
    numbers = np.frombuffer(data, "<f4", count=7 * n, offset=_DVL_HEAD).astype(float)
    speed, distance, merit = (numbers[i * n : (i + 1) * n] for i in range(3))
    x, y, z1, z2 = _where(valid, 12, numbers[6 * n : 7 * n])
    merit = _where(valid, 8, merit)
    return Report(
        time_s=time_s,
        speed=_where(valid, 0, speed),
        sigma=np.where((merit > 0.0) & (merit < _WORST), merit, np.nan),
        distance=_where(valid, 4, distance),
        velocity=np.array([x, y, 0.5 * (z1 + z2)]),
        is_water=packet.kind == DVL_WATER,
    )


def _adcp(data: memoryview) -> Report | None:
    if len(data) < _ADCP_LEAST:
        return None
    start = data[1]
    (config,), (beams,) = struct.unpack_from("<H", data, 2), struct.unpack_from("<H", data, 30)
    n_beams, coordinates = beams >> 12, beams >> 10 & 3
    has_speed, has_distance = bool(config >> 5 & 1), bool(config >> 8 & 1)
    time_s = _when(data, 8)
    if time_s is None or not has_speed or not 1 <= n_beams <= 8:
        return None
    if len(data) < start + 4 * n_beams * (1 + has_distance):
        return None
    if coordinates != _BEAM_COORDINATES:
        raise ValueError("bottom track is in coordinates of the instrument or the Earth")
    scale = 10.0 ** struct.unpack_from("<b", data, 60)[0]
    raw = np.array(struct.unpack_from(f"<{n_beams}i", data, start))
    speed = np.where(np.isin(raw, _BAD), np.nan, raw * scale)
    distance = np.full(n_beams, np.nan)
    if has_distance:
        millimetres = np.array(struct.unpack_from(f"<{n_beams}i", data, start + 4 * n_beams))
        distance = np.where(millimetres > 0, 1e-3 * millimetres, np.nan)
    heading = struct.unpack_from("<H", data, 24)[0] / 100.0
    return Report(
        time_s=time_s,
        speed=speed,
        sigma=np.full(n_beams, np.nan),
        distance=distance,
        velocity=np.full(3, np.nan),
        heading=math.radians(heading) if config >> 2 & 1 else math.nan,
    )


def nucleus_time(data: memoryview) -> float | None:
    """Return the time of a packet of a Nucleus, s: of Unix where its flag says so."""
    if len(data) < 12:
        return None
    seconds, micro = struct.unpack_from("<II", data, 4)
    return float(seconds) + 1e-6 * float(micro)


def _nucleus(packet: Packet) -> Report | None:
    data, n = packet.data, _N_NUCLEUS
    time_s = nucleus_time(data)
    if time_s is None or len(data) < _NUCLEUS_HEAD + 4 * 23:
        return None
    (valid,) = struct.unpack_from("<I", data, 12)
    numbers = np.frombuffer(data, "<f4", count=23, offset=_NUCLEUS_HEAD).astype(float)
    merit = _where(valid, 6, numbers[2 * n : 3 * n])
    return Report(
        time_s=time_s,
        speed=_where(valid, 0, numbers[:n]),
        sigma=np.where((merit > 0.0) & (merit < _WORST), merit, np.nan),
        distance=_where(valid, 3, numbers[n : 2 * n]),
        velocity=_where(valid, 9, numbers[5 * n : 5 * n + 3]),
        is_water=packet.kind == NUCLEUS_WATER,
    )


def nucleus_imu(packet: Packet) -> tuple[float, ...] | None:
    """Return time, gyros and accelerometers of a Nucleus as written; None for another packet."""
    if (packet.family, packet.kind) != (NUCLEUS_FAMILY, NUCLEUS_IMU):
        return None
    return _floats(packet.data, 6, order=(3, 4, 5, 0, 1, 2))


def nucleus_heading(packet: Packet) -> tuple[float, ...] | None:
    """Return time and heading, degrees, of a Nucleus; None for another packet."""
    if (packet.family, packet.kind) != (NUCLEUS_FAMILY, NUCLEUS_AHRS):
        return None
    return _floats(packet.data, 3, order=(2,))


def _floats(data: memoryview, count: int, *, order: tuple[int, ...]) -> tuple[float, ...] | None:
    """Return the time and floats from the offset that a packet states, in another order."""
    time_s = nucleus_time(data)
    if time_s is None or len(data) < data[1] + 4 * count:
        return None
    numbers = struct.unpack_from(f"<{count}f", data, data[1])
    if not all(map(math.isfinite, numbers)):
        return None
    return (time_s, *(numbers[i] for i in order))
