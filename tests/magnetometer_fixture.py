"""A magnetometer: all that the package needs to be told of an instrument that it does not know."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

from ssm_graph.base.frozen import Array, FrozenArrays, Vector, shaped
from ssm_graph.base.settings import FILE_KEY, Key, sigma_key
from ssm_graph.sensors.instrument import XYZ, Column, Instrument
from ssm_graph.sensors.messages import Message

MICROTESLA: Final = 1e-6
"""T"""


@dataclass(frozen=True, slots=True, eq=False)
class MagnetometerLog(FrozenArrays):
    """The Earth's field as the vehicle feels it."""

    SECTION: ClassVar[str] = "[magnetometer]"

    sigma: float
    """T, of each component."""
    time_s: Array = shaped("N")
    """(N,) s"""
    field_b: Array = shaped("N", 3)
    """(N, 3) T"""
    hard_iron_b: Array = shaped(3)
    """(3,) T, of the vehicle itself."""


@dataclass(frozen=True, slots=True)
class MagnetometerReading(Message):
    """One reading."""

    field_b: Vector
    """T"""


MAGNETOMETER: Final = Instrument(
    "magnetometer",
    MagnetometerLog,
    {
        "file": FILE_KEY,
        "noise_ut": sigma_key("sigma", 100.0, "the unit is microtesla", unit=MICROTESLA),
        "hard_iron_ut": Key("hard_iron_b", (3,), -100.0, 100.0, unit=MICROTESLA, is_body=True),
    },
    (
        Column(
            "field_b",
            "field_{}_ut",
            XYZ,
            low=-200.0,
            high=200.0,
            expected="expected microtesla",
            told="field {} T: a wrong unit?",
            unit=MICROTESLA,
            is_body=True,
        ),
    ),
    MagnetometerReading,
    "m",
)
