"""Files of columns and a map of them, as a mission, through the one door of the house."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import BodyAxes, to_frd
from ssm_graph.base.frozen import Array
from ssm_graph.base.tables import (
    TIME,
    Table,
    TableFile,
    check_finite,
    check_increasing,
)
from ssm_graph.base.units import STANDARD_GRAVITY
from ssm_graph.io.columns.map_file import (
    INSTEAD,
    PRESSURE_KEYS,
    QUANTITIES,
    SURFACE_KEY,
    ColumnMap,
    MapSection,
    Quantity,
    Times,
)
from ssm_graph.io.columns.sources import Source, read_source
from ssm_graph.io.columns.units import ISO, factor_to
from ssm_graph.io.mission_folder.assembly import mission_from
from ssm_graph.io.mission_folder.toml import REFERENCE
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.dvl import counted_sigma
from ssm_graph.sensors.imu import interval_ends
from ssm_graph.sensors.instrument import Instrument, read_columns
from ssm_graph.sensors.registry import BY_LOG, BY_SECTION

_OF_DAY: Final = re.compile(r"([01]?\d|2[0-3]):([0-5]\d):((?:[0-5]\d|60)(?:[.,]\d*)?)")


class MappedLogs(NamedTuple):
    """What the columns of some files hold."""

    logs: tuple[Any, ...]
    labels: dict[str, str | TableFile]
    """Where the rows of each section stand."""
    notes: tuple[str, ...]
    """What was left out."""


def convert_columns(
    files: Sequence[Path], column_map: ColumnMap, vehicle: Vehicle, *, name: str
) -> Mission:
    """Return the mission that columns of some files hold.

    Raises :class:`ConfigError` for a map without a DVL, and for all that :func:`logs_of_columns`
    refuses. Raises :class:`DataError` for all that a mission folder is refused for.

    Parameters
    ----------
    files, column_map, vehicle : as of :func:`logs_of_columns`.
    name : of the mission.
    """
    if "dvl" not in {section.name for section in column_map.sections}:
        raise ConfigError(
            f"{column_map.path.name} [dvl]: the section is missing; a mission needs it, or the "
            "recording of a DVL beside the tables"
        )
    found = logs_of_columns(files, column_map, vehicle)
    labels, notes = found.labels, list(found.notes)
    return mission_from(found.logs, vehicle, source=Path(name), labels=labels, notes=notes)


def logs_of_columns(files: Sequence[Path], column_map: ColumnMap, vehicle: Vehicle) -> MappedLogs:
    """Return the logs that columns of some files hold, by the sections of a map.

    Raises :class:`ConfigError` for a map that does not fit the files or the vehicle, a unit that
    measures something else. Raises :class:`DataError` for a cell that is no number, with file, line
    and column.

    Parameters
    ----------
    files : tables that end in .csv, .txt, .tsv, .dat, .parquet, .mat, .h5 or .hdf5.
    column_map : what their columns are.
    vehicle : noise, geometry and place; it has a section for each instrument of the map.
    """
    sources: dict[Path, Source] = {}
    bare = {BY_LOG[kind].section: log for kind, log in vehicle.bare_logs.items()}
    bare[REFERENCE.section] = Reference(**REFERENCE.empty())
    logs: list[Any] = []
    labels: dict[str, str | TableFile] = {}
    notes: list[str] = []
    for section in column_map.sections:
        path = column_map.file_of(section, tuple(files))
        if path not in sources:
            sources[path] = read_source(path)
            notes += sources[path].notes
        if section.name not in bare:
            raise ConfigError(
                f"{section.place}: the vehicle has no [{section.name}]; expected one with its "
                "noise and lever arm in the file of --vehicle"
            )
        log, file, said = _log(section, sources[path], bare[section.name], vehicle)
        logs.append(log)
        labels[section.name] = file
        notes += said
    return MappedLogs(tuple(logs), labels, tuple(notes))


def _log(
    section: MapSection, source: Source, bare: Any, vehicle: Vehicle
) -> tuple[Any, TableFile, list[str]]:
    """Return the log of a section, where its rows stand, and what was left out."""
    one = REFERENCE if section.name == REFERENCE.section else BY_SECTION[section.name]
    columns = {TIME: times(section.times, source)}
    for name, quantity in section.quantities.items():
        columns |= _columns(section, name, quantity, source, one, bare)
    n_rows = len(columns[TIME])
    for name, values in columns.items():
        if len(values) != n_rows:
            raise DataError(
                f"{section.place}: {source.label} has {n_rows} times and {len(values)} readings "
                f"of {name!r}; expected as many; are they of one sensor?"
            )
    kept, notes = _kept(section, one, columns, source)
    file = MappedFile(source.label, source, kept, _origins(section, one, bare))
    table = Table(file, {name: values[kept] for name, values in columns.items()})
    spec = one.spec(bare)
    check_finite(table, spec)
    check_increasing(table, spec)
    rows = read_columns(table, [c for c in one.columns_of(bare) if c.field], BodyAxes.FRD)
    own: dict[str, Any] = {"time_s": table.time_s, **rows}
    if section.name == "imu":
        if len(table) < 2:
            raise DataError(f"{section.place}: {source.label} has {len(table)} samples; expected 2")
        own["start_s"], own["time_s"] = interval_ends(table.time_s, section.stamp)
    if section.name == "dvl":
        own |= _dvl(rows, table, vehicle)
    return replace(bare, **own), file, notes


def _dvl(rows: Mapping[str, Array], table: Table, vehicle: Vehicle) -> dict[str, Any]:
    """Return sigmas that count, and None for what the table does not have."""
    water = rows["water_track"]
    return {
        "sigma": counted_sigma(
            rows["sigma"],
            water > 0.0,
            ground_sigma=vehicle.beam_sigma,
            water_sigma=vehicle.water_sigma,
        ),
        "range_m": rows["range_m"] if "range1_m" in table else None,
        "water_track": water if water.any() else None,
    }


def times(wanted: Times, source: Source) -> Array:
    """Return the times (N,) of a section, s."""
    total: Array | None = None
    for name, unit in zip(wanted.columns, wanted.units, strict=True):
        if unit == ISO:
            part = _dates(source, name, wanted.place)
        else:
            factor = factor_to(unit, "s", place=f"{wanted.place} unit")
            # 1e-9 is not exact, 1e9 is: times of many digits are divided.
            values = source.numbers(name, wanted.place)
            part = values / (1.0 / factor) if factor < 1.0 else values * factor
        if total is not None and len(part) != len(total):
            raise DataError(
                f"{wanted.place}: column {name!r} of {source.label} has {len(part)} rows, the one "
                f"before {len(total)}; expected as many"
            )
        total = part if total is None else total + part
    assert total is not None
    return total + wanted.offset_s


def _dates(source: Source, name: str, place: str) -> Array:
    """Return Unix seconds (N,) of dates, those without a zone are UTC; seconds of times of day."""
    cells = source.column(name, place)
    if not isinstance(cells, list) and cells.dtype.kind == "M":
        unix_s = cells.astype("datetime64[ns]").astype(np.int64) / 1e9
        return np.where(np.isnat(cells), np.nan, unix_s)
    found = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        text = cell.decode("utf-8", "replace") if isinstance(cell, bytes) else str(cell)
        if not text:
            continue
        if clock := _OF_DAY.fullmatch(text.strip()):
            hours, minutes, seconds = clock.groups()
            found[row] = (
                3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds.replace(",", "."))
            )
            continue
        try:
            date = datetime.fromisoformat(text.strip().replace("/", "-"))
        except ValueError:
            raise DataError(
                f"{source.place(row)}: column {name!r} holds {text!r}; expected a time like "
                "2026-05-01T10:00:00.125Z, or date and time of the day in a column each"
            ) from None
        found[row] = (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    return found


def _columns(
    section: MapSection,
    name: str,
    quantity: Quantity,
    source: Source,
    one: Instrument,
    bare: Any,
) -> dict[str, Array]:
    """Return the columns of a mission folder that one quantity makes."""
    names, unit = _target(section, name, one, bare)
    n_given = len(quantity.columns) or len(quantity.values)
    if n_given != len(names):
        hint = ""
        if name in ("beam", "velocity"):
            hint = f"; [dvl] of the vehicle has {len(names)} beams"
        raise ConfigError(f"{quantity.place}: expected {len(names)} columns, got {n_given}{hint}")
    factor = (
        factor_to(quantity.unit, unit, place=f"{quantity.place} unit") if quantity.unit else 1.0
    )
    if quantity.values:
        n_rows = len(times(section.times, source))
        cells = np.tile(np.array(quantity.values), (n_rows, 1))
    else:
        cells = _side_by_side(
            quantity, source, [_signed(source, c, quantity) for c in quantity.columns]
        )
    cells = cells * factor
    cells[~_valid(quantity, source, cells.shape)] = np.nan
    if quantity.axes is not BodyAxes.FRD:
        if len(names) != 3:
            raise ConfigError(
                f"{quantity.place} axes: expected of x, y, z, got {len(names)} columns"
            )
        cells = to_frd(cells, quantity.axes)
    if name == "pressure":
        cells = _depth_of(cells, section.pressure)
    return {column: cells[:, index] for index, column in enumerate(names)}


def _target(
    section: MapSection, name: str, one: Instrument, bare: Any
) -> tuple[tuple[str, ...], str]:
    """Return the columns of the folder's table that a quantity makes, and their unit."""
    instead, unit = INSTEAD.get(section.name, ("", ""))
    first = next(iter(QUANTITIES[section.name]))
    if name == instead == "velocity" and not (
        bare.mount.n_beams == 3 and np.allclose(bare.mount.beams_d, np.eye(3))
    ):
        raise ConfigError(
            f"{section.place} velocity: expected [dvl] beam_vectors = [[1, 0, 0], [0, 1, 0], "
            "[0, 0, 1]] in the file of the vehicle: a velocity is three beams along the axes"
        )
    wanted = QUANTITIES[section.name][first if name == instead else name]
    at = list(QUANTITIES[section.name]).index(wanted.name)
    return one.columns_of(bare)[at].names, unit if name == instead else wanted.unit


def _signed(source: Source, name: str, quantity: Quantity) -> Array:
    """Return a column as it is, or turned where a minus stands before its name."""
    is_turned = name.startswith("-") and name not in source.columns
    values = source.numbers(name[1:] if is_turned else name, quantity.place)
    for code in quantity.missing:
        values = np.where(values == code, np.nan, values)
    return -values if is_turned else values


def _valid(quantity: Quantity, source: Source, shape: tuple[int, ...]) -> Any:
    """Return where readings (N, columns) are valid by the columns that say so."""
    if not quantity.valid:
        return np.ones(shape, bool)
    if len(quantity.valid) not in (1, shape[1]):
        raise ConfigError(
            f"{quantity.place} valid: expected one column or {shape[1]}, got {len(quantity.valid)}"
        )
    flags = [np.nan_to_num(source.numbers(name, quantity.place)) for name in quantity.valid]
    together = _side_by_side(quantity, source, flags, n_rows=shape[0])
    return np.broadcast_to(together != 0.0, shape)


def _side_by_side(
    quantity: Quantity, source: Source, columns: Sequence[Array], n_rows: int | None = None
) -> Array:
    """Return columns as one array (N, columns); raise where they are not of one length."""
    counts = {len(values) for values in columns} | ({n_rows} if n_rows is not None else set())
    if len(counts) > 1:
        raise DataError(
            f"{quantity.place}: its columns of {source.label} have "
            f"{' and '.join(map(str, sorted(counts)))} rows; expected as many of each; are they of "
            "one sensor?"
        )
    return np.column_stack(columns)


def _depth_of(pressure: Array, given: Mapping[str, float]) -> Array:
    """Return minus the height of a sensor, m, of its pressure, Pa."""
    told = {**PRESSURE_KEYS, SURFACE_KEY: 0.0, **given}
    over = pressure - told["atmosphere_pa"]
    return np.asarray(
        over / (told["water_density_kg_per_m3"] * STANDARD_GRAVITY) - told[SURFACE_KEY]
    )


def _kept(
    section: MapSection, one: Instrument, columns: Mapping[str, Array], source: Source
) -> tuple[Any, list[str]]:
    """Return the rows (M,) that hold a reading, and what is told of the others."""
    readings = np.column_stack([values for name, values in columns.items() if name != TIME])
    is_reading = np.isfinite(columns[TIME])
    if section.name in ("imu", "dvl"):  # of which a part may be missing
        own = readings
        if section.name == "dvl":
            speeds = [v for n, v in columns.items() if n.startswith("beam") and "sigma" not in n]
            own = np.column_stack(speeds)
        is_reading &= np.isfinite(own).any(axis=1)
    else:
        required = [name for c in one.columns if not c.optional for name in c.names]
        for name in required:
            is_reading &= np.isfinite(columns[name])
    rows = np.flatnonzero(is_reading)
    notes = []
    if len(rows) < len(is_reading):
        notes.append(
            f"{source.label}: {len(is_reading) - len(rows)} of {len(is_reading)} rows have no "
            f"reading of [{section.name}]"
        )
    if section.only_changes and len(rows):
        part = readings[rows]
        same = (part[1:] == part[:-1]) | (np.isnan(part[1:]) & np.isnan(part[:-1]))
        is_new = np.r_[True, ~same.all(axis=1)]
        notes.append(
            f"{source.label}: {np.sum(~is_new)} rows repeat the reading of [{section.name}] before "
            "them and are left out, as only_changes asks"
        )
        rows = rows[is_new]
    if not len(rows):
        raise DataError(
            f"{section.place}: {source.label} has no row with a reading; expected its columns to "
            "hold numbers"
        )
    return rows, notes


@dataclass(frozen=True, slots=True, eq=False)
class MappedFile(TableFile):
    """Rows and columns of a mission's table by where they came from."""

    source: Source
    rows: Any
    """(M,) row of the source for each of the table."""
    origins: Mapping[str, tuple[str, str]]
    """Column and unit of the source, by the column of the table."""

    def place(self, row: int) -> str:  # noqa: D102
        return self.source.place(int(self.rows[row]))

    def cell(self, row: int, column: str) -> str:  # noqa: D102
        name, unit = self.origins.get(column, ("", ""))
        bare = name if name in self.source.columns else name.removeprefix("-")
        if bare not in self.source.columns:
            return name or "a constant of the map"
        text = self.source.cell(int(self.rows[row]), bare)
        held = f"{text} {unit}".rstrip() if text else "nothing"
        return f"{held} ({name!r} of {self.source.label})"


def _origins(section: MapSection, one: Instrument, bare: Any) -> dict[str, tuple[str, str]]:
    found = {TIME: (section.times.columns[0], section.times.units[0])}
    for name, quantity in section.quantities.items():
        names, unit = _target(section, name, one, bare)
        columns = quantity.columns or tuple(f"{value:g}" for value in quantity.values)
        given = quantity.unit or unit
        found |= {t: (c, given) for t, c in zip(names, columns, strict=False)}
    return found
