"""Units of the world outside; inside there are SI units and radians only."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.base.frozen import Array

DEGREE: Final = math.radians(1.0)
DEG_PER_H: Final = DEGREE / 3600.0
MICRO_G: Final = 9.80665e-6
"""m/s^2"""
PER_SQRT_H: Final = 1.0 / 60.0
"""1/sqrt(s)"""
STANDARD_GRAVITY: Final = 9.80665
"""m/s^2, of an accelerometer that counts in g, and of pressures that are depths"""
STANDARD_ATMOSPHERE: Final = 101_325.0
"""Pa"""
SEA_WATER: Final = 1025.0
"""kg/m^3, where nothing is said of the water"""


def in_unit(value: float, unit: float) -> float:
    """Return the shortest decimal that gives ``value`` (SI) times ``unit``, or the nearest one."""
    exact = value / unit + 0.0  # no minus zero in a file for people
    for digits in range(1, 17):
        short = float(f"{exact:.{digits}g}")
        if short * unit == value:
            return short
    return exact


def exactly_in_unit(value: float, unit: float) -> float:
    """Return the float that times ``unit`` gives ``value`` again, or a neighbour of it.

    Radians of one size lie up to twice as dense as the degrees they come from, so that not every
    float has degrees of its own; the neighbour is less than 5e-16 rad away, 3 nm on the Earth.
    """
    exact = value / unit
    for near in (exact, math.nextafter(exact, math.inf), math.nextafter(exact, -math.inf)):
        if near * unit == value:
            return near
    return exact


def wrapped(angle: Array | float) -> Array:
    """Return angles in [-pi, pi], unchanged in all their digits where they lie there already."""
    return np.asarray(np.where(np.abs(angle) > np.pi, wrap_to_pi(angle), angle))
