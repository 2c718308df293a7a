"""Sections of a TOML file: what a key may hold, and reading a section with every key checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.frozen import Array
from ssm_graph.sensors.limits import DEEPEST_M, LON_RANGE_DEG

TOML_NAME: Final = "mission.toml"
_SHOWN: Final = 60


@dataclass(frozen=True, slots=True)
class Key:
    """One key of a section: what it holds and the range in which a value can be right."""

    shape: tuple[int, ...] | None = ()
    """() for a number, (3,) for three numbers, None for text."""
    low: float = -math.inf
    high: float = math.inf
    positive: bool = False
    """The value must be above zero."""
    required: bool = True
    hint: str = ""
    """What to try when the value is out of range."""

    @property
    def wanted(self) -> str:
        """The expected value in words."""
        if self.shape is None:
            return "a text in quotes"
        words = {(): "a number", (3,): "a list of 3 numbers"}
        text = words.get(self.shape, " lists of ".join(str(n) for n in self.shape) + " numbers")
        if self.positive:
            text += f" above 0 and up to {self.high:g}" if self.high < math.inf else " above 0"
        elif math.isfinite(self.low) and math.isfinite(self.high):
            text += f" from {self.low:g} to {self.high:g}"
        elif math.isfinite(self.low):
            text += f" not below {self.low:g}"
        return text

    def problem(self, value: Any) -> str:
        """Return "" for a good value, "type" or "range" for a bad one."""
        if self.shape is None:
            return "" if isinstance(value, str) and value.strip() else "type"
        numbers = _numbers(value, self.shape)
        if numbers is None or not all(math.isfinite(number) for number in numbers):
            return "type"
        low_ok = all(x > 0.0 for x in numbers) if self.positive else min(numbers) >= self.low
        return "" if low_ok and max(numbers) <= self.high else "range"


def sigma_key(high: float, hint: str = "", *, required: bool = True) -> Key:
    """Return the key of a standard deviation: above zero."""
    return Key(positive=True, high=high, required=required, hint=hint)


def optional_key(low: float, high: float, hint: str) -> Key:
    """Return a key of a number that may be left out; it is zero then."""
    return Key(low=low, high=high, required=False, hint=hint)


FILE_KEY: Final = Key(shape=None)
LEVER_ARM_KEY: Final = Key(shape=(3,), low=-100.0, high=100.0, hint="lever arms are in metres")
PLACE_KEYS: Final[Mapping[str, Key]] = {
    "lat_deg": Key(low=-90.0, high=90.0, hint="are latitude and longitude swapped?"),
    "lon_deg": Key(low=LON_RANGE_DEG[0], high=LON_RANGE_DEG[1], hint="longitude is in degrees"),
    "height_m": Key(
        low=-DEEPEST_M, high=20000.0, hint="height is in metres above the ellipsoid, up"
    ),
}


@dataclass(frozen=True, slots=True)
class Settings:
    """The checked values of one section, in the units of the file."""

    section: str
    """Its name; empty for the keys that stand above all sections."""
    values: Mapping[str, Any]
    file: str = TOML_NAME

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def text(self, key: str) -> str:
        """Return a text."""
        return str(self.values[key])

    def number(self, key: str) -> float:
        """Return a number; an optional one that is not given is zero."""
        return float(self.values.get(key, 0.0))

    def array(self, key: str) -> Array:
        """Return a list as an array."""
        return np.array(self.values[key], dtype=np.float64)

    def fault(self, key: str, text: str) -> ConfigError:
        """Return an error that names file, section and key."""
        place = f"{place_of(self.section)} " if self.section else ""
        return ConfigError(f"{self.file} {place}{key}: {text}")


def read_settings(
    section: str,
    raw: object,
    *,
    known: Mapping[str, Key],
    file: str = TOML_NAME,
    may_miss: frozenset[str] = frozenset(),
) -> Settings:
    """Check every key of a section.

    Parameters
    ----------
    section : its name; with both brackets, ``[[beacon]] 2``, for one of a list.
    raw : what the file holds under that name.
    known : the keys that it may have.
    file : the file's name in messages.
    may_miss : required keys that this file can do without.
    """
    place = f"{file} {place_of(section)}".rstrip()
    if not isinstance(raw, dict):
        raise ConfigError(f"{place}: expected a section, got {shown(raw)}")
    for key in raw:
        if key not in known:
            missing = [name for name in known if name not in raw]
            hint = nearest_hint(key, missing or known)
            raise ConfigError(f"{place} {key}: unknown key; {hint}")
    for name, key in known.items():
        if key.required and name not in raw and name not in may_miss:
            raise ConfigError(f"{place} {name}: the key is missing; expected {key.wanted}")
    settings = Settings(section, {name: _plain(value) for name, value in raw.items()}, file)
    for name, value in settings.values.items():
        problem = known[name].problem(value)
        if problem:
            tail = f"; {known[name].hint}" if known[name].hint and problem == "range" else ""
            raise settings.fault(
                name, f"expected {known[name].wanted}, got {shown(raw[name])}{tail}"
            )
    return settings


def place_of(section: str) -> str:
    """Return a section's name as it stands in the file."""
    return section if section.startswith("[[") or not section else f"[{section}]"


def shown(value: object) -> str:
    """Return a value as it is shown in a message, cut where it is long."""
    try:
        text = repr(value)
    except ValueError:  # an integer of more than 4300 digits
        text = "a number of very many digits"
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def _plain(value: Any) -> Any:
    """Return ints, also those in lists, as floats; an int too large for a float becomes inf."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value) if abs(value) < 10**300 else math.inf
    return value


def _numbers(value: Any, shape: tuple[int, ...]) -> list[float] | None:
    """Return the numbers in nested lists of just this shape, else None."""
    if not shape:
        return [value] if isinstance(value, float) else None
    if not isinstance(value, list) or len(value) != shape[0]:
        return None
    parts = [_numbers(item, shape[1:]) for item in value]
    if any(part is None for part in parts):
        return None
    return [number for part in parts if part is not None for number in part]
