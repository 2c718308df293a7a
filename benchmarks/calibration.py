"""Whether calibration finds what is wrong, invents nothing and costs little.

``python benchmarks/calibration.py --keep`` (some ten minutes on one core; a quick look is
``--runs 3 --transits 2 --minutes 2``).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from benchmarks.calibration_cases import DVL, asking, knowing_dvl, wrong_dvl
from benchmarks.report import Report
from benchmarks.speed import table
from factors.similarity import GaussianKernel, Kernel, LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation import chi2_interval, evaluate, mean_with_interval, paired_ratio
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import (
    CALM,
    DepthProfile,
    GnssSettings,
    Grade,
    OutlierKind,
    Outliers,
    SimulationConfig,
    StartSigmas,
    SurveyRoute,
    TransitRoute,
    scenario_config,
    simulate,
)
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother

RESULTS = Path(__file__).resolve().parent / "results"
LABELS = (
    "dvl_scale_error",
    *(f"dvl_mounting_{axis}_deg" for axis in "xyz"),
    *(f"dvl_lever_arm_{axis}_m" for axis in "xyz"),
    "dvl_time_offset_s",
)
TRUTH: Array = np.concatenate(list(DVL.values()))
"""In the order of the labels, SI."""


@dataclass(frozen=True, slots=True)
class Run:
    """One mission, calibrated."""

    error: Array
    """(8,) in posterior sigmas"""
    ratio: Array
    """(8,) posterior over prior sigma"""
    nees: float
    """Of all eight together"""
    rms_m: float
    """Horizontal, against the truth"""
    rms_known_m: float
    """The same of the run that is told what is wrong; NaN where there was none"""
    status: str


def smoothed(mission: Mission, kernel: Kernel) -> Estimate:
    """Return the batch estimate."""
    return SsmSmoother(SmootherConfig(kernel=kernel)).solve(build_problem(mission))


def rms_each_second(estimate: Estimate, reference: Reference) -> float:
    """Return the horizontal rms error, m; each second counts the same wherever keyframes are."""
    errors = evaluate(estimate.trajectory, reference).errors
    at_s = np.arange(np.ceil(errors.time_s[0]), errors.time_s[-1])
    east, north = (np.interp(at_s, errors.time_s, axis) for axis in errors.position_enu.T[:2])
    return float(np.sqrt(np.mean(east**2 + north**2)))


def judged(estimate: Estimate, mission: Mission, *, known: Estimate | None) -> Run:
    """Compare a calibrated estimate with what is true."""
    calibration, reference = estimate.calibration, mission.reference
    assert calibration is not None
    assert reference is not None
    at = {value.label: i for i, value in enumerate(calibration.values)}
    order = [at[label] for label in LABELS]
    values = [calibration.values[i] for i in order]
    error = np.array([value.value for value in values]) - TRUTH
    covariance = calibration.covariance[np.ix_(order, order)]
    sigma = np.array([value.sigma for value in values])
    return Run(
        error=error / sigma,
        ratio=sigma / [value.prior_sigma for value in values],
        nees=float(error @ np.linalg.solve(covariance, error)),
        rms_m=rms_each_second(estimate, reference),
        rms_known_m=np.nan if known is None else rms_each_second(known, reference),
        status=estimate.status.name,
    )


def turns(seed: int, kernel: Kernel, outlier_rate: float, *, duration_s: float = 400.0) -> Run:
    """Calibrate on survey lines that begin at the surface with GNSS and go down to 15 m."""
    down = DepthProfile(0.3, 15.0, mid_s=0.6 * duration_s, tau_s=15.0)
    config = SimulationConfig(
        route=SurveyRoute(line_m=60.0, depth=down),
        duration_s=duration_s,
        imu_rate_hz=50.0,
        seed=seed,
        grade=Grade.TACTICAL,
        dvl=wrong_dvl(),
        gnss=GnssSettings(),
        outliers=Outliers(OutlierKind.SPARSE, rate=outlier_rate) if outlier_rate else Outliers(),
    )
    mission = simulate(config).mission
    known = smoothed(knowing_dvl(mission), kernel)
    return judged(smoothed(asking(mission, DVL), kernel), mission, known=known)


def transit(seed: int, *, with_gnss: bool, duration_s: float = 600.0) -> Run:
    """Calibrate on a straight run in a calm; its speed at the start is known to 0.5 m/s."""
    depth_m = 0.3 if with_gnss else 20.0
    config = SimulationConfig(
        route=TransitRoute(speed=1.5, depth=DepthProfile(depth_m, depth_m)),
        waves=CALM,
        duration_s=duration_s,
        imu_rate_hz=50.0,
        seed=seed,
        grade=Grade.TACTICAL,
        start_sigmas=StartSigmas(0.3, 0.5, np.radians(0.1), np.radians(0.5)),
        dvl=wrong_dvl(),
        gnss=GnssSettings() if with_gnss else None,
    )
    mission = simulate(config).mission
    return judged(smoothed(asking(mission, DVL), LogKernel()), mission, known=None)


def time_of(mission: Mission) -> tuple[float, int]:
    """Return processor seconds of building and solving, and the passes."""
    begin = time.process_time()
    estimate = SsmSmoother().solve(build_problem(mission))
    return time.process_time() - begin, len(estimate.iterations)


def times(minutes: float, repeats: int) -> tuple[Array, Array]:
    """Return seconds (repeats, 2) and passes without and with calibration, in turn."""
    config = scenario_config(
        "survey",
        grade=Grade.NAVIGATION,
        seed=0,
        duration_s=60.0 * minutes,
        imu_rate_hz=100.0,
        outliers=Outliers(OutlierKind.SPARSE, rate=0.1),
    )
    mission = simulate(config).mission
    pairs = [[time_of(mission), time_of(asking(mission))] for _ in range(repeats)]
    found = np.array(pairs, dtype=np.float64)
    return found[:, :, 0], found[:, :, 1]


def turns_lines(name: str, runs: Sequence[Run]) -> list[str]:
    """Return what the runs with turns show: parameters, all together, and the track."""
    inside = np.array([np.abs(run.error) < 3.0 for run in runs])
    nees = np.array([run.nees for run in runs])
    expected = chi2_interval(len(LABELS), len(runs))
    error = np.array([run.error for run in runs])
    rms, known = (np.array([getattr(run, f) for run in runs]) for f in ("rms_m", "rms_known_m"))
    ratio = paired_ratio(rms, known, rng=np.random.default_rng(0))
    rows = [
        [
            label,
            f"{np.mean([run.ratio[i] for run in runs]):.4f}",
            f"{100.0 * inside[:, i].mean():.1f}",
            f"{error[:, i].mean():+.2f}",
            f"{error[:, i].std():.2f}",
            f"{np.abs(error[:, i]).max():.2f}",
        ]
        for i, label in enumerate(LABELS)
    ]
    settled = sum(run.status == "CONVERGED" for run in runs)
    return [
        f"## Turns and GNSS at the surface: {name}",
        "",
        f"Seeds 0 to {len(runs) - 1}, {settled} of {len(runs)} converged.",
        "",
        *table(
            ["", "posterior / prior sigma", "within 3 sigma, %", "mean error", "sd", "largest"],
            rows,
        ),
        "",
        f"- within 3 sigma, all pooled: {100.0 * inside.mean():.2f} % of {inside.size}",
        f"- NEES of the eight / 8: {nees.mean() / len(LABELS):.3f}, 95 % interval of a consistent "
        f"one {expected.low:.3f} to {expected.high:.3f}",
        f"- horizontal rms, m: calibrated {_mean(rms)}, told {_mean(known)}; "
        f"ratio {ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f})",
        "",
    ]


def transit_lines(name: str, runs: Sequence[Run]) -> list[str]:
    """Return what the straight runs leave open."""
    rows = []
    for i, label in enumerate(LABELS):
        ratio = float(np.mean([run.ratio[i] for run in runs]))
        colour = "green" if ratio < 0.3 else "amber" if ratio < 0.8 else "red"
        largest = max(abs(float(run.error[i])) for run in runs)
        rows.append([label, f"{ratio:.3f}", colour, f"{largest:.2f}"])
    inside = np.array([np.abs(run.error) < 3.0 for run in runs])
    header = ["", "posterior / prior sigma", "colour", "largest error, posterior sigmas"]
    settled = sum(run.status == "CONVERGED" for run in runs)
    return [
        f"## Straight run, {name}",
        "",
        f"Seeds 0 to {len(runs) - 1}, {settled} of {len(runs)} converged; "
        f"{100.0 * inside.mean():.1f} % of {inside.size} values within 3 sigma.",
        "",
        *table(header, rows),
        "",
    ]


def time_lines(minutes: float, seconds: Array, passes: Array) -> list[str]:
    """Return the ratio of times."""
    off, on = seconds.min(axis=0)
    pairs = seconds[:, 1] / seconds[:, 0]
    ratios = ", ".join(f"{ratio:.3f}" for ratio in pairs)
    return [
        f"## Time, {minutes:g} min",
        "",
        "Processor time of `build_problem` and `solve`, default kernel, 100 Hz inertial data, 1 Hz "
        "DVL, 10 % outliers; with calibration of mounting, scale, lever arm, clock and depth.",
        "",
        *table(
            ["", "fastest, s", "passes"],
            [
                ["without", f"{off:.2f}", f"{passes[0, 0]:.0f}"],
                ["with calibration", f"{on:.2f}", f"{passes[0, 1]:.0f}"],
            ],
        ),
        "",
        f"**{np.median(pairs):.3f} times**, the median of pairs one after the other ({ratios}); "
        f"fastest to fastest {on / off:.3f}",
        "",
    ]


def _mean(samples: Array) -> str:
    interval = mean_with_interval(samples)
    return f"{interval.value:.3f} ({interval.low:.3f} to {interval.high:.3f})"


LEGEND = """\
The DVL is off by 1, 0.5 and 2 degrees in roll, pitch and yaw, reads 97 %, sits 0.5 m from where it
is stated (0.3 m forward, 0.4 m starboard), and is stamped 80 ms late. Prior sigmas: 2 degrees each,
3 %, 0.5 m each, 0.1 s. Tactical grade, 50 Hz inertial data, 1 Hz DVL. Errors are in posterior
sigmas; intervals are of 95 %. "Told" is the run that has all this stated.
"""


def parse_args(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the settings given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=100, help="missions with turns, of each kind")
    parser.add_argument("--transits", type=int, default=20, help="straight runs, of each kind")
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the timed mission")
    parser.add_argument("--repeats", type=int, default=7, help="of the timed mission")
    parser.add_argument("--out", type=Path, default=Path("out/calibration"))
    parser.add_argument("--keep", action="store_true", help="write benchmarks/results too")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Run everything and write the report."""
    args = parse_args(argv)
    page = Report("calibration", "Calibration", argv)
    lines = [*page.head(), LEGEND]
    for name, kernel, rate in (
        ("clean beams, gaussian kernel", GaussianKernel(), 0.0),
        ("10 % of the pings with an outlier, log kernel", LogKernel(), 0.1),
    ):
        _note(name)
        lines += turns_lines(name, [turns(seed, kernel, rate) for seed in range(args.runs)])
    for name, with_gnss in (("GNSS throughout", True), ("no GNSS", False)):
        _note(name)
        runs = [transit(seed, with_gnss=with_gnss) for seed in range(args.transits)]
        lines += transit_lines(f"{name}, 10 min, calm", runs)
    _note("time")
    lines += time_lines(args.minutes, *times(args.minutes, args.repeats))
    page.write("\n".join(lines), (args.out, RESULTS)[: 1 + args.keep])
    return 0


def _note(text: str) -> None:
    print(f"{text} ...", file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
