"""Magnetometer of three axes: the Earth's field in the body, and what iron makes of it.

The field at the place of the mission is stated, as a model of it gives it (the World Magnetic
Model, of which NOAA has a calculator): declination, inclination, intensity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array, FrozenArrays, optional_shaped, shaped
from ssm_graph.base.settings import (
    FILE_KEY,
    Key,
    correlation_key,
    number_key,
    optional_key,
    sigma_key,
)
from ssm_graph.base.tables import Table
from ssm_graph.base.units import DEGREE
from ssm_graph.sensors.instrument import XYZ, Column, Instrument
from ssm_graph.sensors.messages import Message

MICROTESLA: Final = 1e-6
"""T"""
STRONGEST_UT: Final = 200.0
"""Three times the Earth's field where it is strongest: iron may add to it, units go beyond."""
EARTH_UT: Final = (20.0, 70.0)
"""Of the Earth's field: 22 in the South Atlantic, 67 south of Australia (WMM 2025)."""
_GAUSS_UT: Final = 100.0


@dataclass(frozen=True, slots=True)
class EarthField:
    """The Earth's magnetic field at the place of a mission, as it is stated."""

    declination: float
    """rad, of magnetic from true north, positive east."""
    inclination: float
    """rad below the horizon, positive on the northern hemisphere."""
    intensity: float
    """T"""

    @property
    def enu(self) -> Array:
        """(3,) east, north, up, T."""
        level = self.intensity * math.cos(self.inclination)
        down = self.intensity * math.sin(self.inclination)
        east, north = math.sin(self.declination), math.cos(self.declination)
        return np.array([level * east, level * north, -down])


@dataclass(frozen=True, slots=True)
class MagneticErrors:
    """What is not known of field and iron, as prior sigmas; zero takes it as it is stated."""

    field_sigma: float = 0.0
    """Of east, north and up of the stated field, T; models leave out the rock: some 0.15 uT."""
    hard_iron_sigma: float = 0.0
    """Of each axis, T: iron that is magnetised, motors, batteries."""
    soft_iron_sigma: float = 0.0
    """Of each of the six numbers of the soft iron, 1: scale and skewness of the axes with it."""
    walk_sigma: float = 0.0
    """Of each axis, T: what currents in the vehicle add, a Gauss-Markov process."""
    correlation_s: float = 60.0
    """Within this time that is forgotten, s."""


@dataclass(frozen=True, slots=True, eq=False)
class MagnetometerLog(FrozenArrays):
    """Readings of a magnetometer fixed to the vehicle."""

    SECTION: ClassVar[str] = "[magnetometer]"

    sigma: float
    """Standard deviation of each axis, T."""
    earth: EarthField
    time_s: Array = shaped("N")
    """(N,) s, strictly increasing."""
    field_b: Array = shaped("N", 3)
    """(N, 3) T as read, body axes."""
    hard_iron_b: Array | None = optional_shaped(3)
    """(3,) T, body axes: readings have so much on top; None for nothing."""
    soft_iron: Array | None = optional_shaped(6)
    """(6,) xx, yy, zz, xy, xz, yz in body axes FRD: readings are ``1 + S`` times the field."""
    errors: MagneticErrors = MagneticErrors()


@dataclass(frozen=True, slots=True)
class MagneticReading(Message):
    """One reading of a magnetometer."""

    field_b: tuple[float, float, float]
    """T as read, body axes."""


_UT: Final = "the unit is microtesla; 1 gauss is 100"
_DEGREES: Final = "the unit is degrees"
_FIELD: Final = Column(
    "field_b",
    "mag_{}_ut",
    over=XYZ,
    limits=(-STRONGEST_UT, STRONGEST_UT),
    expected=f"expected microtesla, up to {STRONGEST_UT:g}; {_UT}",
    told="magnetic field {} T: a wrong unit?",
    unit=MICROTESLA,
    is_body=True,
)
_KEYS: Final = {
    "file": FILE_KEY,
    "noise_ut": sigma_key("sigma", 100.0, _UT, unit=MICROTESLA),
    "declination_deg": Key("earth.declination", low=-180.0, high=180.0, unit=DEGREE),
    "inclination_deg": number_key("earth.inclination", -90.0, 90.0, "positive down", unit=DEGREE),
    "intensity_ut": number_key("earth.intensity", *EARTH_UT, _UT, unit=MICROTESLA),
    "field_sigma_ut": optional_key("errors.field_sigma", 0.0, 100.0, _UT, unit=MICROTESLA),
    "hard_iron_ut": optional_key(
        *("hard_iron_b", -STRONGEST_UT, STRONGEST_UT, _UT),
        shape=(3,),
        unit=MICROTESLA,
        is_body=True,
    ),
    "hard_iron_sigma_ut": optional_key("errors.hard_iron_sigma", 0.0, 200.0, _UT, unit=MICROTESLA),
    "soft_iron": optional_key("soft_iron", -0.9, 0.9, "1 percent is 0.01", shape=(6,)),
    "soft_iron_sigma": optional_key("errors.soft_iron_sigma", 0.0, 0.9, "1 percent is 0.01"),
    "walk_sigma_ut": optional_key("errors.walk_sigma", 0.0, 100.0, _UT, unit=MICROTESLA),
    "correlation_s": correlation_key(
        "errors.correlation_s",
        1e6,
        ("walk_sigma_ut", "expected with a walk_sigma_ut above 0, got none; 0.5 is usual"),
    ),
}


class _Magnetometer(Instrument):
    """The way of magnetometers: some give gauss, or the direction alone."""

    def check(self, table: Table, bare: MagnetometerLog, axes: BodyAxes) -> list[str]:
        notes = super().check(table, bare, axes)
        stated_ut = bare.earth.intensity / MICROTESLA
        found_ut = float(np.median(np.linalg.norm(table.stack(_FIELD.names), axis=1)))
        for factor, unit in ((1.0 / _GAUSS_UT, "gauss"), (1e3, "nanotesla"), (10.0, "milligauss")):
            if 0.8 < found_ut / (factor * stated_ut) < 1.25:
                raise DataError(
                    f"{table.label}: the field has a median of {found_ut:.4g}, where intensity_ut "
                    f"is {stated_ut:.4g}; expected microtesla; is it in {unit}?"
                )
        if not 0.5 < found_ut / stated_ut < 2.0:
            notes.append(
                f"{table.label}: the field has a median of {found_ut:.1f} uT, where intensity_ut "
                f"is {stated_ut:.1f}: much iron, or a direction without its length"
            )
        return notes


MAGNETOMETER: Final = _Magnetometer(
    "magnetometer", MagnetometerLog, _KEYS, (_FIELD,), MagneticReading, "m"
)
