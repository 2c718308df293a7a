"""Lies that last, or that sensors share: the answer is right, or the status says that it is not.

``python -m benchmarks.trust.run --keep`` (hours; a quick look is ``--seeds 2 --grades tactical``;
the same command again does what is missing).
Missions of 400 s, DVL 5 mm/s; what lies, when and by how much is drawn for every seed.
With ``--drawn`` the kind is drawn, too, and two sensors may lie at once.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.processes import all_done, tell
from benchmarks.report import Option, Report, number_text, table
from benchmarks.trust.drawn import aids_of, drawn
from benchmarks.trust.lies import LIES
from ssm_graph import Estimate, SsmGraphError, evaluate, smooth
from ssm_graph.base.code_version import code_version
from ssm_graph.simulation import (
    AidSettings,
    DvlSettings,
    Fault,
    GnssSettings,
    Grade,
    Sensor,
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
SHARES = (1.0, 2.0, 3.0)
"""Sigmas inside which errors are counted."""
DRAWN = "drawn"
"""Label of what is of any kind."""


class Run(NamedTuple):
    """What came of one mission."""

    ratio: float
    """Rms over that of the oracle, horizontal or vertical, whichever is larger"""
    z: float
    """Largest error of a position, in its own sigma"""
    status: str
    is_named: bool
    """Whether the verdict names the sensor that lies, over a time that has to do with the lie"""
    seconds: float
    kind: str = ""
    """Of what was drawn"""

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
    def is_lost(self) -> bool:
        """Whether it is neither right nor said, and not inside its sigmas."""
        return not (self.is_right or self.is_said or self.z <= BEYOND)

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


class Case(NamedTuple):
    """What lies in a mission."""

    faults: tuple[Fault, ...]
    named: tuple[tuple[str, ...], ...]
    """Of each the words of which the verdict has to use one"""
    with_gnss: bool
    kind: str = ""
    aids: AidSettings = AidSettings()


def case_of(label: str, seed: int) -> Case:
    """Draw what lies in the mission of a seed; fixes without need every other seed."""
    rng = np.random.default_rng([seed, *label.encode()])
    if label == DRAWN:
        found = drawn(rng, DURATION_S)
        has_fixes = seed % 2 == 0 or any(one.kind.sensor is Sensor.GNSS for one in found)
        return Case(
            tuple(one.fault for one in found),
            tuple(one.named for one in found),
            has_fixes,
            ", ".join(one.kind.label for one in found),
            aids_of(found),
        )
    lie = LIES[label]
    has_fixes = seed % 2 == 0 if lie.with_gnss is None else lie.with_gnss
    fault = lie.draw(rng, DURATION_S)
    faults = fault if isinstance(fault, tuple) else (fault,)
    return Case(faults, (lie.named,) * len(faults), has_fixes)


def run(key: Key) -> Row:
    """Smooth one mission (label, grade, seed, is realistic) with its lie, and as the oracle."""
    label, grade, seed, realistic = str(key[0]), str(key[1]), int(key[2]), bool(key[3])
    case = case_of(label, seed)
    sim = mission_of(grade, seed, with_gnss=case.with_gnss, realistic=realistic, aids=case.aids)
    broken = with_faults(sim.mission, case.faults, truth=sim.truth_at, seed=seed)
    begin = time.process_time()
    try:
        estimate = smooth(broken.mission)
    except SsmGraphError as error:
        is_named = all(re.search("|".join(words), str(error)) for words in case.named)
        return Run(np.inf, np.inf, "REFUSED", is_named, np.nan, case.kind)._asdict()
    seconds = time.process_time() - begin
    found = errors_of(sim, estimate)
    oracle = errors_of(sim, smooth(broken.told(sim.mission)))
    return Run(
        ratio=max(np.divide(found.rms_m, oracle.rms_m)),
        z=found.z,
        status=estimate.status.name,
        is_named=all(
            _names(estimate, words, fault.start_s, min(fault.end_s, DURATION_S))
            for fault, words in zip(case.faults, case.named, strict=True)
        ),
        seconds=seconds,
        kind=case.kind,
    )._asdict()


def _names(estimate: Estimate, words: Sequence[str], begin_s: float, end_s: float) -> bool:
    """Return whether a finding that overlaps with the lie, or the reason, has one of the words."""
    pattern = re.compile("|".join(words))
    for fault in estimate.faults:
        overlaps = fault.begin_s <= end_s and fault.end_s >= begin_s
        if overlaps and pattern.search(" ".join((fault.sensor, *fault.rivals))):
            return True
    return not estimate.status.is_good and bool(pattern.search(estimate.reason))


class Errors(NamedTuple):
    """Of the positions of an answer, against the truth."""

    rms_m: tuple[float, float]
    """Horizontal, vertical"""
    z: float
    inside: tuple[float, ...]
    """Shares of the errors east, north and up inside :data:`SHARES`"""
    nees: float
    sigma_m: float
    """Horizontal, root of the mean square"""


def errors_of(sim: SimulatedMission, estimate: Estimate) -> Errors:
    """Return the errors of an answer at its keyframes."""
    trajectory = estimate.trajectory
    metrics = evaluate(trajectory, sim.truth_at(trajectory.time_s))
    series = metrics.errors
    z = np.abs(series.position_enu) / series.position_sigma_enu
    inside = tuple(float(x) for s in SHARES for x in np.mean(z < s, axis=0))
    rms_m = metrics.rmse_horizontal_m, metrics.rmse_vertical_m
    sigma_m = float(np.sqrt(np.mean(series.position_sigma_enu[:, :2] ** 2)))
    return Errors(rms_m, float(z.max()), inside, metrics.nees_position, sigma_m)


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


def lost(cells: Sequence[tuple[Key, Run]]) -> list[str]:
    """Return a table of missions neither right nor said, and beyond their sigmas, if there are."""
    rows = []
    for key, run in cells:
        if run.is_lost:
            z, is_named = number_text(run.z), "yes" if run.is_named else "no"
            what = (run.kind or str(key[0]), str(key[1]), str(key[2]))
            rows.append([*what, run.status, f"{run.ratio:.3g}", z, is_named])
    if not rows:
        return []
    header = ("what lies", "grade", "seed", "status", "ratio", "z, sigma", "named")
    return ["", "Neither right nor said, and beyond 5 sigma:", "", *table(header, rows)]


def main() -> None:
    """Run all missions and write the tables."""
    report = Report(
        *(__file__, "Lies that last, or that sensors share", __doc__),
        Option("--seeds", 30, "missions of each kind"),
        Option("--first-seed", 20_000, "where they begin"),
        Option("--grades", "navigation,tactical", "names with commas between them"),
        Option("--only", "", "lies whose names have this in them"),
        Option("--drawn", False, "one row a grade, of faults of any kind, one or two at once"),
        Option("--realistic", False, "lies on realistic instruments, too"),
        Option("--jobs", 2, "missions at a time"),
    )
    args = report.args
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    labels = [DRAWN] if args.drawn else [label for label in LIES if args.only in label]
    cells = [(label, grade) for label in labels for grade in args.grades.split(",")]
    cases: list[Key] = [(*cell, seed, args.realistic) for cell in cells for seed in seeds]
    ledger = Ledger(args.out / f"{code_version()}.jsonl", {"benchmark": "trust.run"})
    made = all_done(run_trials(run, cases, ledger, n_jobs=args.jobs, on_progress=tell))
    runs = [Run(**made[key]) for key in cases]
    rows = [
        line(*cell, runs[i * len(seeds) : (i + 1) * len(seeds)]) for i, cell in enumerate(cells)
    ]
    about = f"Seeds {seeds.start} to {seeds.stop - 1}; missions of {DURATION_S:g} s."
    failed = lost(list(zip(cases, runs, strict=True)))
    report.write([about, "", LEGEND, *table(HEADER, rows), *failed])


if __name__ == "__main__":
    main()
