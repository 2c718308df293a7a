"""What a live estimator is told: one reading of one instrument at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class Message:
    """One reading; those of each instrument say what was read, SI units, radians, body axes FRD."""

    MAY_MISS: ClassVar[frozenset[str]] = frozenset()
    """Fields whose numbers may be NaN."""

    time_s: float
    """As stamped, s on the vehicle's clock."""


def bad_number(message: Message) -> str | None:
    """Return the name of the first field that is not finite, None if all are usable.

    Missing beams and sigmas of a ping are NaN on purpose; infinite ones are not.
    """
    for spec in fields(message):
        value = getattr(message, spec.name)
        if value is None:
            continue
        may_miss = spec.name in message.MAY_MISS
        for number in value if isinstance(value, tuple) else (value,):
            if not math.isfinite(number) and not (may_miss and math.isnan(number)):
                return spec.name
    return None
