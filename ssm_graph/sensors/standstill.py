"""Times in which the vehicle did not go anywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from ssm_graph.base.errors import DataError


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
