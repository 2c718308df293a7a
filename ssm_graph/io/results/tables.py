"""Result folders: ``trajectory.csv``, ``beams.csv`` and ``summary.json``, written and read again.

A run that calibrated leaves ``calibration.toml`` too, one with further aids ``aids.csv``.

Units are those of the mission format: degrees, degrees per hour, micro-g. Column and key names are
a contract: they only grow.
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import parse_json
from ssm_graph.base.units import DEG_PER_H, MICRO_G
from ssm_graph.io.mission_folder.folder import CALIBRATION_NAME, calibration_toml
from ssm_graph.io.results.place import DRAWN, FIGURE_NAME, SUMMARY_NAME, check_is_for_results
from ssm_graph.io.results.states import STATES_NAME, states_bytes
from ssm_graph.io.results.summary import MetricsLike, build_summary
from ssm_graph.io.tables import csv_tables
from ssm_graph.io.tables.append_file import TORN_ROW, AppendFile, write_through
from ssm_graph.mission.estimate import (
    AidTable,
    BeamTable,
    CurrentTrack,
    Estimate,
    ProtectionTrack,
    Trajectory,
)
from ssm_graph.mission.mission import Mission

TRAJECTORY_NAME: Final = "trajectory.csv"
BEAMS_NAME: Final = "beams.csv"
PROTECTION_NAME: Final = "protection.csv"
AIDS_NAME: Final = "aids.csv"
_KINDS: Final[Mapping[str, type]] = {
    **dict.fromkeys(("final", "start", "calibration", "noise", "aids", "current"), dict),
    **dict.fromkeys(("inside_3_sigma", "settings", "versions", "inputs"), dict),
    **dict.fromkeys(("faults", "history", "notes", "mission_notes"), list),
    **dict.fromkeys(("duration_s", "total_path_length_m", "rmse_horizontal_m"), float),
    **dict.fromkeys(("n_beams", "n_outliers"), int),
}
"""Of what a summary says, where it says it."""
_CALLED: Final = {dict: "an object", list: "a list", float: "a number", int: "a whole number"}
Columns = dict[str, tuple[Array, str]]
"""Values of every column and the format of a cell."""


@dataclass(frozen=True, slots=True)
class Results:
    """A result folder as it stands on disk, in the units of its columns."""

    folder: Path
    trajectory: Mapping[str, Array]
    """Columns of ``trajectory.csv``."""
    beams: Mapping[str, Array]
    """Columns of ``beams.csv``."""
    summary: Mapping[str, Any]
    """Content of ``summary.json``; what was not finite is None."""


def write_results(
    folder: Path | str,
    estimate: Estimate,
    *,
    mission: Mission,
    metrics: MetricsLike | None,
    settings: Mapping[str, Any],
    inputs: Mapping[str, Any] | None = None,
    axes: BodyAxes = BodyAxes.FRD,
    draw: Callable[[Path], None] | None = None,
    figure_name: str = FIGURE_NAME,
) -> None:
    """Write one estimate as a result folder.

    All files are complete before the first takes its place, the old summary goes first and the
    new one comes last: an interruption leaves a folder without summary, never a mixture. What an
    earlier run left and this one does not have, a figure or a calibration, goes too.

    Parameters
    ----------
    folder : made if it does not exist; files of the same names are replaced.
    estimate : what was found.
    mission : what it was found from; its name, notes and the origin of the start are noted.
    metrics : comparison with the reference, if there is one.
    settings : of the estimator, noted as they are; units belong into the keys.
    inputs : the mission folder and the SHA-256 of its files, of :func:`input_fields`.
    axes : body axes of the mission's file, for the lever arms of ``calibration.toml``.
    draw : saves the figure at a path; none is written unless given.
    figure_name : one of :data:`ssm_graph.io.results.place.FIGURES`.

    Raises
    ------
    ConfigError
        The folder is that of a mission or a live run.
    DataError
        The folder cannot be made or written; or of the figure, with all else in its place.
    """
    folder = Path(folder)
    check_is_for_results(folder)
    summary = build_summary(estimate, mission=mission, metrics=metrics, settings=settings)
    if inputs:
        summary["inputs"] = inputs
    content = {
        TRAJECTORY_NAME: format_table(
            trajectory_columns(estimate.trajectory)
            | current_columns(estimate.current)
            | suspect_column(estimate)
        ).encode(),
        BEAMS_NAME: format_table(beam_columns(estimate.beams)).encode(),
    }
    if estimate.aids is not None:
        content[AIDS_NAME] = format_aids(estimate.aids).encode()
    if estimate.calibration is not None:
        lines = calibration_toml(mission, estimate.calibration, axes=axes)
        content[CALIBRATION_NAME] = lines.encode()
    if estimate.posterior is not None:
        content[STATES_NAME] = states_bytes(estimate.posterior)
    content[SUMMARY_NAME] = _summary_text(summary).encode()
    process = os.getpid()
    parts = {name: folder / f".{name}.part-{process}" for name in content}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, inside in content.items():
            write_through(parts[name], inside)
        failure = None
        if draw is not None:
            figure = folder / f".{process}-{figure_name}"
            parts = {figure_name: figure, **parts}
            failure = _drawn(draw, figure)
        for name in (SUMMARY_NAME, CALIBRATION_NAME, AIDS_NAME, STATES_NAME, *DRAWN):
            (folder / name).unlink(missing_ok=True)
        for name, part in parts.items():
            if name != figure_name or failure is None:
                part.replace(folder / name)
    except OSError as error:
        raise DataError(f"{folder}: cannot write results: {error.strerror or error}") from error
    finally:
        for part in parts.values():
            if folder.is_dir():
                part.unlink(missing_ok=True)
    if failure is not None:
        raise failure


def _drawn(draw: Callable[[Path], None], path: Path) -> Exception | None:
    """Draw; return what went wrong, which must not cost the tables."""
    try:
        draw(path)
    except Exception as error:
        return error
    return None


def read_results(folder: Path | str) -> Results:
    """Read a result folder; columns and keys beyond the known ones are kept.

    Raises
    ------
    DataError
        No result folder, a file missing or damaged, or a column of the contract missing.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder}: expected a result folder, found no such folder")
    if not (folder / SUMMARY_NAME).is_file():
        raise DataError(
            f"{folder}: expected a result folder with {SUMMARY_NAME}, found none; "
            "was the run interrupted? Run it again"
        )
    try:
        summary = parse_json((folder / SUMMARY_NAME).read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise DataError(f"{folder / SUMMARY_NAME}: expected valid JSON: {error}") from error
    if not isinstance(summary, dict):
        raise DataError(f"{folder / SUMMARY_NAME}: expected a JSON object at the top")
    for name, kind in _KINDS.items():
        value = summary.get(name)
        is_whole = kind is float and isinstance(value, int)
        if value is not None and not isinstance(value, kind) and not is_whole:
            raise DataError(
                f"{folder / SUMMARY_NAME}: key {name!r}: expected {_CALLED[kind]}, got "
                f"{str(value)[:40]!r}; was it edited?"
            )
    return Results(
        folder=folder,
        trajectory=_read_table(folder / TRAJECTORY_NAME, TRAJECTORY_COLUMNS),
        beams=_read_table(folder / BEAMS_NAME, BEAM_COLUMNS),
        summary=summary,
    )


def read_aids(folder: Path) -> dict[str, Any]:
    """Return the columns of ``aids.csv``, words as lists; empty where the run had no aids.

    Raises :class:`DataError` for a table that is damaged.
    """
    path = folder / AIDS_NAME
    if not path.exists():
        return {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        words: dict[str, Any] = {
            name: [row[name] for row in rows] for name in ("aid", "component", "unit")
        }
        for name in ("time_s", "innovation", "mahalanobis_sq", "weight"):
            words[name] = np.array([float(row[name]) for row in rows])
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise DataError(f"{path}: expected a table of aids: {error}; smooth again") from error
    return words if rows else {}


def read_protection(folder: Path) -> dict[str, Array]:
    """Return the columns of ``protection.csv``, infinite where nothing bounds; empty without it.

    Raises :class:`DataError` for a table that is damaged.
    """
    path = folder / PROTECTION_NAME
    if not path.exists():
        return {}
    try:
        rows = np.genfromtxt(path, delimiter=",", names=True)
        return {name: np.atleast_1d(rows[name]) for name in PROTECTION_COLUMNS}
    except (OSError, ValueError, IndexError, TypeError) as error:
        raise DataError(f"{path}: expected a table of protection levels: {error}") from error


def trajectory_columns(trajectory: Trajectory) -> Columns:
    """Return the columns of ``trajectory.csv`` in the order of the contract."""
    position_var = np.diagonal(trajectory.position_cov_enu, axis1=1, axis2=2)
    position_sigma = np.sqrt(np.maximum(position_var, 0.0))
    enu, rph, xyz = ("east", "north", "up"), ("roll", "pitch", "heading"), ("x", "y", "z")
    angles = np.rad2deg(trajectory.roll_pitch_heading)
    angles[:, 2] %= 360.0
    return {
        "time_s": (trajectory.time_s, "%.7f"),
        "lat_deg": (np.rad2deg(trajectory.lat), "%.11f"),
        "lon_deg": (np.rad2deg(trajectory.lon), "%.11f"),
        "height_m": (trajectory.height, "%.6f"),
        **_spread("vel_{}_m_per_s", enu, trajectory.velocity_enu, "%.7f"),
        **_spread("{}_deg", rph, angles, "%.8f"),
        **_spread("sigma_{}_m", enu, position_sigma, "%.7g"),
        **_spread("sigma_vel_{}_m_per_s", enu, trajectory.velocity_sigma_enu, "%.7g"),
        **_spread("sigma_{}_deg", rph, np.rad2deg(trajectory.attitude_sigma), "%.7g"),
        **_spread("gyro_bias_{}_deg_per_h", xyz, trajectory.gyro_bias / DEG_PER_H, "%.9g"),
        **_spread("accel_bias_{}_ug", xyz, trajectory.accel_bias / MICRO_G, "%.9g"),
        "n_beams": (trajectory.n_beams, "%.0f"),
    }


def current_columns(current: CurrentTrack | None) -> Columns:
    """Return the columns that ``trajectory.csv`` has besides where a current was estimated."""
    if current is None:
        return {}
    enu = ("east", "north", "up")
    return {
        **_spread("current_{}_m_per_s", enu, current.velocity_enu, "%.7f"),
        **_spread("sigma_current_{}_m_per_s", enu, current.sigma_enu, "%.7g"),
    }


def suspect_column(estimate: Estimate) -> Columns:
    """Return the last column of ``trajectory.csv``: 1 where a fault makes the answer doubtful."""
    time_s = estimate.trajectory.time_s
    suspects = [fault for fault in estimate.faults if fault.is_suspect]
    inside = [(fault.begin_s <= time_s) & (time_s <= fault.end_s) for fault in suspects]
    return {"suspect": (np.any([np.zeros(len(time_s), bool), *inside], axis=0), "%.0f")}


def protection_columns(protection: ProtectionTrack) -> Columns:
    """Return the columns of ``protection.csv``, which live runs have."""
    return {
        "time_s": (protection.time_s, "%.7f"),
        "protection_m": (protection.horizontal, "%.7g"),
        "protection_up_m": (protection.up, "%.7g"),
    }


def beam_columns(beams: BeamTable) -> Columns:
    """Return the columns of ``beams.csv`` in the order of the contract."""
    return {
        "time_s": (beams.time_s, "%.7f"),
        "beam": (beams.beam, "%.0f"),
        "innovation_m_per_s": (beams.innovation, "%.9g"),
        "mahalanobis_sq": (beams.mahalanobis_sq, "%.9g"),
        "weight": (beams.weight, "%.9g"),
    }


def format_aids(aids: AidTable) -> str:
    """Return the content of ``aids.csv``, angles in degrees."""
    in_degrees = np.array([unit == "rad" for unit in aids.unit], dtype=bool)
    innovation = np.where(in_degrees, np.degrees(aids.innovation), aids.innovation)
    units = np.where(in_degrees, "deg", np.array(aids.unit))
    columns = (aids.time_s, aids.aid, aids.component, innovation, units)
    rows = zip(*columns, aids.mahalanobis_sq, aids.weight, strict=True)
    row_format = "%.7f,%s,%s,%.9g,%s,%.9g,%.9g\n"
    header = "time_s,aid,component,innovation,unit,mahalanobis_sq,weight\n"
    return header + "".join([row_format % row for row in rows])


def format_table(columns: Columns) -> str:
    """Return a CSV table with header; NaN stays ``nan``."""
    row_format = ",".join(cell for _, cell in columns.values()) + "\n"
    rows = np.column_stack([values for values, _ in columns.values()]).tolist()
    return ",".join(columns) + "\n" + "".join([row_format % tuple(row) for row in rows])


def _spread(pattern: str, names: tuple[str, ...], values: Array, cell: str) -> Columns:
    return {pattern.format(name): (values[:, i], cell) for i, name in enumerate(names)}


TRAJECTORY_COLUMNS: Final = tuple(trajectory_columns(Trajectory.empty()))
CURRENT_COLUMNS: Final = tuple(current_columns(CurrentTrack.empty()))
BEAM_COLUMNS: Final = tuple(beam_columns(BeamTable.empty()))
HEADERS: Final = {TRAJECTORY_NAME: TRAJECTORY_COLUMNS, BEAMS_NAME: BEAM_COLUMNS}
PROTECTION_COLUMNS: Final = tuple(protection_columns(ProtectionTrack.empty()))


def _summary_text(summary: Mapping[str, Any]) -> str:
    return json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _read_table(path: Path, required: tuple[str, ...]) -> dict[str, Array]:
    """Return the columns of one table by name."""
    file = csv_tables.CsvFile(str(path), path)
    try:
        csv_tables.check_is_text(file)
        names = csv_tables.read_csv_header(file)
        missing = [name for name in required if name not in names]
        if missing:
            raise DataError(f"{path}:1: column {missing[0]!r} is missing; is it a result table?")
        values = csv_tables.read_csv_values(file, names, blank=frozenset(names))
        csv_tables.check_last_line(file)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    return {name: values[:, index] for index, name in enumerate(names)}


class GrowingResults:
    """Appends to ``trajectory.csv``, ``beams.csv`` and ``protection.csv``.

    A restart continues where it was kept.
    """

    def __init__(
        self, folder: Path, *, sizes: Mapping[str, int] | None = None, has_current: bool = False
    ) -> None:
        """Begin in a folder, or go on at the sizes (bytes) that a checkpoint knew.

        A table that begins anew although it has rows is set aside, ``trajectory.older.csv``. With
        a current ``trajectory.csv`` has its columns, and all rows have one.

        Raises :class:`DataError`: the folder cannot be made or written.
        """
        self._folder = folder
        self.problem: str | None = None
        """Why the last rows are not on disk, if they are not."""
        headers = {PROTECTION_NAME: PROTECTION_COLUMNS, **HEADERS}
        self._waiting: dict[str, str] = dict.fromkeys(headers, "")
        self._files: dict[str, AppendFile] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / SUMMARY_NAME).unlink(missing_ok=True)
            beside = CURRENT_COLUMNS if has_current else ()
            headers[TRAJECTORY_NAME] += beside
            self._heads = {name: (",".join(of) + "\n").encode() for name, of in headers.items()}
            for name, head in self._heads.items():
                size = (sizes or {}).get(name, 0)
                if size == 0:
                    _set_aside(folder / name, len(head))
                file = self._files[name] = AppendFile(folder / name, ending=TORN_ROW)
                file.cut(size)
                if file.size == 0:
                    file.append(head)
        except OSError as error:
            self.close()
            raise DataError(f"{folder}: cannot write results: {error.strerror or error}") from error

    def sizes(self) -> dict[str, int]:
        """Return how large the files are, bytes, for a checkpoint."""
        return {name: file.size for name, file in self._files.items()}

    def regain(self) -> list[str]:
        """Go on where somebody removed, replaced or changed a table; return what was done."""
        texts = {name: self._files[name].regain(head) for name, head in self._heads.items()}
        for name, text in texts.items():
            if text and self._files[name].size < len(self._heads[name]):
                self._files[name].cut(0)
                self._waiting[name] = self._heads[name].decode() + self._waiting[name]
        self._write_waiting()
        return [text for text in texts.values() if text]

    def append(
        self,
        trajectory: Trajectory,
        beams: BeamTable,
        current: CurrentTrack | None = None,
        protection: ProtectionTrack | None = None,
    ) -> None:
        """Add rows; what the disk does not take waits for the next time."""
        self._waiting[TRAJECTORY_NAME] += _rows(
            trajectory_columns(trajectory) | current_columns(current)
        )
        self._waiting[BEAMS_NAME] += _rows(beam_columns(beams))
        if protection is not None:
            self._waiting[PROTECTION_NAME] += _rows(protection_columns(protection))
        self._write_waiting()

    def _write_waiting(self) -> None:
        self.problem = next((file.problem for file in self._files.values() if file.problem), None)
        for name, text in self._waiting.items():
            try:
                if text:
                    self._files[name].append(text.encode())
                    self._waiting[name] = ""
            except OSError as error:
                path = self._folder / name
                self.problem = f"{path}: cannot be written: {error.strerror or error}"

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write what waits, and ``summary.json``, which makes the folder complete.

        Raises :class:`DataError`: it cannot be written.
        """
        self._write_waiting()
        part = self._folder / f".{SUMMARY_NAME}.part-{os.getpid()}"
        try:
            write_through(part, _summary_text(summary).encode())
            part.replace(self._folder / SUMMARY_NAME)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise DataError(
                f"{self._folder / SUMMARY_NAME}: cannot be written: {error.strerror or error}"
            ) from error

    def close(self) -> None:
        """Close the files; a second time does nothing."""
        for file in self._files.values():
            file.close()


def _set_aside(path: Path, n_head: int) -> None:
    """Rename a table that has rows; of several that were set aside the longest is kept."""
    older = path.with_name(f"{path.stem}.older{path.suffix}")
    n_older = older.stat().st_size if older.exists() else 0
    if path.exists() and path.stat().st_size > max(n_head, n_older):
        path.replace(older)


def _rows(columns: Columns) -> str:
    return format_table(columns).partition("\n")[2]
