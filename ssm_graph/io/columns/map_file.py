"""``map.toml``: which columns of which file are which quantity, in which unit, sign and axes."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Final, NamedTuple

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.settings import read_settings_file, shown
from ssm_graph.base.units import SEA_WATER, STANDARD_ATMOSPHERE
from ssm_graph.io.mission_folder.toml import TABLES
from ssm_graph.sensors.imu import Stamp
from ssm_graph.sensors.instrument import Column

FORMAT: Final = 1
_UNITS: Final = {
    "rad_per_s": "rad/s",
    "m_per_s2": "m/s^2",
    "m_per_s": "m/s",
    "deg": "deg",
    "ut": "uT",
    "m": "m",
    "s": "s",
}
"""Unit of a column of a mission folder, by the end of its name."""
_OWN_NAMES: Final = {"vel_{}_m_per_s": ("velocity", "m/s"), "{}_deg": ("attitude", "deg")}
"""Name and unit of columns that have to be called otherwise than in their table."""
_SUFFIX: Final = re.compile(rf"(.+?)_({'|'.join(_UNITS)})")
PASCAL: Final = "Pa"
_OF_SECTION: Final = frozenset({"file", "time", "only_changes"})
_OF_QUANTITY: Final = frozenset(
    {"column", "columns", "value", "values", "unit", "axes", "missing", "valid"}
)
_OF_TIME: Final = frozenset({"column", "columns", "unit", "units", "offset_s"})


class Wanted(NamedTuple):
    """A quantity that an instrument can have."""

    column: Column
    unit: str
    """In which its table has it; "" for a number without."""

    @property
    def name(self) -> str:
        """In the map."""
        return _name_and_unit(self.column)[0]


def _name_and_unit(column: Column) -> tuple[str, str]:
    if column.pattern in _OWN_NAMES:
        return _OWN_NAMES[column.pattern]
    key = column.pattern.replace("{}_", "_").strip("_").replace("__", "_")
    found = _SUFFIX.fullmatch(key)
    return (found[1], _UNITS[found[2]]) if found else (key, "")


QUANTITIES: Final[Mapping[str, Mapping[str, Wanted]]] = {
    one.section: {
        name: Wanted(column, unit)
        for column in one.columns
        for name, unit in (_name_and_unit(column),)
    }
    for one in TABLES
}
"""By section and name: those of the columns of its table, ``gyro`` of ``gyro_{}_rad_per_s``."""
INSTEAD: Final = {"dvl": ("velocity", "m/s"), "depth": ("pressure", PASCAL)}
"""What a section may have in the place of its first quantity."""
PRESSURE_KEYS: Final = {
    "water_density_kg_per_m3": SEA_WATER,
    "atmosphere_pa": STANDARD_ATMOSPHERE,
}
"""Of a depth by pressure, with what is the case without: sea water, an absolute pressure."""
SURFACE_KEY: Final = "surface_height_m"


@dataclass(frozen=True, slots=True)
class Quantity:
    """Where one quantity comes from."""

    place: str
    """In the map, for messages."""
    columns: tuple[str, ...]
    """Names, with a minus before one whose sign is turned."""
    values: tuple[float, ...]
    """Constants in the place of columns."""
    unit: str
    """That of the columns; "" for the table's own."""
    axes: BodyAxes
    """Of a vector of x, y, z."""
    missing: tuple[float, ...]
    """Numbers of the columns that stand for no reading."""
    valid: tuple[str, ...]
    """Columns that are zero or empty where there is no reading: one, or one for each."""


@dataclass(frozen=True, slots=True)
class Times:
    """Where the times of a section come from: the sum of columns, each in its unit."""

    place: str
    columns: tuple[str, ...]
    units: tuple[str, ...]
    offset_s: float


@dataclass(frozen=True, slots=True)
class MapSection:
    """One instrument."""

    name: str
    place: str
    file: str
    """Name or pattern of its file; "" where there is one file."""
    times: Times
    quantities: Mapping[str, Quantity]
    stamp: Stamp
    only_changes: bool
    """Rows that repeat all readings of the row before are left out."""
    pressure: Mapping[str, float] = field(default_factory=dict)
    """Water and air of a depth by pressure."""


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """A map, checked but for the names of columns, which only the files can tell."""

    path: Path
    vehicle: Path | None
    """Of its key ``vehicle``, beside the map."""
    sections: tuple[MapSection, ...]

    def file_of(self, section: MapSection, files: tuple[Path, ...]) -> Path:
        """Return the file that a section is read from; raise where none or several fit."""
        found = [file for file in files if fnmatch(file.name, section.file or "*")]
        if len(found) == 1:
            return found[0]
        names = ", ".join(file.name for file in files)
        what = f"file = {section.file!r}" if section.file else "no file"
        raise ConfigError(
            f"{section.place}: {what} and the files {names}; expected one that fits, got "
            f"{len(found)}; give its name or a pattern, file = {files[0].name!r}"
        )


def read_map(path: Path) -> ColumnMap:
    """Read and check a map; raise :class:`ConfigError` naming section and key."""
    try:
        raw = tomllib.loads(read_settings_file(path).decode("utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: expected valid TOML, got: {error}") from error
    if raw.pop("format", None) != FORMAT:
        raise ConfigError(f"{path.name} format: expected format = {FORMAT}")
    vehicle = raw.pop("vehicle", None)
    if vehicle is not None and not isinstance(vehicle, str):
        raise ConfigError(f"{path.name} vehicle: expected the name of a file, got {shown(vehicle)}")
    for name in raw:
        if name not in QUANTITIES:
            raise ConfigError(
                f"{path.name} {name}: unknown section; {nearest_hint(name, QUANTITIES)}"
            )
    if "imu" not in raw:
        raise ConfigError(f"{path.name} [imu]: the section is missing; a mission needs it")
    return ColumnMap(
        path,
        None if vehicle is None else path.parent / vehicle,
        tuple(_section(path.name, name, raw[name]) for name in QUANTITIES if name in raw),
    )


def _section(file: str, name: str, raw: Any) -> MapSection:
    place = f"{file} [{name}]"
    if not isinstance(raw, dict):
        raise ConfigError(f"{place}: expected a section, got {shown(raw)}")
    wanted = {key: one.unit for key, one in QUANTITIES[name].items()}
    wanted |= dict([INSTEAD[name]]) if name in INSTEAD else {}
    own = {"stamp"} if name == "imu" else set()
    if name == "depth":
        own |= {*PRESSURE_KEYS, SURFACE_KEY}
    known = {*_OF_SECTION, *own, *wanted}
    for key in raw:
        if key not in known:
            raise ConfigError(f"{place} {key}: unknown key; {nearest_hint(key, known)}")
    if "time" not in raw:
        raise ConfigError(f'{place} time: the key is missing; expected time = {{ column = "..." }}')
    quantities = {key: _quantity(f"{place} {key}", raw[key]) for key in wanted if key in raw}
    _check_complete(place, name, quantities)
    return MapSection(
        name=name,
        place=place,
        file=_text(f"{place} file", raw.get("file", "")),
        times=_times(f"{place} time", raw["time"]),
        quantities=quantities,
        stamp=_choice(f"{place} stamp", raw.get("stamp", "end"), Stamp),
        only_changes=_flag(f"{place} only_changes", raw.get("only_changes", False)),
        pressure={
            key: _number(f"{place} {key}", raw[key])
            for key in (*PRESSURE_KEYS, SURFACE_KEY)
            if key in raw
        },
    )


def _check_complete(place: str, name: str, found: Mapping[str, Quantity]) -> None:
    """Raise for a quantity that a table cannot do without."""
    instead = INSTEAD[name][0] if name in INSTEAD else ""
    first = next(iter(QUANTITIES[name]), "")
    for key, wanted in QUANTITIES[name].items():
        is_there = key in found or (key == first and instead in found)
        if not is_there and not wanted.column.optional:
            tail = f", or {instead}" if instead and key == first else ""
            raise ConfigError(f"{place} {key}: the key is missing{tail}; expected its columns")
    if instead in found and first in found:
        raise ConfigError(f"{place} {instead}: given together with {first}; keep one of the two")


def _quantity(place: str, raw: Any) -> Quantity:
    if isinstance(raw, (str, list)):
        raw = {"columns": raw}
    raw = _table(place, raw, _OF_QUANTITY)
    columns = _names(place, raw.get("columns", raw.get("column", [])))
    values = raw.get("values", raw.get("value", []))
    values = values if isinstance(values, list) else [values]
    if bool(columns) == bool(values):
        raise ConfigError(f'{place}: expected columns = ["..."], or values = [...] for constants')
    missing = raw.get("missing", [])
    return Quantity(
        place=place,
        columns=columns,
        values=tuple(_number(place, value) for value in values),
        unit=_text(f"{place} unit", raw.get("unit", "")),
        axes=_choice(f"{place} axes", raw.get("axes", "FRD"), BodyAxes),
        missing=tuple(
            _number(f"{place} missing", code)
            for code in (missing if isinstance(missing, list) else [missing])
        ),
        valid=_names(f"{place} valid", raw.get("valid", [])),
    )


def _times(place: str, raw: Any) -> Times:
    if isinstance(raw, (str, list)):
        raw = {"columns": raw}
    raw = _table(place, raw, _OF_TIME)
    columns = _names(place, raw.get("columns", raw.get("column", [])))
    units = _names(f"{place} units", raw.get("units", raw.get("unit", ["s"] * len(columns))))
    if not columns or len(units) != len(columns):
        raise ConfigError(
            f"{place}: expected one column and its unit, or several that are added with as many "
            f'units, ["s", "ns"], got {len(columns)} and {len(units)}'
        )
    return Times(place, columns, units, _number(f"{place} offset_s", raw.get("offset_s", 0.0)))


def _table(place: str, raw: Any, known: frozenset[str]) -> dict[str, Any]:
    if not isinstance(raw, dict):
        raise ConfigError(f'{place}: expected {{ columns = ["..."], unit = "..." }}, got {raw!r}')
    for key in raw:
        if key not in known:
            raise ConfigError(f"{place} {key}: unknown key; {nearest_hint(key, known)}")
    return raw


def _names(place: str, raw: Any) -> tuple[str, ...]:
    names = [raw] if isinstance(raw, str) else raw
    if not isinstance(names, list) or not all(isinstance(n, str) and n.strip() for n in names):
        raise ConfigError(f"{place}: expected names in quotes, got {shown(raw)}")
    return tuple(names)


def _text(place: str, raw: Any) -> str:
    if not isinstance(raw, str):
        raise ConfigError(f"{place}: expected a text in quotes, got {shown(raw)}")
    return raw


def _flag(place: str, raw: Any) -> bool:
    if not isinstance(raw, bool):
        raise ConfigError(f"{place}: expected true or false, got {shown(raw)}")
    return raw


def _number(place: str, raw: Any) -> float:
    if isinstance(raw, bool) or not isinstance(raw, (int, float)):
        raise ConfigError(f"{place}: expected a number, got {shown(raw)}")
    return float(raw)


def _choice(place: str, raw: Any, kind: Any) -> Any:
    try:
        return kind(raw)
    except ValueError:
        known = ", ".join(str(choice.value) for choice in kind)
        raise ConfigError(f"{place}: expected one of {known}, got {shown(raw)}") from None
