"""Missions without a lie: nothing is accused, and errors are as large as their sigmas say.

``python -m benchmarks.trust.sound --keep`` (hours; the same command again does what is missing).
Missions of 400 s like those of ``benchmarks.trust.run``, every other one with fixes; instruments
err as real ones of the grade, which the mission states as their data sheets would, or by bias,
walk and white noise alone.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.processes import tell
from benchmarks.report import Option, Report, table
from benchmarks.trust.run import DURATION_S, SHARES, errors_of, mission_of
from factors.similarity import GaussianKernel
from ssm_graph import Estimate, SmootherConfig, evaluate, smooth
from ssm_graph.base.code_version import code_version
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.consistency import rate_with_interval
from ssm_graph.simulation import SimulatedMission
from ssm_graph.study.ledger import ERROR, Key, Ledger, Row, run_trials

REALISTIC, PLAIN = "realistic", "plain"
GOALS = ((63.0, 74.0), (93.0, 98.0), (99.0, 99.9))
"""%, of the errors of each axis inside 1, 2 and 3 sigma."""


class Sound(NamedTuple):
    """What came of one mission."""

    status: str
    blamed: tuple[str, ...]
    """Sentences about sensors that are said not to be sound"""
    inside: tuple[float, ...]
    """Shares of the errors east, north and up inside 1, 2 and 3 sigma: nine numbers"""
    nees: float
    """Over 3, mean of all keyframes"""
    rms_m: float
    """Horizontal"""
    seconds: float
    plain_seconds: float
    """Without the search for faults"""
    least_m: float = np.nan
    """Horizontal rms of least squares without a search: the best where noise is as stated"""
    sigma_ratio: float = np.nan
    """Horizontal sigma by that of least squares, roots of the mean squares"""
    apart: float = np.nan
    """Mean square distance from least squares, by its variance: horizontally, and"""
    apart_up: float = np.nan
    """upwards"""


def run(key: Key) -> Row:
    """Smooth one mission (instruments, grade, seed) as it is usual, and without the search."""
    instruments, grade, seed = str(key[0]), str(key[1]), int(key[2])
    sim = mission_of(grade, seed, with_gnss=seed % 2 == 0, realistic=instruments == REALISTIC)
    begin = time.process_time()
    estimate = smooth(sim.mission)
    middle = time.process_time()
    smooth(sim.mission, SmootherConfig())
    end = time.process_time()
    found = errors_of(sim, estimate)
    made = Sound(
        estimate.status.name,
        tuple(one.sentence for one in estimate.faults if one.treatment.is_blame),
        found.inside,
        found.nees,
        found.rms_m[0],
        seconds=middle - begin,
        plain_seconds=end - middle,
    )
    if instruments == PLAIN:
        least = smooth(sim.mission, SmootherConfig(kernel=GaussianKernel()))
        best = errors_of(sim, least)
        ratio = found.sigma_m / best.sigma_m
        level, up = _apart(sim, estimate, least)
        made = made._replace(least_m=best.rms_m[0], sigma_ratio=ratio, apart=level, apart_up=up)
    return made._asdict()


def _apart(sim: SimulatedMission, estimate: Estimate, least: Estimate) -> tuple[float, float]:
    own, best = (
        evaluate(one.trajectory, sim.truth_at(one.trajectory.time_s)).errors
        for one in (estimate, least)
    )
    square = np.mean((own.position_enu - best.position_enu) ** 2, axis=0)
    variance = np.mean(best.position_sigma_enu**2, axis=0)
    horizontal = np.sum(square[:2]) / np.sum(variance[:2])
    return float(horizontal), float(square[2] / variance[2])


def _of(row: Row) -> Sound:
    if ERROR in row:
        return Sound("REFUSED", (row[ERROR],), (np.nan,) * 9, *(np.nan,) * 4)
    return Sound(**{name: row[name] for name in Sound._fields})


HEADER: tuple[str, ...] = ("instruments", "grade", "missions", "not CONVERGED", "with blame")
HEADER += tuple(f"inside {share:g} sigma E / N / U, %" for share in SHARES)
HEADER += ("NEES / 3", "time with search / without")
PRICE: tuple[str, ...] = ("grade", "missions", "rms by least squares", "sigma by least squares")
PRICE += ("price horizontally, %", "price up, %")
LEGEND = """\
Not CONVERGED and with blame: missions, and in brackets the largest rate that such a count leaves
open (95 %, one side). Inside: mean over missions and its standard error, for the errors of one
mission go together; asked for are {goals} %. NEES / 3: the same, 1 where sigmas are right.
"""
ABOUT_PRICE = """\
The price of weights where noise is as stated: horizontal rms and sigma by those of least squares,
which nothing can be better than there; roots of mean squares over all missions. What an answer is
apart from that of least squares owes nothing to the error of this, and so adds to its square: the
price is half of that by the variance of least squares, which scatters far less than the ratio of
the errors.
"""


def line(instruments: str, grade: str, runs: Sequence[Sound]) -> list[str]:
    """Return one row of the first table."""
    inside = 100.0 * np.array([one.inside for one in runs])
    shares = np.split(np.array([_mean(of) for of in inside.T]), len(SHARES))
    times = [sum(getattr(one, name) for one in runs) for name in ("seconds", "plain_seconds")]
    return [
        *(instruments, grade, str(len(runs))),
        _rate([one.status != "CONVERGED" for one in runs]),
        _rate([bool(one.blamed) for one in runs]),
        *(" / ".join(of) for of in shares),
        _mean(np.array([one.nees for one in runs]), digits=2),
        f"{times[0] / times[1]:.2f}",
    ]


def price_line(grade: str, runs: Sequence[Sound]) -> list[str]:
    """Return one row of the table of the price."""
    own, best = (np.array([getattr(one, name) for one in runs]) for name in ("rms_m", "least_m"))
    ratio = np.sqrt(np.sum(own**2) / np.sum(best**2))
    left_out = [
        np.sqrt((np.sum(own**2) - a**2) / (np.sum(best**2) - b**2))
        for a, b in zip(own, best, strict=True)
    ]
    n = len(runs)
    error = np.sqrt((n - 1) / n * np.sum((np.array(left_out) - np.mean(left_out)) ** 2))
    sigma = np.sqrt(np.mean([one.sigma_ratio**2 for one in runs]))
    prices = (
        _mean(50.0 * of, digits=2) for of in np.array([(one.apart, one.apart_up) for one in runs]).T
    )
    return [grade, str(n), f"{ratio:.4f} ± {error:.4f}", f"{sigma:.4f}", *prices]


def _rate(happened: Sequence[bool]) -> str:
    most = rate_with_interval(happened, confidence=0.9).high
    return f"{sum(happened)} ({100.0 * most:.1f} %)"


def _mean(values: Array, *, digits: int = 1) -> str:
    values = values[np.isfinite(values)]
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return f"{np.mean(values):.{digits}f} ± {error:.{digits}f}"


def main() -> None:
    """Run all missions and write the tables."""
    report = Report(
        *(__file__, "Missions without a lie", __doc__),
        Option("--seeds", 30, "missions of each kind"),
        Option("--first-seed", 83_000, "where they begin"),
        Option("--grades", "navigation,tactical,mems", "names with commas between them"),
        Option("--instruments", f"{REALISTIC},{PLAIN}", "the same"),
        Option("--jobs", 2, "missions at a time"),
    )
    args = report.args
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    kinds = [(i, g) for i in args.instruments.split(",") for g in args.grades.split(",")]
    # One seed of all kinds after the other: what is done when time is up is alike for all.
    cases: list[Key] = [(*kind, seed) for seed in seeds for kind in kinds]
    ledger = Ledger(args.out / f"{code_version()}.jsonl", {"benchmark": "trust.sound"})
    made = run_trials(run, cases, ledger, n_jobs=args.jobs, on_progress=tell)
    runs = {kind: [_of(made[(*kind, seed)]) for seed in seeds] for kind in kinds}
    report.write(_page(runs, seeds))


def _page(runs: dict[tuple[str, str], list[Sound]], seeds: range) -> list[str]:
    goals = ", ".join(f"{low:g} to {high:g}" for low, high in GOALS)
    prices = [price_line(kind[1], own) for kind, own in runs.items() if kind[0] == PLAIN]
    accused = [
        f"- {kind[0]}, {kind[1]}: {sentence}"
        for kind, own in runs.items()
        for one in own
        for sentence in one.blamed
    ]
    lines = [f"Seeds {seeds.start} to {seeds.stop - 1}; missions of {DURATION_S:g} s.", ""]
    lines += [
        LEGEND.format(goals=goals),
        *table(HEADER, [line(*k, own) for k, own in runs.items()]),
    ]
    lines += ["", ABOUT_PRICE, *table(PRICE, prices)] if prices else []
    return lines + (["", "Accused:", "", *accused] if accused else [])


if __name__ == "__main__":
    main()
