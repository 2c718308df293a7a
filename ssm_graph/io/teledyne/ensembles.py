"""PD0 ensembles in a stream of bytes: found by their checksum, whatever stands between them.

Layout: Teledyne RDI, "PD0 Output Data Format" (Workhorse Commands and Output Data Format).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import teller
from ssm_graph.io.recording import running_sums

_HEADER: Final = b"\x7f\x7f"
_FIXED, _VARIABLE, _BOTTOM = 0x0000, 0x0080, 0x0600
_LEAST: Final = 6
"""Bytes of a header before the offsets."""
_BAD: Final = -32768
"""Of a velocity that is not known."""
_BEAM_ANGLES: Final = (15.0, 20.0, 30.0)
_COORDINATES: Final = ("beam", "instrument", "ship", "earth")


@dataclass(frozen=True, slots=True)
class Setup:
    """What the fixed leader says of the instrument."""

    beam_angle_deg: float | None
    """From the axis; None where it is not told."""
    is_convex: bool
    is_up: bool
    """Looking up at the surface."""
    coordinates: str
    """Of all velocities: beam, instrument, ship or earth."""
    uses_tilts: bool
    """Whether ship coordinates are level."""
    heading_alignment_deg: float
    n_beams: int
    """Four where it is not told; bottom track has no more."""


@dataclass(frozen=True, slots=True, eq=False)
class Ensemble:
    """One ensemble, as far as navigation needs it."""

    setup: Setup
    number: int
    unix_s: float
    """By the instrument's clock, taken for UTC."""
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    sensors: int
    """Bits of what was measured and not typed in: 5 depth, 4 heading, 3 pitch, 2 roll."""
    transducer_depth_m: float
    pressure_pa: float
    """Over that of the air."""
    bottom: Array | None
    """(4,) m/s as written, in the coordinates of the setup; None without bottom track."""
    bottom_range_m: Array
    """(4,) vertical, NaN where there is none"""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """All sound ensembles of a file, and what else was met."""

    ensembles: tuple[Ensemble, ...]
    n_damaged: int
    """Headers whose ensemble is torn, or whose checksum is wrong."""
    n_undated: int
    """Sound ensembles whose clock has no date."""
    n_other: int
    """Bytes that belong to no ensemble."""


def find_ensembles(data: bytes) -> Found:
    """Return the ensembles of a recording in order; NMEA and anything else between is skipped."""
    found: list[Ensemble] = []
    sums, tell = running_sums(data), teller(len(data))
    n_damaged, n_undated, used, at = 0, 0, 0, data.find(_HEADER)
    while at >= 0:
        tell(at)
        size = _sound_size(data, at, sums)
        leaders = _leaders(memoryview(data)[at : at + size]) if size else None
        if leaders is not None:
            ensemble = _ensemble(*leaders)
            n_undated += ensemble is None
            found += [ensemble] if ensemble is not None else []
            used += size + 2
            at = data.find(_HEADER, at + size + 2)
            continue
        # A header by chance has no length that could be one.
        n_damaged += size > 0 or _is_plausible(data, at)
        at = data.find(_HEADER, at + 1)
    return Found(tuple(found), n_damaged, n_undated, len(data) - used)


def is_pd0(head: bytes) -> bool:
    """Return whether the first bytes of a file hold a header with a plausible length."""
    at = head.find(_HEADER)
    while at >= 0:
        if _is_plausible(head, at):
            return True
        at = head.find(_HEADER, at + 1)
    return False


def _is_plausible(data: bytes, at: int) -> bool:
    """Return whether number, offsets and length of a header go together."""
    if len(data) < at + _LEAST + 2:
        return False
    size, n_types = struct.unpack_from("<HxB", data, at + 2)
    if not 2 <= n_types <= 30 or len(data) < at + _LEAST + 2 * n_types:
        return False
    offsets = struct.unpack_from(f"<{n_types}H", data, at + _LEAST)
    rises = all(a < b for a, b in pairwise(offsets))
    return rises and offsets[0] == _LEAST + 2 * n_types and offsets[-1] < size


def _sound_size(data: bytes, at: int, sums: NDArray[np.uint16]) -> int:
    """Return the length of an ensemble without its checksum; 0 where that is wrong."""
    if not _is_plausible(data, at):
        return 0
    (size,) = struct.unpack_from("<H", data, at + 2)
    if len(data) < at + size + 2:
        return 0
    (told,) = struct.unpack_from("<H", data, at + size)
    return size if (int(sums[at + size]) - int(sums[at])) & 0xFFFF == told else 0


def _leaders(
    data: memoryview,
) -> tuple[memoryview, memoryview, memoryview | None] | None:
    """Return fixed and variable leader and bottom track; None where a leader is missing."""
    n_types = data[5]
    starts = struct.unpack_from(f"<{n_types}H", data, _LEAST)
    parts = {}
    for start, end in zip(starts, (*starts[1:], len(data)), strict=True):
        if end - start >= 2:
            parts[struct.unpack_from("<H", data, start)[0]] = data[start:end]
    fixed, variable = parts.get(_FIXED), parts.get(_VARIABLE)
    if fixed is None or variable is None or len(fixed) < 42 or len(variable) < 28:
        return None
    return fixed, variable, parts.get(_BOTTOM)


def _ensemble(
    fixed: memoryview, variable: memoryview, bottom_track: memoryview | None
) -> Ensemble | None:
    """Return what a sound ensemble says; None for a clock without a date."""
    when = _when(variable)
    if when is None:
        return None
    number, number_msb = struct.unpack_from("<H", variable, 2)[0], variable[11]
    depth, heading, pitch, roll = struct.unpack_from("<HHhh", variable, 16)
    pressure = struct.unpack_from("<I", variable, 48)[0] if len(variable) >= 52 else 0
    bottom, ranges = _bottom(bottom_track)
    return Ensemble(
        setup=_setup(fixed),
        number=number + 65536 * number_msb,
        unix_s=when,
        heading_deg=heading / 100.0,
        pitch_deg=pitch / 100.0,
        roll_deg=roll / 100.0,
        sensors=fixed[31],
        transducer_depth_m=depth / 10.0,
        # Above 2^31 it is negative: a sensor in air, whose zero has moved.
        pressure_pa=10.0 * (pressure - 2**32 if pressure >= 2**31 else pressure),
        bottom=bottom,
        bottom_range_m=ranges,
    )


def _setup(fixed: memoryview) -> Setup:
    low, high, transform = fixed[4], fixed[5], fixed[25]
    told = fixed[58] if len(fixed) > 58 else 0
    coded = high & 0x03
    angle = float(told) if told else _BEAM_ANGLES[coded] if coded < 3 else None
    return Setup(
        beam_angle_deg=angle,
        is_convex=bool(low & 0x08),
        is_up=bool(low & 0x80),
        coordinates=_COORDINATES[(transform >> 3) & 0x03],
        uses_tilts=bool(transform & 0x04),
        heading_alignment_deg=struct.unpack_from("<h", fixed, 26)[0] / 100.0,
        n_beams=fixed[8] or 4,
    )


def _when(variable: memoryview) -> float | None:
    """Return Unix seconds of the clock, with a century where it has one; None for no date."""
    year, month, day, hour, minute, second, hundredths = variable[4:11]
    century = 20 if year < 80 else 19
    if len(variable) >= 65 and variable[57] in (19, 20):
        century, year, month, day, hour, minute, second, hundredths = variable[57:65]
    try:
        date = datetime(100 * century + year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    return date.timestamp() + hundredths / 100.0


def _bottom(part: memoryview | None) -> tuple[Array | None, Array]:
    """Return bottom velocities (4,) and ranges (4,) of an ensemble."""
    nothing = np.full(4, np.nan)
    if part is None or len(part) < 32:
        return None, nothing
    ranges = np.array(struct.unpack_from("<4H", part, 16), np.float64)
    if len(part) >= 81:
        ranges += 65536.0 * np.frombuffer(part[77:81], np.uint8)
    speeds = np.array(struct.unpack_from("<4h", part, 24), np.float64)
    speeds[speeds == _BAD] = np.nan
    return speeds / 1000.0, np.where(ranges > 0.0, ranges / 100.0, np.nan)
