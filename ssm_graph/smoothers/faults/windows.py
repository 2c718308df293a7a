"""Whether the inertial data fit an answer as well as their noise says, in windows of a mission.

What the search finds is freed before; what is left is noise, or what no hypothesis describes. The
inertial data pay for all of it: whatever bends the answer bends it against them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.graph.inertial_rows import InertialFit
from ssm_graph.mission.fault import DetectedFault, Treatment

WINDOW_S: Final = 60.0
USUAL: Final = 2.0
"""Chi-square by its degrees of freedom that errors of healthy instruments may come to: vibration
and quantisation make it up to 1.25, of MEMS units up to 1.6, over realistic missions (30 a grade,
seeds 100 to 129)."""
TAIL: Final = 1e-6
"""Probability of a stretch's chi-square where it is as large as is usual."""
MOST: Final = 3
"""Stretches that are named."""
OTHERS: Final = "DVL or aids, whose lie the inertial data contradict"


def noisier_than_stated(fit: InertialFit, keyframe_s: Array) -> list[DetectedFault]:
    """Return the stretches of whole windows in which inertial data err more than they may.

    Over most of a mission that is their noise. For a while it may be anything that they contradict.
    """
    since = keyframe_s[:-1] - keyframe_s[0]
    first = np.flatnonzero(np.diff(np.floor(since / WINDOW_S), prepend=-1.0))
    begin_s = np.append(keyframe_s[first], keyframe_s[-1])
    chi_sq, dof = (np.add.reduceat(x, first) for x in (fit.chi_sq, fit.dof))
    found = []
    for begin, end in _stretches(chi_sq, dof):
        total, expected = float(chi_sq[begin:end].sum()), max(float(dof[begin:end].sum()), 1.0)
        is_noise = 2 * (end - begin) > len(first)
        found.append(
            DetectedFault(
                sensor="IMU",
                what=f"errs {np.sqrt(total / expected):.1f} times as much as its noise says "
                f"(chi-square {total:.0f} with {expected:.0f} degrees of freedom)",
                begin_s=float(begin_s[begin]),
                end_s=float(begin_s[end]),
                chi_sq=total - expected,
                dof=round(expected),
                treatment=Treatment.SAID,
                rivals=() if is_noise else (OTHERS,),
                remedy="look at the densities of [imu], its units, axes and time stamps",
            )
        )
    return sorted(found, key=lambda fault: fault.begin_s)


def _stretches(chi_sq: Array, dof: Array) -> Iterator[tuple[int, int]]:
    """Yield stretches of windows (N,) beyond chance, the least likely first, none twice."""
    n = len(chi_sq)
    begin, end = np.triu_indices(n + 1, 1)
    sums = [np.concatenate([[0.0], np.cumsum(x)]) for x in (chi_sq, dof)]
    total, expected = (x[end] - x[begin] for x in sums)
    # Where other sensors leave no degree of freedom there is nothing to be said.
    likely = chi2.logsf(total / USUAL, np.maximum(expected, 1.0))
    for _ in range(MOST):
        least = int(np.argmin(likely))
        if likely[least] > np.log(TAIL):
            return
        yield int(begin[least]), int(end[least])
        likely = np.where((begin < end[least]) & (end > begin[least]), 0.0, likely)
