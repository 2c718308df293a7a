"""Times in which the vehicle did not go anywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

from ssm_graph.base.errors import DataError
from ssm_graph.base.settings import Key, Settings, build


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
