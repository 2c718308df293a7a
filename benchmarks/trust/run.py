"""Lies that last, or that sensors share: the answer is right, or the status says that it is not.

``python -m benchmarks.trust.run --keep`` (hours; a quick look is ``--seeds 2 --grades tactical``;
the same command again does what is missing).
Missions of 400 s, DVL 5 mm/s; what lies, when and by how much is drawn for every seed.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.processes import tell
from benchmarks.report import Option, Report, number_text, table
from benchmarks.trust.lies import LIES
from ssm_graph import Estimate, Mission, SmootherConfig, SsmGraphError, evaluate, smooth
from ssm_graph.base.code_version import code_version
from ssm_graph.simulation import (
    AidSettings,
    DvlSettings,
    GnssSettings,
    Grade,
    SimulatedMission,
    SimulationConfig,
    SpiralRoute,
    SurveyRoute,
    simulate,
    with_faults,
)
from ssm_graph.study.ledger import Key, Ledger, Row, run_trials

DURATION_S = 400.0
SIGMA_M_PER_S = 0.005
AS_GOOD = 1.2
"""Ratio to the oracle up to which an answer is right."""
BEYOND = 5.0
"""Sigmas of an error that its sigma does not cover."""
CLEAN, REALISTIC = "no fault", "no fault, realistic instruments, as stated by their preset"
SHARES = (1.0, 2.0, 3.0)
"""Sigmas inside which errors are counted."""


class Run(NamedTuple):
    """What came of one mission."""

    ratio: float
    """Rms over that of the oracle, horizontal or vertical, whichever is larger"""
    z: float
    """Largest error of a position, in its own sigma"""
    status: str
    is_named: bool
    """Whether the verdict names the sensor that lies, over a time that has to do with the lie"""
    n_blamed: int
    """Faults that it found; what is only allowed for is none"""
    inside: tuple[float, ...]
    """Shares of the errors east, north and up inside 1, 2 and 3 sigma: nine numbers"""
    nees: float
    seconds: float
    plain_seconds: float
    """Without the search for faults; NaN where it was not tried"""
    plain_ratio: float
    """Horizontal rms with the search over that without it"""

    @property
    def is_right(self) -> bool:
        """Whether the answer is nearly as good as that of the oracle."""
        return self.ratio <= AS_GOOD

    @property
    def is_said(self) -> bool:
        """Whether the status says that it may not be, and who is to blame."""
        return self.status != "CONVERGED" and self.is_named

    @property
    def is_covered(self) -> bool:
        """Whether the sigmas cover the error, in an answer that names who lies."""
        return self.z <= BEYOND and self.is_named

    @property
    def is_deceived(self) -> bool:
        """Whether it is called good while the error is beyond its sigmas."""
        return self.status == "CONVERGED" and self.z > BEYOND


def mission_of(
    grade: str,
    seed: int,
    *,
    with_gnss: bool,
    realistic: bool,
    aids: AidSettings | None = None,
    duration_s: float = DURATION_S,
) -> SimulatedMission:
    """Simulate a survey or, each third seed, a spiral, of a place of its own."""
    rng = np.random.default_rng([seed, *b"trust"])
    route = SpiralRoute() if seed % 3 == 2 else SurveyRoute(line_m=float(rng.uniform(60.0, 200.0)))
    return simulate(
        SimulationConfig(
            route=route,
            duration_s=duration_s,
            lat=float(rng.uniform(-1.2, 1.2)),
            seed=seed,
            grade=Grade[grade.upper()],
            dvl=DvlSettings(noise=SIGMA_M_PER_S),
            gnss=GnssSettings(windows=((0.0, duration_s),)) if with_gnss else None,
            aids=aids or AidSettings(),
            realistic=realistic,
            calibrates=realistic,
        )
    )


def run(key: Key) -> Row:
    """Smooth one mission (label, grade, seed, is realistic) with its lie, and as the oracle."""
    label, grade, seed, realistic = str(key[0]), str(key[1]), int(key[2]), bool(key[3])
    row = _run(label, grade, seed, realistic)._asdict()
    return row | {f"inside {i}": share for i, share in enumerate(row.pop("inside"))}


def _of(row: Row) -> Run:
    inside = tuple(row[f"inside {i}"] for i in range(3 * len(SHARES)))
    return Run(inside=inside, **{name: row[name] for name in Run._fields if name != "inside"})


def _run(label: str, grade: str, seed: int, realistic: bool) -> Run:
    rng = np.random.default_rng([seed, *label.encode()])
    lie = LIES.get(label)
    with_gnss = seed % 2 == 0 if lie is None or lie.with_gnss is None else lie.with_gnss
    sim = mission_of(grade, seed, with_gnss=with_gnss, realistic=realistic)
    if lie is None:
        return _judged(sim, sim.mission, sim.mission, None)
    drawn = lie.draw(rng, DURATION_S)
    faults = drawn if isinstance(drawn, tuple) else (drawn,)
    broken = with_faults(sim.mission, faults, truth=sim.truth_at, seed=seed)
    begin, end = min(f.start_s for f in faults), max(min(f.end_s, DURATION_S) for f in faults)
    return _judged(sim, broken.mission, broken.told(sim.mission), (lie.named, begin, end))


def _judged(
    sim: SimulatedMission,
    mission: Mission,
    told: Mission,
    lie: tuple[tuple[str, ...], float, float] | None,
) -> Run:
    begin = time.process_time()
    try:
        estimate = smooth(mission)
    except SsmGraphError as error:
        return _refused(str(error), lie)
    seconds = time.process_time() - begin
    found = _errors(sim, estimate)
    oracle = found if told is mission else _errors(sim, smooth(told))
    plain_seconds = plain_ratio = np.nan
    if lie is None:
        begin = time.process_time()
        plain = smooth(mission, SmootherConfig())
        plain_seconds = time.process_time() - begin
        plain_ratio = found.rms_m[0] / _errors(sim, plain).rms_m[0]
    return Run(
        ratio=max(np.divide(found.rms_m, oracle.rms_m)),
        z=found.z,
        status=estimate.status.name,
        is_named=lie is not None and _names(estimate, *lie),
        n_blamed=sum(one.treatment.is_blame for one in estimate.faults),
        inside=found.inside,
        nees=found.nees,
        seconds=seconds,
        plain_seconds=plain_seconds,
        plain_ratio=plain_ratio,
    )


def _refused(said: str, lie: tuple[tuple[str, ...], float, float] | None) -> Run:
    is_named = lie is not None and bool(re.search("|".join(lie[0]), said))
    return Run(np.inf, np.inf, "REFUSED", is_named, 0, (np.nan,) * 9, *(np.nan,) * 4)


def _names(estimate: Estimate, words: Sequence[str], begin_s: float, end_s: float) -> bool:
    """Return whether a finding that overlaps with the lie, or the reason, has one of the words."""
    pattern = re.compile("|".join(words))
    for fault in estimate.faults:
        overlaps = fault.begin_s <= end_s and fault.end_s >= begin_s
        if overlaps and pattern.search(" ".join((fault.sensor, *fault.rivals))):
            return True
    return not estimate.status.is_good and bool(pattern.search(estimate.reason))


class _Errors(NamedTuple):
    rms_m: tuple[float, float]
    """Horizontal, vertical"""
    z: float
    inside: tuple[float, ...]
    nees: float


def _errors(sim: SimulatedMission, estimate: Estimate) -> _Errors:
    trajectory = estimate.trajectory
    metrics = evaluate(trajectory, sim.truth_at(trajectory.time_s))
    series = metrics.errors
    z = np.abs(series.position_enu) / series.position_sigma_enu
    inside = tuple(float(x) for s in SHARES for x in np.mean(z < s, axis=0))
    rms_m = metrics.rmse_horizontal_m, metrics.rmse_vertical_m
    return _Errors(rms_m, float(z.max()), inside, metrics.nees_position)


HEADER: tuple[str, ...] = (
    "what lies",
    "grade",
    "ratio to oracle, median",
    "ratio, largest",
    "right",
    "said",
)
HEADER += (
    "covered",
    "any of these",
    "CONVERGED and beyond 5 sigma",
    "largest z of CONVERGED, sigma",
)
HEADER += ("median, s",)
LEGEND = f"""\
Ratio: rms over that of the smoother that is told which measurements are bad, horizontal or
vertical, whichever is larger. Right: up to {AS_GOOD}. Said: not CONVERGED, and the sensor that lies
is among those named. Covered: no error beyond {BEYOND:g} of its sigmas, and the sensor is named.
z: largest error of a position in its own sigma.
"""
CLEAN_HEADER: tuple[str, ...] = (
    "mission",
    "grade",
    "not CONVERGED",
    "sensors blamed",
    "missions with blame",
)
CLEAN_HEADER += ("inside 1 sigma E/N/U, %", "inside 2 sigma, %", "inside 3 sigma, %", "NEES / 3")
CLEAN_HEADER += ("rms with search / without", "time with search / without")


def line(label: str, grade: str, runs: Sequence[Run]) -> list[str]:
    """Return one row of the table of lies."""
    n, good = len(runs), [run for run in runs if run.status == "CONVERGED"]
    ratios = [run.ratio for run in runs]
    either = sum(run.is_right or run.is_said or run.is_covered for run in runs)
    return [
        *(label, grade, f"{np.median(ratios):.2f}", f"{max(ratios):.3g}"),
        *(str(sum(run.is_right for run in runs)), str(sum(run.is_said for run in runs))),
        *(str(sum(run.is_covered for run in runs)), f"{either} of {n}"),
        str(sum(run.is_deceived for run in runs)),
        number_text(max((run.z for run in good), default=np.nan)),
        f"{np.nanmedian([run.seconds for run in runs]):.1f}",
    ]


def clean_line(label: str, grade: str, runs: Sequence[Run]) -> list[str]:
    """Return one row of the table of missions without a lie."""
    inside = 100.0 * np.mean([run.inside for run in runs], axis=0)
    return [
        *(label, grade, f"{sum(run.status != 'CONVERGED' for run in runs)} of {len(runs)}"),
        *(str(sum(run.n_blamed for run in runs)), str(sum(run.n_blamed > 0 for run in runs))),
        *(" / ".join(f"{x:.1f}" for x in part) for part in np.split(inside, 3)),
        f"{np.mean([run.nees for run in runs]):.2f}",
        f"{np.mean([run.plain_ratio for run in runs]):.3f}",
        f"{sum(run.seconds for run in runs) / sum(run.plain_seconds for run in runs):.2f}",
    ]


def main() -> None:
    """Run all missions and write the tables."""
    report = Report(
        *(__file__, "Lies that last, or that sensors share", __doc__),
        Option("--seeds", 30, "missions of each kind"),
        Option("--first-seed", 20_000, "where they begin"),
        Option("--grades", "navigation,tactical", "names with commas between them"),
        Option("--clean-grades", "navigation,tactical,mems", "of missions without a fault"),
        Option("--only", "", "lies, or missions without, whose names have this in them"),
        Option("--realistic", False, "lies on realistic instruments, too"),
        Option("--jobs", 2, "missions at a time"),
    )
    args = report.args
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    labels = [label for label in LIES if args.only in label]
    lies = [(label, grade) for label in labels for grade in args.grades.split(",")]
    sound = [label for label in (CLEAN, REALISTIC) if args.only in label]
    fair = [(label, grade) for label in sound for grade in args.clean_grades.split(",")]
    cells = [(*cell, args.realistic) for cell in lies]
    cells += [(label, grade, label == REALISTIC) for label, grade in fair]
    cases: list[Key] = [(*cell[:2], seed, cell[2]) for cell in cells for seed in seeds]
    ledger = Ledger(args.out / f"{code_version()}.jsonl", {"benchmark": "trust.run"})
    made = run_trials(run, cases, ledger, n_jobs=args.jobs, on_progress=tell)
    runs = [_of(made[key]) for key in cases]
    rows: dict[bool, list[list[str]]] = {True: [], False: []}
    for i, (label, grade, _) in enumerate(cells):
        own = runs[i * len(seeds) : (i + 1) * len(seeds)]
        rows[label in LIES].append((line if label in LIES else clean_line)(label, grade, own))
    report.write(_page(rows[True], rows[False], seeds))


def _page(lies: Sequence[list[str]], fair: Sequence[list[str]], seeds: range) -> list[str]:
    about = f"Seeds {seeds.start} to {seeds.stop - 1}; missions of {DURATION_S:g} s."
    shown = [table(head, rows) for head, rows in ((HEADER, lies), (CLEAN_HEADER, fair)) if rows]
    return [about, "", LEGEND, *("\n".join((*lines, "")) for lines in shown)]


if __name__ == "__main__":
    main()
