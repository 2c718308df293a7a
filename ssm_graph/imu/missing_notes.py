"""What a user is told of inertial samples that are missing from a log."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.imu.thinned import MOST_MISSING, sampling_interval, unseen_steps
from ssm_graph.sensors.imu import ImuLog, imu_gaps


def notes_of_missing(imu: ImuLog, keyframe_s: Array) -> tuple[str, ...]:
    """Return a note of gaps, and one of what is missing here and there between keyframes (K,)."""
    return (*_gap_note(imu), *_thin_note(imu, keyframe_s))


def _gap_note(imu: ImuLog) -> tuple[str, ...]:
    begin, end = imu_gaps(imu)
    if len(begin) == 0:
        return ()
    longest = int(np.argmax(end - begin))
    return (
        f"gaps in the inertial data: {len(begin)}, the longest of "
        f"{end[longest] - begin[longest]:.2f} s at {begin[longest]:.3f} s; bridged with larger "
        "process noise",
    )


def _thin_note(imu: ImuLog, keyframe_s: Array) -> tuple[str, ...]:
    period_s = sampling_interval(np.concatenate([[imu.start_s], imu.time_s]))
    unseen_s = unseen_steps(imu.time_s, keyframe_s, imu_gaps(imu), period_s)
    thin = np.flatnonzero(unseen_s)
    if len(thin) == 0:
        return ()
    return (
        f"inertial samples are missing here and there: more than {100.0 * MOST_MISSING:.0f} % of "
        f"those due every {1e3 * period_s:.3g} ms in {len(thin)} of {len(unseen_s)} steps between "
        f"keyframes, {keyframe_s[thin[0]]:.3f} to {keyframe_s[thin[-1] + 1]:.3f} s; sigmas grow by "
        "what they leave unseen",
    )
