"""Ranges from text tables as people have them: commas or spaces, with a header or without."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.ranges import LONGEST_M, Ranges, screened_ranges
from ssm_graph.systems.visual_ranges.readers.times import UNITS, range_seconds

LENGTHS: Final = {"m": 1.0, "cm": 0.01, "mm": 1e-3, "ft": 0.3048}
"""Names of units of length in headers, and each in metres."""
_NAMES: Final[Mapping[str, tuple[str, ...]]] = {
    "time": ("time", "timestamp", "stamp", "t", "time_stamp"),
    "anchor": ("anchor", "anchor_id", "to_id", "to", "responder", "beacon", "id", "anchor_name"),
    "range": ("range", "distance", "dist", "ranging", "measurement"),
    "sigma": ("std", "sigma", "stddev", "range_std", "range_sigma"),
}
_PLAIN: Final = ("time", "anchor", "range", "sigma")
"""Columns of a table without a header."""


@dataclass(slots=True)
class _Columns:
    time: list[float] = field(default_factory=list)
    anchor: list[str] = field(default_factory=list)
    range: list[float] = field(default_factory=list)
    sigma: list[float] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    bad: list[int] = field(default_factory=list)


def read_ranges(
    path: Path,
    image_time_s: Array,
    *,
    sigma_m: float | None = None,
    unit: str = "",
    time_unit: str = "",
    known: Mapping[str, Array] | None = None,
) -> Ranges:
    """Return the ranges of a text table; `Ranges.notes` says what was dropped, with its line.

    Columns are told by their names, ``time [ns]``, ``anchor``, ``range_mm`` and the like, or,
    without a header, by their place: time, anchor, range, sigma.

    Raises :class:`DataError` for a file that is no such table, one most of whose lines cannot be
    read, and ranges that can only be in another unit.

    Parameters
    ----------
    image_time_s : (K,) times of the images, to find the unit of the ranges' times by.
    sigma_m : standard deviation of ranges whose row does not say, m; None: that of `Ranges`.
    unit, time_unit : of the columns, where the header does not say.
    known : places (3,) of known anchors, m.
    """
    if unit and unit not in LENGTHS:
        raise ConfigError(f"unit of ranges: expected one of {', '.join(LENGTHS)}, got {unit!r}")
    if time_unit and time_unit not in UNITS:
        raise ConfigError(f"unit of times: expected one of {', '.join(UNITS)}, got {time_unit!r}")
    columns, units = _read(path)
    length = LENGTHS[unit or units.get("range", "") or "m"]
    values = np.array(columns.range) * length
    time_s, note = range_seconds(
        np.array(columns.time), path.name, image_time_s, time_unit or units.get("time", "")
    )
    if not unit and "range" not in units:
        _check_unit(path, values)
    stated = np.array(columns.sigma) * LENGTHS[unit or units.get("sigma", "") or "m"]
    if sigma_m is not None:
        stated = np.where(np.isfinite(stated) & (stated > 0.0), stated, sigma_m)
    notes = [note] if note else []
    if columns.bad:
        notes.append(
            f"{path.name}: {len(columns.bad)} lines that are no ranges, left out (first: line "
            f"{columns.bad[0]})"
        )
    found = screened_ranges(
        time_s,
        columns.anchor,
        values,
        stated,
        known=known,
        lines=columns.lines,
        source=path.name,
    )
    return found if not notes else _noted(found, notes)


def _noted(ranges: Ranges, notes: list[str]) -> Ranges:
    return replace(ranges, notes=(*notes, *ranges.notes))


def _check_unit(path: Path, values: Array) -> None:
    good = values[np.isfinite(values) & (values > 0.0)]
    if len(good) and np.median(good) > LONGEST_M:
        low, high = np.percentile(good, (5, 95))
        raise DataError(
            f"{path}: ranges are {low:.0f} to {high:.0f}, expected metres up to {LONGEST_M:g}; are "
            "they millimetres? then give --range-unit mm"
        )


def _read(path: Path) -> tuple[_Columns, dict[str, str]]:
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
    rows = [(n, line) for n, line in lines if not line.startswith("#")]
    if not rows:
        raise DataError(f"{path}: expected rows of time, anchor and range, found none")
    comments = [line.lstrip("# ") for n, line in lines if line.startswith("#") and n < rows[0][0]]
    separator = next((c for c in (",", ";") if c in rows[0][1]), None)
    head = _cells(rows[0][1], separator)
    if not _is_number(head[0]):
        place, units = _header(path, head)
        rows = rows[1:]
    elif comments and (names := _maybe_header(_cells(comments[-1], separator))) is not None:
        place, units = names
    elif len(head) in (3, 4):
        place, units = {name: i for i, name in enumerate(_PLAIN[: len(head)])}, {}
    else:
        raise DataError(
            f"{path}:{rows[0][0]}: expected a header, or columns time, anchor, range and perhaps "
            f"sigma, got {len(head)} columns without names; add a first line of names"
        )
    columns = _filled(rows, separator, place)
    if len(columns.bad) > max(10, len(columns.lines)):
        raise DataError(
            f"{path}:{columns.bad[0]}: expected time, anchor and range, got "
            f"{dict(rows)[columns.bad[0]][:60]!r}; {len(columns.bad)} such lines"
        )
    return columns, units


def _cells(line: str, separator: str | None) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(separator)]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _maybe_header(cells: list[str]) -> tuple[dict[str, int], dict[str, str]] | None:
    place: dict[str, int] = {}
    units: dict[str, str] = {}
    for i, cell in enumerate(_joined(cells)):
        match = re.fullmatch(r"(.*?)[\s_]*[\[(](\w+)[\])]", cell.lower())
        name, unit = (match[1], match[2]) if match else (cell.lower(), "")
        name = name.strip().replace(" ", "_")
        if not unit and name.rpartition("_")[2] in {*UNITS, *LENGTHS}:
            name, _, unit = name.rpartition("_")
        for role, names in _NAMES.items():
            if name in names and role not in place:
                place[role] = i
                if unit in (UNITS if role == "time" else LENGTHS):
                    units[role] = unit
    return (place, units) if {"time", "anchor", "range"} <= set(place) else None


def _joined(cells: list[str]) -> Iterator[str]:
    """Join a unit in brackets that spaces separated from its name."""
    found: list[str] = []
    for cell in cells:
        if cell.startswith(("[", "(")) and found:
            found[-1] += f" {cell}"
        else:
            found.append(cell)
    yield from found


def _header(path: Path, cells: list[str]) -> tuple[dict[str, int], dict[str, str]]:
    found = _maybe_header(cells)
    if found is None:
        raise DataError(
            f"{path}:1: expected columns for time, anchor and range, got {', '.join(cells)}; names "
            "that are known: "
            + "; ".join(f"{role}: {', '.join(names)}" for role, names in _NAMES.items())
        )
    return found


def _filled(
    rows: list[tuple[int, str]], separator: str | None, place: Mapping[str, int]
) -> _Columns:
    columns, n_cells = _Columns(), max(place.values()) + 1
    for number, line in rows:
        cells = _cells(line, separator)
        try:
            time, measured = float(cells[place["time"]]), float(cells[place["range"]] or "nan")
            sigma = float(cells[place["sigma"]] or "nan") if "sigma" in place else np.nan
            name = cells[place["anchor"]]
        except (ValueError, IndexError):
            columns.bad.append(number)
            continue
        if len(cells) < n_cells or not name:
            columns.bad.append(number)
            continue
        columns.time.append(time)
        columns.anchor.append(_short(name))
        columns.range.append(measured)
        columns.sigma.append(sigma)
        columns.lines.append(number)
    return columns


def _short(name: str) -> str:
    """Return an anchor's name; one that was written as a float is that of its whole number."""
    return name[:-2] if re.fullmatch(r"\d+\.0", name) else name
