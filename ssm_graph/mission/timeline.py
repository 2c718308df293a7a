"""Keyframe times of a mission: one for each ping, fix and range, a few where all are silent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.base.times import MIN_SPACING_S, Indices, is_inside, left_out, nearest
from ssm_graph.graph.aids import AIDS
from ssm_graph.mission.mission import Mission


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

    aids_s = [np.zeros(0)]
    for what, time_s in (kind.times(mission.aids) for kind in AIDS):
        inside = is_inside(time_s, start_s, end_s)
        aids_s.append(time_s[inside])
        notes += left_out(what, int(np.sum(~inside)), start_s, end_s)
    measured = np.clip(np.concatenate([ping_s[ping], fix_s[fix], *aids_s]), start_s, end_s)
    keyframe_s = _fill(_thin(np.concatenate([[start_s], measured, [end_s]])), interval_s)
    return Timeline(
        keyframe_s=keyframe_s,
        ping=ping,
        ping_keyframe=nearest(keyframe_s, ping_s[ping]),
        fix=fix,
        fix_keyframe=nearest(keyframe_s, fix_s[fix]),
        notes=notes,
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
