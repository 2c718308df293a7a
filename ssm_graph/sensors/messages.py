"""What a live estimator is told: one reading of one instrument at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar, Final


@dataclass(frozen=True, slots=True)
class Message:
    """One reading; those of each instrument say what was read, SI units, radians, body axes FRD."""

    MAY_MISS: ClassVar[frozenset[str]] = frozenset()
    """Fields whose numbers may be NaN."""

    time_s: float
    """As stamped, s on the vehicle's clock."""


Readings = tuple[Message, ...]
"""A message in each way that its stamp can be read, the likeliest first."""

_FIELDS: Final[dict[type, tuple[str, ...]]] = {}


def field_names(kind: type[Message]) -> tuple[str, ...]:
    """Return the names of a message's fields; asked for every message of an IMU."""
    if kind not in _FIELDS:
        _FIELDS[kind] = tuple(spec.name for spec in fields(kind))
    return _FIELDS[kind]


def bad_number(message: Message) -> str | None:
    """Return the name of the first field that is not finite, None if all are usable.

    Missing beams and sigmas of a ping are NaN on purpose; infinite ones are not.
    """
    for name in field_names(type(message)):
        value = getattr(message, name)
        if value is None:
            continue
        numbers = value if isinstance(value, tuple) else (value,)
        if all(map(math.isfinite, numbers)):
            continue
        if name not in message.MAY_MISS or any(map(math.isinf, numbers)):
            return name
    return None
