"""Times in which the vehicle did not go anywhere: stated afterwards, or told while it stands."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.base.settings import FILE_KEY, Key, Settings, build, sigma_key
from ssm_graph.sensors.instrument import SMALLEST_SIGMA, Column, Instrument
from ssm_graph.sensors.messages import Message


@dataclass(frozen=True, slots=True)
class Standstill:
    """A time in which the vehicle did not go anywhere: on deck, moored, on the bottom."""

    SECTION: ClassVar[str] = "[[standstill]]"

    begin_s: float
    end_s: float
    sigma: float = 0.05
    """m/s, of each component of its velocity: it sways."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.begin_s) and self.begin_s < self.end_s < math.inf):
            raise DataError(
                f"Standstill: expected a begin before its end, got {self.begin_s} and "
                f"{self.end_s} s"
            )
        if not 0.0 < self.sigma < math.inf:
            raise DataError(f"Standstill.sigma: expected m/s above zero, got {self.sigma}")


STANDSTILL_KEYS: Final = {
    "begin_s": Key("begin_s"),
    "end_s": Key("end_s"),
    "sigma_m_per_s": Key("sigma", positive=True, high=10.0, required=False, hint="the unit is m/s"),
}
"""Of a section ``[[standstill]]``."""


def standstill(settings: Settings) -> Standstill:
    """Return the standstill that a section states."""
    begin_s, end_s = settings.number("begin_s"), settings.number("end_s")
    if not begin_s < end_s:
        raise settings.fault("end_s", f"expected a time after {begin_s:z.3f} s, got {end_s:z.3f} s")
    return build(Standstill, settings.given())


def check_during(
    still: Standstill, settings: Settings, *, first_s: float, last_s: float, label: str
) -> None:
    """Raise where a standstill lies outside the inertial data, of the table ``label``."""
    if still.end_s < first_s or still.begin_s > last_s:
        raise settings.fault(
            "begin_s",
            f"{still.begin_s:z.3f} to {still.end_s:z.3f} s lies outside {label}, "
            f"{first_s:z.3f} to {last_s:z.3f} s; give times on the clock of the tables",
        )


@dataclass(frozen=True, slots=True, eq=False)
class RestLog(FrozenArrays):
    """What somebody on board said while the vehicle stood still, reading by reading."""

    SECTION: ClassVar[str] = "[at_rest]"

    nominal_sigma: float
    """m/s, of each component of the velocity, where a reading states none: it sways."""
    time_s: Array = shaped("N")
    """(N,) s, strictly increasing: the vehicle stands still now."""
    sigma: Array = shaped("N")
    """(N,) m/s; NaN for the nominal one."""

    @property
    def counted_sigma(self) -> Array:
        """(N,) m/s, the nominal one where a reading states none."""
        return np.where(np.isnan(self.sigma), self.nominal_sigma, self.sigma)


@dataclass(frozen=True, slots=True)
class RestReading(Message):
    """Says that the vehicle stands still at its time: moored, on deck, on the bottom."""

    MAY_MISS: ClassVar[frozenset[str]] = frozenset({"sigma"})

    sigma: float = math.nan
    """m/s, of each component of its velocity; NaN is the nominal one."""


HOLDS_S: Final = 1.0
"""A reading holds for so long: whoever says that the vehicle stands says it again and again."""
_SIGMA: Final = Column(
    "sigma",
    "sigma_m_per_s",
    limits=(SMALLEST_SIGMA, 10.0),
    expected="expected a standard deviation above 0, up to 10 m/s",
    told="sigma {:g} m/s, expected above 0, up to 10",
    optional=True,
)
AT_REST: Final = Instrument(
    "at_rest",
    RestLog,
    {"file": FILE_KEY, "noise_m_per_s": sigma_key("nominal_sigma", 10.0, "the unit is m/s")},
    (_SIGMA,),
    RestReading,
    "s",
)
