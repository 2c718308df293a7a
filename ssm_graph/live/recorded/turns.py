"""How far two clocks are apart, by the turns that a gyro and a heading on the other clock show."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.sensors.imu import ImuLog

STEP_S: Final = 0.05
"""Of the grid on which rates are compared."""
SPAN_S: Final = 0.5
"""A rate is the mean over so long."""
LEAST_OVERLAP_S: Final = 30.0
LEAST_RATE: Final = np.radians(1.0)
"""rad/s, root mean square: who turns less shows nothing."""
LEAST_ALIKE: Final = 0.8
"""Correlation of the rates where the clocks fit."""
LEAST_EVIDENCE: Final = 10.0
"""Natural logarithm of how much more likely the best offset has to be than any other: lines of a
survey repeat."""
LONGEST_S: Final = 2.0 * 86_400.0
_TINY: Final = 1e-9
_APART_S: Final = 5.0
"""Another offset is further off than so long."""


class Offset(NamedTuple):
    """What is to be added to the times of the headings."""

    seconds: float
    sigma_s: float
    correlation: float
    overlap_s: float


def clock_offset(imu: ImuLog, time_s: Array, heading: Array) -> Offset:
    """Return what makes headings (N,), rad, at times (N,), s, those of the inertial data.

    Raises :class:`DataError` where the turns do not tell: too few, unlike, or alike elsewhere.
    """
    up_b = _slow(imu.accel_b, max(1, round(2.0 / float(np.median(np.diff(imu.time_s))))))
    up_b /= np.linalg.norm(up_b, axis=1, keepdims=True)
    rate = -np.sum(imu.gyro_b * up_b, axis=1)
    turned = np.concatenate([[0.0], np.cumsum(rate * np.diff(imu.time_s, prepend=imu.start_s))])
    own_s = np.concatenate([[imu.start_s], imu.time_s])
    for name, span_s in (("gyro", own_s[-1] - own_s[0]), ("headings", time_s[-1] - time_s[0])):
        if span_s > LONGEST_S:
            raise DataError(
                f"the times of the {name} span {span_s / 86_400.0:.1f} days; expected one run of "
                f"up to {LONGEST_S / 86_400.0:g}: was the clock set amid it? split the file there"
            )
    own, other = _rates(own_s, turned), _rates(time_s, np.unwrap(heading))
    least = min(LEAST_OVERLAP_S, 0.5 * STEP_S * min(len(own), len(other)))
    for name, rates in (("gyro", own), ("headings", other)):
        if len(rates) * STEP_S < least or np.sqrt(np.mean(rates**2)) < LEAST_RATE:
            raise DataError(
                f"the clocks cannot be told apart by turns: the {name} turn too little or are too "
                f"short ({len(rates) * STEP_S:.0f} s); state  --clock-offset SECONDS"
            )
    alike, overlap = _alike(own, other, round(least / STEP_S))
    best = int(np.argmax(alike))
    away = np.abs(np.arange(len(alike)) - best) * STEP_S > _APART_S
    rival = float(np.max(alike[away], initial=0.0))
    n_free = overlap[best] * STEP_S / SPAN_S
    unlike, other_unlike = (max(1.0 - x**2, _TINY) for x in (float(alike[best]), rival))
    evidence = 0.5 * n_free * math.log(other_unlike / unlike)
    if alike[best] < LEAST_ALIKE or evidence < LEAST_EVIDENCE:
        raise DataError(
            f"the clocks cannot be told apart by turns: the rates are alike to {alike[best]:.3f} "
            f"at best, and to {rival:.3f} at another offset; expected {LEAST_ALIKE:g} and no other "
            "like it; are the files of one run? else state  --clock-offset SECONDS"
        )
    before, at, behind = alike[np.clip([best - 1, best, best + 1], 0, len(alike) - 1)].tolist()
    curve = min(before - 2.0 * at + behind, -_TINY)
    lag_s = (best + 0.5 * (before - behind) / curve - (len(other) - 1)) * STEP_S
    sigma_s = STEP_S * math.sqrt(unlike / (n_free * -curve))
    seconds = float(own_s[0] - time_s[0] + lag_s)
    return Offset(seconds, sigma_s, float(alike[best]), float(overlap[best] * STEP_S))


def _slow(values: Array, width: int) -> Array:
    """Return running means (N, 3)."""
    ones = np.ones(width)
    count = np.convolve(np.ones(len(values)), ones, mode="same")
    return np.stack([np.convolve(axis, ones, mode="same") / count for axis in values.T], axis=1)


def _rates(time_s: Array, angle: Array) -> Array:
    """Return mean rates on the grid that begins with the first time, rad/s."""
    grid_s = np.arange(time_s[0], time_s[-1], STEP_S)
    half = round(0.5 * SPAN_S / STEP_S)
    on_grid = np.interp(grid_s, time_s, angle)
    rates = np.zeros(len(grid_s))
    if len(grid_s) > 2 * half:
        rates[half:-half] = (on_grid[2 * half :] - on_grid[: -2 * half]) / (2 * half * STEP_S)
    return rates


def _alike(own: Array, other: Array, least: int) -> tuple[Array, Array]:
    """Return the correlation at every offset with enough in common, and how many that are."""
    from scipy.signal import fftconvolve  # costly to import

    flipped = other[::-1]
    overlap = np.round(fftconvolve(np.ones(len(own)), np.ones(len(other))))
    both = fftconvolve(own, flipped)
    power = fftconvolve(own**2, np.ones(len(other))) * fftconvolve(np.ones(len(own)), flipped**2)
    tiny = (LEAST_RATE**2 * np.maximum(overlap, 1.0) * 0.01) ** 2
    alike = np.where(overlap >= least, both / np.sqrt(np.maximum(power, tiny)), -1.0)
    return np.asarray(alike), overlap
