"""What is to be compared: a study file, or mission folders."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Final, TypeVar

from ssm_graph.base.errors import ConfigError, DataError, nearest_hint
from ssm_graph.io.mission_folder.reader import read_mission
from ssm_graph.simulation import SCENARIOS, FaultShape, Grade, Loss, OutlierKind, Outliers
from ssm_graph.study.cells import WITHOUT_SIZE, Cell, Recording, Source, StudyFault, digest
from ssm_graph.study.methods import parse_method, parse_methods
from ssm_graph.study.toml_table import TomlTable
from ssm_graph.study.water_keys import read_current, read_water_track

_Made = TypeVar("_Made")

DEFAULT_SEEDS: Final = 20
ALL_BEAMS: Final = (0, 1, 2, 3)


@dataclass(frozen=True, slots=True)
class MethodSet:
    """Methods that are tried on equally many trials."""

    names: tuple[str, ...]
    n_seeds: int


@dataclass(frozen=True, slots=True)
class Study:
    """Methods times missions."""

    name: str
    sources: tuple[Source, ...]
    methods: tuple[MethodSet, ...]
    grades: tuple[Grade | None, ...]
    """None alone for recorded missions."""
    first_seed: int = 0
    baseline: str | None = None
    """The method that others are compared with."""

    @property
    def method_names(self) -> tuple[str, ...]:
        """All methods, in the order in which they are named."""
        return tuple(dict.fromkeys(name for group in self.methods for name in group.names))

    def seeds_of(self, method: str) -> range:
        """Return the seeds on which a method is tried."""
        n_seeds = max(group.n_seeds for group in self.methods if method in group.names)
        return range(self.first_seed, self.first_seed + n_seeds)

    def changed(self, *, methods: Sequence[str] | None = None, n_seeds: int | None = None) -> Study:
        """Return the study with other methods or another number of seeds for all of them."""
        study = self
        if methods is not None:
            names = parse_methods(methods, where="--methods")
            most = max(group.n_seeds for group in study.methods)
            baseline = study.baseline if study.baseline in names else None
            study = replace(study, methods=(MethodSet(names, most),), baseline=baseline)
        if n_seeds is not None:
            if n_seeds < 1:
                raise ConfigError(f"--seeds: expected 1 or more, got {n_seeds}; try 3")
            if isinstance(study.sources[0], Recording):
                raise ConfigError("--seeds: expected with a study file, got mission folders")
            sets = tuple(replace(group, n_seeds=n_seeds) for group in study.methods)
            study = replace(study, methods=sets)
        return study


def read_study(path: Path) -> Study:
    """Read a study file.

    Raises
    ------
    ConfigError
        Naming file, table and key.
    """
    try:
        raw = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror or error}); expected a study file"
        ) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: expected valid TOML, got: {error}") from error
    return study_from(raw, where=path.name)


def study_from(raw: dict[str, Any], *, where: str) -> Study:
    """Return the study that a parsed file describes."""
    table = TomlTable(where, raw)
    scenario = table.text("scenario", "survey")
    if scenario not in SCENARIOS:
        hint = nearest_hint(scenario, SCENARIOS)
        raise table.fault("scenario", expected="a known scenario", got=scenario, hint=hint)
    duration_s = _positive(table, "duration_s", SCENARIOS[scenario].config.duration_s)
    name = table.text("name")
    grades = table.choices("grades", Grade, (Grade.NAVIGATION,))
    first_seed = table.count("first_seed", 0)
    methods = tuple(_method_set(entry) for entry in table.tables("methods"))
    cells = [c for entry in table.tables("cases") for c in _cells(entry, scenario, duration_s)]
    baseline = table.text("baseline") if table.has("baseline") else None
    table.end()
    for key, given in (("methods", methods), ("cases", cells)):
        if not given:
            raise ConfigError(f"{where}: expected at least one [[{key}]], got none; see --help")
    study = Study(name, _unique(where, cells), methods, grades, first_seed)
    return _with_baseline(study, baseline, where)


def _with_baseline(study: Study, baseline: str | None, where: str) -> Study:
    if baseline is None:
        return study
    (name,) = parse_methods([baseline], where=f"{where} baseline")
    if name not in study.method_names:
        hint = nearest_hint(name, study.method_names)
        raise ConfigError(f"{where} baseline: expected a method of the study, got {name!r}; {hint}")
    return replace(study, baseline=name)


def _unique(where: str, cells: Sequence[Cell]) -> tuple[Cell, ...]:
    named: dict[str, Cell] = {}
    for cell in cells:
        if named.setdefault(cell.case, cell) != cell:
            raise ConfigError(
                f"{where} [[cases]]: expected different names, got {cell.case!r} for two different "
                "cases; give one of them another name"
            )
    return tuple(named.values())


def _method_set(table: TomlTable) -> MethodSet:
    names = parse_methods(table.texts("names"), where=f"{table.where} names")
    group = MethodSet(names, table.count("seeds", DEFAULT_SEEDS, least=1))
    table.end()
    return group


def _cells(table: TomlTable, scenario: str, duration_s: float) -> list[Cell]:
    """Return the cells of one ``[[cases]]``: every kind with every rate and size."""
    name = table.text("name") if table.has("name") else None
    outliers = _outliers(table)
    duration_s = _positive(table, "duration_s", duration_s)
    faults = tuple(_fault(entry, duration_s) for entry in table.tables("faults"))
    losses = tuple(_loss(entry, duration_s) for entry in table.tables("losses"))
    dropout_rate = _fraction(table, "dropout_rate", table.number("dropout_rate", 0.0))
    current, water_track = read_current(table), read_water_track(table)
    table.end()
    if name is not None and len(outliers) > 1:
        raise table.fault(
            "name",
            expected="a name for a single kind, rate and size only",
            got=name,
            hint="leave it out, the cases name themselves",
        )
    if name is None and (faults or losses or dropout_rate or current or water_track):
        raise ConfigError(
            f"{table.where} name: expected a name for a case with faults, losses, dropouts or "
            'currents, got nothing; try name = "fault"'
        )
    case = replace(
        Cell("", scenario, duration_s),
        faults=faults,
        losses=losses,
        dropout_rate=dropout_rate,
        current=current,
        water_track=water_track,
    )
    return [replace(case, case=name or _case_name(each), outliers=each) for each in outliers]


def _outliers(table: TomlTable) -> list[Outliers]:
    kinds = table.choices("kinds", OutlierKind, (OutlierKind.NONE,))
    rates = tuple(_fraction(table, "rates", rate) for rate in table.numbers("rates", (0.1,)))
    sizes = table.pairs("sizes_m_per_s") if table.has("sizes_m_per_s") else (None,)
    found: dict[Outliers, None] = {}
    for kind, rate, size in product(kinds, rates, sizes):
        if kind is OutlierKind.NONE:
            found[Outliers()] = None
            continue
        try:
            found[Outliers(kind, rate, None if kind in WITHOUT_SIZE else size)] = None
        except ConfigError as error:
            raise ConfigError(f"{table.where} sizes_m_per_s: {error}") from error
    return list(found)


def _case_name(outliers: Outliers) -> str:
    """Return, for example, ``sparse10``; with the size where it is not that of the kind."""
    if outliers.kind is OutlierKind.NONE:
        return "clean"
    name = f"{outliers.kind.name.lower()}{100.0 * outliers.rate:g}"
    if outliers.size is None or outliers.size == Outliers(outliers.kind).low_high:
        return name
    return f"{name}_{outliers.size[0]:g}to{outliers.size[1]:g}"


def _fault(table: TomlTable, duration_s: float) -> StudyFault:
    start_s, length_s = _window(table, duration_s)
    shape = table.choice("shape", FaultShape, FaultShape.CONSTANT)
    has_offset = shape in (FaultShape.CONSTANT, FaultShape.DRIFT)
    fault = StudyFault(
        beams=_beams(table, table.counts("beams")),
        start_s=start_s,
        length_s=length_s,
        offset_m_per_s=table.numbers("offset_m_per_s") if has_offset else (0.0,),
        is_turned_by_seed=table.flag("turn_by_seed", False),
        shape=shape,
        share=table.number("share") if shape is FaultShape.COVERED else 0.0,
    )
    table.end()
    _checked(table, lambda: fault.of_trial(0))
    return fault


def _loss(table: TomlTable, duration_s: float) -> Loss:
    beams = _beams(table, table.counts("beams", ALL_BEAMS))
    start_s, length_s = _window(table, duration_s)
    table.end()
    return _checked(table, lambda: Loss(start_s, start_s + length_s, beams))


def _window(table: TomlTable, duration_s: float) -> tuple[float, float]:
    start_s, length_s = table.number("start_s"), _positive(table, "length_s")
    if not 0.0 <= start_s < start_s + length_s <= duration_s:
        raise table.fault(
            "start_s",
            expected=f"a window within the {duration_s:g} s of the mission",
            got=f"{start_s:g} to {start_s + length_s:g} s",
            hint="make duration_s longer, or begin earlier",
        )
    return start_s, length_s


def _beams(table: TomlTable, beams: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(beams)) < len(beams) or not set(beams) <= set(ALL_BEAMS):
        raise table.fault(
            "beams", expected="different numbers from 0 to 3", got=beams, hint="beams count from 0"
        )
    return beams


def _checked(table: TomlTable, make: Callable[[], _Made]) -> _Made:
    try:
        return make()
    except ConfigError as error:
        raise ConfigError(f"{table.where}: {error}") from error


def _positive(table: TomlTable, key: str, *default: float) -> float:
    value = table.number(key, *default)
    if value <= 0.0:
        raise table.fault(key, expected="seconds above 0", got=value, hint="try 600")
    return value


def _fraction(table: TomlTable, key: str, value: float) -> float:
    if not 0.0 <= value <= 1.0:
        raise table.fault(
            key, expected="a fraction between 0 and 1", got=value, hint="write 10 % as 0.1"
        )
    return value


def study_of_folders(folders: Sequence[Path], methods: Sequence[str]) -> Study:
    """Return the study that compares methods on recorded missions.

    Raises
    ------
    ConfigError
        Two folders of one name, an unknown method, or one that has to know the truth.
    DataError
        A mission that cannot be read: better now than in a process elsewhere, hours later.
    """
    names = parse_methods(methods, where="--methods")
    told = [name for name in names if parse_method(name).is_oracle]
    if told:
        raise ConfigError(
            f"--methods: expected methods for recorded missions, got {told[0]!r}, which has to be "
            "told the bad beams; leave it out"
        )
    recordings = tuple(_recording(folder) for folder in folders)
    for i, recording in enumerate(recordings):
        if recording.case in {other.case for other in recordings[:i]}:
            raise ConfigError(
                f"MISSION: expected folders of different names, got {recording.case!r} twice; "
                "rename one, the tables go by it"
            )
    return Study("missions", recordings, (MethodSet(names, 1),), (None,))


def _recording(folder: Path) -> Recording:
    try:
        imu = read_mission(folder).imu
    except (ConfigError, DataError) as error:
        raise type(error)(f"{folder}: {error}") from error
    files = sorted(p for p in folder.iterdir() if p.is_file())
    content = b"".join(p.name.encode() + b"\0" + p.read_bytes() for p in files)
    duration_s = float(imu.time_s[-1] - imu.start_s)
    return Recording(folder.resolve().name, folder.resolve(), digest(content), duration_s)
