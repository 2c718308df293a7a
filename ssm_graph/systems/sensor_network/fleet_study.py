"""A study of a fleet by a file: each vehicle by itself and by ranges, its truth inside or not."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.settings import Key, number_key, read_settings
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.systems.sensor_network.fleet import (
    SET_BYTES,
    FleetSetting,
    FleetTrial,
    run_fleet,
)
from ssm_graph.systems.sensor_network.setting import read_study

_TOP: Final = {
    "name": Key(shape=None),
    "kind": Key(shape=None),
    "runs": number_key("", 1, 1000, "it is a count", required=False),
    "seed": number_key("", 0, 2**31, "it is a count", required=False),
    "fleet": Key(required=False),
    "links": Key(required=False),
}


def _above(high: float) -> Key:
    return Key(positive=True, high=high, required=False)


_FLEET: Final = {
    "n_vehicles": number_key("", 2, 255, required=False),
    "n_steps": number_key("", 1, 10**6, required=False),
    "speed_m_per_s": number_key("", -100.0, 100.0, required=False),
    "start_bound_m": _above(1e4),
    "dvl_bound_m_per_s": _above(10.0),
    "compass_bound_deg": _above(179.0),
    "turn_bound_deg": _above(90.0),
    "depth_bound_m": _above(100.0),
    "fix_bound_m": _above(1e4),
    "fix_every_s": number_key("", 0, 10**6, "0 for no fixes", required=False),
    "n_surfaced": number_key("", 0, 255, required=False),
}
_LINKS: Final = {
    "slot_s": number_key("", 1, 3600, "whole seconds from packet to packet", required=False),
    "loss": number_key("", 0.0, 0.99, "a share of packets", required=False),
    "range_bound_m": _above(1e3),
    "false_range": _above(1e3),
}
_FIELDS: Final = {
    "compass_bound_deg": ("compass_bound_rad", math.radians(1.0)),
    "turn_bound_deg": ("turn_bound_rad", math.radians(1.0)),
    "fix_every_s": ("fix_every", 1),
    "slot_s": ("slot", 1),
}
_COUNTS: Final = ("n_vehicles", "n_steps", "n_surfaced", "fix_every", "slot")


@dataclass(frozen=True, slots=True)
class FleetStudy:
    """What a study file asks for."""

    name: str
    setting: FleetSetting
    runs: int = 5
    seed: int = 0


@dataclass(frozen=True, slots=True)
class FleetRow:
    """All runs of a fleet under one kind of errors, each by itself or by ranges."""

    errors: str
    """``uniform`` within their bounds, or at their ``corners``"""
    heard: str
    """``nothing`` or ``ranges``"""
    half_width_m: float
    """At the end, mean of the vehicles without fixes and of east and north"""
    widest_m: float
    """The largest of all runs, steps and vehicles"""
    largest_excess: float
    """Of the truth, at most 1 inside"""
    n_outside: int
    n_checks: int
    n_packets_heard: int
    n_unsent: int
    """Packets that a set was too wide or too far away for"""
    n_alarms: int


@dataclass(frozen=True, slots=True, eq=False)
class FleetResult:
    """What came of a study."""

    study: FleetStudy
    rows: tuple[FleetRow, ...]
    first_alarm: str
    """Of the fleets that hear each other; empty without one"""
    alone: FleetTrial
    """The first run with uniform errors, for the figure"""
    together: FleetTrial


def read_fleet_study(path: Path) -> FleetStudy:
    """Read a study file; what it does not say is as in :class:`.fleet.FleetSetting`."""
    raw = read_study(path)
    sections = {name: raw.pop(name) for name in ("fleet", "links") if name in raw}
    top = read_settings("", raw, known=_TOP, file=str(path))
    found: dict[str, Any] = {}
    for section, known in (("fleet", _FLEET), ("links", _LINKS)):
        if section not in sections:
            continue
        part = read_settings(section, sections[section], known=known, file=str(path))
        for name in sections[section]:
            field, unit = _FIELDS.get(name, (name, 1.0))
            value = part.number(name) * unit
            found[field] = part.count(name) if field in _COUNTS else value
    try:
        setting = FleetSetting(**found)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    runs = top.count("runs") if "runs" in top else 5
    return FleetStudy(top.text("name"), setting, runs, top.count("seed"))


def run_fleet_study(study: FleetStudy, tell: Callable[[str], None] = lambda _: None) -> FleetResult:
    """Run all fleets; ``tell`` hears what is worked on."""
    rows, alarm, shown = [], "", {}
    for errors in ("uniform", "corners"):
        setting = replace(study.setting, at_corners=errors == "corners")
        for heard in ("nothing", "ranges"):
            tell(f"errors {errors}, vehicles hear {heard}")
            seeds = range(study.seed, study.seed + study.runs)
            trials = [run_fleet(setting, seed=seed, hears=heard == "ranges") for seed in seeds]
            rows.append(_row(setting, errors, heard, trials))
            shown[errors, heard] = trials[0]
            alarms = [one for trial in trials for one in trial.alarms]
            if alarms and heard == "ranges" and not alarm:
                step, vehicle, what = alarms[0]
                alarm = f"vehicle {vehicle}, {step} s: its {what} misses its set"
    return FleetResult(
        study, tuple(rows), alarm, shown["uniform", "nothing"], shown["uniform", "ranges"]
    )


def _row(setting: FleetSetting, errors: str, heard: str, trials: list[FleetTrial]) -> FleetRow:
    excess = np.array([trial.excess for trial in trials])
    half = np.array([trial.half_widths[..., :2] for trial in trials])
    below = half[:, -1, min(setting.n_surfaced, setting.n_vehicles - 1) :]
    return FleetRow(
        errors,
        heard,
        float(below.mean()),
        float(half.max()),
        float(excess.max()),
        int(np.sum(excess > 1.0 + 1e-9)),
        excess.size,
        sum(trial.n_heard for trial in trials),
        sum(trial.n_unsent for trial in trials),
        sum(len(trial.alarms) for trial in trials),
    )


def fleet_words(result: FleetResult) -> list[str]:
    """Return what came of it in sentences."""
    alone, together = result.rows[0], result.rows[1]
    outside = sum(row.n_outside for row in result.rows)
    checks = sum(row.n_checks for row in result.rows)
    setting = result.study.setting
    lines = [
        f"The truth was outside in {outside} of {checks} checks, largest e'P⁻¹e "
        f"{max(row.largest_excess for row in result.rows):.6f}.",
        f"Vehicles without fixes end within ±{alone.half_width_m:.1f} m by themselves, within "
        f"±{together.half_width_m:.1f} m by ranges: a packet of {SET_BYTES} bytes every "
        f"{setting.slot} s, {setting.loss:.0%} of them lost.",
    ]
    unsent = sum(row.n_unsent for row in result.rows)
    if unsent:
        lines.append(f"{unsent} packets were not sent: a set was too wide or far for their bytes.")
    if result.first_alarm:
        lines.append(f"Alarm, so a bound is false: {result.first_alarm}.")
    return lines


def write_fleet_result(folder: Path, result: FleetResult, *, command: str) -> None:
    """Write ``summary.md`` and ``table.csv``."""
    folder.mkdir(parents=True, exist_ok=True)
    study, setting = result.study, result.study.setting
    lines = [f"# Fleet: {study.name}", "", f"    {command}", "", *fleet_words(result), ""]
    lines += [
        f"{study.runs} runs of {setting.n_vehicles} vehicles, {setting.n_steps} s, seed "
        f"{study.seed}; the first {setting.n_surfaced} have fixes. Bounds: velocity of the DVL "
        f"±{setting.dvl_bound_m_per_s:g} m/s a component, compass "
        f"±{math.degrees(setting.compass_bound_rad):g} deg, depth ±{setting.depth_bound_m:g} m, "
        f"range ±{setting.range_bound_m:g} m, fix ±{setting.fix_bound_m:g} m.",
        "",
        "| errors | heard | half-width at the end, m | widest, m | largest e'P⁻¹e | outside | "
        "packets heard | alarms |",
        "|" + "---|" * 8,
    ]
    lines += [
        f"| {row.errors} | {row.heard} | {row.half_width_m:.2f} | {row.widest_m:.2f} | "
        f"{row.largest_excess:.6f} | {row.n_outside} of {row.n_checks} | {row.n_packets_heard} | "
        f"{row.n_alarms} |"
        for row in result.rows
    ]
    names, table = FleetRow.__slots__, io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([getattr(row, name) for name in names] for row in result.rows)
    write_through(folder / "table.csv", table.getvalue().encode())
    write_through(folder / "summary.md", ("\n".join(lines) + "\n").encode())
