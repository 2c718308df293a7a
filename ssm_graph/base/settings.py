"""Sections of a TOML file, declared key by key: what each may hold, its unit, and where it goes.

One declaration checks a section, builds a frozen value of it, and writes the section again.
"""

from __future__ import annotations

import json
import math
import stat
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Any, Final, TypeVar, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.frames import BodyAxes, matrix_to_frd, to_frd
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import in_unit, wrapped

_SHOWN: Final = 60
MOST_BYTES: Final = 2**20
MOST_DOTS: Final = 500
LEAST_SIZE: Final = 1e-12
"""Smallest size that is not zero, in the unit of its key, whatever that is: less is a slip, and
what is divided by its square overflows."""
_Kind = TypeVar("_Kind")
_Choice = TypeVar("_Choice", bound=Enum)


@dataclass(frozen=True, slots=True)
class Key:
    """One key of a section: what it holds and the range in which a value can be right."""

    field: str = ""
    """Of the value that the section describes, such as ``calibration.offset``; "" for none."""
    shape: tuple[int | tuple[int, int], ...] | None = ()
    """() for a number, (3,) for three numbers, a pair for any count between, None for text."""
    low: float = -math.inf
    high: float = math.inf
    positive: bool = False
    """The value must be above zero."""
    required: bool = True
    hint: str = ""
    """What to try when the value is out of range."""
    unit: float = 1.0
    """One unit of the file in SI."""
    is_body: bool = False
    """A vector in the body axes of the file."""
    is_body_matrix: bool = False
    """Numbers of a matrix in the body axes of the file, see :func:`matrix_to_frd`."""
    wraps: bool = False
    """An angle that is kept within half a turn."""
    beside: tuple[str, str] = ("", "")
    """A key without which this one says nothing, and what is expected then."""

    @property
    def wanted(self) -> str:
        """The expected value in words."""
        if self.shape is None:
            return "a text in quotes"
        sizes = [f"{n[0]} to {n[1]}" if isinstance(n, tuple) else str(n) for n in self.shape]
        words: dict[object, str] = {(): "a number", (3,): "a list of 3 numbers"}
        text = words.get(self.shape, " lists of ".join(sizes) + " numbers")
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
        low_ok = all(x > 0.0 if self.positive else x >= self.low for x in numbers)
        if self.positive or self.low == 0.0:  # its square has to be told from zero
            low_ok = low_ok and not any(0.0 < x < LEAST_SIZE for x in numbers)
        return "" if low_ok and all(x <= self.high for x in numbers) else "range"


def sigma_key(field: str, high: float, hint: str = "", **more: Any) -> Key:
    """Return the key of a standard deviation: above zero; ``more`` are other fields of a key."""
    return Key(field, positive=True, high=high, hint=hint, **more)


def number_key(field: str, low: float, high: float, hint: str = "", **more: Any) -> Key:
    """Return the key of numbers within limits; ``more`` are other fields of a key."""
    return Key(field, low=low, high=high, hint=hint, **more)


def optional_key(field: str, low: float, high: float, hint: str, **more: Any) -> Key:
    """Return a key of a number that may be left out; it is zero, or what its field says, then."""
    return number_key(field, low, high, hint, required=False, **more)


def correlation_key(field: str, high: float, beside: tuple[str, str]) -> Key:
    """Return the key of how long an error is remembered, s, which stands ``beside`` its sigma."""
    hint = "the unit is seconds"
    return Key(field, positive=True, high=high, required=False, hint=hint, beside=beside)


FILE_KEY: Final = Key(shape=None)
"""Where the table of an instrument is."""
LEVER_ARM_KEY: Final = Key(
    "lever_arm_b", shape=(3,), low=-100.0, high=100.0, hint="lever arms are in metres", is_body=True
)


@dataclass(frozen=True, slots=True)
class Settings:
    """The checked values of one section, in the units of the file."""

    section: str
    """Its name; empty for the keys that stand above all sections."""
    values: Mapping[str, Any]
    file: str
    known: Mapping[str, Key]
    """The keys that it may have."""
    axes: BodyAxes = BodyAxes.FRD
    """Of the vectors in body axes."""

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def text(self, key: str) -> str:
        """Return a text."""
        return str(self.values[key])

    def number(self, key: str) -> float:
        """Return a number in the unit of the file; an optional one that is not given is zero."""
        return float(self.values.get(key, 0.0))

    def count(self, key: str) -> int:
        """Return a whole number; an optional one that is not given is zero."""
        value = self.number(key)
        if not value.is_integer():
            raise self.fault(key, f"expected a whole number, got {value:g}")
        return int(value)

    def counts(self, key: str) -> NDArray[np.int64]:
        """Return a list, or lists of a list, of whole numbers."""
        values = self.array(key)
        if np.any(values != np.floor(values)):
            raise self.fault(key, f"expected whole numbers, got {shown(self.values[key])}")
        return values.astype(np.int64)

    def array(self, key: str) -> Array:
        """Return a list as an array, in the unit of the file."""
        return np.array(self.values[key], dtype=np.float64)

    def choice(self, key: str, choices: type[_Choice], default: _Choice) -> _Choice:
        """Return the member of an enumeration that a text names."""
        if key not in self:
            return default
        try:
            return choices(self.values[key])
        except ValueError:
            known = ", ".join(str(choice.value) for choice in choices)
            got = shown(self.values[key])
            raise self.fault(key, f"expected one of {known}, got {got}") from None

    def si(self, key: str) -> float | Array:
        """Return a number or a list in SI units; body vectors in forward-right-down."""
        known = self.known[key]
        value = self.array(key) * known.unit
        if known.wraps:
            value = wrapped(value)
        if known.is_body:
            value = to_frd(value, self.axes)
        if known.is_body_matrix:
            value = matrix_to_frd(value, self.axes)
        return value if known.shape else float(value)

    def given(self) -> dict[str, float | Array]:
        """Return what the file says by the fields of the value that it describes, SI units."""
        return {
            key.field: self.si(name)
            for name, key in self.known.items()
            if key.field and name in self
        }

    def fault(self, key: str, text: str) -> ConfigError:
        """Return an error that names file, section and key."""
        place = f"{place_of(self.section)} " if self.section else ""
        return ConfigError(f"{self.file} {place}{key}: {text}")


def read_settings(
    section: str,
    raw: object,
    *,
    known: Mapping[str, Key],
    file: str,
    axes: BodyAxes = BodyAxes.FRD,
    may_miss: frozenset[str] = frozenset(),
) -> Settings:
    """Check every key of a section.

    ``section`` is its name; with both brackets, ``[[beacon]] 2``, for one of a list. ``may_miss``
    are required keys that this file can do without.
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
    values = {name: _plain(value) for name, value in raw.items()}
    settings = Settings(section, values, file, known, axes)
    for name, value in values.items():
        problem = known[name].problem(value)
        if problem:
            tail = f"; {known[name].hint}" if known[name].hint and problem == "range" else ""
            raise settings.fault(
                name, f"expected {known[name].wanted}, got {shown(raw[name])}{tail}"
            )
    for name in values:
        other, expected = known[name].beside
        if not other:
            continue
        is_said = known[name].shape is None or np.any(settings.array(name))
        if is_said and not settings.number(other):
            raise settings.fault(name, expected)
    return settings


def build(kind: type[_Kind], given: Mapping[str, Any]) -> _Kind:
    """Return a frozen value of its fields; a dotted field is one of a value within the value."""
    hints = get_type_hints(kind)
    values = {name: value for name, value in given.items() if "." not in name}
    for name in {name.split(".")[0] for name in given if "." in name}:
        inner = {
            k.removeprefix(f"{name}."): v for k, v in given.items() if k.startswith(f"{name}.")
        }
        values[name] = build(hints[name], inner)
    return kind(**values)


def written(value: object, keys: Mapping[str, Key]) -> dict[str, Any]:
    """Return the section that describes a value: the inverse of reading and building it.

    Optional keys are left out where they say what is the case without them. Axes are FRD.
    """
    found: dict[str, Any] = {}
    for name, key in keys.items():
        if not key.field:
            continue
        owner, field = owner_of(value, key.field)
        inside = getattr(owner, field)
        if not key.required and (inside is None or np.all(inside == _default(owner, field))):
            continue
        if key.beside[0] and not getattr(*owner_of(value, keys[key.beside[0]].field)):
            continue
        cells = [in_unit(float(x), key.unit) for x in np.ravel(inside)]
        found[name] = np.reshape(cells, np.shape(inside)).tolist() if key.shape else cells[0]
    return found


def owner_of(value: object, dotted: str) -> tuple[object, str]:
    """Return the value within a value that has a field, and the field."""
    *outer, field = dotted.split(".")
    for part in outer:
        value = getattr(value, part)
    return value, field


def _default(owner: object, field: str) -> Any:
    """Return what a field is where nothing says it; zero where the value asks for it."""
    default = {spec.name: spec.default for spec in fields(cast(Any, owner))}[field]
    return 0.0 if default is MISSING else default


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


def read_settings_file(path: Path) -> bytes:
    """Return the bytes of a file that people write; what would take for ever to read is refused.

    Raises :class:`ConfigError` for a pipe, a folder, a file of more than :data:`MOST_BYTES`, and a
    line of more than :data:`MOST_DOTS` dots, whose keys are as many sections within each other.
    Raises :class:`OSError` where it cannot be read.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise ConfigError(f"{path.name}: expected a file, got {str(path)!r}, which is none")
    if found.st_size > MOST_BYTES:
        raise ConfigError(
            f"{path.name}: expected at most {MOST_BYTES} bytes of settings, got {found.st_size}; "
            "is it another file?"
        )
    content = path.read_bytes()
    for number, line in enumerate(content.split(b"\n"), 1):
        if line.count(b".") > MOST_DOTS:
            raise ConfigError(
                f"{path.name}:{number}: expected at most {MOST_DOTS} dots in a line, got "
                f"{line.count(b'.')}; write lists of numbers on several lines"
            )
    return content


def read_toml(path: Path) -> dict[str, Any]:
    """Return what a TOML file that people write says.

    Raises :class:`ConfigError` as :func:`read_settings_file` does and for what is no TOML in UTF-8,
    :class:`OSError` where it cannot be read.
    """
    try:
        return tomllib.loads(read_settings_file(path).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # of TOML, Unicode, digits and brackets
        raise ConfigError(f"{path}: expected TOML in UTF-8; {error}") from error


def parse_json(text: str | bytes) -> Any:
    """Return what JSON says; raise :class:`ValueError` for what is none, or nests too deep."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError(f"expected JSON, got brackets that nest too deep: {error}") from error


def _plain(value: Any) -> Any:
    """Return ints, also those in lists, as floats; an int too large for a float becomes inf."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value) if abs(value) < 10**300 else math.inf
    return value


def _numbers(value: Any, shape: tuple[int | tuple[int, int], ...]) -> list[float] | None:
    """Return the numbers in nested lists of just this shape, else None."""
    if not shape:
        return [value] if isinstance(value, float) else None
    least, most = shape[0] if isinstance(shape[0], tuple) else (shape[0], shape[0])
    if not isinstance(value, list) or not least <= len(value) <= most:
        return None
    parts = [_numbers(item, shape[1:]) for item in value]
    if any(part is None for part in parts):
        return None
    return [number for part in parts if part is not None for number in part]
