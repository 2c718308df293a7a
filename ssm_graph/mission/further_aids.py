"""Acoustic fixes and ranges, headings and standstills of a mission, at their keyframes.

Fixes and ranges have keyframes of their own, at the times when they were valid. Compasses are read
faster than the vehicle turns: each keyframe takes the one reading that is nearest to it, led to it
by the gyros. Within a standstill every keyframe stands still.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factors import so3
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, ReadOnlyArrays, ShortRepr
from ssm_graph.mission.aids import Fixes, fixes_at
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.ping_motion import turn_between
from ssm_graph.mission.timeline import Indices, is_inside, left_out, nearest
from ssm_graph.sensors.acoustic import RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.standstill import Standstill


@dataclass(frozen=True, slots=True, eq=False)
class Ranges(ReadOnlyArrays):
    """Ranges to B beacons at their keyframes."""

    keyframe: Indices
    """(M,)"""
    beacon: Indices
    """(M,) which of the beacons, from 0"""
    range_m: Array
    """(M,) m"""
    sigma: Array
    """(M,) m"""
    lever_arm_b: Array
    """(3,) m"""
    number: NDArray[np.intp]
    """(B,) what the mission calls the beacons"""
    beacon_n: Array
    """(B, 3) where the mission puts them, m"""
    R_nl: Array
    """(B, 3, 3) east, north, up at them"""
    is_known: NDArray[np.bool_]
    """(B,)"""


@dataclass(frozen=True, slots=True, eq=False)
class Headings(ReadOnlyArrays):
    """Compass readings, at most one of a keyframe."""

    keyframe: Indices
    """(M,)"""
    heading: Array
    """(M,) rad, clockwise from true north but for the compass's errors"""
    since_s: Array
    """(M,) from the first reading of all to each, s"""
    sigma: float
    """rad"""
    R_back: Array
    """(M, 3, 3) body axes at the reading to those at the keyframe"""


@dataclass(frozen=True, slots=True, eq=False)
class Standstills(ReadOnlyArrays):
    """Keyframes at which the vehicle stands still."""

    keyframe: Indices
    """(M,)"""
    sigma: Array
    """(M,) m/s"""


@dataclass(frozen=True, slots=True, eq=False)
class FurtherAids(ShortRepr):
    """What a problem has beside beams, depth and GNSS; for estimators that weigh it."""

    usbl: Fixes | None = None
    ranges: Ranges | None = None
    headings: Headings | None = None
    standstills: Standstills | None = None
    sections: tuple[str, ...] = ()
    """What the mission calls them."""


NO_FURTHER = FurtherAids()


def further_aids(mission: Mission, keyframe_s: Array) -> tuple[FurtherAids, tuple[str, ...]]:
    """Return the further aids of a mission at keyframes (K,), and notes on what is left out."""
    aids = mission.aids
    usbl, ranges, heading = aids.get(UsblLog), aids.get(RangeLog), aids.get(HeadingLog)
    notes: tuple[str, ...] = ()
    for log_s, what in (
        (usbl.valid_s if usbl else np.zeros(0), "USBL fix"),
        (ranges.time_s if ranges else np.zeros(0), "range"),
    ):
        inside = is_inside(log_s, keyframe_s[0], keyframe_s[-1])
        notes += left_out(what, int(np.sum(~inside)), keyframe_s[0], keyframe_s[-1])
    found = FurtherAids(
        usbl=_usbl(mission, usbl, keyframe_s) if usbl else None,
        ranges=_ranges(mission.frame, ranges, keyframe_s) if ranges else None,
        headings=_headings(mission, heading, keyframe_s) if heading else None,
        standstills=_standstills(aids.all(Standstill), keyframe_s)
        if aids.all(Standstill)
        else None,
        sections=aids.sections,
    )
    return found, notes


def _usbl(mission: Mission, log: UsblLog, keyframe_s: Array) -> Fixes:
    fix = np.flatnonzero(is_inside(log.valid_s, keyframe_s[0], keyframe_s[-1]))
    fix = fix[np.argsort(log.valid_s[fix], kind="stable")]
    valid_s = log.valid_s[fix]
    return fixes_at(mission, log, fix, time_s=valid_s, keyframe=nearest(keyframe_s, valid_s))


def _ranges(frame: LocalFrame, log: RangeLog, keyframe_s: Array) -> Ranges:
    used = is_inside(log.time_s, keyframe_s[0], keyframe_s[-1])
    number = np.array([beacon.number for beacon in log.beacons], dtype=np.intp)
    lat, lon, height = np.array([(b.lat, b.lon, b.height) for b in log.beacons]).T
    beacon_n = frame.p_n_from_geodetic(lat, lon, height)
    order = np.argsort(number)
    return Ranges(
        keyframe=nearest(keyframe_s, log.time_s[used]),
        beacon=order[np.searchsorted(number[order], log.beacon[used])],
        range_m=log.range_m[used],
        sigma=log.sigma[used],
        lever_arm_b=log.lever_arm_b,
        number=number,
        beacon_n=beacon_n,
        R_nl=frame.R_nl_at(beacon_n),
        is_known=np.array([beacon.is_known for beacon in log.beacons]),
    )


def _headings(mission: Mission, log: HeadingLog, keyframe_s: Array) -> Headings:
    reading = nearest(log.time_s, keyframe_s)
    # A reading belongs to the keyframe nearest to it, and a keyframe has but its nearest reading.
    is_own = nearest(keyframe_s, log.time_s[reading]) == np.arange(len(keyframe_s))
    is_own &= is_inside(log.time_s[reading], keyframe_s[0], keyframe_s[-1])
    keyframe, reading = np.flatnonzero(is_own), reading[is_own]
    turn_b = turn_between(mission.imu, log.time_s[reading], keyframe_s[keyframe])
    return Headings(
        keyframe=keyframe,
        heading=log.heading[reading] + log.declination,
        since_s=log.time_s[reading] - log.time_s[0],
        sigma=log.sigma,
        R_back=so3.exp(-turn_b),
    )


def _standstills(standstills: tuple[Standstill, ...], keyframe_s: Array) -> Standstills:
    sigma = np.full(len(keyframe_s), np.inf)
    for still in standstills:
        inside = (keyframe_s >= still.begin_s) & (keyframe_s <= still.end_s)
        sigma[inside] = np.minimum(sigma[inside], still.sigma)
    keyframe = np.flatnonzero(np.isfinite(sigma))
    return Standstills(keyframe, sigma[keyframe])
