"""Compass, or a heading gyro that seeks no north."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ssm_graph.base.frozen import Array, FrozenArrays, shaped


@dataclass(frozen=True, slots=True)
class HeadingErrors:
    """Errors of a compass beside its noise, as prior sigmas in rad; zero is none.

    A heading gyro that seeks no north, a directional gyro, has an offset of pi and a rate.
    """

    offset_sigma: float = 0.0
    """Of what is constant: mounting, declination."""
    rate_sigma: float = 0.0
    """Of a constant drift since the first reading, rad/s."""
    walk_sigma: float = 0.0
    """Of what comes and goes, a Gauss-Markov process."""
    correlation_s: float = 600.0
    """Within this time it is forgotten, s."""
    one_cycle_sigma: float = 0.0
    """Of the sine and of the cosine of the heading: hard iron."""
    two_cycle_sigma: float = 0.0
    """Of the sine and of the cosine of twice the heading: soft iron."""


@dataclass(frozen=True, slots=True, eq=False)
class HeadingLog(FrozenArrays):
    """Readings of a magnetic or any other compass, or of a directional gyro."""

    SECTION: ClassVar[str] = "[heading]"

    sigma: float
    """Standard deviation of a reading, rad."""
    time_s: Array = shaped("N")
    """(N,) s, strictly increasing."""
    heading: Array = shaped("N")
    """(N,) rad as read, clockwise from the compass's north."""
    declination: float = 0.0
    """rad, of the compass's north from true north, positive east."""
    errors: HeadingErrors = HeadingErrors()
