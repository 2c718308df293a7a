"""Checks of settings; each message says where, what was expected, what came, what to try."""

from __future__ import annotations

import math

from ssm_graph.base.errors import ConfigError


def require(condition: bool, where: str, *, expected: str, got: object, hint: str) -> None:
    """Raise :class:`ConfigError` unless ``condition`` holds."""
    if not condition:
        raise ConfigError(f"{where}: expected {expected}, got {got!r}; {hint}")


def require_positive(where: str, value: float, *, hint: str) -> None:
    """Refuse anything but a finite number above zero."""
    require(
        math.isfinite(value) and value > 0.0,
        where,
        expected="a finite number above 0",
        got=value,
        hint=hint,
    )


def require_not_negative(where: str, value: float, *, hint: str) -> None:
    """Refuse anything but a finite number of at least zero."""
    require(
        math.isfinite(value) and value >= 0.0,
        where,
        expected="a finite number of at least 0",
        got=value,
        hint=hint,
    )


def require_fraction(where: str, value: float) -> None:
    """Refuse anything but a number between 0 and 1."""
    require(
        0.0 <= value <= 1.0,
        where,
        expected="a fraction between 0 and 1",
        got=value,
        hint="write 10 % as 0.1",
    )


def require_window(where: str, start_s: float, end_s: float) -> None:
    """Refuse a window of time that is empty or runs backwards."""
    require(
        math.isfinite(start_s) and start_s < end_s,
        where,
        expected="start_s < end_s, seconds since the start",
        got=(start_s, end_s),
        hint="swap the two times or drop the window",
    )


def require_beams(where: str, beams: tuple[int, ...], n_beams: int) -> None:
    """Refuse an empty, repeated or unknown choice of beams."""
    known = bool(beams) and len(set(beams)) == len(beams) and set(beams) <= set(range(n_beams))
    require(
        known,
        where,
        expected=f"different beams out of 0..{n_beams - 1}",
        got=beams,
        hint="beams are counted from 0",
    )
