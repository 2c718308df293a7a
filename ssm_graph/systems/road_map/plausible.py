"""Whether the logs of a drive are of one drive: clocks, sides, units, directions."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEGREE, wrapped
from ssm_graph.systems.road_map.drive import Drive, dead_reckoned
from ssm_graph.systems.road_map.motion import noise_of, turn_between

_LEFT_OUT: Final = 0.1
"""Share of the pictures that may be taken while the chassis is not recorded."""
_LEAST_FIXES: Final = 5
_CLEAR: Final = 5.0
"""Sigmas of the fixes' noise that tell a way; its length, beyond what fixes are off by as well."""
_FACTOR: Final = 1.3
"""No wheel is so far from its size; km/h for m/s is 3.6."""
_TURNED: Final = 60.0 * DEGREE
"""No course over ground is so far off; clockwise for anticlockwise, or from east, is."""

_BESIDE: Final = 3.0 * np.sqrt(2.0)
"""Sigmas of the fixes' noise beyond which a way is not theirs."""
_BETTER: Final = 2.5
"""So much nearer to the fixes another reading has to be, and theirs."""
_READ_WRONGLY: Final = {
    -1.0: "is it clockwise?",
    1.0 / DEGREE: "is it in rad/s?",
    -1.0 / DEGREE: "is it in rad/s, and clockwise?",
    DEGREE: "was it turned from rad/s into deg/s twice?",
}


def require_plausible(drive: Drive) -> None:
    """Raise :class:`DataError` where logs contradict each other, with what is likely wrong."""
    _require_one_clock(drive)
    _require_sides(drive)
    _require_one_way(drive)


def _require_one_clock(drive: Drive) -> None:
    first, last = (float(drive.chassis.time_s[k]) for k in (0, -1))
    span = f"the times of the chassis, {first:.3f} to {last:.3f} s"
    t = drive.gnss.time_s
    if not np.any((t >= first - 1.0) & (t <= last)):
        raise DataError(
            f"{drive.name} gnss: no fix within {span}, got {t[0]:.3f} to {t[-1]:.3f} s; are the "
            "clocks the same?"
        )
    t = drive.curves.time_s
    outside = np.mean((t < first - 1e-6) | (t > last + 1e-6)) if len(t) else 0.0
    if len(t) == 0 or outside == 1.0:
        raise DataError(f"{drive.name} curves: none within {span}; are the clocks the same?")
    if outside > _LEFT_OUT:
        raise DataError(
            f"{drive.name} curves: {100.0 * outside:.0f} % of them are not within {span}; are the "
            "clocks the same? Cut what is not wanted"
        )


def _require_sides(drive: Drive) -> None:
    k = drive.curves
    wrong = float(np.mean(k.side * k.cubic[:, 0] < 0.0))
    if wrong > 0.5:
        raise DataError(
            f"{drive.name} curves: {100.0 * wrong:.0f} % lie on the other side than they say, c0 "
            "above zero with side -1 or the reverse; y is to the left, and 1 is left"
        )


def _require_one_way(drive: Drive) -> None:
    """Compare the way of the fixes with the one that is reckoned: its length and its direction."""
    gnss, t = drive.gnss, drive.chassis.time_s
    inside = np.flatnonzero((gnss.time_s >= t[0]) & (gnss.time_s <= t[-1]))
    if len(inside) < _LEAST_FIXES:
        return
    way = dead_reckoned(np.zeros(3), gnss.time_s[inside], drive.chassis)
    a, b = (x - x.mean(axis=0) for x in (way[:, :2], gnss.x_y[inside]))
    length, seen = _spread(a), _spread(b)
    noise = noise_of(drive)
    _require_turns(drive, inside, _beside(a, b), noise)
    is_other = not 1.0 / _FACTOR < (length + noise) / (seen + noise) < _FACTOR
    if is_other and abs(length - seen) > _CLEAR * noise + drive.gnss_bias_m:
        raise DataError(
            f"{drive.name} chassis: its way spreads over {length:.0f} m, that of the fixes over "
            f"{seen:.0f} m; expected the same; is the speed in m/s, the yaw rate in deg/s "
            "anticlockwise, are x and y metres?"
        )
    if min(length, seen) < _CLEAR * noise:
        return
    if gnss.yaw is None:
        return
    off = wrapped(gnss.yaw[inside] - way[:, 2] - turn_between(a, b))
    known = off[np.isfinite(off)]
    if len(known) and abs(float(np.median(known))) > _TURNED:
        raise DataError(
            f"{drive.name} gnss: the heading is {np.degrees(np.median(known)):+.0f} deg off "
            "(anticlockwise) the way that the fixes go; expected the course over ground, degrees "
            "clockwise from north; leave the column out, and the way tells it"
        )


def _require_turns(drive: Drive, inside: NDArray[np.int64], off: float, noise: float) -> None:
    """Compare the way as it is, ``off`` m beside the fixes, with those of yaw rates read wrongly.

    A straight road tells nothing of them.
    """
    if off < _BESIDE * noise:
        return
    chassis, fixes = drive.chassis, drive.gnss.x_y[inside]
    b = fixes - fixes.mean(axis=0)
    for factor, what in _READ_WRONGLY.items():
        other = replace(chassis, yaw_rate=factor * chassis.yaw_rate)
        way = dead_reckoned(np.zeros(3), drive.gnss.time_s[inside], other)[:, :2]
        found = _beside(way - way.mean(axis=0), b)
        if found < min(off / _BETTER, _BESIDE * noise):
            raise DataError(
                f"{drive.name} chassis: the yaw rate turns the way {off:.0f} m beside the fixes, "
                f"times {factor:.4g} it would be {found:.1f} m; {what}; expected deg/s, "
                "anticlockwise above zero"
            )


def _spread(x_y: Array) -> float:
    return float(np.sqrt(np.square(x_y).sum(axis=1).mean()))


def _beside(a: Array, b: Array) -> float:
    """Return how far points (N, 2) about their mean stay from others once turned onto them, m."""
    turn = turn_between(a, b)
    c, s = np.cos(turn), np.sin(turn)
    return _spread(a @ np.array([[c, s], [-s, c]]) - b)
