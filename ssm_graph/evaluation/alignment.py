"""Interpolation of a reference at other times, only where it really exists."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
from scipy.interpolate import PchipInterpolator

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array

MIN_GAP_S: Final = 2.0
GAP_STEPS: Final = 5.0
TIME_TOLERANCE_S: Final = 1e-6
"""Times this close to a reference's sample count as inside, whatever the rounding of clocks."""


def gap_limit_s(time_s: Array) -> float:
    """Return the longest step between samples that is interpolated across, s.

    Five median steps, but never less than two seconds: a reference of 2 Hz may miss four samples.
    """
    if len(time_s) < 2:
        return MIN_GAP_S
    return max(MIN_GAP_S, GAP_STEPS * float(np.median(np.diff(time_s))))


def interpolate_within(time_s: Array, *, known_s: Array, values: Array) -> Array:
    """Return the columns of ``values`` at ``time_s``; NaN outside of the data and in its gaps.

    Monotone piecewise cubic (PCHIP) between samples that are not further apart than
    :func:`gap_limit_s`, column by column: it does not overshoot where a reference is noisy.

    Parameters
    ----------
    time_s : (M,) wanted times, s.
    known_s : (N,) times of the samples, s, strictly increasing.
    values : (N, K) samples; NaN is a missing one. Angles must be unwrapped.

    Returns
    -------
    (M, K) values.
    """
    if np.any(np.diff(known_s) <= 0.0):
        raise DataError("reference: times must increase strictly")
    result = np.full((len(time_s), values.shape[1]), np.nan)
    for column, samples in enumerate(values.T):
        good = np.isfinite(samples)
        result[:, column] = _interpolate_column(time_s, known_s[good], samples[good])
    return result


def _interpolate_column(time_s: Array, known_s: Array, samples: Array) -> Array:
    result = np.full(len(time_s), np.nan)
    if len(known_s) == 0:
        return result
    breaks = np.flatnonzero(np.diff(known_s) > gap_limit_s(known_s)) + 1
    for begin, end in pairwise([0, *breaks, len(known_s)]):
        first, last = known_s[begin], known_s[end - 1]
        inside = (time_s >= first - TIME_TOLERANCE_S) & (time_s <= last + TIME_TOLERANCE_S)
        if end - begin == 1:
            result[inside] = samples[begin]
        elif np.any(inside):
            # Relative times: in Unix seconds the cubic's coefficients would lose digits.
            curve = PchipInterpolator(known_s[begin:end] - first, samples[begin:end])
            result[inside] = curve(np.clip(time_s[inside], first, last) - first)
    return result
