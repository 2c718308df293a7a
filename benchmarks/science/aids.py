"""What further aids are worth, with and without gross errors in them, and whether sigmas hold.

``python -m benchmarks.science.aids --keep`` (some ten minutes on one core; a quick look is
``--runs 3``).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.report import Option, Report, mean_text, note, table
from factors.similarity import GaussianKernel, Kernel, LogKernel
from ssm_graph import SmootherConfig, SsmSmoother, build_problem, evaluate
from ssm_graph.evaluation.statistics import chi2_interval
from ssm_graph.mission.estimate import Calibration
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.compass import HeadingErrors
from ssm_graph.sensors.standstill import Standstill
from ssm_graph.simulation import (
    CALM,
    AidSettings,
    BeaconSettings,
    CompassSettings,
    Grade,
    GrossErrors,
    HoverRoute,
    RangingSettings,
    SimulatedMission,
    SimulationConfig,
    UsblSettings,
    simulate,
)

RATE = 0.1
"""Of gross errors, where there are any."""
PLACES = ((300.0, 100.0, -60.0), (-100.0, 400.0, -60.0), (100.0, -300.0, -50.0))
KNOWN = tuple(BeaconSettings(number, enu) for number, enu in enumerate(PLACES, start=1))
KERNELS: dict[str, Kernel] = {"gaussian": GaussianKernel(), "log": LogKernel()}
PRIOR_M = (80.0, 80.0, 10.0)
"""Of the unknown beacon; where it is stated is drawn from it."""
IRON = HeadingErrors(
    offset_sigma=math.radians(3.0),
    walk_sigma=math.radians(1.0),
    correlation_s=300.0,
    one_cycle_sigma=math.radians(2.0),
    two_cycle_sigma=math.radians(1.0),
)
SURVEY = SimulationConfig(duration_s=600.0, imu_rate_hz=50.0, grade=Grade.TACTICAL)
REST = dataclasses.replace(
    SURVEY,
    duration_s=300.0,
    route=HoverRoute(sway_m=0.0, yaw=0.0),
    waves=CALM,
    dropout_rate=1.0,
    depth=None,
)


class Case(NamedTuple):
    """One kind of aid and a mission for it."""

    name: str
    text: str
    config: SimulationConfig = SURVEY
    has_gross: bool = True


FIXES = Case(
    "Acoustic fixes",
    "Survey, tactical grade, 10 min. A fix every 5 s with 2 m of noise an axis, 1.5 s late; "
    "gross errors of 20 to 100 m.",
)
RANGES = Case(
    "Ranges to three known beacons",
    "The same survey. A range every 4 s with 0.3 m of noise, to each beacon in turn; gross "
    "errors of 5 to 50 m.",
)
UNKNOWN = Case(
    "Ranges to one beacon whose place is not known",
    "The same survey. The place is stated within 80 m east and north and 10 m up (1 sigma); "
    "ranges as before.",
)
COMPASS = Case(
    "Compass",
    "Survey, MEMS grade, 10 min. 4 Hz with 1 degree of noise, offset 3 degrees, walk 1 degree "
    "within 300 s, hard iron 2 degrees, soft iron 1 degree, all estimated; disturbances of "
    "11 to 57 degrees for 3 s.",
    dataclasses.replace(SURVEY, grade=Grade.MEMS),
)
STANDSTILL = Case(
    "Standstill",
    "At rest for 5 min without bottom lock and without depth, tactical grade; sigma 0.02 m/s.",
    REST,
    has_gross=False,
)
CASES = (FIXES, RANGES, UNKNOWN, COMPASS, STANDSTILL)


@dataclasses.dataclass(frozen=True, slots=True)
class Run:
    """One mission, smoothed."""

    horizontal_m: float
    """rms"""
    heading_deg: float
    """rms"""
    nees: float
    """Of the position, over 3"""
    status: str
    error: tuple[float, ...]
    """Of what was estimated of the aid, in posterior sigmas; empty for nothing"""


def aid_of(case: Case, seed: int, rate: float) -> AidSettings:
    """Return the aid of a case, a fraction ``rate`` of it grossly wrong."""
    if case is FIXES:
        return AidSettings(usbl=UsblSettings(gross=GrossErrors(rate, (20.0, 100.0))))
    if case is COMPASS:
        gross = GrossErrors(rate, (0.2, 1.0))
        return AidSettings(compass=CompassSettings(errors=IRON, gross=gross))
    if case is STANDSTILL:
        return AidSettings(standstills=(Standstill(0.0, case.config.duration_s, sigma=0.02),))
    beacons = KNOWN if case is RANGES else (unknown_beacon(seed),)
    return AidSettings(ranging=RangingSettings(beacons, gross=GrossErrors(rate, (5.0, 50.0))))


def unknown_beacon(seed: int) -> BeaconSettings:
    """Return a beacon whose stated place is off by a draw from its prior."""
    off = np.random.default_rng([seed, 1]).standard_normal(3) * PRIOR_M
    east, north, up = off.tolist()
    return BeaconSettings(7, (250.0, -100.0, -55.0), (east, north, up), PRIOR_M)


def run(sim: SimulatedMission, kernel: Kernel, *, is_aided: bool = True) -> Run:
    """Smooth one mission, with or without its aid."""
    mission = sim.mission
    if not is_aided:
        mission = dataclasses.replace(mission, aids=Aids())
    estimate = SsmSmoother(SmootherConfig(kernel=kernel)).solve(build_problem(mission))
    assert mission.reference is not None
    metrics = evaluate(estimate.trajectory, mission.reference)
    names = ("heading_offset", "heading_one_cycle", "heading_two_cycle")
    of_compass = zip(names, np.split(sim.aids.heading_errors[:5], [1, 3]), strict=True)
    ranging = sim.config.aids.ranging
    beacons = ranging.beacons if ranging is not None else ()
    off = {f"beacon_{beacon.number}": -np.array(beacon.stated_off) for beacon in beacons}
    return Run(
        horizontal_m=metrics.rmse_horizontal_m,
        heading_deg=math.degrees(metrics.rmse_attitude[2]),
        nees=metrics.nees_position,
        status=estimate.status.name,
        error=errors_of(estimate.calibration, off | dict(of_compass)),
    )


def errors_of(calibration: Calibration | None, truth: dict[str, np.ndarray]) -> tuple[float, ...]:
    """Return the errors of estimated constants, in their posterior sigmas."""
    errors: list[float] = []
    for variable, true in truth.items():
        values = [v for v in calibration.values if v.variable == variable] if calibration else []
        errors += [(v.value - t) / v.sigma for v, t in zip(values, true, strict=False)]
    return tuple(errors)


def results_of(case: Case, n_runs: int) -> dict[str, list[Run]]:
    """Smooth missions of one case in every way that is compared, by its name in the table."""
    results: dict[str, list[Run]] = {}
    for seed in range(n_runs):
        for rate in (0.0, RATE) if case.has_gross else (0.0,):
            aids = aid_of(case, seed, rate)
            sim = simulate(dataclasses.replace(case.config, seed=seed, aids=aids))
            if rate == 0.0:
                plain = run(sim, LogKernel(), is_aided=False)
                results.setdefault("without the aid", []).append(plain)
            about = f"{100.0 * rate:.0f} % gross errors, " if case.has_gross else ""
            for name, kernel in KERNELS.items():
                results.setdefault(about + name, []).append(run(sim, kernel))
    return results


def case_lines(case: Case, results: Mapping[str, Sequence[Run]]) -> list[str]:
    """Return the section of one aid."""
    n_runs = len(next(iter(results.values())))
    rows, found = [], []
    for name, runs in results.items():
        means = [
            mean_text([getattr(run, field) for run in runs])
            for field in ("horizontal_m", "heading_deg", "nees")
        ]
        settled, suspect = (
            sum(run.status == status for run in runs) for status in ("CONVERGED", "SUSPECT")
        )
        rows.append([name, *means, f"{settled} / {suspect}"])
        found += _estimated(name, runs)
    expected = chi2_interval(3, n_runs)
    header = ["", "horizontal rms, m", "heading rms, deg", "NEES / 3", "CONVERGED / SUSPECT"]
    return [
        *(f"## {case.name}", "", case.text, "", *table(header, rows), ""),
        f"Seeds 0 to {n_runs - 1}. The epochs of one run depend on each other; did they all say "
        "the same, NEES / 3 of consistent runs would be "
        f"{expected.low:.2f} to {expected.high:.2f}.",
        "",
        *([*found, ""] if found else []),
    ]


def _estimated(name: str, runs: Sequence[Run]) -> list[str]:
    """Return how well the sigmas of what was estimated hold."""
    errors = np.array([run.error for run in runs])
    if errors.size == 0:
        return []
    inside = np.abs(errors) < 3.0
    all_inside = int(inside.all(axis=1).sum())
    return [
        f"- {name}: all {errors.shape[1]} estimated constants within 3 sigma in {all_inside} of "
        f"{len(runs)} runs, {100.0 * inside.mean():.2f} % of {inside.size} values; mean square of "
        f"the errors over their variances {np.mean(errors**2):.2f}, largest error "
        f"{np.abs(errors).max():.1f} sigma"
    ]


LEGEND = """\
Inertial data of 50 Hz, DVL of 1 Hz with clean beams, depth, no GNSS, the start known to the sigmas
of the grade. "gaussian" is least squares, weight 1 for every beam and every measurement of the aid;
"log" weighs both by the default kernel. Intervals are of 95 %.
"""


def main() -> None:
    """Run everything and write the report."""
    names = [case.name for case in CASES]
    report = Report(
        *(__file__, "Further aids", __doc__),
        Option("--runs", 30, "missions of each kind"),
        Option("--cases", names, "kinds of aids", names),
    )
    lines = [LEGEND]
    for case in CASES:
        if case.name in report.args.cases:
            note(f"{case.name} ...")
            lines += case_lines(case, results_of(case, report.args.runs))
    report.write(lines)


if __name__ == "__main__":
    main()
