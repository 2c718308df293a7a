"""Keys of a study file: what each may hold beside the numbers and texts of a mission's."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, TypeVar

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.settings import Key, Settings, read_settings

_Choice = TypeVar("_Choice", bound=Enum)
_Made = TypeVar("_Made")
_Read = Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class StudyKey(Key):
    """A key with a reader of its own, which refuses by a TypeError or ValueError."""

    read: _Read = str
    expected: str = ""
    default: Any = None
    """Where the key is missing."""

    @property
    def wanted(self) -> str:
        """The expected value in words."""
        return self.expected

    def problem(self, value: Any) -> str:
        """Return "" for a good value, "range" for any other: the hint always helps."""
        try:
            self.read(value)
        except (TypeError, ValueError):
            return "range"
        return ""


def _of(kind: type, test: Callable[[Any], Any] = lambda _: True) -> _Read:
    """Return what reads a value of a kind that passes a test."""

    def read(value: Any) -> Any:
        if not isinstance(value, kind) or not test(value):
            raise TypeError
        return value

    return read


def _whole(least: int) -> _Read:
    number = _of(float, lambda n: n >= least and n.is_integer())
    return lambda value: int(number(value))


def _list(read: _Read, *, count: int | None = None, or_alone: bool = False) -> _Read:
    """Return what reads a list of one or more, or of so many; one alone may be a list of one."""

    def read_all(value: Any) -> tuple[Any, ...]:
        items = [value] if or_alone and not isinstance(value, list) else value
        if not isinstance(items, list) or not items or len(items) != (count or len(items)):
            raise TypeError
        return tuple(map(read, items))

    return read_all


REQUIRED: Any = object()
"""For ``default``: the key must be there."""
_NUMBER: Final = _of(float, math.isfinite)
_FRACTION: Final = _of(float, lambda x: 0.0 <= x <= 1.0)


def _kind(expected: str, read: _Read, hint: str = "see --help") -> Callable[..., StudyKey]:
    def make(default: Any = None) -> StudyKey:
        told: dict[str, Any] = {"hint": hint, "read": read, "expected": expected}
        if default is REQUIRED:
            return StudyKey(**told)
        return StudyKey(required=False, default=default, **told)

    return make


text = _kind("a text in quotes", _of(str, str.strip))
texts = _kind("a list of texts", _list(_of(str, str.strip)))
number = _kind("a finite number", _NUMBER)
numbers = _kind("a list of numbers", _list(_NUMBER, or_alone=True))
three = _kind("three numbers", _list(_NUMBER, count=3), "along east, north, up, as [0.3, 0.0, 0.0]")
seconds = _kind("seconds above 0", _of(float, lambda x: 0.0 < x < math.inf), "try 600")
fraction = _kind("a fraction between 0 and 1", _FRACTION, "write 10 % as 0.1")
fractions = _kind(
    "a fraction between 0 and 1, or a list of them",
    _list(_FRACTION, or_alone=True),
    "write 10 % as 0.1",
)
count = _kind("a whole number from 0", _whole(0), "raise it")
positive_count = _kind("a whole number from 1", _whole(1), "raise it")
counts = _kind("a list of whole numbers", _list(_whole(0)))
pairs = _kind("a list of pairs, as [[0.5, 3.0]]", _list(_list(_NUMBER, count=2)))
flag = _kind("true or false", _of(bool))
table = _kind("a table of keys", _of(dict))
tables = _kind("tables", _list(_of(dict)))


@dataclass(frozen=True, slots=True)
class StudyTable:
    """One table of a study file, every key checked."""

    settings: Settings
    keys: Mapping[str, StudyKey]

    @property
    def where(self) -> str:
        """File and table, as in messages."""
        return f"{self.settings.file} {self.settings.section}".rstrip()

    def __getitem__(self, name: str) -> Any:
        key = self.keys[name]
        return key.read(self.settings.values[name]) if name in self.settings else key.default

    def fault(self, name: str, expected: str, got: object, hint: str) -> ConfigError:
        """Return an error that names the key."""
        return self.settings.fault(name, f"expected {expected}, got {got!r}; {hint}")

    def of(self, name: str, keys: Mapping[str, StudyKey]) -> list[StudyTable]:
        """Return the tables under a key: one, those of a list, or none."""
        found, section = self.settings.values.get(name, []), self.settings.section
        if isinstance(found, dict):
            return [read_table(found, f"{section} {name}", keys, file=self.settings.file)]
        return [
            read_table(raw, f"{section} [[{name}]] {i}".strip(), keys, file=self.settings.file)
            for i, raw in enumerate(found, 1)
        ]

    def choices(self, name: str, kinds: type[_Choice]) -> tuple[_Choice, ...]:
        """Return members of an enumeration, named in lower case."""
        known = {member.name.lower(): member for member in kinds}
        told = self[name]
        for word in (told,) if isinstance(told, str) else told:
            if word not in known:
                expected = f"some of {', '.join(known)}"
                raise self.fault(name, expected, word, nearest_hint(word, known))
        return tuple(known[word] for word in ((told,) if isinstance(told, str) else told))

    def checked(self, make: Callable[[], _Made], key: str = "") -> _Made:
        """Return what is made, an error with the place in front."""
        try:
            return make()
        except ConfigError as error:
            raise ConfigError(f"{self.where} {key}".rstrip() + f": {error}") from error


def read_table(raw: object, section: str, keys: Mapping[str, StudyKey], *, file: str) -> StudyTable:
    """Check every key of a table; a ConfigError names file, table and key."""
    return StudyTable(read_settings(section, raw, known=keys, file=file), keys)
