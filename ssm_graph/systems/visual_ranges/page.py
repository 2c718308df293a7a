"""The report of a visual run: one file of HTML with its figures in it."""

from __future__ import annotations

import base64
import html
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.code_version import code_version
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.report.page.frame import frame, numbered
from ssm_graph.report.page.words import table
from ssm_graph.systems.visual_ranges.accuracy import Accuracy
from ssm_graph.systems.visual_ranges.outputs import metres, told_events
from ssm_graph.systems.visual_ranges.ranging import RangingResult
from ssm_graph.systems.visual_ranges.result import FrameState, VisualResult
from ssm_graph.systems.visual_ranges.sequence import Sequence
from ssm_graph.systems.visual_ranges.verdict import Judged, reprojection_errors

MOST_REFUSED: Final = 20
"""Loops refused that are shown one by one."""


def write_page(
    path: Path,
    sequence: Sequence,
    result: VisualResult,
    judged: Judged,
    errors: Accuracy | None,
    figures: list[tuple[str, str, str]],
    notes: tuple[str, ...] = (),
) -> None:
    """Write the page beside its figures (file name, title, note)."""
    parts = [
        (title, f'<p class="note">{html.escape(note)}</p>{_picture(path.parent / name, title)}')
        for name, title, note in figures
    ]
    parts += [(title, text) for title, text in _sections(sequence, result, errors, notes) if text]
    text = frame(
        f"{result.name}: camera and ranges",
        head=_head(sequence, result, judged, errors),
        links=[(f"part{n}", title) for n, (title, _) in enumerate(parts)],
        body=numbered(parts),
        footer=f"ssm-graph {code_version()}, ssm-graph visual",
        css="img { max-width: 100%; }\n",
    )
    write_through(path, text.encode())


def _picture(path: Path, title: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img alt="{html.escape(title)}" src="data:image/png;base64,{data}">'


def _head(sequence: Sequence, result: VisualResult, judged: Judged, errors: Accuracy | None) -> str:
    sign, style = ("✔", "good") if judged.verdict.is_good else ("⚠", "bad")
    reasons = "".join(f"<p>{html.escape(text)}</p>" for text in judged.reasons)
    if judged.advice:
        reasons += f"<p><b>What helps:</b> {html.escape(judged.advice)}</p>"
    facts = "".join(
        f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"
        for name, value in _facts(sequence, result, judged, errors)
    )
    return (
        f'<section class="verdict {style}"><p class="status"><span class="sign">{sign}</span> '
        f"{judged.verdict.name.replace('_', ' ')}</p>"
        f'<p class="meaning">{html.escape(judged.verdict.value)}</p>{reasons}</section>'
        f'<dl class="facts">{facts}</dl>'
    )


def _facts(
    sequence: Sequence, result: VisualResult, judged: Judged, errors: Accuracy | None
) -> list[tuple[str, str]]:
    unit = "m" if judged.verdict.has_scale else "map units"
    place = result.position[np.isfinite(result.t_cw).all(axis=1)] * metres(result)
    length = float(np.linalg.norm(np.diff(place, axis=0), axis=1).sum()) if len(place) > 1 else 0.0
    n_tracked = int((result.state == FrameState.TRACKED).sum())
    error, _ = reprojection_errors(result)
    facts = [
        ("duration", f"{sequence.duration_s:.1f} s"),
        ("images with a pose", f"{n_tracked} of {len(result.time_s)}"),
        ("path length", f"{length:.2f} {unit}"),
        ("key frames, points", f"{len(result.map.time_s)}, {(result.map.points_views >= 2).sum()}"),
    ]
    if len(error):
        size = float(np.median(np.linalg.norm(error, axis=1)))
        facts.append(("reprojection, median", f"{size:.2f} px"))
    ranging: RangingResult | None = result.ranging
    if ranging is not None and ranging.has_scale:
        facts.append(("scale, 1 sigma", f"{100 * ranging.sigma_log_scale:.2f} %"))
        if np.isfinite(ranging.started_s):
            since = ranging.started_s - sequence.time_s[0]
            facts.append(("scale known after", f"{since:.1f} s"))
    if errors is not None:
        if np.isfinite(errors.metric_m):
            facts.append(("against the truth, rms", f"{errors.metric_m:.3f} m"))
            facts.append(("scale error", f"{100 * errors.scale_error:+.2f} %"))
        facts.append(("the same, scale aligned", f"{errors.similar_m:.3f} m"))
    return facts


def _sections(
    sequence: Sequence, result: VisualResult, errors: Accuracy | None, notes: tuple[str, ...]
) -> list[tuple[str, str]]:
    return [
        ("Anchors", _anchors(result.ranging, errors)),
        ("Loops", _loops(result)),
        ("What happened", _list(tuple(told_events(result.events)))),
        ("The recording", _list((*sequence.notes, *notes))),
        ("Time taken", _timing(result)),
    ]


def _anchors(ranging: RangingResult | None, errors: Accuracy | None) -> str:
    if ranging is None:
        return "<p>There were no ranges.</p>"
    if not ranging.anchors:
        return "<p>There were no anchors.</p>"
    rows = []
    for j, a in enumerate(ranging.anchors):
        own = np.flatnonzero((ranging.anchor_of == j) & np.isfinite(ranging.error_m))
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.diag(a.covariance))
        middle = f"{np.median(ranging.error_m[own]):+.3f}" if len(own) else ""
        spread = f"{np.median(np.abs(ranging.error_m[own])) * 1.4826:.3f}" if len(own) else ""
        off = errors.anchor_m[j] if errors is not None and j < len(errors.anchor_m) else np.nan
        rows.append(
            (
                a.name,
                f"{a.state.name.lower()}: {a.state.value}",
                _triple(a.place_m),
                _triple(sigma),
                f"{a.bias_m:+.3f} ± {a.bias_sigma_m:.3f}" if np.isfinite(a.bias_sigma_m) else "",
                a.n_ranges,
                f"{100 * a.nlos_share:.0f} %" if np.isfinite(a.nlos_share) else "",
                middle,
                spread,
                f"{off:.3f}" if np.isfinite(off) else "",
                "; ".join(_triple(place) for place in a.alternatives_m),
            )
        )
    header = ["anchor", "state", "x, y, z (m)", "sigma (m)", "bias (m)", "ranges", "not believed"]
    header += ["median error (m)", "robust rms (m)", "off the truth (m)", "other places"]
    return table(header, rows)


def _triple(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return ", ".join(f"{x:.3f}" for x in values) if np.isfinite(values).all() else ""


def _loops(result: VisualResult) -> str:
    if not result.loops:
        return "<p>No place was seen again.</p>"
    begin = result.time_s[0]
    taken = [loop for loop in result.loops if loop.is_taken]
    refused = [loop for loop in result.loops if not loop.is_taken]
    shown = sorted([*taken, *refused[:MOST_REFUSED]], key=lambda loop: loop.time_s)
    rows = [
        (
            f"{loop.time_s - begin:.1f}",
            "taken" if loop.is_taken else "refused",
            loop.why,
            f"{loop.n_inliers} of {loop.n_matches}",
            f"{loop.scale:.3f}",
            f"{100 * loop.shift / max(loop.path, 1e-9):.1f} %",
        )
        for loop in shown
    ]
    told = f"<p>{len(taken)} closed, {len(refused)} refused"
    told += f", the first {MOST_REFUSED} shown.</p>" if len(refused) > MOST_REFUSED else ".</p>"
    header = ("time (s)", "", "why", "inliers of matches", "scale", "moves, of the path between")
    return told + table(header, rows)


def _list(lines: tuple[str, ...]) -> str:
    if not lines:
        return ""
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>"


def _timing(result: VisualResult) -> str:
    rows = [
        (
            part,
            len(values),
            f"{1e3 * np.median(values):.1f}",
            f"{1e3 * np.percentile(values, 99):.1f}",
            f"{values.sum():.1f}",
        )
        for part, values in result.timing_s.items()
        if len(values)
    ]
    return table(("part", "times", "median (ms)", "99 % (ms)", "all (s)"), rows) if rows else ""
