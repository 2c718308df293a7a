"""What an estimator found to be wrong with a sensor over a stretch of a mission."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from ssm_graph.base.frozen import ShortRepr


class Treatment(Enum):
    """What became of a faulty stretch; the text is shown to the user."""

    LEFT_OUT = "left out there"
    FREED = "estimated and taken off there"
    COVERED = "the sigmas cover what it may have cost"
    ALLOWED = "too little to decide, the sigmas allow for it"
    WIDENED = "the sigmas allow for it"
    CHANGING = "estimated there, but it was another at each look"
    SAID = "counted as it is"

    @property
    def is_blame(self) -> bool:
        """Whether a sensor is said not to be sound, or not to be what it is taken for."""
        return self not in (Treatment.ALLOWED, Treatment.WIDENED)

    @property
    def is_harmless(self) -> bool:
        """Whether the answer does not rest on what is wrong."""
        return self not in (Treatment.SAID, Treatment.CHANGING)


@dataclass(frozen=True, slots=True, eq=False)
class DetectedFault(ShortRepr):
    """A sensor that was off from one time to another."""

    sensor: str
    """As people call it: ``GNSS``, ``depth``, ``DVL``, ``DVL beam 2``, ``DVL beams 1 and 3``,
    ``IMU``, ``gyros``, ``accelerometers``, ``compass``, ``USBL``, ``start``."""
    what: str
    """What it did, with its size and unit: ``3.1 m to the east``, ``reads 0.60 of the turn``."""
    begin_s: float
    end_s: float
    chi_sq: float
    """By which the data fit better once this is allowed for,"""
    dof: int
    """with so many numbers."""
    treatment: Treatment
    rivals: tuple[str, ...] = ()
    """Other sensors, or the same, with what they would have done, that explain the data as well."""
    cost_m: float = 0.0
    """By how much the horizontal position moves, at most, between the explanations, m."""
    remedy: str = ""
    """What to look at, or the line of ``mission.toml`` that mends it."""
    late_s: float | None = None
    """How late its stamps are, s, if that is what is off."""

    def is_rest_of(self, others: Iterable[DetectedFault]) -> bool:
        """Return whether it is what is left of a lie of the same sensor that has been taken off."""
        return self.treatment is Treatment.SAID and any(
            other.treatment is Treatment.FREED
            and other.sensor == self.sensor
            and other.begin_s < self.end_s
            and other.end_s > self.begin_s
            for other in others
        )

    @property
    def is_decided(self) -> bool:
        """Whether the data name this sensor then, and no other: how it was off may be open."""
        this = f"{self._when}, "
        return all(rival.startswith(this) for rival in self.rivals)

    @property
    def is_suspect(self) -> bool:
        """Whether the answer may be wrong over this stretch by more than its sigmas say."""
        return not self.treatment.is_harmless or not self.is_decided

    @property
    def sentence(self) -> str:
        """The finding for people: who, when, what, and what became of it."""
        text = f"{self._when}, {self.what}: {self.treatment.value}"
        if self.rivals:
            text += f"; {' or '.join(self.rivals)} would explain the data as well"
            text += f" (the answers differ by {self.cost_m:.2g} m at most)" if self.cost_m else ""
        return f"{text}; {self.remedy}" if self.remedy else text

    @property
    def _when(self) -> str:
        return f"{self.sensor}, {self.begin_s:.0f}-{self.end_s:.0f} s"
