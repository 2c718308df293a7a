"""Keyframe times of a mission: one for each ping, fix and range, a few where all are silent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.mission.mission import Aids, Mission
from ssm_graph.sensors.acoustic import RangeLog, UsblLog

MIN_SPACING_S = 1e-3
"""Times closer than this share a keyframe."""

Indices = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Timeline(ReadOnlyArrays):
    """Keyframe times and what was measured at them."""

    keyframe_s: Array
    """(K,) s, strictly increasing."""
    ping: Indices
    """(P,) pings used, as rows of the DVL table."""
    ping_keyframe: Indices
    """(P,) their keyframes."""
    fix: Indices
    """(F,) GNSS fixes used, as rows of the GNSS table."""
    fix_keyframe: Indices
    """(F,) their keyframes."""
    notes: tuple[str, ...]


def build_timeline(mission: Mission, *, start_s: float, interval_s: float) -> Timeline:
    """Choose keyframes from ``start_s`` to the end of the inertial data.

    Parameters
    ----------
    mission : the recorded run.
    start_s : time of the initial state, the first keyframe.
    interval_s : longest time between keyframes where DVL and GNSS are silent, s.
    """
    begin_s, end_s = mission.imu.start_s, float(mission.imu.time_s[-1])
    if start_s < begin_s - MIN_SPACING_S:
        raise DataError(
            f"the start at {start_s:.3f} s lies before the inertial data, which begin at "
            f"{begin_s:.3f} s: expected it inside; move [initial] time_s"
        )
    start_s = max(start_s, begin_s)
    if end_s - start_s < MIN_SPACING_S:
        raise DataError(
            f"the start at {start_s:.3f} s leaves no inertial data, which end at {end_s:.3f} s"
        )
    ping_s = mission.dvl.valid_s
    has_beam = np.isfinite(mission.dvl.speed).any(axis=1)
    fix_s = mission.gnss.valid_s if mission.gnss is not None else np.zeros(0)
    ping = np.flatnonzero(has_beam & is_inside(ping_s, start_s, end_s))
    fix = np.flatnonzero(is_inside(fix_s, start_s, end_s))
    notes = left_out("ping", int(has_beam.sum()) - len(ping), start_s, end_s)
    notes += left_out("GNSS fix", len(fix_s) - len(fix), start_s, end_s)

    acoustic_s = _acoustic_s(mission.aids, start_s, end_s)
    measured = np.clip(np.concatenate([ping_s[ping], fix_s[fix], *acoustic_s]), start_s, end_s)
    keyframe_s = _fill(_thin(np.concatenate([[start_s], measured, [end_s]])), interval_s)
    return Timeline(
        keyframe_s=keyframe_s,
        ping=ping,
        ping_keyframe=nearest(keyframe_s, ping_s[ping]),
        fix=fix,
        fix_keyframe=nearest(keyframe_s, fix_s[fix]),
        notes=notes,
    )


def _acoustic_s(aids: Aids, start_s: float, end_s: float) -> list[Array]:
    """Return the times of acoustic fixes and ranges within the span."""
    usbl, ranges = aids.get(UsblLog), aids.get(RangeLog)
    times = [usbl.valid_s] if usbl else []
    times += [ranges.time_s] if ranges else []
    return [time_s[is_inside(time_s, start_s, end_s)] for time_s in times]


def is_inside(time_s: Array, start_s: float, end_s: float) -> NDArray[np.bool_]:
    """Return which times lie in the span, but for rounding."""
    return (time_s > start_s - MIN_SPACING_S) & (time_s < end_s + MIN_SPACING_S)


def nearest(keyframe_s: Array, time_s: Array) -> Indices:
    """Return the index of the keyframe nearest to each time."""
    middle = 0.5 * (keyframe_s[:-1] + keyframe_s[1:])
    return np.searchsorted(middle, time_s)


def left_out(what: str, count: int, start_s: float, end_s: float) -> tuple[str, ...]:
    """Return the note on measurements outside the keyframes, if there are any."""
    if count == 0:
        return ()
    plural = "" if count == 1 else "es" if what.endswith("fix") else "s"
    return (
        f"{count} {what}{plural} outside the smoothed span {start_s:.3f}..{end_s:.3f} s left out",
    )


def _thin(times: Array) -> Array:
    """Return the distinct times, later ones dropped where closer than :data:`MIN_SPACING_S`."""
    ordered = np.unique(times)
    kept = [ordered[0]]
    for time in ordered[1:]:
        if time - kept[-1] >= MIN_SPACING_S:
            kept.append(time)
    return np.array(kept)


def _fill(times: Array, interval_s: float) -> Array:
    """Return the times with equally spaced ones added wherever they are further apart."""
    n_pieces = np.maximum(np.ceil(np.diff(times) / interval_s - 1e-6).astype(int), 1)
    pieces = [
        np.linspace(begin, end, count, endpoint=False)
        for begin, end, count in zip(times[:-1], times[1:], n_pieces, strict=True)
    ]
    return np.concatenate([*pieces, times[-1:]])
