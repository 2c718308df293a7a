"""Points seen again and again by a sonar or a camera, in range and direction; nobody knows where.

A boulder, a corner of a structure, a clamp on a pipeline: it stays where it is, and whoever finds
it in the picture gives it a number. Its place is estimated with the track.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.base.settings import FILE_KEY, LEVER_ARM_KEY, Key, sigma_key
from ssm_graph.base.tables import Table
from ssm_graph.base.units import DEGREE
from ssm_graph.sensors.instrument import Column, Instrument
from ssm_graph.sensors.messages import Message

LONGEST_M: Final = 1000.0
"""Twice what sonars reach that tell a point's direction (long-range multibeams: some 500 m)."""
MOST_NUMBER: Final = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class FeatureLog(FrozenArrays):
    """Sightings of numbered points."""

    SECTION: ClassVar[str] = "[features]"

    range_sigma: float
    """m"""
    angle_sigma: float
    """Of the direction, across and upwards each, rad."""
    mounting_rpy: Array = shaped(3)
    """(3,) roll, pitch and yaw of the instrument in the body, rad; a sonar that looks down by 20
    degrees has a pitch of -20."""
    time_s: Array = shaped("N")
    """(N,) s, increasing; sightings of several points may have one time."""
    feature: Array = shaped("N")
    """(N,) number of the point."""
    range_m: Array = shaped("N")
    """(N,) m"""
    bearing: Array = shaped("N")
    """(N,) rad from the instrument's x axis, positive to starboard."""
    elevation: Array = shaped("N")
    """(N,) rad above its plane of x and y, positive upwards."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to instrument, m."""


@dataclass(frozen=True, slots=True)
class FeatureSighting(Message):
    """One sighting of one point."""

    feature: float
    """Its number."""
    range_m: float
    """m"""
    bearing: float
    """rad, positive to starboard."""
    elevation: float
    """rad, positive upwards."""


_DEGREES: Final = "the unit is degrees"
_FEATURE: Final = Column("feature", "feature", limits=(0.0, MOST_NUMBER))
_RANGE: Final = Column(
    "range_m",
    "range_m",
    limits=(1e-3, LONGEST_M),
    expected=f"expected metres above 0 and up to {LONGEST_M:g}; is it in mm?",
    told="range {:g} m: mm, or none?",
)
_BEARING: Final = Column(
    "bearing",
    "bearing_deg",
    limits=(-360.0, 360.0),
    expected=f"expected -360 to 360; {_DEGREES}",
    told="bearing {:g} rad: more than a turn",
    unit=DEGREE,
)
_ELEVATION: Final = Column(
    "elevation",
    "elevation_deg",
    limits=(-90.0, 90.0),
    expected=f"expected -90 to 90, positive upwards; {_DEGREES}",
    told="elevation {:g} rad: beyond the zenith",
    unit=DEGREE,
)
_KEYS: Final = {
    "file": FILE_KEY,
    "noise_m": sigma_key("range_sigma", 100.0),
    "noise_deg": sigma_key("angle_sigma", 45.0, _DEGREES, unit=DEGREE),
    "mounting_rpy_deg": Key(
        "mounting_rpy", shape=(3,), low=-360.0, high=360.0, hint=_DEGREES, unit=DEGREE
    ),
    "lever_arm_m": LEVER_ARM_KEY,
}


class _Features(Instrument):
    """The way of sightings: angles written in radians are noticed, and points seen once."""

    def check(self, table: Table, bare: FeatureLog, axes: BodyAxes) -> list[str]:
        notes = super().check(table, bare, axes)
        number = table["feature"]
        whole = number % 1.0 == 0.0
        if not whole.all():
            raise table.cell_fault(int(np.argmin(whole)), "feature", "expected a whole number")
        reach = max(float(np.abs(table[name]).max()) for name in ("bearing_deg", "elevation_deg"))
        if len(number) > FEWEST_TO_TELL and reach <= math.pi / 2.0:
            raise DataError(
                f"{table.label}: no direction is more than {reach:.3g} degrees off the axis in "
                f"{len(number)} sightings; expected degrees; are they in radians?"
            )
        numbers, counts = np.unique(number, return_counts=True)
        once = [f"{n:g}" for n in numbers[counts == 1]]
        if once:
            notes.append(
                f"{table.label}: features {', '.join(once[:5])} were seen once: nothing is learnt"
            )
        return notes

    def problem(self, message: Message, bare: FeatureLog) -> str | None:
        assert isinstance(message, FeatureSighting)
        if message.feature % 1.0 != 0.0:
            return f"feature {message.feature:g}: expected a whole number"
        return super().problem(message, bare)


FEWEST_TO_TELL: Final = 20
"""Sightings of which one at least is expected to be off the axis by more than 1.6 degrees."""
FEATURES: Final = _Features(
    "features",
    FeatureLog,
    _KEYS,
    (_FEATURE, _RANGE, _BEARING, _ELEVATION),
    FeatureSighting,
    "p",
    row_key=("feature",),
)
