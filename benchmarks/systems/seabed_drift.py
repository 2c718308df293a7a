"""What a map of the seabed does to the drift of long missions whose start is known.

``python -m benchmarks.systems.seabed_drift --keep`` (minutes on one core). Missions that are done
are kept in the folder of ``--out``: the same command goes on.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.report import Option, Report, table
from ssm_graph.study.ledger import ERROR, Key, Ledger, run_trials
from ssm_graph.systems.seabed.study import FIRST_HELD_OUT, IMU_HZ, LONG_PING_S, drift_trial

COLUMNS = ("rms_m", "largest_m", "end_m", "nees", "status")
HEADER = ("grade", "seed", "map", "rms (m)", "largest (m)", "end (m)", "NEES / 3", "status")


def main() -> None:
    """Do what is missing and write the page."""
    report = Report(
        __file__,
        "No drift with a map of the seabed",
        __doc__,
        Option("--grades", ["MEMS", "TACTICAL"], "of the inertial sensors"),
        Option("--hours", 2.0, "length of a mission"),
        Option("--missions", 1, "of each grade"),
        Option("--first-seed", FIRST_HELD_OUT, "of the missions"),
    )
    seeds = range(report.args.first_seed, report.args.first_seed + report.args.missions)
    keys: list[Key] = [
        ("rough", g, s, report.args.hours) for g in report.args.grades for s in seeds
    ]
    told = {"imu_hz": IMU_HZ, "ping_s": LONG_PING_S}
    rows = run_trials(drift_trial, keys, Ledger(report.args.out / "missions.jsonl", told))
    cells = [
        (str(key[1]).lower(), str(key[2]), name, *(_cell(row, f"{name}_{c}") for c in COLUMNS))
        for key, row in rows.items()
        for name in ("with", "without")
    ]
    lines = [
        f"Survey lines of {report.args.hours:g} h at 1.5 m/s, 40 m deep over ground at 80 m, DVL "
        f"of {1.0 / LONG_PING_S:g} Hz, start known as the grade knows it. The error is that of the "
        "smoother, horizontal.",
        "",
        *table(HEADER, cells),
    ]
    report.write(lines)


def _cell(row: Mapping[str, Any], name: str) -> str:
    if ERROR in row:
        return str(row[ERROR])
    value = row[name]
    return value if isinstance(value, str) else f"{value:.2f}"


if __name__ == "__main__":
    main()
