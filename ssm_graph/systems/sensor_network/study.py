"""A study of a network: the patent's recursion beside the recommended one, and Table 1."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.settings import Key, Settings, number_key, read_settings
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.systems.sensor_network.codes import bits_for
from ssm_graph.systems.sensor_network.patent import Parameters, PatentSettings, Saturation
from ssm_graph.systems.sensor_network.setting import SETTINGS, Setting, Share, read_study
from ssm_graph.systems.sensor_network.world import Disturbance, Trial, run_patent, run_sets

KEYS: Final = (1.0, 5.0, 20.0, 50.0, 100.0, 200.0)
"""Keys of Table 1: the patent's own is lost."""
INTERVALS: Final = (0.05, 0.01)
"""d of Table 1."""
CLAIMED: Final = (0.51, 0.90, 0.82, 0.96)
"""By how much the patent says that the mean error of each node falls."""
PATENT_FILTERS: Final = {
    "patent, parameters 1": PatentSettings(parameters=Parameters.ONES),
    "patent": PatentSettings(),
    "patent, no consensus": PatentSettings(consensus=0.0),
    "patent, saturation tested": PatentSettings(saturation=Saturation.TESTED),
    "patent, tested, Lagrange": PatentSettings(saturation=Saturation.TESTED, lam=None),
}
SET_FILTERS: Final = {
    "sets, alone": Share.NONE,
    "sets, measurements shared": Share.MEASUREMENTS,
    "sets, ellipsoids shared": Share.ELLIPSOIDS,
}
_TOP: Final = {
    "name": Key(shape=None),
    "kind": Key(shape=None, required=False),
    "base": Key(shape=None, required=False),
    "runs": number_key("", 1, 1000, "it is a count", required=False),
    "seed": number_key("", 0, 2**31, "it is a count", required=False),
    "disturbances": Key(shape=None, required=False),
    "setting": Key(required=False),
    "network": Key(required=False),
    "code": Key(required=False),
}
_ABOVE: Final = {"positive": True, "required": False}
_SETTING: Final = {
    "n_nodes": number_key("n_nodes", 1, 255, required=False),
    "n_steps": number_key("n_steps", 1, 10**6, required=False),
    "speed_m": number_key("speed_m", -1e3, 1e3, required=False),
    "turn_amplitude_rad": number_key("turn_amplitude_rad", -10, 10, required=False),
    "turn_rate_rad": number_key("turn_rate_rad", -10, 10, required=False),
    "saturation": Key("saturation", shape=(3,), high=1e6, **_ABOVE),  # type: ignore[arg-type]
    "motion_bound": Key("motion_bound", shape=(3,), high=1e3, **_ABOVE),  # type: ignore[arg-type]
    "position_bound_m": Key("position_bound", high=1e4, **_ABOVE),  # type: ignore[arg-type]
    "compass_bound_rad": Key("compass_bound", high=3.14, **_ABOVE),  # type: ignore[arg-type]
    "initial_variance": Key("initial_variance", high=1e6, **_ABOVE),  # type: ignore[arg-type]
    "true_scale": Key("true_scale", high=100.0, **_ABOVE),  # type: ignore[arg-type]
}
_NETWORK: Final = {
    "edges": Key(shape=((0, 65025), 2), low=1, high=255, required=False),
    "loss": number_key("loss", 0.0, 0.99, "a share of packets", required=False),
    "delay_steps": Key("", shape=(2,), low=0, high=50, required=False),
}
_CODE: Final = {
    "d": Key("d", required=False, high=1e6, low=-1e6),
    "key": Key("key", required=False, high=1e9, low=-1e9),
    "bits": number_key("bits", 1, 32, "of an index", required=False),
}


@dataclass(frozen=True, slots=True)
class NetworkStudy:
    """What a study file asks for."""

    setting: Setting
    disturbances: tuple[Disturbance, ...] = tuple(Disturbance)
    runs: int = 20
    seed: int = 0


def read_network_study(path: Path) -> NetworkStudy:
    """Read a study file; what it does not say is as in the setting that it is based on."""
    raw = read_study(path)
    sections = {name: raw.pop(name) for name in ("setting", "network", "code") if name in raw}
    top = read_settings("", raw, known=_TOP, file=str(path))
    base = top.text("base") if "base" in top else "patent"
    if base not in SETTINGS:
        raise top.fault("base", f"unknown setting {base!r}; {nearest_hint(base, SETTINGS)}")
    found: dict[str, Any] = {"name": top.text("name")}
    for section, known in (("setting", _SETTING), ("network", _NETWORK), ("code", _CODE)):
        if section in sections:
            part = read_settings(section, sections[section], known=known, file=str(path))
            found |= _fields(part)
    try:
        setting = replace(SETTINGS[base], **found)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    kinds = tuple(Disturbance)
    if "disturbances" in top:
        kinds = tuple(_disturbance(top, word) for word in top.text("disturbances").split(","))
    runs = top.count("runs") if "runs" in top else 20
    return NetworkStudy(setting, kinds, runs, top.count("seed"))


def _fields(part: Settings) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in part.given().items():
        is_count = name in ("n_nodes", "n_steps", "bits")
        found[name] = part.count(name) if is_count else value
        if isinstance(value, np.ndarray):
            found[name] = tuple(float(x) for x in value)
    if "edges" in part:
        found["edges"] = tuple((int(i), int(j)) for i, j in part.counts("edges"))
    if "delay_steps" in part:
        low, high = part.counts("delay_steps")
        found["delay"] = (int(low), int(high))
    return found


def _disturbance(top: Settings, word: str) -> Disturbance:
    try:
        return Disturbance[word.strip().upper()]
    except KeyError:
        known = [kind.name.lower() for kind in Disturbance]
        raise top.fault("disturbances", f"unknown {word!r}; {nearest_hint(word, known)}") from None


@dataclass(frozen=True, slots=True)
class Row:
    """One filter under one disturbance."""

    filter: str
    disturbance: str
    error: float
    """Mean length of the error of the centre, m and rad mixed as in the patent"""
    position_rms_m: float
    """Of the point estimate, each component"""
    ekf_rms_m: float
    position_half_width_m: float
    heading_half_width_rad: float
    largest_excess: float
    """Of e'P^-1e; above 1 the truth was outside"""
    n_outside: int
    n_checks: int
    n_alarms: int
    ms_per_node_step: float

    @classmethod
    def of(cls, name: str, kind: Disturbance, trial: Trial) -> Row:
        """Return the row of a trial."""
        truth = trial.truth[:, :, None]
        checks = trial.excess.size

        def rms(points: Any) -> float:
            return float(np.sqrt(np.mean(np.square((points - truth)[..., :2]))))

        half = trial.half_widths.mean(axis=(0, 1, 2))
        return cls(
            name,
            kind.name.lower(),
            float(trial.error.mean()),
            rms(trial.point),
            rms(trial.ekf),
            float(half[:2].mean()),
            float(half[2]),
            float(trial.excess.max()),
            int(np.sum(trial.excess > 1.0 + 1e-9)),
            checks,
            len(trial.alarms),
            1e3 * trial.cpu_s / checks,
        )


@dataclass(frozen=True, slots=True)
class NetworkResult:
    """What came of a study."""

    study: NetworkStudy
    rows: tuple[Row, ...]
    table_1: Mapping[float, Mapping[float, Sequence[float]]]
    """Mean error of each node by key and interval d."""


def run_network_study(
    study: NetworkStudy, on_progress: Callable[[str], None] | None = None
) -> NetworkResult:
    """Run every filter under every disturbance, and Table 1; the same study makes the same rows."""
    say = on_progress or (lambda _: None)
    rows = []
    for kind in study.disturbances:
        for name, settings in PATENT_FILTERS.items():
            say(f"{name}, {kind.name.lower()}")
            trial = run_patent(
                study.setting, kind, runs=study.runs, seed=study.seed, settings=settings
            )
            rows.append(Row.of(name, kind, trial))
        for name, share in SET_FILTERS.items():
            say(f"{name}, {kind.name.lower()}")
            setting = replace(study.setting, share=share)
            trial = run_sets(setting, kind, runs=study.runs, seed=study.seed)
            rows.append(Row.of(name, kind, trial))
    say("Table 1")
    return NetworkResult(study, tuple(rows), table_1(study.setting, seed=study.seed))


def table_1(
    setting: Setting, *, seed: int = 0, keys: Sequence[float] = KEYS
) -> dict[float, dict[float, tuple[float, ...]]]:
    """Return the mean errors of the nodes by key and interval, under the patent's noise."""
    found: dict[float, dict[float, tuple[float, ...]]] = {}
    for key in keys:
        found[key] = {}
        for d in INTERVALS:
            one = replace(setting, key=key, d=d)
            trial = run_patent(one, Disturbance.PATENT, runs=20, seed=seed)
            found[key][d] = tuple(float(x) for x in trial.error.mean(axis=(0, 1)))
    return found


def falls(by_interval: Mapping[float, Sequence[float]]) -> tuple[float, ...]:
    """Return by how much each node's mean error falls from the large interval to the small one."""
    large, small = (by_interval[d] for d in INTERVALS)
    return tuple(a - b for a, b in zip(large, small, strict=True))


def plain_words(result: NetworkResult) -> list[str]:
    """Return what holds and what is vacuous, a sentence each, from the numbers at hand."""
    s = np.asarray(result.study.setting.saturation)
    trivial = float(s[:2].mean())
    own = [row for row in result.rows if row.filter == "patent"]
    tested = [row for row in result.rows if row.filter == "patent, saturation tested"]
    sets = [row for row in result.rows if row.filter in SET_FILTERS]
    lines = []
    if own:
        width = max(row.position_half_width_m for row in own)
        heading = max(row.heading_half_width_rad for row in own)
        missed, checks = sum(row.n_outside for row in own), sum(row.n_checks for row in own)
        held = f"was violated in {missed} of" if missed else "held in"
        is_vacuous = heading >= s[2]
        verdict = (
            ": of the heading, and so of its trace, it is vacuous, and that errors are below the "
            "trace (figures 8 and 9) is true of any estimate"
        )
        lines.append(
            f"The patent's bound {held} {checks} checks. It says ±{width:.1f} m and "
            f"±{heading:.0f} rad, where the walls alone say ±{trivial:.0f} m and ±{s[2]:.0f} rad"
            f"{verdict if is_vacuous else ''}."
        )
    outside = sum(row.n_outside for row in tested)
    if outside:
        lines.append(
            f"Without the inflation by the trace, lambda = 3 is no bound: outside {outside} times "
            f"of {sum(row.n_checks for row in tested)}."
        )
    if sets:
        width = max(row.position_half_width_m for row in sets)
        outside = sum(row.n_outside for row in sets)
        lines.append(
            f"The recommended sets: outside {outside} times of "
            f"{sum(row.n_checks for row in sets)}, largest e'P⁻¹e "
            f"{max(row.largest_excess for row in sets):.12f}, at most ±{width:.2f} m on average "
            "under the worst of the disturbances."
        )
        widest = max(row.heading_half_width_rad for row in sets)
        if widest >= math.pi:
            lines.append(f"The heading is not observed: ±{widest:.1f} rad is more than a turn.")
    fall_1, fall_100 = (np.mean(falls(result.table_1[key])) for key in (1.0, 100.0))
    lines.append(
        f"Table 1: with a key of 1 the mean error falls by {fall_1:z.2f}, with one of 100 by "
        f"{fall_100:.2f}; the patent claims {', '.join(map(str, CLAIMED))} and its key is lost. "
        "The key only makes the steps of the quantiser larger: it costs accuracy, one known pair "
        "of value and index reveals it, and it is no encryption."
    )
    deaf = result.study.setting.deaf
    if deaf:
        lines.append(f"Nodes that hear nobody: {', '.join(map(str, deaf))}.")
    return lines


def summary(result: NetworkResult, *, command: str) -> str:
    """Return the page of a study, Markdown."""
    setting = result.study.setting
    lines = [f"# Network: {setting.name}", "", f"    {command}", "", *plain_words(result), ""]
    lines += [
        f"{result.study.runs} runs of {setting.n_steps} steps, {setting.n_nodes} nodes, seed "
        f"{result.study.seed}; step of the quantiser {setting.step:g} m, plain index of "
        f"{bits_for(setting.saturation[1], setting.step)} bits.",
        "",
        "| filter | disturbance | mean error | rms of the point, m | EKF, m | half-width, m | "
        "heading, rad | largest e'P⁻¹e | outside | alarms | ms per node and step |",
        "|" + "---|" * 11,
    ]
    lines += [
        f"| {row.filter} | {row.disturbance} | {row.error:.2f} | {row.position_rms_m:.3f} | "
        f"{row.ekf_rms_m:.3f} | {row.position_half_width_m:.3f} | "
        f"{row.heading_half_width_rad:.3g} | {row.largest_excess:.4f} | "
        f"{row.n_outside} of {row.n_checks} | {row.n_alarms} | {row.ms_per_node_step:.2f} |"
        for row in result.rows
    ]
    lines += [
        "",
        "## Table 1",
        "",
        f"Mean error of the patent's filter, nodes 1 to {setting.n_nodes}.",
        "",
    ]
    lines += ["| key | d = 0.05 | d = 0.01 | fall |", "|---|---|---|---|"]
    for key, by_interval in result.table_1.items():
        cells = [" ".join(f"{x:.2f}" for x in by_interval[d]) for d in INTERVALS]
        fall = " ".join(f"{x:z.2f}" for x in falls(by_interval))
        lines.append(f"| {key:g} | {cells[0]} | {cells[1]} | {fall} |")
    return "\n".join(lines) + "\n"


def write_network_result(folder: Path, result: NetworkResult, *, command: str) -> str:
    """Write ``summary.md`` and ``table.csv``; return the summary."""
    folder.mkdir(parents=True, exist_ok=True)
    text = summary(result, command=command)
    names = Row.__slots__
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([getattr(row, name) for name in names] for row in result.rows)
    write_through(folder / "table.csv", table.getvalue().encode())
    write_through(folder / "summary.md", text.encode())
    return text
