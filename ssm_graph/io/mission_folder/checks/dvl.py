"""Check that beam speeds are those of a DVL: units, codes for no bottom lock, repeats."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.keys import LIMITS, RANGE, SPEED, SPEED_SIGMA, WATER_TRACK
from ssm_graph.io.tables.table import Table
from ssm_graph.sensors.limits import LARGEST_SPEED

FASTEST: Final = 20.0
"""m/s, of 99 % of the beam speeds."""
SHORTEST_STEP_S: Final = 1e-3
_CODE_SIZE: Final = 2.0**14
_CODES: Final = (-1.0, -9.999, 9.999)
_CODE_SHARE: Final = 0.01
_REPEATED_SHARE: Final = 0.2
_IDENTICAL_SHARE: Final = 0.9
_FEW: Final = 5
_STUCK_PINGS: Final = 20
_EMPTY: Final = "leave the cells of beams without bottom lock empty"


def check_dvl(table: Table) -> list[str]:
    """Check units, codes, repeats and sigmas of the pings; return the notes."""
    if len(table) == 0:
        return [f"{table.label}: the table has no rows; nothing will aid the inertial sensors"]
    _sigmas_and_ranges(table)
    _water_flags(table)
    speed = table.stack(SPEED)
    if np.isnan(speed).all():
        return [f"{table.label}: no beam ever had bottom lock; every speed is empty or NaN"]
    if len(table) > 2 and np.median(np.diff(table.time_s)) < SHORTEST_STEP_S:
        raise DataError(
            f"{table.label}: the rows are {np.median(np.diff(table.time_s)):.3g} s apart; expected "
            "seconds between pings, at least 0.001; are the times in minutes or hours?"
        )
    _units(table, speed)
    _small_codes(table, speed)
    notes = _identical_beams(table, speed)
    notes += _repeats(table, speed)
    for beam in range(speed.shape[1]):
        notes += _stuck(table, speed, beam)
    return notes


def _sigmas_and_ranges(table: Table) -> None:
    for name in (*SPEED_SIGMA, *RANGE):
        if name not in table:
            continue
        is_sigma = name in SPEED_SIGMA
        low, high = LIMITS[name]
        bad = (table[name] < low) | (table[name] > high)
        if bad.any():
            text = (
                "expected a standard deviation above 0, in m/s; leave the cell empty to use "
                "beam_noise_m_per_s"
                if is_sigma
                else "expected metres, not below 0; leave the cell empty where it is unknown"
            )
            raise table.cell_fault(int(np.argmax(bad)), name, text)


def _water_flags(table: Table) -> None:
    """Refuse a flag that is neither yes nor no."""
    if WATER_TRACK not in table:
        return
    flag = table[WATER_TRACK]
    bad = np.isfinite(flag) & (flag != 0.0) & (flag != 1.0)
    if bad.any():
        raise table.cell_fault(
            int(np.argmax(bad)),
            WATER_TRACK,
            "expected 1 for a ping off the water, 0 or nothing for one off the ground",
        )


def _units(table: Table, speed: Array) -> None:
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
                SPEED[beam],
                f"expected m/s; {counts.max()} cells hold this code; {_EMPTY}",
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
        raise table.cell_fault(
            int(row), SPEED[beam], f"expected m/s, up to {LARGEST_SPEED:g}; {_EMPTY}"
        )


def _small_codes(table: Table, speed: Array) -> None:
    """Refuse a code such as -1 that hides among possible speeds: exact, and far too common."""
    for code in _CODES:
        exact = int(np.sum(speed == code))
        near = int(np.sum(np.abs(speed - code) < 0.05)) - exact
        if exact > max(2, _CODE_SHARE * len(table), 3 * near):
            row, beam = np.argwhere(speed == code)[0]
            raise table.cell_fault(
                int(row),
                SPEED[beam],
                f"{exact} cells hold exactly {code:g} and hardly any a number near it; expected "
                f"m/s; this is a driver's code; {_EMPTY}",
            )


def _identical_beams(table: Table, speed: Array) -> list[str]:
    four = speed[np.isfinite(speed).all(axis=1) & (speed != 0.0).any(axis=1)]
    share = float((four == four[:, :1]).all(axis=1).mean()) if len(four) >= _FEW else 0.0
    if share > _IDENTICAL_SHARE:
        raise DataError(
            f"{table.label}: in {100 * share:.0f} % of the pings all four beams hold the same "
            "number; expected the speed along each beam; the driver writes one velocity into all "
            "of them: export beam velocities"
        )
    if share > 0.05:
        return [f"{table.label}: in {100 * share:.0f} % of the pings all four beams are the same"]
    return []


def _repeats(table: Table, speed: Array) -> list[str]:
    same = (speed[1:] == speed[:-1]) | (np.isnan(speed[1:]) & np.isnan(speed[:-1]))
    moving = (np.isfinite(speed[1:]) & (speed[1:] != 0.0)).any(axis=1)
    repeated = same.all(axis=1) & moving
    count = int(repeated.sum())
    if not count:
        return []
    row = int(np.argmax(repeated)) + 1
    text = (
        f"{count} of {len(table)} pings ({100 * count / len(table):.0f} %) repeat all four speeds "
        "of the ping before under a new time"
    )
    if count > _REPEATED_SHARE * len(table) and count >= _FEW:
        raise table.fault(
            row, f"{text}; expected each report once; the driver republishes: delete the copies"
        )
    return [f"{table.file.place(row)}: {text}"]


def _stuck(table: Table, speed: Array, beam: int) -> list[str]:
    values = speed[:, beam]
    changes = np.flatnonzero(np.diff(values) != 0.0) + 1  # NaN differs from everything
    edges = np.concatenate([[0], changes, [len(values)]])
    lengths = np.diff(edges)
    longest = int(np.argmax(lengths))
    if lengths[longest] < _STUCK_PINGS:
        return []
    row = int(edges[longest])
    hint = " (a code for no bottom lock?)" if values[row] == 0.0 else ""
    return [
        f"{table.file.place(row)}: beam {beam + 1} holds {values[row]:g}{hint} in "
        f"{lengths[longest]} pings running"
    ]
