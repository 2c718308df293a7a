"""Whether answers stay honest where the clock is set on a machine that reads seconds late.

``python -m benchmarks.faults.lagging --keep``; no clock is looked at, every arrival is drawn from
the seed, so that a run is the same on any machine. Runs that are done are kept in ``--out``, in a
file of the code's version, and the same command goes on.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from benchmarks.faults.case import Stage, stage_config
from benchmarks.processes import all_done, tell
from benchmarks.report import Option, Report, table
from ssm_graph.base.code_version import code_version
from ssm_graph.simulation import simulate
from ssm_graph.study.ledger import Key, Ledger, run_trials
from tests.lagging_fixture import Lag, sail

SET_AT_S: Final = 40.0
END_S: Final = 70.0
SET_BY_S: Final = (0.0, 0.1, -0.1, 0.2, -0.2, 0.5, -0.5, 1.0, -1.0, 2.0, -2.0, 5.0, -5.0)
LAGS: Final = {
    "now and then": Lag(),
    "nearly always": Lag(every=8.0, stall_s=0.8, longest_s=3.0, link_s=0.05, jitter_s=0.8),
}
FAR: Final = 5.0
"""Sigmas, which no good answer should be off by."""
HEADER: Final = (
    "the machine stands still",
    "clock set by, s",
    "good answers",
    "within 3 σ",
    "largest, σ",
    "furthest misread, s",
    "refused of all",
)


def one_run(key: Key) -> dict[str, Any]:
    """Sail once: lag, what the clock is set by, whether fixes follow it, seed."""
    lag, by_s, follows, seed = key
    stage = Stage(END_S, ((0.0, END_S),), seed=int(seed))
    settings = [(SET_AT_S, float(by_s))] if by_s else []
    sailed = sail(
        *(simulate(stage_config(stage)), settings, LAGS[str(lag)]),
        seed=int(seed),
        gnss_follows=bool(follows),
    )
    good = [answer.sigmas for answer in sailed.answers if answer.is_good]
    return {
        "n_answers": len(sailed.answers),
        "n_good": len(good),
        "n_inside": int(np.sum(np.less_equal(good, 3.0))),
        "worst": sailed.worst,
        "misread_s": sailed.misread_s,
        "n_sent": sailed.n_sent,
        "n_refused": sailed.n_refused,
    }


def main() -> None:
    """Run all; write the page."""
    report = Report(
        *(__file__, "A clock that is set on a machine that lags", __doc__),
        Option("--seeds", 3, "missions of each case"),
        Option("--first-seed", 0, "of the missions"),
        Option("--jobs", 1, "processes"),
    )
    a = report.args
    seeds = range(a.first_seed, a.first_seed + a.seeds)
    cases = [(lag, by_s) for lag in LAGS for by_s in SET_BY_S]
    keys: list[Key] = [
        (lag, by_s, k, seed) for seed in seeds for lag, by_s in cases for k in (0, 1)
    ]
    ledger = Ledger(a.out / f"{code_version()}.jsonl", {"benchmark": "faults.lagging"})
    found = all_done(run_trials(one_run, keys, ledger, n_jobs=a.jobs, on_progress=tell))
    rows = []
    for case in cases:
        of = [found[key] for key in keys if key[:2] == case]
        n = {name: sum(x[name] for x in of) for name in of[0]}
        rows.append([
            case[0], f"{case[1]:+g}", f"{n['n_good']} of {n['n_answers']}",
            f"{100.0 * n['n_inside'] / max(n['n_good'], 1):.1f} %",
            f"{max(x['worst'] for x in of):.1f}", f"{max(x['misread_s'] for x in of):.2f}",
            f"{n['n_refused']} of {n['n_sent']}",
        ])  # fmt: skip
    worst = max(row["worst"] for row in found.values())
    report.write([
        f"{len(seeds)} missions of {END_S:g} s from seed {a.first_seed}, as in [faults](faults.md) "
        f"with GNSS throughout; at {SET_AT_S:g} s the vehicle's clock is set. IMU, DVL and depth "
        "are stamped by it, GNSS by it or by a clock that is right. The machine looks at what has "
        "come every 0.02 s, but stands still after one look in 20 for 0.3 s in the mean, or after "
        "one in 8 for 0.8 s, at most 3 s, and links delay by up to 0.12 or 0.85 s. Every answer is "
        "held against the truth of its time: horizontal position and velocity, in their sigmas.",
        "", *table(HEADER, rows), "",
        f"Of {len(keys)} runs the largest error of a good answer is {worst:.1f} of its sigmas: "
        f"**{'below' if worst < FAR else 'NOT below'} {FAR:g}**.",
    ])  # fmt: skip


if __name__ == "__main__":
    main()
