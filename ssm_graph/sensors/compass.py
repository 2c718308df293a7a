"""Compass, or a heading gyro that seeks no north."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.base.settings import FILE_KEY, correlation_key, optional_key, sigma_key
from ssm_graph.base.tables import Table
from ssm_graph.base.units import DEG_PER_H, DEGREE
from ssm_graph.sensors.instrument import Calibrated, Column, Instrument
from ssm_graph.sensors.messages import Message


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


@dataclass(frozen=True, slots=True)
class HeadingReading(Message):
    """One reading of a compass."""

    heading: float
    """rad as read, clockwise from the compass's north."""


_DEGREES: Final = "the unit is degrees"
_HEADING: Final = Column(
    "heading",
    "heading_deg",
    limits=(-360.0, 360.0),
    expected="expected degrees up to 360, clockwise from north",
    told="heading {:g} rad: degrees?",
    unit=DEGREE,
)
_KEYS: Final = {
    "file": FILE_KEY,
    "noise_deg": sigma_key("sigma", 90.0, _DEGREES, unit=DEGREE),
    "declination_deg": optional_key("declination", -180.0, 180.0, _DEGREES, unit=DEGREE),
    "offset_sigma_deg": optional_key("errors.offset_sigma", 0.0, 180.0, _DEGREES, unit=DEGREE),
    "rate_sigma_deg_per_h": optional_key(
        "errors.rate_sigma", 0.0, 1e4, "the unit is degrees per hour", unit=DEG_PER_H
    ),
    "walk_sigma_deg": optional_key("errors.walk_sigma", 0.0, 90.0, _DEGREES, unit=DEGREE),
    "correlation_s": correlation_key(
        "errors.correlation_s",
        1e6,
        ("walk_sigma_deg", "expected with a walk_sigma_deg above 0, got none; 1 is usual"),
    ),
    "one_cycle_sigma_deg": optional_key("errors.one_cycle_sigma", 0.0, 90.0, _DEGREES, unit=DEGREE),
    "two_cycle_sigma_deg": optional_key("errors.two_cycle_sigma", 0.0, 90.0, _DEGREES, unit=DEGREE),
}


def _less(log: HeadingLog, stated: float | Array, off: Array) -> Array:  # noqa: ARG001
    """Return the declination of a compass whose headings were found to be too large by so much."""
    return np.asarray(stated - off)


_CALIBRATED: Final = {"heading_offset": Calibrated("declination_deg", "offset_sigma_deg", _less)}


class _Compass(Instrument):
    """The way of compasses: some give radians."""

    def check(self, table: Table, bare: HeadingLog, axes: BodyAxes) -> list[str]:
        super().check(table, bare, axes)
        if np.all(np.abs(table["heading_deg"]) <= 2.0 * np.pi):
            return [
                f"{table.label}: all headings lie within 6.3 degrees of north; if they are in "
                "radians, multiply them by 180/pi"
            ]
        return []


COMPASS: Final = _Compass(
    "heading", HeadingLog, _KEYS, (_HEADING,), HeadingReading, "h", calibrated=_CALIBRATED
)
