"""Faults injected into missions, one a row: what happens, what is lost, how it comes back.

``python benchmarks/faults.py --keep`` (some minutes on two cores); ``--only clock`` runs the rows
whose name has that word. Exit code 1 if a row fails.
"""

from __future__ import annotations

import argparse
import multiprocessing
import shlex
import sys
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.faults_case import (
    BEGIN_S,
    GROUPS,
    LAG_S,
    LOOK_S,
    Case,
    Rule,
    Stage,
    run_case,
    shares_inside,
    undisturbed,
)
from benchmarks.faults_data import data_cases
from benchmarks.faults_judge import HEADER, RULES, Row, judge, share_text
from benchmarks.faults_process import PROCESS_ROWS, run_process_row
from benchmarks.faults_transforms import untouched
from benchmarks.report import machine
from benchmarks.speed import table
from ssm_graph.mission.navigation import Health

PROCESS = """\
Kills and disks: `ssm-graph online` replays 40 s as fast as it goes, a checkpoint every 3 s; the
folder that is left is compared with that of an uninterrupted run, results to nine digits, the log
byte by byte. Connections: the same runner behind real sockets, 60 s with GNSS for 20 s, inertial
data, depth and GNSS as JSON lines over TCP and the DVL as a Water Linked server, on a clock that
runs with the data.
"""
RESULTS = Path(__file__).resolve().parent / "results"
DURATION = f"{Stage().duration_s:.0f} s"
LEGEND = f"""\
Simulated survey lines of 60 m in waves: tactical-grade inertial data at 100 Hz, DVL and depth at
2 Hz, GNSS at 1 Hz for 60 s, {DURATION} unless the fault needs longer; `FixedLagSmoother` as on a
vehicle with a lag of {LAG_S:.0f} s. Faults begin at {BEGIN_S:.0f} s unless the row says otherwise;
the newest answer is looked at every {LOOK_S:g} s. "Good again" counts from the end of the fault, or
from its begin where it never ends. The shares are those of position, velocity and attitude.
"""


def parse_args(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="rows whose name has this word")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/faults"))
    parser.add_argument("--keep", action="store_true", help="write benchmarks/results too")
    return parser.parse_args(argv)


def run_row(name: str) -> Row:
    """Run the case of this name; a numerical warning counts as an exception."""
    if name in PROCESS_ROWS:
        return run_process_row(name)
    case = next(case for case in data_cases() if case.name == name)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        return judge(case, run_case(case))


def run_rows(names: Sequence[str], jobs: int) -> list[Row]:
    """Run cases side by side."""
    rows = []
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        for name, row in zip(names, pool.map(run_row, names), strict=True):
            rows.append(row)
            print(f"{name}: {row.texts[-1]}", file=sys.stderr, flush=True)
    return rows


def summary(data: Sequence[Row], process: Sequence[Row]) -> str:
    """Return how many rows passed."""
    parts = [
        f"{sum(row.has_passed for row in rows)} of {len(rows)} faults of {what}"
        for rows, what in ((data, "data"), (process, "processes and connections"))
        if rows
    ]
    return f"**Passed: {', '.join(parts)}.**"


def undisturbed_line() -> str:
    """Return how good the undisturbed mission is."""
    case = Case("", "", untouched, Rule())
    shares = shares_inside(undisturbed(case.stage).looks, case, Health.GOOD)
    return f"Undisturbed, the truth is inside in {share_text(shares)} ({', '.join(GROUPS)})."


def report(command: str, data: Sequence[Row], process: Sequence[Row], *, plain: str) -> str:
    """Return the page; ``plain`` says how good the undisturbed mission is."""
    lines = ["# Faults", "", f"    {command}", "", f"{machine()}.", ""]
    lines += [summary(data, process), "", LEGEND, RULES, plain, ""]
    for title, text, rows in (("Data", "", data), ("Processes and connections", PROCESS, process)):
        if rows:
            lines += [f"## {title}", "", *([text] if text else [])]
            lines += [*table(HEADER, [row.texts for row in rows]), ""]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark and write its report."""
    args = parse_args(argv)
    data_names = [case.name for case in data_cases() if args.only in case.name]
    process_names = [name for name in PROCESS_ROWS if args.only in name]
    rows = run_rows([*data_names, *process_names], args.jobs)
    data, process = rows[: len(data_names)], rows[len(data_names) :]
    command = shlex.join(["python", "benchmarks/faults.py", *(argv or sys.argv[1:])])
    text = report(command, data, process, plain=undisturbed_line())
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "faults.md").write_text(text, encoding="utf-8")
    if args.keep:
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "faults.md").write_text(text, encoding="utf-8")
    print(text)
    return 0 if all(row.has_passed for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
