"""Beam speeds that no beam has measured: one set of rules, for files and for live pings alike.

Speeds are (P, B), m/s, NaN without bottom lock.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.runs import runs_of
from ssm_graph.base.tables import Table
from ssm_graph.sensors.instrument import Column

Mask = NDArray[np.bool_]

LARGEST_SPEED: Final = 30.0
"""m/s along a beam: three times what instruments state as their range, 10 m/s; beyond is a code or
another unit."""
COUNTS: Final = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")
LEAVE_EMPTY: Final = "leave the cells of beams without bottom lock empty"


def no_lock(speed: Array) -> Mask:
    """Return which pings (P,) hold exactly zero in all of their beams, two of them at least.

    Drivers write that while there is no bottom lock. One beam may read exactly zero, that of a
    vehicle at rest or a level one; all of them do so by chance once in ten thousand pings of an
    instrument that resolves 1 mm/s with a noise of some mm/s.
    """
    heard = np.isfinite(speed)
    return np.asarray((heard.sum(axis=1) > 1) & (~heard | (speed == 0.0)).all(axis=1))


def identical_beams(speed: Array) -> Mask:
    """Return which pings (P,) hold one number, not zero, in all of three or more beams.

    Drivers write one component of the velocity into all of them; by chance it happens as seldom as
    zeros in all of them.
    """
    if speed.shape[1] < 3:
        return np.zeros(len(speed), bool)
    return np.asarray((speed == speed[:, :1]).all(axis=1) & (speed[:, 0] != 0.0))


def repeats_of_ping_before(speed: Array, is_water: Mask) -> Mask:
    """Return which pings (P,) repeat every speed of the ping before, missing ones as well.

    A driver that publishes faster than the instrument measures sends them under new times. A ping
    whose speeds are all zero or missing repeats nothing, nor does one of the other track, off the
    ground or off the water (P,).
    """
    repeated = np.zeros(len(speed), bool)
    same = (speed[1:] == speed[:-1]) | (np.isnan(speed[1:]) & np.isnan(speed[:-1]))
    moving = np.isfinite(speed[1:]) & (speed[1:] != 0.0)
    repeated[1:] = same.all(axis=1) & moving.any(axis=1) & (is_water[1:] == is_water[:-1])
    return repeated


def without_false_speeds(speed: Array, is_water: Mask) -> Array:
    """Return the speeds without those of pings that no beam has measured."""
    false = no_lock(speed) | identical_beams(speed) | repeats_of_ping_before(speed, is_water)
    return np.where(false[:, None], np.nan, speed)


STUCK_PINGS: Final = 8
"""So many equal readings in a row, while other beams change with every ping, are no measurements.

A beam of a resting vehicle whose noise is half of its resolution repeats itself in some half of the
pings, and others change as well in most of them: eight in a row come once in a thousand pings, and
then leave out what the other beams tell too.
"""


def stuck_beams(speed: Array) -> NDArray[np.bool_]:
    """Return which beam speeds (P, B), m/s, NaN without bottom lock, belong to a stuck beam."""
    is_stuck = np.zeros(speed.shape, bool)
    if len(speed) < STUCK_PINGS:
        return is_stuck
    repeats = speed[1:] == speed[:-1]
    has_changed = np.isfinite(speed[1:] - speed[:-1]) & ~repeats
    repeats &= has_changed.any(axis=1)[:, None]
    for beam in np.flatnonzero(repeats.sum(axis=0) >= STUCK_PINGS - 1):
        for begin, end in runs_of(repeats[:, beam]):
            if end - begin >= STUCK_PINGS - 1:
                is_stuck[begin : end + 1, beam] = True
    return is_stuck


FASTEST: Final = 20.0
"""m/s, of 99 % of the beam speeds: no vehicle with a DVL swims, or drives along a beam, so fast."""
SHORTEST_STEP_S: Final = 1e-3
_CODE_SIZE: Final = 2.0**14
_CODES: Final = (-1.0, -9.999, 9.999)
_CODE_SHARE: Final = 0.01
_REPEATED_SHARE: Final = 0.2
_IDENTICAL_SHARE: Final = 0.9
_FEW: Final = 5


def check_speeds(table: Table, column: Column, is_water: Mask) -> list[str]:
    """Refuse a table whose speeds have another unit, or are codes or copies; return the notes.

    What the notes say to be left out is what :func:`without_false_speeds` leaves out.
    """
    speed = table.stack(column.names)
    if len(speed) == 0:
        return [f"{table.label}: the table has no rows; nothing will aid the inertial sensors"]
    if np.isnan(speed).all():
        return [f"{table.label}: no beam ever had bottom lock; every speed is empty or NaN"]
    if len(speed) > 2 and np.median(np.diff(table.time_s)) < SHORTEST_STEP_S:
        raise DataError(
            f"{table.label}: the rows are {np.median(np.diff(table.time_s)):.3g} s apart; expected "
            "seconds between pings, at least 0.001; are the times in minutes or hours?"
        )
    _units(table, speed, column)
    _small_codes(table, speed, column)
    notes = _zeros(table, speed)
    notes += _identical(table, speed)
    notes += _repeats(table, speed, is_water)
    is_stuck = stuck_beams(without_false_speeds(speed, is_water))
    for beam in np.flatnonzero(is_stuck.any(axis=0)):
        notes += _stuck(table, speed[:, beam], is_stuck[:, beam], int(beam))
    return notes


def _units(table: Table, speed: Array, column: Column) -> None:
    size = np.abs(speed)
    finite = size[np.isfinite(size)]
    large = speed[size > LARGEST_SPEED]
    if large.size:
        values, counts = np.unique(large, return_counts=True)
        common = values[np.argmax(counts)]
        is_rare = large.size < 0.5 * finite.size
        if counts.max() > max(1.0, 0.5 * large.size) and (is_rare or abs(common) > _CODE_SIZE):
            row, beam = np.argwhere(speed == common)[0]
            raise table.cell_fault(
                int(row),
                column.names[beam],
                f"expected m/s; {counts.max()} cells hold this code; {LEAVE_EMPTY}",
            )
    fast = float(np.percentile(finite, 99.0))
    if fast > FASTEST:
        unit = (
            "mm/s: divide them by 1000"
            if fast > 200.0
            else "cm/s or mm/s: divide them by 100 or 1000"
        )
        raise DataError(
            f"{table.label}: 1 % of the beam speeds exceed {fast:.4g}; expected m/s, up to "
            f"{FASTEST:g}; the speeds seem to be in {unit}"
        )
    if large.size:
        row, beam = np.argwhere(size > LARGEST_SPEED)[0]
        raise table.cell_fault(int(row), column.names[beam], column.expected)


def _small_codes(table: Table, speed: Array, column: Column) -> None:
    """Refuse a code such as -1 that hides among possible speeds: exact, and far too common."""
    for code in _CODES:
        exact = int(np.sum(speed == code))
        near = int(np.sum(np.abs(speed - code) < 0.05)) - exact
        if exact > max(2, _CODE_SHARE * len(speed), 3 * near):
            row, beam = np.argwhere(speed == code)[0]
            raise table.cell_fault(
                int(row),
                column.names[beam],
                f"{exact} cells hold exactly {code:g} and hardly any a number near it; expected "
                f"m/s; this is a driver's code; {LEAVE_EMPTY}",
            )


def _zeros(table: Table, speed: Array) -> list[str]:
    zero = no_lock(speed)
    count = int(zero.sum())
    if not count:
        return []
    return [
        f"{table.file.place(int(np.argmax(zero)))}: {count} of {len(speed)} pings hold exactly 0 "
        "in all beams: taken for no bottom lock; a time at rest may be stated as [[standstill]]"
    ]


def _identical(table: Table, speed: Array) -> list[str]:
    same = identical_beams(speed)
    whole = np.isfinite(speed).all(axis=1) & ~no_lock(speed)
    share = float(same.sum() / whole.sum()) if same.any() else 0.0
    all_beams = f"all {COUNTS[speed.shape[1]]} beams"
    if share > _IDENTICAL_SHARE and whole.sum() >= _FEW:
        raise DataError(
            f"{table.label}: in {100 * share:.0f} % of the pings {all_beams} hold the same "
            "number; expected the speed along each beam; the driver writes one velocity into all "
            "of them: export beam velocities"
        )
    if not same.any():
        return []
    return [
        f"{table.file.place(int(np.argmax(same)))}: in {same.sum()} pings {all_beams} are the "
        "same: left out"
    ]


def _repeats(table: Table, speed: Array, is_water: Mask) -> list[str]:
    repeated = repeats_of_ping_before(speed, is_water)
    count = int(repeated.sum())
    if not count:
        return []
    row = int(np.argmax(repeated))
    text = (
        f"{count} of {len(speed)} pings ({100 * count / len(speed):.0f} %) repeat all "
        f"{COUNTS[speed.shape[1]]} speeds of the ping before under a new time"
    )
    if count > _REPEATED_SHARE * len(speed) and count >= _FEW:
        raise table.fault(
            row, f"{text}; expected each report once; the driver republishes: delete the copies"
        )
    return [f"{table.file.place(row)}: {text}: left out"]


def _stuck(table: Table, speed: Array, is_stuck: Mask, beam: int) -> list[str]:
    begin, end = max(runs_of(is_stuck), key=lambda run: run[1] - run[0])
    hint = " (a code for no bottom lock?)" if speed[begin] == 0.0 else ""
    return [
        f"{table.file.place(begin)}: beam {beam + 1} holds {speed[begin]:g}{hint} in "
        f"{end - begin} pings running: left out"
    ]
