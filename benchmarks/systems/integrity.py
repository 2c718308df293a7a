"""Integrity of one vehicle: the set of its stated bounds beside the smoother, when something lies.

``python -m benchmarks.systems.integrity --keep`` (half an hour). Missions, lies and times are those
of ``benchmarks.trust``, on seeds of their own.
"""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.report import Option, Report, note, table
from benchmarks.systems.stated_bounds import over_bounds, wide_enough
from benchmarks.trust.lies import LIES
from benchmarks.trust.run import DURATION_S, mission_of
from ssm_graph import Mission, smooth
from ssm_graph.base.errors import SsmGraphError
from ssm_graph.evaluation.consistency import rate_with_interval
from ssm_graph.simulation import SimulatedMission, with_faults
from ssm_graph.study.ledger import ERROR, Key, Ledger, Row, run_trials
from ssm_graph.systems.sensor_network.integrity import Agreement, check_integrity, holds_truth
from ssm_graph.systems.sensor_network.witness import WitnessBounds, witness

CLEAN = "no fault"
FIRST_SEED = 500
"""Bounds and rules were chosen on seeds 0 to 2, and mended upon 100 to 103 and 300 to 303."""


@dataclass(frozen=True)
class Outcome:
    """What came of one mission."""

    false_bounds: dict[str, float]
    """Sensors whose errors are beyond their bound, and by what factor"""
    holds_truth: bool
    alarm: str
    """The first one, empty without"""
    half_width_m: float
    """At the end, the larger of east and north"""
    wide_holds_truth: bool
    """With bounds that are true: those of `false_bounds` wider by their factor"""
    wide_alarm: str
    wide_half_width_m: float
    ms_per_ping: float
    """Of processor time, of the set by itself"""
    agreement: str = "not smoothed"
    radius_m: float = np.nan
    """Guaranteed for the answer at the end"""
    sigma_radius_m: float = np.nan
    """Five sigma of the smoother at the end"""
    error_m: float = np.nan
    """Of the smoother, level, largest at the ends of blocks"""


def _mission(
    label: str, grade: str, seed: int, *, with_gnss: bool
) -> tuple[SimulatedMission, Mission]:
    sim = mission_of(grade, seed, with_gnss=with_gnss, realistic=False)
    if label == CLEAN:
        return sim, sim.mission
    drawn = LIES[label].draw(np.random.default_rng([seed, *label.encode()]), DURATION_S)
    faults = drawn if isinstance(drawn, tuple) else (drawn,)
    return sim, with_faults(sim.mission, faults, truth=sim.truth_at, seed=seed).mission


def run(key: Key) -> Row:
    """Lead the sets of one mission with its lie on, and smooth it if asked to, or if none told."""
    label, grade, seed, with_gnss = str(key[0]), str(key[1]), int(key[2]), bool(key[3])
    sim, mission = _mission(label, grade, seed, with_gnss=with_gnss)
    own = WitnessBounds()
    assert mission.initial is not None
    begin = time.process_time()
    w = witness(mission, mission.initial, own)
    ms = 1e3 * (time.process_time() - begin) / len(mission.dvl.time_s)
    truth = sim.truth_at(w.time_s)
    over = over_bounds(sim, mission, own, w.time_s)
    holds = bool(holds_truth(mission, w, truth).all())
    wide = witness(mission, mission.initial, wide_enough(over, own))
    outcome = asdict(
        Outcome(
            {name: ratio for name, ratio in over.items() if ratio > 1.0},
            holds,
            w.alarms[0].sentence if w.alarms else "",
            float(np.max(w.half_widths[-1, :2])),
            bool(holds_truth(mission, wide, truth).all()),
            wide.alarms[0].sentence if wide.alarms else "",
            float(np.max(wide.half_widths[-1, :2])),
            ms,
        )
    )
    if not key[4] and (holds or w.alarms):
        return outcome
    try:
        found = check_integrity(mission, smooth(mission), own)
    except SsmGraphError:
        return outcome | {"agreement": "no answer"}
    p_n = mission.frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
    return outcome | {
        "agreement": found.agreement.name,
        "radius_m": float(found.radius_m[-1]),
        "sigma_radius_m": float(found.sigma_radius_m[-1]),
        "error_m": float(np.max(np.linalg.norm((found.answer_n - p_n)[:, :2], axis=1))),
    }


def main() -> None:
    """Run what is missing and write the page."""
    report = Report(
        __file__,
        "Integrity: the set of the stated bounds, when something lies",
        __doc__,
        Option("--seeds", 4, "missions of each lie"),
        Option("--clean", 4, "missions without a lie"),
        Option("--first-seed", FIRST_SEED, "of the missions of each lie"),
        Option("--smoothed", 1, "missions of each lie that are smoothed in any case"),
        Option("--grade", "tactical", "of the inertial sensors"),
        Option("--jobs", 1, "processes"),
    )
    a = report.args
    keys: list[Key] = []
    for label in [CLEAN, *LIES]:
        for i in range(a.clean if label == CLEAN else a.seeds):
            asked = None if label == CLEAN else LIES[label].with_gnss
            with_gnss = i % 2 == 0 if asked is None else asked
            keys.append((label, a.grade, a.first_seed + i, int(with_gnss), int(i < a.smoothed)))
    ledger = Ledger(Path(a.out) / "runs.jsonl", {"study": "integrity of stated bounds"})
    rows = run_trials(
        run, keys, ledger, n_jobs=a.jobs, on_progress=lambda n, of, key: note(f"{n}/{of} {key}")
    )
    report.write(_page(rows))


def _is_told(row: Row) -> bool:
    return bool(row["holds_truth"]) or bool(row["alarm"])


def _says_outside(row: Row) -> bool:
    return bool(row["agreement"] == Agreement.OUTSIDE.name)


def _page(rows: dict[Key, Row]) -> list[str]:
    good = {key: row for key, row in rows.items() if ERROR not in row}
    true = [row for row in good.values() if not row["false_bounds"]]
    false = [row for row in good.values() if row["false_bounds"]]
    sound = [_is_told(row) for row in true]
    wide = [bool(row["wide_holds_truth"]) for row in good.values()]
    silent = {key: row for key, row in good.items() if not _is_told(row)}
    outside = sum(map(_says_outside, silent.values()))
    lines = [
        f"{len(rows)} missions of {DURATION_S:.0f} s, {len(rows) - len(good)} refused by the "
        "witness. Bounds are five stated sigmas of every reading, and five of their own for means "
        "over the witness's blocks. Which of them are false is told from the truth, sensor by "
        "sensor: raw speeds, fixes and depths; turn and velocity that inertial data make.",
        "",
        f"**The statement.** Where all bounds hold ({len(true)} missions): truth inside in "
        f"{sum(row['holds_truth'] for row in true)}, inside or alarm in {sum(sound)}, false alarms "
        f"in {sum(bool(row['alarm']) for row in true)}. In all {len(good)} missions with bounds "
        f"that hold, those of the sensor that lies being stated as wide as its errors: truth "
        f"inside throughout in {sum(wide)} (a rate of {rate_with_interval(wide).low:.3f} or more, "
        f"97.5 %), false alarms in {sum(bool(row['wide_alarm']) for row in good.values())}.",
        "",
        f"**Beyond the statement.** Where one is false ({len(false)}), nothing is promised: truth "
        f"inside all the same or alarm in {sum(map(_is_told, false))}; in {len(silent)} neither, "
        f"of which the answer of the smoother was outside the set in {outside}, which is told.",
        "",
        *_table_of_lies(good),
        "",
        "Widths are medians at the end, of missions with fixes and without: without fixes, five "
        "sigma of the stated heading of the start make nearly all of the width. Error at most and "
        "5 sigma are of the missions that were smoothed. Leading the set on took "
        f"{np.median([row['ms_per_ping'] for row in good.values()]):.2f} ms of processor a ping "
        "(median).",
        "",
        "## Missions whose truth was outside without an alarm",
        "",
    ]
    cells = [
        [
            f"{key[0]}, seed {key[2]}",
            _words(row["false_bounds"]),
            str(row["agreement"]).lower(),
            "yes" if row["wide_holds_truth"] else "no",
        ]
        for key, row in silent.items()
    ]
    header = ["mission", "false bounds, times", "the smoother's answer", "inside true bounds"]
    return [*lines, *table(header, cells)]


def _words(false: dict[str, float]) -> str:
    return ", ".join(f"{name} {ratio:.1f}" for name, ratio in false.items()) or "none"


def _table_of_lies(good: dict[Key, Row]) -> list[str]:
    by_label: dict[str, list[Row]] = defaultdict(list)
    for key, row in good.items():
        by_label[str(key[0])].append(row)
    header = ["lie", "false bounds, times at most", "inside", "alarm", "neither, of it told"]
    header += ["inside true bounds", "half-width, m", "with true bounds, m"]
    header += ["error at most, m", "5 sigma, m", "largest error, m"]
    names = ("half_width_m", "wide_half_width_m", "radius_m", "sigma_radius_m", "error_m")
    cells = []
    for label, group in by_label.items():
        worst: dict[str, float] = {}
        for row in group:
            for name, ratio in row["false_bounds"].items():
                worst[name] = max(ratio, worst.get(name, 0.0))
        silent = [row for row in group if not _is_told(row)]
        medians = [
            f"{np.nanmedian([row[name] for row in group]):.2f}"
            if np.isfinite([row[name] for row in group]).any()
            else "–"
            for name in names
        ]
        cells.append(
            [
                label,
                _words(worst),
                f"{sum(bool(row['holds_truth']) for row in group)} of {len(group)}",
                str(sum(bool(row["alarm"]) for row in group)),
                f"{len(silent)}, {sum(map(_says_outside, silent))}" if silent else "0",
                f"{sum(bool(row['wide_holds_truth']) for row in group)} of {len(group)}",
                *medians,
            ]
        )
    return table(header, cells)


if __name__ == "__main__":
    main()
