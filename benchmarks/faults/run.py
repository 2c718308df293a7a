"""Faults injected into missions, one a row: what happens, what is lost, how it comes back.

``python -m benchmarks.faults.run --keep`` (some minutes on two cores); ``--only clock`` runs the
rows whose name has that word. A row that is done is kept in ``--out``, in a file of the code's
version, and the same command goes on. Exit code 1 if a row fails.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.faults.case import (
    BEGIN_S,
    GROUPS,
    HEADER,
    LAG_S,
    LOOK_S,
    RULES,
    Case,
    Row,
    Rule,
    Stage,
    judge,
    run_case,
    share_text,
    shares_inside,
    undisturbed,
)
from benchmarks.faults.data import data_cases
from benchmarks.faults.process import PROCESS_ROWS, run_process_row
from benchmarks.faults.transforms import untouched
from benchmarks.processes import tell
from benchmarks.report import Option, Report, table
from ssm_graph.base.code_version import code_version
from ssm_graph.mission.navigation import Health
from ssm_graph.study.ledger import ERROR, Key, Ledger, run_trials

PROCESS = """\
Kills and disks: `ssm-graph online` replays 40 s as fast as it goes, a checkpoint every 3 s; the
folder that is left is compared with that of an uninterrupted run, results to nine digits, the log
byte by byte. Connections: the same runner behind real sockets, 60 s with GNSS for 20 s, inertial
data, depth and GNSS as JSON lines over TCP and the DVL as a Water Linked server, on a clock that
runs with the data.
"""
DURATION = f"{Stage().duration_s:.0f} s"
LEGEND = f"""\
Simulated survey lines of 60 m in waves: tactical-grade inertial data at 100 Hz, DVL and depth at
2 Hz, GNSS at 1 Hz for 60 s, {DURATION} unless the fault needs longer; `FixedLagSmoother` as on a
vehicle with a lag of {LAG_S:.0f} s. Faults begin at {BEGIN_S:.0f} s unless the row says otherwise;
the newest answer is looked at every {LOOK_S:g} s. "Good again" counts from the end of the fault, or
from its begin where it never ends. The shares are those of position, velocity and attitude.
"""


def run_row(key: Key) -> dict[str, Any]:
    """Run the case of this name; a numerical warning counts as an exception."""
    (name,) = key
    if name in PROCESS_ROWS:
        return run_process_row(str(name))._asdict()
    case = next(case for case in data_cases() if case.name == name)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        return judge(case, run_case(case))._asdict()


def row_of(key: Key, made: Mapping[str, Any]) -> Row:
    """Return the row that a trial came to; one that raised fails, by the first rule."""
    if ERROR in made:
        return Row((str(key[0]), *("–",) * (len(HEADER) - 2)), (f"raised: {made[ERROR]}",))
    return Row(tuple(made["cells"]), tuple(made["faults"]))


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


def lines_of(data: Sequence[Row], process: Sequence[Row]) -> list[str]:
    """Return the page."""
    lines = [summary(data, process), "", LEGEND, RULES, undisturbed_line(), ""]
    for title, text, rows in (("Data", "", data), ("Processes and connections", PROCESS, process)):
        if rows:
            lines += [f"## {title}", "", *([text] if text else [])]
            lines += [*table(HEADER, [row.texts for row in rows]), ""]
    return lines


def main() -> int:
    """Run the benchmark and write its report."""
    report = Report(
        *(__file__, "Faults", __doc__),
        Option("--only", "", "rows whose name has this word"),
        Option("--jobs", 2, "processes"),
    )
    every = [case.name for case in data_cases()], PROCESS_ROWS
    of_data, of_process = ([x for x in names if report.args.only in x] for names in every)
    ledger = Ledger(report.args.out / f"{code_version()}.jsonl", {"benchmark": "faults.run"})
    keys: list[Key] = [(name,) for name in (*of_data, *of_process)]
    found = run_trials(run_row, keys, ledger, n_jobs=report.args.jobs, on_progress=tell)
    rows = [row_of(key, found[key]) for key in keys]
    report.write(lines_of(rows[: len(of_data)], rows[len(of_data) :]))
    return 0 if all(row.has_passed for row in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
