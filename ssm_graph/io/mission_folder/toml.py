"""Reading ``mission.toml``: the sections with every key checked, and where the tables are."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from difflib import get_close_matches
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.frames import BodyAxes
from ssm_graph.io.mission_folder.aid_keys import LISTS
from ssm_graph.io.mission_folder.keys import (
    FORMAT,
    OPTIONAL_TABLES,
    REQUIRED_SECTIONS,
    SECTIONS,
    TABLES,
    Stamp,
)
from ssm_graph.io.tables.settings import TOML_NAME, Settings, read_settings, shown
from ssm_graph.io.tables.table import Order

_Choice = TypeVar("_Choice", bound=Enum)
_ABOUT_TABLES = frozenset({"file", "stamp"})


@dataclass(frozen=True, slots=True)
class MissionToml:
    """The content of one ``mission.toml``, checked."""

    folder: Path
    file: str
    """The file's own name in messages."""
    name: str
    order: Order
    body: BodyAxes
    stamp: Stamp
    sections: dict[str, Settings]
    lists: dict[str, tuple[Settings, ...]]
    """The sections that may come several times."""

    def __getitem__(self, section: str) -> Settings:
        return self.sections[section]

    def __contains__(self, section: str) -> bool:
        return section in self.sections

    def fault_of_no_place(self) -> ConfigError:
        """Return the error of a mission that may be anywhere on Earth."""
        return ConfigError(
            f"{self.file} [origin]: nothing says where on Earth the mission was; add [origin] with "
            "lat_deg, lon_deg and height_m, or a [gnss] or [usbl] table, or [initial]"
        )


def read_mission_toml(folder: Path) -> MissionToml:
    """Read and check ``mission.toml``; raise :class:`ConfigError` naming section and key."""
    wanted = f"a mission folder with {TOML_NAME} and its tables"
    return _checked(_parse(folder / TOML_NAME, wanted), folder / TOML_NAME, frozenset())


def read_vehicle_toml(path: Path) -> MissionToml:
    """Read and check a file like ``mission.toml`` that need not name tables nor their stamps."""
    wanted = "a file that describes a vehicle, or a mission folder"
    return _checked(_parse(path, wanted), path, _ABOUT_TABLES)


def _checked(raw: dict[str, Any], path: Path, may_miss: frozenset[str]) -> MissionToml:
    file = path.name
    _check_format(raw, file)
    for name in raw:
        if name not in (*SECTIONS, *LISTS, "format", "name", "order"):
            names = (*SECTIONS, *LISTS)
            missing = [known for known in names if known not in raw] or names
            known = ("order",) if get_close_matches(name, ("order",)) else missing
            raise ConfigError(f"{file} {name}: unknown key or section; {nearest_hint(name, known)}")
    for name in REQUIRED_SECTIONS:
        if name not in raw:
            raise ConfigError(f"{file} [{name}]: the section is missing; every mission needs it")
    sections = {
        name: read_settings(name, raw[name], known=SECTIONS[name], file=file, may_miss=may_miss)
        for name in raw
        if name in SECTIONS
    }
    _check_beam_keys(sections["dvl"])
    top = Settings("", {"order": raw.get("order", Order.TIME.value)}, file)
    return MissionToml(
        folder=path.parent,
        file=file,
        name=_mission_name(raw, file),
        order=_choice(top, "order", Order),
        body=_choice(sections["frames"], "body", BodyAxes),
        stamp=_choice(sections["imu"], "stamp", Stamp) if "stamp" in sections["imu"] else Stamp.END,
        sections=sections,
        lists={name: _read_list(name, raw.get(name, []), file) for name in LISTS},
    )


def _read_list(name: str, raw: object, file: str) -> tuple[Settings, ...]:
    """Read the sections ``[[name]]`` of a file."""
    if not isinstance(raw, list):
        raise ConfigError(
            f"{file} [{name}]: expected a list of sections, each under [[{name}]], got "
            f"{shown(raw)}; write double brackets"
        )
    return tuple(
        read_settings(f"[[{name}]] {number}", item, known=LISTS[name], file=file)
        for number, item in enumerate(raw, start=1)
    )


def table_path(toml: MissionToml, section: str) -> Path | None:
    """Return the path of a section's table; None where an optional table's file is missing.

    A name that is close to that of a file in the folder is a slip, and an error even then.
    """
    label = toml[section].text("file")
    path = toml.folder / label
    try:
        if path.is_file():
            return path
    except OSError as error:
        raise toml[section].fault("file", f"cannot be read: {error.strerror}") from error
    others = {toml[name].text("file") for name in TABLES if name in toml}
    found = sorted(p.name for p in toml.folder.iterdir() if p.name not in {*others, TOML_NAME})
    stems = {Path(name).stem: name for name in reversed(found)}
    close = get_close_matches(Path(label).stem, stems, n=1, cutoff=0.75)
    if section in OPTIONAL_TABLES and not close:
        return None
    hint = f"did you mean {stems[close[0]]!r}?" if close else "paths start at the mission folder"
    raise toml[section].fault("file", f"there is no file {label!r}; {hint}")


def _parse(path: Path, wanted: str) -> dict[str, Any]:
    file = path.name
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(
            f"{file}: there is none in {str(path.parent)!r}; expected {wanted}"
        ) from None
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: expected UTF-8 text, got bytes that are none") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: expected valid TOML, got: {error}") from error


def _check_format(raw: dict[str, Any], file: str) -> None:
    if "format" not in raw:
        raise ConfigError(f"{file} format: the key is missing; expected format = {FORMAT}")
    if type(raw["format"]) is not int or raw["format"] != FORMAT:
        raise ConfigError(
            f"{file} format: expected {FORMAT}, got {shown(raw['format'])}; a newer format "
            "needs a newer program"
        )


def _mission_name(raw: dict[str, Any], file: str) -> str:
    name = raw.get("name")
    if not isinstance(name, str) or not name.strip():
        got = "nothing" if name is None else shown(name)
        raise ConfigError(f"{file} name: expected a text in quotes, got {got}")
    return name


def _choice(settings: Settings, key: str, choices: type[_Choice]) -> _Choice:
    try:
        return choices(settings.values[key])
    except ValueError:
        known = [str(choice.value) for choice in choices]
        raise settings.fault(
            key,
            f"expected one of {', '.join(known)}, got {shown(settings.values[key])}",
        ) from None


def _check_beam_keys(dvl: Settings) -> None:
    angles = ("beam_azimuth_deg", "beam_janus_deg")
    given = [key for key in angles if key in dvl]
    if "beam_vectors" in dvl and given:
        raise dvl.fault("beam_vectors", f"given together with {given[0]}; keep one of the two")
    if "beam_vectors" not in dvl and len(given) < len(angles):
        missing = next(key for key in angles if key not in dvl)
        raise dvl.fault(
            missing,
            "the key is missing; expected beam_azimuth_deg with beam_janus_deg, or beam_vectors",
        )
