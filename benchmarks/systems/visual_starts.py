"""Starts of scale and anchors: NLOS, honesty, observability, real radios of STAR-loc."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import ROOT, Option, Report, note, number_text, rms, table
from ssm_graph.evaluation.consistency import rate_with_interval
from ssm_graph.study.ledger import Key, Ledger, run_trials
from ssm_graph.systems.visual_ranges.observability import Motion
from ssm_graph.systems.visual_ranges.readers.starloc import read_starloc
from ssm_graph.systems.visual_ranges.start_study import (
    NEVER_READY,
    SHAPES,
    shape_trial,
    starloc_trial,
    walk_trial,
)

DATA = Path(os.environ.get("SSM_GRAPH_DATA", ROOT.parent / "shared" / "data")) / "systems"
WALKS: tuple[tuple[str | int | float, ...], ...] = (
    ("room", 30, 1, 0.0, 0.005),
    ("room", 30, 1, 0.1, 0.005),
    ("room", 30, 1, 0.3, 0.005),
    ("room", 30, 1, 0.4, 0.005),
    ("room", 30, 1, 0.5, 0.005),
    ("room", 60, 1, 0.0, 0.002),
    ("room", 60, 1, 0.3, 0.002),
    ("room", 60, 1, 0.4, 0.002),
    ("room", 60, 1, 0.5, 0.002),
    ("room", 30, 3, 0.3, 0.002),
    ("corridor", 60, 1, 0.3, 0.002),
)
"""World, seconds, anchors, share of ranges not in line of sight, drift."""
SHAPE_DRIFT = 0.001
READY = ("READY", "MIRROR")
NAMED = {
    "standing still": (Motion.STILL,),
    "turning only": (Motion.ROTATION,),
    "line": (Motion.LINE,),
    "line through the anchor": (Motion.LINE_THROUGH_ANCHOR,),
    "plane curve": (Motion.PLANE,),
    "circle": (Motion.CIRCLE,),
    "circle about the anchor's axis": (Motion.CIRCLE_ABOUT_ANCHOR,),
    "sphere": (Motion.SPHERE,),
    "helix": (Motion.GENERAL,),
    "plane curve with 0.1 m heave": (Motion.GENERAL,),
    "circle with 0.3 m heave": (Motion.GENERAL, Motion.SPHERE),
}
"""What a motion may be called; the last is 2 cm off a sphere."""


def walks(ledger: Ledger, seeds: Sequence[int], jobs: int) -> Iterator[str]:
    """Yield the table of walks and the rates of true sigmas over all of them."""
    keys: list[Key] = [(*case, seed) for case in WALKS for seed in seeds]
    done = run_trials(walk_trial, keys, ledger, n_jobs=jobs)
    rows: list[tuple[str, ...]] = []
    inside: tuple[list[bool], list[bool]] = ([], [])
    near: list[bool] = []
    for case in WALKS:
        trials = [done[(*case, seed)] for seed in seeds]
        ready = [row for row in trials if row["state"] in READY]
        coarse = [row for row in trials if row["state"] == "COARSE"]
        error = np.array([row["scale_percent"] for row in ready])
        sigma = np.array([row["sigma_percent"] for row in ready])
        for kind, found in zip(inside, (ready, coarse), strict=True):
            kind += [
                100.0 * abs(np.log1p(row["scale_percent"] / 100.0)) <= 3.0 * row["sigma_percent"]
                for row in found
            ]
        known = [
            (off, sigma)
            for row in ready
            for off, sigma, is_ready in zip(
                row["anchor_m"], row["anchor_sigma_m"], row["anchor_ready"], strict=True
            )
            if is_ready
        ]
        near += [off <= 3.0 * sigma for off, sigma in known]
        rows.append(
            (
                f"{case[0]}, {case[1]} s, {case[2]} anchor{'s' if case[2] != 1 else ''}",
                f"{100 * float(case[3]):.0f} %",
                f"{100 * float(case[4]):.1f} %",
                f"{len(ready)} of {len(trials)}",
                str(len(coarse)),
                number_text(rms(error)) if len(error) else "–",
                number_text(np.abs(error).max(initial=0.0)),
                number_text(float(sigma.mean())) if len(sigma) else "–",
                number_text(float(np.median([off for off, _ in known]))) if known else "–",
                str(int((np.abs(error) > 5.0).sum())),
            )
        )
    header = (
        "walk",
        "NLOS",
        "drift",
        "scale ready",
        "coarse",
        "scale rms, %",
        "worst, %",
        "sigma, %",
    )
    yield from table((*header, "anchor median, m", "ready and off by 5 %"), rows)
    yield ""
    called = ("scales called ready", "scales called coarse", "anchors called ready")
    for what, kind in zip(called, (*inside, near), strict=True):
        if kind:
            rate = rate_with_interval(kind)
            yield (
                f"Truth within 3 sigma in {100 * rate.value:.1f} % ({100 * rate.low:.1f} to "
                f"{100 * rate.high:.1f}) of {len(kind)} {what}."
            )


def shapes(ledger: Ledger, names: Sequence[str], seeds: Sequence[int], jobs: int) -> Iterator[str]:
    """Yield the table of motions."""
    keys: list[Key] = [(name, SHAPE_DRIFT, seed) for name in names for seed in seeds]
    done = run_trials(shape_trial, keys, ledger, n_jobs=jobs)
    rows = []
    for name in names:
        trials = [done[(name, SHAPE_DRIFT, seed)] for seed in seeds]
        right = {motion.name for motion in NAMED[name]}
        states: dict[str, int] = {}
        for row in trials:
            states[row["state"]] = states.get(row["state"], 0) + 1
        listed = [bool(row["truth_listed"]) for row in trials if "truth_listed" in row]
        ready = [row for row in trials if row["state"] in (*READY, "COARSE")]
        scale = [abs(row["scale_percent"]) for row in ready]
        rows.append(
            (
                name,
                f"{sum(row['motion'] in right for row in trials)} of {len(trials)}",
                ", ".join(f"{count} {state.lower()}" for state, count in sorted(states.items())),
                f"{sum(listed)} of {len(listed)}" if listed and name not in NEVER_READY else "–",
                number_text(max(scale)) if scale else "–",
            )
        )
    header = ("motion", "named right", "called", "truth among the solutions", "worst scale, %")
    yield from table(header, rows)


def starloc(folder: Path) -> Iterator[str]:
    """Yield the table of real runs, one anchor at a time and all together."""
    rows = []
    for path in sorted(p.parent for p in folder.glob("*/uwb.csv")):
        run = read_starloc(path)
        for names in (*((name,) for name in run.ranges.names), run.ranges.names):
            note(f"{path.name}, {', '.join(names)}")
            row: dict[str, Any] = starloc_trial(run, names)
            rows.append(
                (
                    path.name,
                    ", ".join(names),
                    row["state"].lower(),
                    f"{row['scale_percent']:+.2f} ± {row['sigma_percent']:.2f}",
                    ", ".join(f"{x:.2f}" for x in row["anchor_m"]),
                )
            )
    yield "True path in map units, lever arm as calibrated, anchors unknown."
    yield ""
    yield from table(("run", "anchors", "called", "scale error, %", "anchor error, m"), rows)


def main() -> None:
    """Run and write the page."""
    report = Report(
        __file__,
        "Starts of scale and anchors from ranges",
        __doc__,
        Option("--walks", 20, "seeds of each walk"),
        Option("--shapes", 20, "seeds of each motion"),
        Option("--motions", [*SHAPES], "motions that are tried"),
        Option("--first-seed", 1000, "of both"),
        Option("--jobs", 1, "processes"),
    )
    asked = report.args
    seeds = range(asked.first_seed, asked.first_seed + max(asked.walks, asked.shapes))
    report.places()
    ledger = Ledger(asked.out / "trials.jsonl", {"benchmark": "visual_starts"})
    lines = [*walks(ledger, seeds[: asked.walks], asked.jobs), ""]
    lines += [
        f"Motions of 3 m, 200 ranges of 8 cm, drift {100 * SHAPE_DRIFT:.1f} % of the way.",
        "",
    ]
    lines += [*shapes(ledger, asked.motions, seeds[: asked.shapes], asked.jobs), ""]
    if (DATA / "starloc").is_dir():
        lines += starloc(DATA / "starloc")
    else:
        lines.append(f"STAR-loc is not in {DATA}: set SSM_GRAPH_DATA to have its runs here.")
    report.write(lines)


if __name__ == "__main__":
    main()
