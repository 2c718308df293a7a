"""Whether calibration finds what is wrong, invents nothing and costs little.

``python -m benchmarks.science.calibration --keep`` (some ten minutes on one core; a quick look is
``--runs 3 --transits 2 --minutes 2``).
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from benchmarks.missions import survey
from benchmarks.report import Option, Report, mean_text, note, ratio_text, table
from factors.similarity import GaussianKernel, LogKernel
from ssm_graph import Mission, SsmSmoother, build_problem
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.statistics import chi2_interval
from ssm_graph.simulation import Grade
from tests.calibration_cases import asking
from tests.calibration_runs import LABELS, Run, transit, turns


def time_of(mission: Mission) -> tuple[float, int]:
    """Return processor seconds of building and solving, and the passes."""
    begin = time.process_time()
    estimate = SsmSmoother().solve(build_problem(mission))
    return time.process_time() - begin, len(estimate.iterations)


def times(minutes: float, repeats: int) -> tuple[Array, Array]:
    """Return seconds (repeats, 2) and passes without and with calibration, in turn."""
    mission = survey(60.0 * minutes, Grade.NAVIGATION, seed=0).mission
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
        f"- horizontal rms, m: calibrated {mean_text(rms, '.3f')}, told "
        f"{mean_text(known, '.3f')}; ratio {ratio_text(rms, known)}",
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
    names = ("without", "with calibration")
    rows = [
        [x, f"{s:.2f}", f"{n:.0f}"] for x, s, n in zip(names, (off, on), passes[0], strict=True)
    ]
    pairs = seconds[:, 1] / seconds[:, 0]
    ratios = ", ".join(f"{ratio:.3f}" for ratio in pairs)
    return [
        f"## Time, {minutes:g} min",
        "",
        "Processor time of `build_problem` and `solve`, default kernel, 100 Hz inertial data, 1 Hz "
        "DVL, 10 % outliers; with calibration of mounting, scale, lever arm, clock and depth.",
        "",
        *table(["", "fastest, s", "passes"], rows),
        "",
        f"**{np.median(pairs):.3f} times**, the median of pairs one after the other ({ratios}); "
        f"fastest to fastest {on / off:.3f}",
        "",
    ]


LEGEND = """\
The DVL is off by 1, 0.5 and 2 degrees in roll, pitch and yaw, reads 97 %, sits 0.5 m from where it
is stated (0.3 m forward, 0.4 m starboard), and is stamped 80 ms late. Prior sigmas: 2 degrees each,
3 %, 0.5 m each, 0.1 s. Tactical grade, 50 Hz inertial data, 1 Hz DVL. Errors are in posterior
sigmas; intervals are of 95 %. "Told" is the run that has all this stated.
"""


def main() -> None:
    """Run everything and write the report."""
    report = Report(
        *(__file__, "Calibration", __doc__),
        Option("--runs", 100, "missions with turns, of each kind"),
        Option("--transits", 20, "straight runs, of each kind"),
        Option("--minutes", 60.0, "length of the timed mission"),
        Option("--repeats", 7, "of the timed mission"),
    )
    args = report.args
    lines = [LEGEND]
    for name, kernel, rate in (
        ("clean beams, gaussian kernel", GaussianKernel(), 0.0),
        ("10 % of the pings with an outlier, log kernel", LogKernel(), 0.1),
    ):
        note(f"{name} ...")
        lines += turns_lines(name, [turns(seed, kernel, rate) for seed in range(args.runs)])
    for name, with_gnss in (("GNSS throughout", True), ("no GNSS", False)):
        note(f"{name} ...")
        runs = [transit(seed, with_gnss=with_gnss) for seed in range(args.transits)]
        lines += transit_lines(f"{name}, 10 min, calm", runs)
    note("time ...")
    report.write([*lines, *time_lines(args.minutes, *times(args.minutes, args.repeats))])


if __name__ == "__main__":
    main()
