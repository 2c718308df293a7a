"""One look at whatever lies at a path: its format by content, its sensors, and a verdict."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import DataError, SsmGraphError
from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.inspection.sensors import SensorFound, sensors_in, sensors_of
from ssm_graph.inspection.timing import timing_of
from ssm_graph.io.ardupilot.convert import convert_ardupilot, is_ardupilot
from ssm_graph.io.ardupilot.dataflash import is_dataflash
from ssm_graph.io.blueye.convert import convert_blueye
from ssm_graph.io.columns.convert import times
from ssm_graph.io.columns.draft import guess_sections, guess_time
from ssm_graph.io.columns.map_file import Times
from ssm_graph.io.columns.sources import ENDINGS, read_source
from ssm_graph.io.file_kind import first_bytes, is_mcap, kind_of
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.mission_folder.toml import TOML_NAME
from ssm_graph.io.ros.convert import convert_rosbag
from ssm_graph.io.ros.log import is_rosbag
from ssm_graph.live.recorded.log import read_recorded
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.suspects.find import find_suspects
from ssm_graph.mission.usable import require_usable
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import ImuSample

LEAST_S: Final = 30.0
"""Of a mission without a start: alignment needs about as much."""
TABLE: Final = "table"
"""What stands for the sensor that a table of unknown columns may be of."""
MOST_FILES: Final = 30
"""Of a folder, that are looked at one by one."""


@dataclass(frozen=True, slots=True, eq=False)
class Inspection:
    """What was found at a path."""

    path: Path
    kind: str
    """Of what format it is, by its content."""
    sensors: tuple[SensorFound, ...]
    notes: tuple[str, ...]
    """Of the reader: what it left out or assumed."""
    suspects: tuple[str, ...]
    """Clocks, units and axes that the data contradict."""
    missing: tuple[str, ...]
    """What stands between this and a trajectory, with what to do; empty if it can be smoothed."""
    mission: Mission | None
    """Where it could be read as one."""

    @property
    def is_recording(self) -> bool:
        """Whether it is the output of an instrument."""
        return any(one.name != TABLE for one in self.sensors)

    @property
    def can_be_smoothed(self) -> bool:
        """Whether ``ssm-graph smooth`` will take it, as a mission folder or once converted."""
        return self.mission is not None and not self.missing

    @property
    def verdict(self) -> str:
        """One sentence."""
        if not self.can_be_smoothed:
            return "cannot be smoothed as it is: " + "; ".join(self.missing)
        first = (
            "can be smoothed" if is_mission_folder(self.path) else "can be converted, then smoothed"
        )
        if self.suspects:
            return f"{first}, but look first at what is suspect"
        return first

    def as_dict(self) -> dict[str, Any]:
        """Return all of it but the curves, for JSON."""
        return {
            "path": str(self.path),
            "format": self.kind,
            "can_be_smoothed": self.can_be_smoothed,
            "verdict": self.verdict,
            "missing": list(self.missing),
            "suspects": list(self.suspects),
            "notes": list(self.notes),
            "sensors": [
                {
                    "name": one.name,
                    "n": one.timing.n,
                    **{
                        name: value if math.isfinite(value) else None
                        for name, value in (
                            ("begin_s", one.timing.begin_s),
                            ("end_s", one.timing.end_s),
                            ("rate_hz", one.timing.rate_hz),
                            ("jitter_s", one.timing.jitter_s),
                        )
                    },
                    "n_gaps": one.timing.n_gaps,
                    "in_gaps_s": one.timing.in_gaps_s,
                    "n_repeats": one.timing.n_repeats,
                    "n_back": one.timing.n_back,
                    "facts": list(one.facts),
                    "oddities": list(one.oddities),
                }
                for one in self.sensors
            ],
        }


def is_mission_folder(path: Path) -> bool:
    """Return whether a path is a mission folder, or its ``mission.toml``."""
    return (path / TOML_NAME).is_file() or path.name == TOML_NAME


def inspect_path(path: Path, stage: Callable[[str], None] | None = None) -> Inspection:
    """Look at a file, folder, bag or mission; what cannot be read is said, not raised.

    Raises :class:`DataError` only where there is nothing at the path.

    Parameters
    ----------
    path : what to look at.
    stage : is told what is done next, for a display.
    """
    if not path.exists():
        raise DataError(f"{path}: there is no such file or folder")
    kind, read = _reader(path)
    if read is None:
        return _without_mission(path)
    try:
        mission = read(path)
    except SsmGraphError as error:
        return Inspection(path, kind, (), (), (), (str(error),), None)
    if stage is not None:
        stage("comparing clocks, units and axes")
    return inspect_mission(mission, path, kind)


def _reader(path: Path) -> tuple[str, Any]:
    """Return the format of a path and what reads it as a mission, None for nothing."""
    if is_mission_folder(path):
        return "mission folder", lambda p: read_mission(p if p.is_dir() else p.parent)
    if is_rosbag(path):
        number = 1 if first_bytes(path).startswith(b"#ROSBAG") else 2
        return f"ROS {number} bag", convert_rosbag
    if path.is_file() and is_mcap(path):
        return "Blueye X3 log (MCAP)", convert_blueye
    if path.is_file() and is_ardupilot(path):
        kind = "dataflash" if is_dataflash(first_bytes(path)) else "telemetry"
        return f"ArduPilot {kind} log", convert_ardupilot
    return "", None


def inspect_mission(mission: Mission, path: Path, kind: str = "mission") -> Inspection:
    """Look at a mission that is read already."""
    missing: list[str] = []
    suspects: tuple[str, ...] = ()
    try:
        require_usable(mission)
        suspects = tuple(fault.sentence for fault in find_suspects(mission))
    except SsmGraphError as error:
        missing.append(str(error))
    missing += _missing(mission)
    sensors = tuple(sensors_of(mission))
    return Inspection(path, kind, sensors, mission.notes, suspects, tuple(missing), mission)


def _missing(mission: Mission) -> Iterator[str]:
    """Yield what a smoother would want of a mission and not find."""
    span_s = float(mission.imu.time_s[-1] - mission.imu.start_s)
    if not np.isfinite(mission.dvl.speed).any():
        yield "no beam has a speed: without bottom lock there is nothing to aid the inertial data"
    if mission.initial is None and span_s < LEAST_S:
        yield (
            f"{span_s:.0f} s of inertial data and no [initial]: give a start, or at least "
            f"{LEAST_S:.0f} s to align with"
        )
    has_start = mission.initial is not None or mission.local is not None
    if not has_start and mission.gnss is None and not mission.aids:
        yield (
            "neither a fix nor [initial] says where it begins: give [initial] in mission.toml, or "
            "[local] for a tank or a pool"
        )
    if len(mission.dvl.time_s) == 0:
        return
    overlap = min(mission.imu.time_s[-1], mission.dvl.time_s[-1]) - max(
        mission.imu.start_s, mission.dvl.time_s[0]
    )
    if overlap < 0.0:
        yield (
            f"IMU ({mission.imu.start_s:.1f} to {mission.imu.time_s[-1]:.1f} s) and DVL "
            f"({mission.dvl.time_s[0]:.1f} to {mission.dvl.time_s[-1]:.1f} s) do not overlap: are "
            "they on one clock?"
        )


def _without_mission(path: Path) -> Inspection:
    """Return what a file of one instrument, a table or an unknown file is."""
    if path.is_dir():
        return _folder(path)
    try:
        recorded = read_recorded(path)
    except SsmGraphError as error:
        return Inspection(path, "a recording", (), (), (), (str(error),), None)
    if recorded is None:
        return _table(path) or Inspection(path, "file", (), (), (), (kind_of(path),), None)
    sensors = tuple(sensors_in(recorded.messages))
    missing = "it holds no inertial data; ssm-graph convert makes tables of it for a mission folder"
    if {ImuSample, Ping} <= {type(message) for message in recorded.messages}:
        missing = (
            "it says nothing of noise, mounting and place; ssm-graph convert with  --vehicle  "
            "makes a mission of it"
        )
    return Inspection(path, recorded.about, sensors, recorded.notes, (), (missing,), None)


def _folder(path: Path) -> Inspection:
    """Return what lies in a folder that is neither mission nor bag, file by file."""
    inside = sorted(one for one in path.iterdir() if one.is_file())
    shown = inside[:MOST_FILES]
    looks = [inspect_path(one) for one in told(shown, len(shown))]
    notes = [f"{look.path.name}: {look.kind}" for look in looks]
    if len(inside) > len(shown):
        notes.append(f"{len(inside) - len(shown)} more files are not looked at")
    kind = f"folder of {len(inside)} file{'s' * (len(inside) != 1)}"
    missing = kind_of(path)
    if any(look.mission is not None or look.is_recording for look in looks):
        missing = "no mission: inspect and convert its files by name (ssm-graph convert --help)"
    return Inspection(path, kind, (), tuple(notes), (), (missing,), None)


def _table(path: Path) -> Inspection | None:
    """Return what a table of numbers holds: columns with their range, and the rate of its time."""
    if path.suffix.lower() not in ENDINGS:
        return None
    try:
        source = read_source(path)
    except SsmGraphError as error:
        return Inspection(path, "text, or a damaged table", (), (), (), (str(error),), None)
    columns: dict[str, Array] = {}
    for name in source.columns:
        with contextlib.suppress(DataError):
            values = source.numbers(name, "inspect")
            if np.isfinite(values).any():
                columns[name] = values
    facts = [
        f"{name}: {np.nanmin(values):.6g} to {np.nanmax(values):.6g}"
        for name, values in columns.items()
    ]
    known = np.zeros(0)
    with contextlib.suppress(SsmGraphError):  # no time, or no package that knows its unit
        guess = guess_time(source)
        time_s = times(Times("", guess.columns, (guess.unit,), 0.0), source)
        known = time_s[np.isfinite(time_s)]
        facts += [
            f"may be {one.key} of [{section}]: {', '.join(one.columns)}, {one.unit} ({one.why})"
            for section, guesses in guess_sections(source).items()
            for one in guesses[1:]
        ]
    found = SensorFound(TABLE, timing_of(known), tuple(facts), (), known, {})
    missing = (
        "a table alone is no mission: --draft-map map.toml says what its columns may be, and "
        "ssm-graph convert --map makes a mission of it; or put it into a folder with a "
        "mission.toml that names it (docs/mission-folder.md)"
    )
    n_rows = max((len(values) for values in source.columns.values()), default=0)
    kind = f"table, {n_rows} rows of {len(source.columns)} columns"
    return Inspection(path, kind, (found,), (), (), (missing,), None)
