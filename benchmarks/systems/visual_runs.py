"""Whole runs of camera and ranges, and which goals they meet.

Rendered worlds, and real images with simulated ranges: 7-Scenes kitchen and KITTI 07 of
``$SSM_GRAPH_DATA/systems``; the visual front end was chosen on these two, their ranges and anchors
are new with every seed.

``python -m benchmarks.systems.visual_runs --keep`` runs what the goals need: some hours on one
core. Every run is kept in the folder of ``--out`` as it ends, and the same command goes on;
``--minutes 30`` starts none after half an hour and writes the page of all that is there. A quick
look is ``--cases room-small --runs 1 --duration 12``.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from benchmarks.report import Option, Report, note, number_text, table
from benchmarks.systems.visual_goals import GOALS, RUNS, goal_cells, good_rows
from benchmarks.systems.visual_goals import HEADER as GOALS_HEADER
from ssm_graph.study.ledger import ERROR, Key, Ledger, Row, run_trials
from ssm_graph.systems.visual_ranges.study import CASES, FIRST_FRESH, RECORDED, TAGS, case_of, trial

HEADER = (
    "case",
    "runs",
    "verdicts",
    "images with a pose, %",
    "metric rms, m",
    "worst, m",
    "scale-aligned rms, m",
    "scale, rms, %",
    "worst, %",
    "anchor, m",
    "started after, s",
    "clock, ms",
    "loops taken true / false",
    "refused true / false",
    "key frames",
    "images a CPU second",
    "images with a pose in the last 10 s, %",
    "memory, MiB",
)


def about(case: str) -> str:
    """Return a case in words."""
    if case in RECORDED:
        return RECORDED[case].about
    if case in TAGS:
        return f"STAR-loc {TAGS[case]}, tags and ranges alone"
    return case_of(case).about + (", 320 x 240" if case.endswith("-small") else "")


def cells_of(case: str, rows: Sequence[Row]) -> list[str]:
    """Return the cells of a case; medians but where the header says otherwise."""
    good = good_rows(rows)
    if not good:
        return [about(case), f"0 of {len(rows)}", *(["–"] * (len(HEADER) - 2))]

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
        about(case),
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
        middle("n_key_frames"),
        number_text(float(column("n_images").sum() / column("cpu_s").sum())),
        number_text(100.0 * float(column("tracked_last").min())),
        largest("peak_mib"),
    ]


def main() -> None:
    """Do what is missing and write the page."""
    report = Report(
        __file__,
        "Camera and ranges: whole runs",
        __doc__,
        Option("--cases", [*RUNS], "in this order; with -small at the end in a quarter of pixels"),
        Option("--runs", 0, "of each case, at most; 0: what the goals ask for"),
        Option("--first-seed", FIRST_FRESH, "the first seed"),
        Option("--duration", 0.0, "of a run, s; 0: that of its case"),
        Option(
            "--minutes", -1.0, "after which no run is started: 0 for the page alone; -1: no end"
        ),
    )
    asked = report.args
    ledger = Ledger(
        asked.out / "runs.jsonl", {"first_seed": asked.first_seed, "duration_s": asked.duration}
    )
    keys = keys_of(asked.cases, asked.runs, asked.first_seed, asked.duration)
    end = time.monotonic() + 60.0 * asked.minutes if asked.minutes >= 0.0 else np.inf
    for count, key in enumerate(keys, 1):
        if key not in ledger and time.monotonic() < end:
            note(f"{count} of {len(keys)}: {key[0]}, seed {key[1]}")
            run_trials(in_own_process if key[0] == "room-long" else trial, [key], ledger)
    report.write(page(ledger, asked.first_seed, asked.duration))


def keys_of(cases: Sequence[str], runs: int, first_seed: int, duration_s: float) -> list[Key]:
    """Return the runs that are asked for, seed by seed, so that every case has one before long."""
    wanted = {case: min(RUNS.get(case, 5), runs or 10**6) for case in cases}
    return [
        (case, first_seed + k, duration_s)
        for k in range(max(wanted.values()))
        for case in cases
        if k < wanted[case]
    ]


def in_own_process(key: Key) -> Row:
    """Do a run in a process of its own, whose memory is that of the run."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(trial, key).result()


def page(ledger: Ledger, first_seed: int, duration_s: float) -> Iterator[str]:
    """Yield the goals, then a table of all cases that have a run."""
    rows: dict[str, list[Row]] = {}
    failed: list[str] = []
    for case in dict.fromkeys([*RUNS, *CASES, *(f"{name}-small" for name in CASES), *RECORDED]):
        keys = [(case, first_seed + k, duration_s) for k in range(RUNS.get(case, 5))]
        found = [(key, ledger[key]) for key in keys if key in ledger]
        failed += [f"- {case}, seed {key[1]}: {row[ERROR]}" for key, row in found if ERROR in row]
        if found:
            rows[case] = [row for _, row in found]
    yield (
        f"Seeds from {first_seed} on; images of 640 x 480 at 20 Hz (under water 10 Hz), "
        "ranges at 10 Hz, sigma 0.08 m and a bias of 0.05 m, longer where something stands in the "
        "way; under water once a second, two-way, sigma 0.1 m, with a sound speed that is 1 % off. "
        "Deterministic, one thread, where not said otherwise. Medians over runs. A loop is false "
        "where it puts two cameras 1 m or more too near or too far. Anchors of real images stand "
        "at 1.5 to 3 m (kitchen) and 30 to 60 m (KITTI) from the middle of the path. The front end "
        "was chosen on these two recordings."
    )
    yield ""
    good = {case: good_rows(own) for case, own in rows.items()}
    yield from table(GOALS_HEADER, [goal_cells(g, good, about(g.cases[0])) for g in GOALS])
    yield ""
    yield (
        "Starts alone, motions that leave the scale open, and real radios: visual_starts.md. That "
        "the adjustment ends where GTSAM's does, Jacobians, and equality bit for bit: the tests."
    )
    yield ""
    yield from table(HEADER, [cells_of(case, own) for case, own in rows.items()])
    yield ""
    yield from failed


if __name__ == "__main__":
    main()
