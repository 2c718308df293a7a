"""A TOML table read strictly: unknown keys and wrong types are refused, saying where."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from typing import Any, TypeVar

from ssm_graph.base.errors import ConfigError, nearest_hint

_Choice = TypeVar("_Choice", bound=Enum)
_Value = TypeVar("_Value")

MISSING: Any = object()
"""For ``default``: the key must be there."""


class TomlTable:
    """One table of a study file; every key is taken once, and :meth:`end` refuses the rest."""

    def __init__(self, where: str, values: object) -> None:
        if not isinstance(values, dict):
            raise ConfigError(f"{where}: expected a table of keys, got {values!r}; see --help")
        self.where = where
        self._values = dict(values)
        self._asked: set[str] = set()

    def has(self, key: str) -> bool:
        """Return whether the key is given."""
        self._asked.add(key)
        return key in self._values

    def end(self) -> None:
        """Refuse keys that nothing asked for."""
        for key in self._values:
            if key not in self._asked:
                raise ConfigError(f"{self.where}: unknown key {key!r}; {self._hint(key)}")

    def _hint(self, key: str) -> str:
        return nearest_hint(key, self._asked)

    def fault(self, key: str, *, expected: str, got: object, hint: str) -> ConfigError:
        """Return an error that names the key."""
        return ConfigError(f"{self.where} {key}: expected {expected}, got {got!r}; {hint}")

    def _take(self, key: str, default: Any, expected: str, read: Callable[[Any], Any]) -> Any:
        self._asked.add(key)
        if key not in self._values:
            if default is MISSING:
                close = ConfigError(f"{self.where} {key}: expected {expected}, got nothing")
                raise close
            return default
        value = self._values[key]
        try:
            return read(value)
        except (TypeError, ValueError):
            raise self.fault(key, expected=expected, got=value, hint="see --help") from None

    def text(self, key: str, default: str = MISSING) -> str:
        """Return a text that is not empty."""
        return str(self._take(key, default, "a text in quotes", _text))

    def number(self, key: str, default: float = MISSING) -> float:
        """Return a finite number."""
        return float(self._take(key, default, "a finite number", _number))

    def count(self, key: str, default: int = MISSING, *, least: int = 0) -> int:
        """Return a whole number of at least ``least``."""
        value = int(self._take(key, default, f"a whole number from {least}", _whole))
        if value < least:
            raise self.fault(
                key, expected=f"a whole number from {least}", got=value, hint="raise it"
            )
        return value

    def flag(self, key: str, default: bool = MISSING) -> bool:
        """Return true or false."""
        return bool(self._take(key, default, "true or false", _flag))

    def texts(self, key: str, default: tuple[str, ...] = MISSING) -> tuple[str, ...]:
        """Return a list of texts."""
        return self._list(key, default, "a list of texts", _text)

    def numbers(self, key: str, default: tuple[float, ...] = MISSING) -> tuple[float, ...]:
        """Return a list of numbers; a number alone is a list of one."""
        if isinstance(self._values.get(key), int | float):
            return (self.number(key),)
        return self._list(key, default, "a list of numbers", _number)

    def counts(self, key: str, default: tuple[int, ...] = MISSING) -> tuple[int, ...]:
        """Return a list of whole numbers."""
        return self._list(key, default, "a list of whole numbers", _whole)

    def pairs(
        self, key: str, default: tuple[tuple[float, float], ...] = MISSING
    ) -> tuple[Any, ...]:
        """Return a list of pairs of numbers."""
        return self._list(key, default, "a list of pairs, as [[0.5, 3.0]]", _pair)

    def tables(self, key: str) -> tuple[TomlTable, ...]:
        """Return a list of tables, named by their place; none where the key is missing."""
        listed = self._list(key, (), f"tables [[{key}]]", _dict)
        path = f"{self.where} [[{key}]]"
        return tuple(TomlTable(f"{path} {i}", values) for i, values in enumerate(listed, 1))

    def table(self, key: str) -> TomlTable | None:
        """Return a table within this one; None where the key is missing."""
        if not self.has(key):
            return None
        return TomlTable(f"{self.where} {key}", self._values[key])

    def choices(
        self, key: str, kinds: type[_Choice], default: tuple[_Choice, ...] = MISSING
    ) -> tuple[_Choice, ...]:
        """Return members of an enumeration, named in lower case."""
        if not self.has(key) and default is not MISSING:
            return default
        return tuple(self._choice(key, name, kinds) for name in self.texts(key))

    def choice(self, key: str, kinds: type[_Choice], default: _Choice) -> _Choice:
        """Return a member of an enumeration, named in lower case."""
        return self._choice(key, self.text(key), kinds) if self.has(key) else default

    def _choice(self, key: str, name: str, kinds: type[_Choice]) -> _Choice:
        known = {member.name.lower(): member for member in kinds}
        if name not in known:
            expected = f"some of {', '.join(known)}"
            raise self.fault(key, expected=expected, got=name, hint=nearest_hint(name, known))
        return known[name]

    def _list(
        self,
        key: str,
        default: tuple[_Value, ...],
        expected: str,
        read: Callable[[Any], _Value],
    ) -> tuple[_Value, ...]:
        def read_all(value: Any) -> tuple[_Value, ...]:
            if not isinstance(value, list) or not value:
                raise TypeError
            return tuple(read(item) for item in value)

        taken: tuple[_Value, ...] = self._take(key, default, expected, read_all)
        return taken


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise TypeError
    return value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError
    return float(value)


def _whole(value: Any) -> int:
    if type(value) is not int:
        raise TypeError
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError
    return value


def _pair(value: Any) -> tuple[float, float]:
    first, second = value
    return _number(first), _number(second)


def _dict(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError
    return value
