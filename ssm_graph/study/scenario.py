"""What is to be compared: a study file, or mission folders."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final, TypeVar

from ssm_graph.base.errors import ConfigError, DataError, nearest_hint
from ssm_graph.base.settings import read_settings_file
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.simulation import (
    SCENARIOS,
    CurrentSettings,
    FaultShape,
    Grade,
    Loss,
    OutlierKind,
    Outliers,
    Sensor,
    SimulationConfig,
    WaterTrack,
)
from ssm_graph.simulation.faults import WHOLE_ARRAY
from ssm_graph.study import keys
from ssm_graph.study.cells import WITHOUT_SIZE, Cell, Recording, Source, StudyFault, digest
from ssm_graph.study.keys import StudyTable
from ssm_graph.study.methods import parse_method, parse_methods

_Made = TypeVar("_Made")

DEFAULT_SEEDS: Final = 20


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

    Raises :class:`ConfigError`, naming file, table and key.
    """
    try:
        raw = tomllib.loads(read_settings_file(path).decode("utf-8-sig"))
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror or error}); expected a study file"
        ) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: expected valid TOML, got: {error}") from error
    return study_from(raw, where=path.name)


_STUDY: Final = {
    "name": keys.text(keys.REQUIRED),
    "scenario": keys.text("survey"),
    "duration_s": keys.seconds(),
    "grades": keys.texts(("navigation",)),
    "first_seed": keys.count(0),
    "methods": keys.tables(),
    "cases": keys.tables(),
    "baseline": keys.text(),
}
_METHODS: Final = {"names": keys.texts(keys.REQUIRED), "seeds": keys.positive_count(DEFAULT_SEEDS)}
_CASE: Final = {
    "name": keys.text(),
    "kinds": keys.texts(("none",)),
    "rates": keys.fractions((0.1,)),
    "sizes_m_per_s": keys.pairs((None,)),
    "duration_s": keys.seconds(),
    "faults": keys.tables(),
    "losses": keys.tables(),
    "dropout_rate": keys.fraction(0.0),
    "current": keys.table(),
    "water_track": keys.table(),
    "gnss_windows_s": keys.pairs(),
    "realistic": keys.flag(False),
}
_LOSS: Final = {
    "beams": keys.counts(),
    "start_s": keys.number(keys.REQUIRED),
    "length_s": keys.seconds(keys.REQUIRED),
}
_FAULT: Final = {
    **_LOSS,
    "length_s": keys.seconds(),
    "sensor": keys.text("dvl"),
    "size": keys.numbers(),
    "axes": keys.counts(),
    "turn_by_seed": keys.flag(False),
    "shape": keys.text("constant"),
    "offset_m_per_s": keys.numbers(),
    "share": keys.number(),
}
_CURRENT: Final = {
    "steady_enu_m_per_s": keys.three(),
    "tide_m_per_s": keys.number(),
    "tide_period_s": keys.number(),
    "sigma_m_per_s": keys.number(),
    "vertical_sigma_m_per_s": keys.number(),
    "correlation_s": keys.number(),
}
_WATER_TRACK: Final = {
    "noise_m_per_s": keys.number(),
    "beams": keys.counts(),
    "every": keys.count(),
}


def study_from(raw: dict[str, Any], *, where: str) -> Study:
    """Return the study that a parsed file describes."""
    table = keys.read_table(raw, "", _STUDY, file=where)
    scenario = table["scenario"]
    if scenario not in SCENARIOS:
        hint = nearest_hint(scenario, SCENARIOS)
        raise table.fault("scenario", "a known scenario", scenario, hint)
    config = SCENARIOS[scenario].config
    config = replace(config, duration_s=table["duration_s"] or config.duration_s)
    methods = tuple(
        MethodSet(parse_methods(t["names"], where=f"{t.where} names"), t["seeds"])
        for t in table.of("methods", _METHODS)
    )
    cells = [c for t in table.of("cases", _CASE) for c in _cells(t, scenario, config)]
    for key, given in (("methods", methods), ("cases", cells)):
        if not given:
            raise ConfigError(f"{where}: expected at least one [[{key}]], got none; see --help")
    grades = table.choices("grades", Grade)
    study = Study(table["name"], _unique(where, cells), methods, grades, table["first_seed"])
    return _with_baseline(study, table["baseline"], where)


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


def _cells(table: StudyTable, scenario: str, config: SimulationConfig) -> list[Cell]:
    """Return the cells of one ``[[cases]]``: every kind with every rate and size."""
    name, outliers = table["name"], _outliers(table)
    config = replace(config, duration_s=table["duration_s"] or config.duration_s)
    case = replace(
        Cell("", scenario, config.duration_s),
        faults=tuple(_fault(entry, config) for entry in table.of("faults", _FAULT)),
        losses=tuple(_loss(entry, config) for entry in table.of("losses", _LOSS)),
        dropout_rate=table["dropout_rate"],
        current=_made(CurrentSettings, table.of("current", _CURRENT)),
        water_track=_made(WaterTrack, table.of("water_track", _WATER_TRACK)),
        gnss_windows_s=table["gnss_windows_s"],
        realistic=table["realistic"],
    )
    if name is not None and len(outliers) > 1:
        expected = "a name for a single kind, rate and size only"
        raise table.fault("name", expected, name, "leave it out, the cases name themselves")
    if name is None and case != Cell("", scenario, config.duration_s):
        raise ConfigError(
            f"{table.where} name: expected a name for a case with faults, losses, dropouts, "
            'currents, fixes or realistic instruments, got nothing; try name = "fault"'
        )
    return [replace(case, case=name or _case_name(each), outliers=each) for each in outliers]


def _made(kind: Callable[..., _Made], tables: Sequence[StudyTable]) -> _Made | None:
    """Return settings of the simulator whose fields are the keys without their unit."""
    for table in tables:
        given = {key.removesuffix("_m_per_s"): table[key] for key in table.settings.values}
        return table.checked(partial(kind, **given))
    return None


def _outliers(table: StudyTable) -> list[Outliers]:
    found: dict[Outliers, None] = {}
    combined = product(table.choices("kinds", OutlierKind), table["rates"], table["sizes_m_per_s"])
    for kind, rate, size in combined:
        if kind is OutlierKind.NONE:
            found[Outliers()] = None
            continue
        chosen = None if kind in WITHOUT_SIZE else size
        found[table.checked(partial(Outliers, kind, rate, chosen), "sizes_m_per_s")] = None
    return list(found)


def _case_name(outliers: Outliers) -> str:
    """Return, for example, ``sparse10``; with the size where it is not that of the kind."""
    if outliers.kind is OutlierKind.NONE:
        return "clean"
    name = f"{outliers.kind.name.lower()}{100.0 * outliers.rate:g}"
    if outliers.size is None or outliers.size == Outliers(outliers.kind).low_high:
        return name
    return f"{name}_{outliers.size[0]:g}to{outliers.size[1]:g}"


def _fault(table: StudyTable, config: SimulationConfig) -> StudyFault:
    (shape,), (sensor,) = table.choices("shape", FaultShape), table.choices("sensor", Sensor)
    of_dvl = sensor is Sensor.DVL
    has_offset = of_dvl and shape in (FaultShape.CONSTANT, FaultShape.DRIFT)
    has_share = shape in (FaultShape.COVERED, FaultShape.SPIKES)
    is_whole = not of_dvl or shape in WHOLE_ARRAY
    for key, is_asked, is_told in (
        ("beams", of_dvl and not is_whole, of_dvl and not is_whole),
        ("offset_m_per_s", has_offset, has_offset),
        ("share", has_share, has_share),
        ("size", False, not has_offset),
    ):
        if is_asked and table[key] is None:
            raise table.settings.fault(key, f"the key is missing; expected {_FAULT[key].wanted}")
        if not is_told and table[key] is not None:
            raise table.settings.fault(key, f"expected none with shape = {shape.name.lower()!r}")
    start_s, length_s = _window(table, config)
    fault = StudyFault(
        beams=() if is_whole else _beams(table, config),
        start_s=start_s,
        length_s=length_s,
        offset_m_per_s=table["offset_m_per_s"] or (0.0,),
        is_turned_by_seed=table["turn_by_seed"],
        shape=shape,
        share=table["share"] or 0.0,
        n_beams=config.dvl.mount.n_beams,
        sensor=sensor,
        size=table["size"] or (),
        axes=table["axes"] or (),
    )
    table.checked(lambda: fault.of_trial(0))
    return fault


def _loss(table: StudyTable, config: SimulationConfig) -> Loss:
    beams = _beams(table, config)
    start_s, length_s = _window(table, config)
    return table.checked(lambda: Loss(start_s, start_s + length_s, beams))


def _window(table: StudyTable, config: SimulationConfig) -> tuple[float, float]:
    """Return begin and length; one without a length goes on to the end."""
    start_s, length_s = table["start_s"], table["length_s"]
    if length_s is None and 0.0 <= start_s < config.duration_s:
        return start_s, math.inf
    if length_s is None or not 0.0 <= start_s < start_s + length_s <= config.duration_s:
        raise table.fault(
            "start_s",
            f"a window within the {config.duration_s:g} s of the mission",
            f"{start_s:g} to {start_s + (length_s or 0.0):g} s",
            "make duration_s longer, or begin earlier",
        )
    return start_s, length_s


def _beams(table: StudyTable, config: SimulationConfig) -> tuple[int, ...]:
    """Return the beams that are named, all where none is."""
    known = range(config.dvl.mount.n_beams)
    beams = tuple(known) if table["beams"] is None else table["beams"]
    if len(set(beams)) < len(beams) or not set(beams) <= set(known):
        expected = f"different numbers from 0 to {known[-1]}"
        raise table.fault("beams", expected, beams, "beams count from 0")
    return beams


def study_of_folders(folders: Sequence[Path], methods: Sequence[str]) -> Study:
    """Return the study that compares methods on recorded missions.

    Raises :class:`ConfigError`: two folders of one name, an unknown method, or one that has to know
    the truth. Raises :class:`DataError`: a mission that cannot be read: better now than in a
    process elsewhere, hours later.
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
