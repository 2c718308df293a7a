"""Reading ``mission.toml``: the sections with every key checked, and where the tables are."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.settings import (
    FILE_KEY,
    Key,
    Settings,
    build,
    number_key,
    read_settings,
    read_settings_file,
    shown,
)
from ssm_graph.base.tables import LARGEST_TIME_S, Order, Table
from ssm_graph.base.units import DEGREE
from ssm_graph.io.instruments import library as instruments
from ssm_graph.io.seabed.section import MAP_KEYS
from ssm_graph.mission.mission import InitialState, LocalStart, Reference
from ssm_graph.mission.point import POINT_KEYS, Point, point
from ssm_graph.sensors.current import CURRENT_KEYS
from ssm_graph.sensors.imu import Stamp
from ssm_graph.sensors.instrument import ENU, Column, Instrument
from ssm_graph.sensors.place import PLACE_KEYS, POSITION, PositionInstrument
from ssm_graph.sensors.registry import INSTRUMENTS
from ssm_graph.sensors.standstill import STANDSTILL_KEYS

TOML_NAME: Final = "mission.toml"
FORMAT: Final = 1
_ABOUT_TABLES = frozenset({"file", "stamp"})

VELOCITY: Final = Column(
    "velocity_enu",
    "vel_{}_m_per_s",
    ENU,
    limits=(-100.0, 100.0),
    expected="expected m/s; is it in mm/s?",
    optional=True,
)
ATTITUDE: Final = Column(
    "roll_pitch_heading",
    "{}_deg",
    ("roll", "pitch", "heading"),
    limits=(-360.0, 360.0),
    expected="expected degrees up to 360",
    unit=DEGREE,
    optional=True,
)
_PITCH: Final = Column("", "pitch_deg", limits=(-90.0, 90.0), expected="expected degrees up to 90")


class _Reference(PositionInstrument):
    """An outside trajectory is read and written as instruments are."""

    def check(self, table: Table, bare: Reference, axes: BodyAxes) -> list[str]:
        _PITCH.beyond(table)
        return super().check(table, bare, axes)


REFERENCE: Final = _Reference(
    "reference", Reference, {"file": FILE_KEY}, (*POSITION, VELOCITY, ATTITUDE)
)
INITIAL_KEYS: Final[Mapping[str, Key]] = {
    "time_s": Key("time_s", low=-LARGEST_TIME_S, high=LARGEST_TIME_S),
    **PLACE_KEYS,
    "vel_enu_m_per_s": number_key("velocity_enu", -50.0, 50.0, "the unit is m/s", shape=(3,)),
    "roll_deg": Key("roll", low=-180.0, high=180.0, unit=DEGREE),
    "pitch_deg": Key("pitch", low=-90.0, high=90.0, unit=DEGREE),
    "heading_deg": number_key(
        "heading", -180.0, 360.0, "heading is clockwise from north", unit=DEGREE
    ),
    "position_sigma_m": Key("position_sigma_enu", shape=(3,), positive=True, high=1e7),
    "velocity_sigma_m_per_s": Key("velocity_sigma_enu", shape=(3,), positive=True, high=1e3),
    "attitude_sigma_deg": Key("attitude_sigma", shape=(3,), positive=True, high=360.0, unit=DEGREE),
}
LOCAL_KEYS: Final[Mapping[str, Key]] = {
    "lat_deg": replace(PLACE_KEYS["lat_deg"], required=False),
    "heading_deg": replace(INITIAL_KEYS["heading_deg"], required=False),
    "heading_sigma_deg": Key(
        "heading_sigma", positive=True, high=180.0, required=False, unit=DEGREE
    ),
}
TABLES: Final = (*INSTRUMENTS, REFERENCE)
"""Everything that has a table, in the order in which tables are read."""
SECTIONS: Final[Mapping[str, Mapping[str, Key]]] = {
    "frames": {"body": Key(shape=None)},
    "origin": PLACE_KEYS,
    "current": CURRENT_KEYS,
    "initial": INITIAL_KEYS,
    "local": LOCAL_KEYS,
    "map": MAP_KEYS,
    **{one.section: one.keys for one in TABLES},
}
LISTS: Final[Mapping[str, Mapping[str, Key]]] = {
    **{name: keys for one in INSTRUMENTS for name, keys in one.lists.items()},
    "standstill": STANDSTILL_KEYS,
    "point": POINT_KEYS,
}
"""Sections that may come several times, ``[[beacon]]``."""
OF_PLACES: Final = ("origin", "initial", "gnss", "usbl", "reference")
"""Sections of places on Earth, which no local start has."""
REQUIRED_SECTIONS: Final = ("frames", *(one.section for one in INSTRUMENTS if one.is_required))


@dataclass(frozen=True, slots=True)
class MissionToml:
    """The content of one ``mission.toml``, checked."""

    folder: Path
    file: str
    """The file's own name in messages."""
    name: str
    order: Order
    body: BodyAxes
    sections: dict[str, Settings]
    lists: dict[str, tuple[Settings, ...]]
    """The sections that may come several times."""
    notes: tuple[str, ...] = ()
    """Where figures of instruments that it names come from, one sentence each."""

    def __getitem__(self, section: str) -> Settings:
        return self.sections[section]

    def __contains__(self, section: str) -> bool:
        return section in self.sections

    def bare(self, instrument: Instrument) -> Any:
        """Return the log without rows of an instrument that has a section."""
        return instrument.bare(self[instrument.section], self.lists)

    def frame(self, section: str) -> LocalFrame | None:
        """Return the frame at the place that ``[origin]`` or ``[initial]`` states."""
        if section not in self:
            return None
        given = self[section].given()
        return LocalFrame(*(float(given[name]) for name in ("lat", "lon", "height")))

    def initial(self) -> InitialState | None:
        """Return the state that ``[initial]`` states."""
        return build(InitialState, self["initial"].given()) if "initial" in self else None

    def local(self) -> LocalStart | None:
        """Return the start at zero that ``[local]`` states.

        Raises :class:`ConfigError` beside a section that states a place on Earth.
        """
        if "local" not in self:
            return None
        others = [name for name in OF_PLACES if name in self]
        if others:
            raise ConfigError(
                f"{self.file} [local]: given together with [{others[0]}], which has places on "
                "Earth; expected one of the two; [local] is for a tank or a pool without either"
            )
        return build(LocalStart, self["local"].given())

    def points(self) -> dict[str, Point]:
        """Return every point of the vehicle by name: ``[[point]]``, and instruments elsewhere."""
        found = {}
        for one in INSTRUMENTS:
            bare = self.bare(one) if one.section in self else None
            owner = getattr(bare, "mount", bare)
            if owner is not None and hasattr(owner, "lever_arm_b"):
                found[one.section] = Point(one.section, owner.lever_arm_b)
        for settings in self.lists["point"]:
            name = settings.text("name")
            if name in found:
                raise settings.fault("name", f"there is another {name!r}; expected one of its own")
            found[name] = point(settings)
        return found

    def point(self, name: str) -> Point:
        """Return a point of the vehicle; raise :class:`ConfigError` for one that it has not."""
        points = self.points()
        if name not in points:
            raise ConfigError(
                f"--point: {name!r} is none of the vehicle, {nearest_hint(name, points)}; add "
                f"[[point]] with name and lever_arm_m to {TOML_NAME}"
            )
        return points[name]

    def fault_of_no_place(self) -> ConfigError:
        """Return the error of a mission that may be anywhere on Earth."""
        return ConfigError(
            f"{self.file} [origin]: nothing says where on Earth the mission was; add [origin] with "
            "lat_deg, lon_deg and height_m, or a [gnss] or [usbl] table, or [initial]; "
            "in a tank or a pool, [local]"
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
    raw, notes = _with_instruments(raw, file)
    frames = read_settings("frames", raw["frames"], known=SECTIONS["frames"], file=file)
    body = frames.choice("body", BodyAxes, BodyAxes.FRD)
    sections = {
        name: read_settings(
            name, raw[name], known=SECTIONS[name], file=file, axes=body, may_miss=may_miss
        )
        for name in raw
        if name in SECTIONS
    }
    top = Settings("", {"order": raw.get("order", Order.TIME.value)}, file, {})
    return MissionToml(
        folder=path.parent,
        file=file,
        name=_mission_name(raw, file),
        order=top.choice("order", Order, Order.TIME),
        body=body,
        sections=sections,
        lists={name: _read_list(name, raw.get(name, []), file, body) for name in LISTS},
        notes=notes,
    )


def required_keys(section: str) -> frozenset[str]:
    """Return the keys that a section of the file has to have."""
    return frozenset(name for name, key in SECTIONS[section].items() if key.required)


def _with_instruments(raw: dict[str, Any], file: str) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a file with the figures of the instruments that it names, and where they are from.

    ``imu = "VN-100"`` above the sections stands for a section with that instrument and the usual
    name of its table, whose stamps are the ends of intervals.
    """
    found, notes = dict(raw), []
    for section in instruments.TABLES:
        own = raw[section]
        if isinstance(own, str):
            own = {"file": f"{section}.csv", instruments.KEY: own}
            own |= {"stamp": Stamp.END.value} if section == "imu" else {}
        if not isinstance(own, dict):
            continue
        required = required_keys(section)
        found[section], preset = instruments.with_preset(section, own, file=file, required=required)
        if preset is not None:
            notes.append(f"[{section}] {preset.maker} {preset.name}: {preset.source}")
    return found, tuple(notes)


def _read_list(name: str, raw: object, file: str, axes: BodyAxes) -> tuple[Settings, ...]:
    """Read the sections ``[[name]]`` of a file."""
    if not isinstance(raw, list):
        raise ConfigError(
            f"{file} [{name}]: expected a list of sections, each under [[{name}]], got "
            f"{shown(raw)}; write double brackets"
        )
    return tuple(
        read_settings(f"[[{name}]] {number}", item, known=LISTS[name], file=file, axes=axes)
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
    others = {toml[one.section].text("file") for one in TABLES if one.section in toml}
    found = sorted(p.name for p in toml.folder.iterdir() if p.name not in {*others, TOML_NAME})
    stems = {Path(name).stem: name for name in reversed(found)}
    close = get_close_matches(Path(label).stem, stems, n=1, cutoff=0.75)
    if section not in REQUIRED_SECTIONS and not close:
        return None
    hint = f"did you mean {stems[close[0]]!r}?" if close else "paths start at the mission folder"
    raise toml[section].fault("file", f"there is no file {label!r}; {hint}")


def _parse(path: Path, wanted: str) -> dict[str, Any]:
    file = path.name
    try:
        text = read_settings_file(path).decode("utf-8-sig")
        return tomllib.loads(text)
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
