"""The page's words and tables: the verdict first, then what it rests on."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.runs import runs_of
from ssm_graph.report.clock import clocked
from ssm_graph.report.page.content import Z95, Content

VERDICTS: Final = {
    "CONVERGED": ("✔", "good", "The answer may be used: nothing in the data contradicts it."),
    "SUSPECT": (
        "⚠",
        "bad",
        "Look first: the data contradict the answer, or leave it ambiguous.",
    ),
    "MAX_ITERATIONS": ("⚠", "bad", "Not settled: the iteration limit came first."),
    "INTERRUPTED": ("⚠", "bad", "Not settled: the run was interrupted."),
    "DIVERGED": ("✖", "bad", "No answer: the solution ran away."),
}
"""Sign, style and meaning of each status; the sign says without colour what the colour says."""
NOTHING: Final = "\u2013"
"""In a cell where there is nothing to say."""
MOST_STRETCHES: Final = 3
"""Of time in which a limit is not met that are told one by one."""


@dataclass(frozen=True, slots=True)
class Order:
    """One order of IHO S-44, edition 6.1: allowed uncertainty of a sounding, 95 %."""

    name: str
    horizontal_m: float
    horizontal_of_depth: float
    vertical_m: float
    """The part that does not depend on depth."""
    vertical_of_depth: float


ORDERS: Final = (
    Order("Exclusive", 1.0, 0.0, 0.15, 0.0075),
    Order("Special", 2.0, 0.0, 0.25, 0.0075),
    Order("1a, 1b", 5.0, 0.05, 0.5, 0.013),
    Order("2", 20.0, 0.10, 1.0, 0.023),
)


def verdict(content: Content) -> str:
    """Return the head of the page: status in words, why, and the numbers people ask for first."""
    summary = content.summary
    status = str(summary.get("status"))
    sign, style, meaning = VERDICTS.get(status, ("?", "bad", "The status is not known."))
    reason = clocked(str(summary.get("reason") or ""), content.begin_s, content.epoch_s)
    facts = "".join(
        f"<div><dt>{_text(name)}</dt><dd>{_text(value)}</dd></div>"
        for name, value in _facts(content)
    )
    return (
        f'<section class="verdict {style}"><p class="status"><span class="sign">{sign}</span> '
        f'{_text(status.replace("_", " "))}</p><p class="meaning">{_text(meaning)}</p>'
        f'<p>{_text(reason)}</p>{_local(summary)}</section><dl class="facts">{facts}</dl>'
    )


def _local(summary: Mapping[str, Any]) -> str:
    """Return what a start without a place on Earth means for the numbers of the page."""
    said = summary.get("local_start")
    return f"<p><strong>{_text(said)}.</strong></p>" if said else ""


def _facts(content: Content) -> Iterable[tuple[str, str]]:
    summary, radius_m = content.summary, content.radius_95_m
    duration_s = float(summary.get("duration_s") or 0.0)
    yield "mission", str(summary.get("mission"))
    yield "method, kernel", f"{summary.get('method')}, {summary.get('kernel')}"
    yield "begin", _when(content, content.begin_s)
    yield "duration", f"{duration_s / 60.0:.1f} min"
    yield "path length", f"{summary.get('total_path_length_m') or 0.0:.0f} m"
    known = radius_m[np.isfinite(radius_m)]
    if len(known):
        yield "position at the end, 95\u00a0%", f"{radius_m[-1]:.2f} m"
        yield "position at the worst, 95\u00a0%", f"{known.max():.2f} m"
    n_beams, n_out = summary.get("n_beams") or 0, summary.get("n_outliers") or 0
    if n_beams:
        yield "beam speeds left out", f"{n_out} of {n_beams} ({100.0 * n_out / n_beams:.1f} %)"
    if summary.get("rmse_horizontal_m") is not None:
        yield "against the reference, rms", f"{summary['rmse_horizontal_m']:.2f} m"


def _when(content: Content, time_s: float) -> str:
    if content.epoch_s is None:
        return f"{time_s:.1f} s on the mission's clock"
    when = datetime.fromtimestamp(time_s + content.epoch_s, UTC)
    return when.strftime("%Y-%m-%d %H:%M:%S UTC")


def sections(content: Content) -> list[tuple[str, str]]:
    """Return title and HTML of each section that has something to say."""
    found = [
        ("Sensors that were off", _faults(content)),
        ("Beams", _beams(content)),
        ("Further measurements", _aids(content)),
        ("Data quality", _data(content)),
        ("Against the reference", _reference(content.summary)),
        ("Calibration", _calibration(content.summary)),
        ("Position uncertainty for surveys", _survey(content)),
        ("Start, assumptions and notes", _assumed(content)),
        ("Settings and versions", _settings(content.summary)),
    ]
    return [(title, text) for title, text in found if text]


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table; a cell with nothing to say has a dash."""
    head = "".join(f"<th>{_text(name)}</th>" for name in header)
    body = "".join(
        "<tr>"
        + "".join(f"<td>{_text(NOTHING if cell == '' else cell)}</td>" for cell in row)
        + "</tr>"
        for row in rows
    )
    inside = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{inside}</div>'


def _faults(content: Content) -> str:
    faults: Sequence[Mapping[str, Any]] = content.summary.get("faults") or ()
    if not faults:
        return "<p>None was found.</p>"
    rows = [
        (
            ("⚠ " if fault["is_suspect"] else "") + fault["sensor"],
            f"{content.minutes(np.array(fault['begin_s'])):.1f} to "
            f"{content.minutes(np.array(fault['end_s'])):.1f}",
            fault["what"],
            fault["treatment"].replace("_", " ")
            + (f"; or it is {' or '.join(fault['rivals'])}" if fault["rivals"] else ""),
            f"{fault['cost_m']:.2g}" if fault["cost_m"] else "",
            fault["remedy"],
        )
        for fault in faults
    ]
    header = (
        "sensor",
        "minutes",
        "what",
        "what became of it",
        "cost at most, m",
        "what to look at",
    )
    return table(header, rows)


def _beams(content: Content) -> str:
    rows, noise = content.beams, content.summary.get("noise") or {}
    numbers = np.unique(rows["beam"]).astype(int)
    if len(numbers) == 0:
        return "<p>No beam speed was used.</p>"
    found = noise.get("beam_sigma_estimated_over_stated") or []
    cells = []
    for beam in numbers:
        mine = rows["beam"] == beam
        weight, innovation = rows["weight"][mine], rows["innovation_m_per_s"][mine]
        is_out = weight < 0.05
        kept = innovation[~is_out]
        ratio = found[beam - 1] if beam <= len(found) else None
        cells.append(
            (
                f"beam {beam}",
                len(weight),
                f"{int(is_out.sum())} ({100.0 * is_out.mean():.1f} %)",
                f"{np.median(weight):.2f}",
                f"{1e3 * np.sqrt(np.mean(kept**2)):.2f}" if len(kept) else "",
                f"{ratio:.2f}" if ratio is not None else "",
            )
        )
    header = ("", "speeds", "left out, weight < 0.05", "median weight", "innovation, rms, mm/s")
    text = table((*header, "noise found over stated"), cells)
    share = _nis(rows)
    return text + share + _left_out(content)


def _nis(rows: Mapping[str, Any]) -> str:
    """Return whether the squared innovations are as large as they should be."""
    used = rows["mahalanobis_sq"][rows["weight"] > 0.05]
    if len(used) < 30:
        return ""
    mean, error = float(used.mean()), float(np.sqrt(2.0 / len(used)))
    return (
        f"<p>Mean squared innovation in sigmas (NIS) {mean:.3f}; of noise as stated it lies within "
        f"{1 - 1.96 * error:.3f} and {1 + 1.96 * error:.3f} in 19 of 20 missions. Above: noisier "
        "than stated, or an error that lasts; below: quieter than stated.</p>"
    )


def _left_out(content: Content) -> str:
    """Return the minutes in which most was left out."""
    rows = content.beams
    minute = np.floor(content.minutes(rows["time_s"])).astype(int)
    is_out = rows["weight"] < 0.05
    if not is_out.any():
        return ""
    first = minute.min()
    n_out = np.bincount(minute - first, weights=is_out)
    n_all = np.bincount(minute - first)
    worst = np.argsort(-n_out, kind="stable")[:5]
    cells = []
    for i in sorted(i for i in worst if n_out[i] > 0):
        mine = is_out & (minute - first == i)
        beams = ", ".join(f"{beam:.0f}" for beam in np.unique(rows["beam"][mine]))
        cells.append((f"{i + first} to {i + first + 1}", f"{n_out[i]:.0f} of {n_all[i]}", beams))
    return "<p>Most was left out in these minutes:</p>" + table(
        ("minutes", "speeds", "beams"), cells
    )


def _aids(content: Content) -> str:
    counts: Mapping[str, Any] = content.summary.get("aids") or {}
    if not counts:
        return ""
    rows = [(name, of["n_measurements"], of["n_outliers"]) for name, of in counts.items()]
    return table(("", "measurements", "left out, weight < 0.05"), rows)


def _reference(summary: Mapping[str, Any]) -> str:
    if summary.get("rmse_horizontal_m") is None:
        return ""
    names = {
        "rmse_horizontal_m": "horizontal error, rms, m",
        "max_horizontal_m": "horizontal error, largest, m",
        "end_error_m": "horizontal error at the end, m",
        "drift_percent": "error at the end, % of the path",
        "rmse_vertical_m": "vertical error, rms, m",
        "rmse_velocity_m_per_s": "velocity error, rms, m/s",
        "rmse_heading_deg": "heading error, rms, degrees",
        "nees_position": "NEES of the position over 3; 1 is expected",
    }
    told = {label: summary.get(key) for key, label in names.items()}
    rows = [(label, _number(value)) for label, value in told.items() if value is not None]
    inside = summary.get("inside_3_sigma") or {}
    shares = ", ".join(
        f"{axis} {100.0 * share:.1f}" for axis, share in inside.items() if share is not None
    )
    return table(("", ""), [*rows, ("inside 3 sigma, %; 99.7 is expected", shares)])


_LIGHTS: Final = {"green": "● by the data", "amber": "◐ in part", "red": "○ not by this mission"}


def _calibration(summary: Mapping[str, Any]) -> str:
    values: Mapping[str, Any] = summary.get("calibration") or {}
    rows = [
        (
            label,
            *(_number(of[key]) for key in ("value", "sigma", "prior_sigma")),
            _LIGHTS[of["determined"]],
        )
        for label, of in values.items()
    ]
    return table(("", "found", "sigma", "sigma before", "determined"), rows) if rows else ""


def _survey(content: Content) -> str:
    """Return how much of the time the position alone meets the orders of S-44."""
    horizontal = content.radius_95_m
    vertical = Z95 * content.trajectory["sigma_up_m"]
    rows = []
    for order in ORDERS:
        cells, is_met = [order.name], np.ones(len(vertical), bool)
        for limit, of in ((order.horizontal_m, horizontal), (order.vertical_m, vertical)):
            cells += [f"{limit:g}", f"{100.0 * np.mean(of <= limit):.1f}"]
            is_met &= of <= limit
        rows.append((*cells, _stretches(content, ~is_met)))
    header = ("order", "horizontal limit, m, 95 %", "met, % of the time", "vertical limit, m, 95 %")
    return (
        "<p>Of the vehicle's position alone, against what IHO S-44 (edition 6.1) allows a whole "
        "sounding in depth zero, where its limits are tightest. Whether a sounding meets an order "
        "depends on the echo sounder too.</p>"
        + table((*header, "met, % of the time", "not met, minutes"), rows)
    )


def _stretches(content: Content, is_so: Array) -> str:
    """Return from which minute to which something is so, the longest stretches."""
    minutes = content.since_min
    runs = [(minutes[begin], minutes[end - 1]) for begin, end in runs_of(is_so)]
    longest = sorted(runs, key=lambda run: run[0] - run[1])[:MOST_STRETCHES]
    told = ", ".join(f"{begin:.1f} to {end:.1f}" for begin, end in sorted(longest))
    more = len(runs) - len(longest)
    return f"{told} and {more} shorter" if more > 0 else told


def _data(content: Content) -> str:
    """Return how regular each sensor of the mission is, and what it reads."""
    if not content.data:
        return ""
    header = ("", "rows", "rate, Hz", "jitter, ms", "gaps", "in gaps, s")
    reads = "".join(
        f"<li>{_text(f'{name}: {clocked(said, content.begin_s, content.epoch_s)}')}</li>"
        for name, *_, said in content.data
    )
    return table(header, [row[:-1] for row in content.data]) + f"<ul>{reads}</ul>"


def _assumed(content: Content) -> str:
    summary = content.summary
    start = summary.get("start") or {}
    lines = []
    if start:
        how = {"mission": "is that of the mission file", "local": "is local, at zero"}
        lines.append(f"The start {how.get(str(start.get('origin')), 'was aligned')}.")
    notes = dict.fromkeys([*(summary.get("mission_notes") or ()), *(summary.get("notes") or ())])
    lines += [clocked(str(note), content.begin_s, content.epoch_s) for note in notes]
    items = "".join(f"<li>{_text(text)}</li>" for text in lines)
    return f"<ul>{items}</ul>" if items else ""


def _settings(summary: Mapping[str, Any]) -> str:
    rows = [*(summary.get("settings") or {}).items()]
    versions: Mapping[str, Any] = summary.get("versions") or {}
    rows += [(f"version of {name}", text) for name, text in versions.items()]
    inputs: Mapping[str, Any] = summary.get("inputs") or {}
    if inputs:
        rows.append(("mission folder", inputs.get("folder")))
    for name, digest in (inputs.get("sha256") or {}).items():
        rows.append((f"SHA-256 of {name}", digest))
    cells = [(name, "" if value is None else value) for name, value in rows]
    return f'<div class="long">{table(("", ""), cells)}</div>'


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.4g}"


def _text(value: Any) -> str:
    return html.escape(str(value))
