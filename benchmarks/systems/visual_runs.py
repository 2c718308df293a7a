"""Whole runs of camera and ranges: rendered worlds, and real images with simulated ranges.

Real images are 7-Scenes kitchen and KITTI 07 of ``$SSM_GRAPH_DATA/systems``; the visual front end
was chosen on these two, their ranges and anchors are new with every seed.

``python -m benchmarks.systems.visual_runs --keep`` (some minutes a run on one core; a quick look is
``--cases room-small --runs 1 --duration 12``). Runs that are done are kept in the folder of
``--out``: the same command goes on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.report import Option, Report, note, number_text, table
from ssm_graph.study.ledger import ERROR, Ledger, Row, run_trials
from ssm_graph.systems.visual_ranges.study import CASES, FIRST_FRESH, RECORDED, case_of, trial

HEADER = (
    "case",
    "runs",
    "verdicts",
    "images with a pose, %",
    "metric rms, m",
    "worst",
    "scale-aligned rms, m",
    "scale, rms %",
    "worst %",
    "anchor, m",
    "started after, s",
    "clock, ms",
    "loops taken true / false",
    "refused true / false",
    "images a CPU second",
)


def cells_of(case: str, rows: Sequence[Row]) -> list[str]:
    """Return the cells of a case; medians but where the header says otherwise."""
    good = [row for row in rows if ERROR not in row]
    about = RECORDED[case].about if case in RECORDED else case_of(case).about
    if not good:
        return [about, f"0 of {len(rows)}", *(["–"] * (len(HEADER) - 2))]

    def column(name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        values = np.array([row[name] for row in good], dtype=np.float64)
        return values[np.isfinite(values)]

    def middle(name: str) -> str:
        return number_text(float(np.median(column(name)))) if len(column(name)) else "–"

    def largest(name: str, factor: float = 1.0) -> str:
        return number_text(factor * float(np.abs(column(name)).max())) if len(column(name)) else "–"

    words = [str(row["verdict"]) for row in good]
    scale = column("scale")
    counts = {k: int(column(k).sum()) for k in good[0] if k.startswith(("taken_", "refused_"))}
    return [
        about + (", 320 x 240" if case.endswith("-small") else ""),
        f"{len(good)} of {len(rows)}",
        ", ".join(f"{words.count(word)} {word}" for word in sorted(set(words))),
        f"{100 * float(np.median(column('tracked'))):.1f}",
        middle("metric_m"),
        largest("metric_m"),
        middle("similar_m"),
        number_text(100 * float(np.sqrt(np.mean(scale**2)))) if len(scale) else "–",
        largest("scale", 100.0),
        middle("anchor_m"),
        middle("started_s"),
        number_text(1e3 * float(np.median(column("clock_s")))) if "clock_s" in good[0] else "–",
        f"{counts['taken_true']} / {counts['taken_false']}",
        f"{counts['refused_true']} / {counts['refused_false']}",
        number_text(float(column("n_images").sum() / column("cpu_s").sum())),
    ]


def main() -> None:
    """Do what is missing and write the page."""
    report = Report(
        __file__,
        "Camera and ranges: whole runs",
        __doc__,
        Option(
            "--cases",
            [*CASES, *RECORDED],
            "cases; with -small at the end in a quarter of the pixels",
        ),
        Option("--runs", 5, "of each case"),
        Option("--first-seed", FIRST_FRESH, "the first seed"),
        Option("--duration", 0.0, "of a run, s; 0: that of its case"),
        Option("--jobs", 1, "processes"),
    )
    ledger = Ledger(report.args.out / "runs.jsonl", {"first_seed": report.args.first_seed})
    seeds = range(report.args.first_seed, report.args.first_seed + report.args.runs)
    duration = report.args.duration
    keys = [(case, seed, duration) for case in report.args.cases for seed in seeds]
    rows = run_trials(
        trial,
        keys,
        ledger,
        n_jobs=report.args.jobs,
        on_progress=lambda done, n, key: note(f"{done} of {n}: {key[0]}, seed {key[1]}"),
    )
    lines = [
        f"Seeds {seeds[0]} to {seeds[-1]}; images of 640 x 480 at 20 Hz (under water 10 Hz), "
        "ranges at 10 Hz, sigma 0.08 m and a bias of 0.05 m, longer where something stands in the "
        "way; under water once a second, two-way, sigma 0.1 m, with a sound speed that is 1 % off. "
        "Deterministic, one thread. Medians over runs. A loop is false where it puts two cameras "
        "1 m or more too near or too far. Anchors of real images stand at 1.5 to 3 m (kitchen) and "
        "30 to 60 m (KITTI) from the middle of the path.",
        "",
        *table(
            HEADER, [cells_of(c, [rows[c, s, duration] for s in seeds]) for c in report.args.cases]
        ),
    ]
    failed = {key: row[ERROR] for key, row in rows.items() if ERROR in row}
    lines += ["", *(f"- {case}, seed {seed}: {text}" for (case, seed, _), text in failed.items())]
    report.write(lines)


if __name__ == "__main__":
    main()
