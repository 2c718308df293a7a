"""Settings whose fields declare what they may hold.

Each message says where, what was expected, what came, what to try.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import MISSING, fields
from functools import partial
from typing import Any, Final, NamedTuple, cast

from ssm_graph.base.errors import ConfigError
from ssm_graph.sensors.dvl import MOST_BEAMS


class Rule(NamedTuple):
    """What a field may hold."""

    holds: Callable[[Any], bool]
    expected: str
    hint: str = ""
    """What to try; a field may have a better one."""


def _are_finite(point: Sequence[float]) -> bool:
    return len(point) == 3 and all(math.isfinite(c) for c in point)


def _is_window(window: Sequence[float]) -> bool:
    start_s, end_s = window
    return math.isfinite(start_s) and start_s < end_s


def _are_beams(beams: Sequence[int]) -> bool:
    is_known = set(beams) <= set(range(MOST_BEAMS))
    return bool(beams) and len(set(beams)) == len(beams) and is_known


POSITIVE: Final = Rule(lambda x: math.isfinite(x) and x > 0.0, "a finite number above 0")
NOT_NEGATIVE: Final = Rule(lambda x: math.isfinite(x) and x >= 0.0, "a finite number of at least 0")
FRACTION: Final = Rule(lambda x: 0.0 <= x <= 1.0, "a fraction between 0 and 1", "write 10 % as 0.1")
POINT: Final = Rule(_are_finite, "three finite numbers, m", "body axes are forward, right, down")
VELOCITY: Final = Rule(_are_finite, "three finite numbers, m/s", "axes are east, north, up")
SIZES: Final = Rule(
    lambda size: 0.0 <= size[0] <= size[1] < math.inf,
    "0 <= low <= high",
    "sizes are absolute values, the sign is drawn",
)
WINDOW: Final = Rule(
    _is_window, "start_s < end_s, seconds since the start", "swap the two times or drop the window"
)
WINDOWS: Final = Rule(lambda windows: all(map(_is_window, windows)), *WINDOW[1:])
BEAMS: Final = Rule(
    _are_beams, f"different beams out of 0..{MOST_BEAMS - 1}", "beams are counted from 0"
)


def require(condition: bool, where: str, *, expected: str, got: object, hint: str) -> None:
    """Raise :class:`ConfigError` unless ``condition`` holds."""
    if not condition:
        raise ConfigError(f"{where}: expected {expected}, got {got!r}; {hint}")


def require_rule(where: str, rule: Rule, value: object, *, hint: str = "") -> None:
    """Raise :class:`ConfigError` unless a rule holds."""
    is_good = rule.holds(value)
    require(is_good, where, expected=rule.expected, got=value, hint=hint or rule.hint)


def require_beams(where: str, named: Sequence[int], n_beams: int) -> None:
    """Refuse beams that an instrument of ``n_beams`` does not have."""
    expected = f"different beams out of 0..{n_beams - 1}"
    is_known = set(named) <= set(range(n_beams))
    require(is_known, where, expected=expected, got=tuple(named), hint=BEAMS.hint)


def field(rule: Rule, default: Any = MISSING, *, hint: str = "") -> Any:
    """Declare a field of :class:`Settings` with what it may hold; None is always left alone."""
    metadata = {"rule": rule, "hint": hint or rule.hint}
    return dataclasses.field(default=default, metadata=metadata)


positive, not_negative = partial(field, POSITIVE), partial(field, NOT_NEGATIVE)
fraction, point, velocity = (
    partial(field, FRACTION),
    partial(field, POINT),
    partial(field, VELOCITY),
)
sizes, windows, beams = partial(field, SIZES), partial(field, WINDOWS), partial(field, BEAMS)


class Settings:
    """Checks every field that is declared with :func:`field`."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for spec in fields(cast(Any, self)):
            rule, value = spec.metadata.get("rule"), getattr(self, spec.name)
            if rule is not None and value is not None:
                where = f"{type(self).__name__}.{spec.name}"
                require_rule(where, rule, value, hint=spec.metadata["hint"])
