"""Keyframes as plain arrays and back: for checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from factors.inertial import Intervals
from ssm_graph.base.frozen import Array
from ssm_graph.smoothers.keyframe import BeamSpeeds, Keyframe

_GROUPS = {
    "beams": BeamSpeeds._fields,
    "depth": ("depth_s", "depth"),
    "fix": ("fix_n", "fix_cov_n"),
}


def pack_keyframes(keyframes: Sequence[Keyframe]) -> dict[str, Array]:
    """Return times, gyro readings and measurements, with how many of these each keyframe has."""
    arrays = {
        "time_s": np.array([keyframe.time_s for keyframe in keyframes]),
        "gyro_b": np.array([keyframe.gyro_b for keyframe in keyframes]),
        "speed_sigma": np.array([keyframe.speed_sigma for keyframe in keyframes]),
    }
    for group, names in _GROUPS.items():
        for name in names:
            parts = [_column(keyframe, group, name) for keyframe in keyframes]
            arrays[f"{group}_{name}"] = np.concatenate(parts)
        arrays[f"{group}_count"] = np.array([float(len(part)) for part in parts])
    return arrays


def _column(keyframe: Keyframe, group: str, name: str) -> Array:
    column: Array = getattr(keyframe.beams if group == "beams" else keyframe, name)
    return column


def unpack_keyframes(
    arrays: Mapping[str, Array], inertial: Callable[[float, float], Intervals]
) -> list[Keyframe]:
    """Return the keyframes that were packed; ``inertial`` gives the data between two times."""
    times = arrays["time_s"].tolist()
    intervals = [None, *(inertial(begin_s, end_s) for begin_s, end_s in pairwise(times))]
    edges = {
        group: np.concatenate([[0], np.cumsum(arrays[f"{group}_count"])]).astype(int)
        for group in _GROUPS
    }
    keyframes = []
    for k, time_s in enumerate(times):
        found = {
            group: [arrays[f"{group}_{name}"][slice(*edges[group][k : k + 2])] for name in names]
            for group, names in _GROUPS.items()
        }
        (depth_s, depth), (fix_n, fix_cov_n) = found["depth"], found["fix"]
        keyframes.append(
            Keyframe(
                time_s=time_s,
                gyro_b=arrays["gyro_b"][k],
                beams=BeamSpeeds(*found["beams"]),
                depth_s=depth_s,
                depth=depth,
                fix_n=fix_n,
                fix_cov_n=fix_cov_n,
                speed_sigma=float(arrays["speed_sigma"][k]),
                inertial=intervals[k],
            )
        )
    return keyframes
