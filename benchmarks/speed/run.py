"""How fast the smoother is, beside the plain GTSAM script (a) and the native floor (b).

``python -m benchmarks.speed.run --keep``  (one hour takes some ten minutes, nearly all of it (a));
``--minutes 2 --lengths`` is a quick look, ``--skip-plain`` leaves (a) out.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks.processes import in_fresh_process
from benchmarks.report import Option, Report, note, table
from benchmarks.speed.tasks import (
    PlainStart,
    Timing,
    time_floor,
    time_ours,
    time_plain,
    write_mission,
)

OURS, PLAIN, FLOOR = "ours", "(a) plain GTSAM script", "(b) native floor"


class Bench:
    """Runs tasks on simulated missions, each of which is made once."""

    def __init__(self, folder: Path, args: argparse.Namespace) -> None:
        self.folder, self.args = folder, args

    def mission(self, minutes: float) -> Path:
        """Return the file of the mission of this length."""
        path = self.folder / f"{minutes:g}.pickle"
        if not path.exists():
            note(f"simulating {minutes:g} min ...")
            in_fresh_process(write_mission, path, minutes, self.args.seed)
        return path

    def compare(self) -> dict[str, Timing]:
        """Time ours, (a) and (b) on the same mission."""
        args = self.args
        timings = {OURS: self.ours(args.minutes)}
        path = self.mission(args.minutes)
        note(f"{FLOOR} ...")
        timings[FLOOR] = self._fastest(time_floor, path, timings[OURS].n_iterations)
        if not args.skip_plain:
            note(f"{PLAIN} ...")
            start = PlainStart[args.plain_start]
            timings[PLAIN] = in_fresh_process(time_plain, path, start, args.plain_tolerance)
        return timings

    def ours(self, minutes: float) -> Timing:
        """Time ours on a mission of this length."""
        path = self.mission(minutes)
        note(f"{OURS}, {minutes:g} min ...")
        return self._fastest(time_ours, path)

    def _fastest(self, task: Callable[..., Timing], *args: object) -> Timing:
        """Return the run that others on the machine disturbed least."""
        runs = [in_fresh_process(task, *args) for _ in range(self.args.repeats)]
        return min(runs, key=lambda timing: timing.total)


def comparison_lines(minutes: float, timings: dict[str, Timing]) -> list[str]:
    """Return the section that compares ours with (a) and (b)."""
    ours = timings[OURS]
    header = ["", "total, s", "ours / this", "passes", "rms, m", "peak, MB", "outcome"]
    rows = [
        [
            name,
            f"{t.total:.2f}",
            f"{ours.total / t.total:.3g}",
            str(t.n_iterations),
            "–" if math.isnan(t.rms_horizontal_m) else f"{t.rms_horizontal_m:.2f}",
            f"{t.peak_mb:.0f}",
            t.status,
        ]
        for name, t in timings.items()
    ]
    lines = [f"## {minutes:g} min, 100 Hz inertial, 1 Hz DVL, 10 % outliers", ""]
    lines += table(header, rows)
    lines += ["", f"**{verdict(timings)}**", ""]
    for name, timing in timings.items():
        lines += [f"### {name}", "", *parts_table(timing), ""]
    return lines


def verdict(timings: dict[str, Timing]) -> str:
    """Return the two ratios in a sentence."""
    ours = timings[OURS].total
    text = f"{ours / timings[FLOOR].total:.2f} times the floor (b)"
    if PLAIN in timings:
        gain = timings[PLAIN].total / ours
        text = f"{gain:.{0 if gain >= 10.0 else 1}f} times faster than (a); {text}"
    return text


def parts_table(timing: Timing) -> list[str]:
    """Return the wall time of every part, and of each of its passes."""
    rows = [
        [name, f"{seconds:.3f}", f"{1e3 * seconds / max(timing.n_iterations, 1):.1f}"]
        for name, seconds in timing.parts.items()
    ]
    return table(["part", "s", "ms a pass"], rows)


def lengths_lines(timings: dict[float, Timing]) -> list[str]:
    """Return the section on length."""
    header = ["min", "keyframes", "passes", "total, s", "s per hour", "s per pass and hour"]
    header += ["build, s", "first pass, s", "peak, MB", "of it mission, MB", "outcome"]
    rows = []
    for minutes, t in timings.items():
        hours = minutes / 60.0
        build, first = t.parts["build: merge and preintegrate"], t.parts["first pass"]
        loop = t.total - build - first
        numbers = [t.total, t.total / hours, loop / t.n_iterations / hours, build, first]
        rows.append(
            [f"{minutes:g}", str(t.n_keyframes), str(t.n_iterations)]
            + [f"{x:.2f}" for x in numbers]
            + [f"{t.peak_mb:.0f}", f"{t.idle_mb:.0f}", t.status]
        )
    return ["## Length", "", *table(header, rows), ""]


LEGEND = """\
Each row is a process of its own, the fastest of a few; (a) runs once. Ours: `build_problem` and
`SsmSmoother().solve`, default kernel. (a): default preintegration of the raw samples, one Python
`CustomFactor` for every beam with Cauchy noise, Levenberg-Marquardt with MULTIFRONTAL_QR and
GTSAM's other defaults. Unless the command says otherwise, (a) is given the first values of ours,
in no time, and stops at GTSAM's own tolerance of 1e-5, before it has settled as far as ours. (b):
preintegration, and as many passes of `linearize`, `eliminateMultifrontal` by QR and `optimize` as
ours took, with a built-in one-row C++ factor on pose and velocity for every beam; no weights, no
marginals, no update. Missions are simulated before and read from a file. Peak: the largest resident
size of the process, GTSAM and SciPy included.
"""


def main() -> None:
    """Run the benchmark and write its report."""
    starts = [start.name for start in PlainStart]
    report = Report(
        *(__file__, "Speed", __doc__),
        Option("--minutes", 60.0, "length of the comparison"),
        Option("--lengths", [10.0, 60.0, 240.0], "minutes"),
        Option("--repeats", 3, "fastest of so many runs counts, for all but (a)"),
        Option("--skip-plain", False, "leave (a) out"),
        Option("--plain-tolerance", float, "of (a); about 1e-9 settles as far as ours does"),
        Option("--plain-start", "FIRST_PASS", "of (a)", starts),
        Option("--seed", 0, "of the missions"),
    )
    args = report.args
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), args)
        timings = bench.compare()
        by_length = {minutes: bench.ours(minutes) for minutes in args.lengths}
    lines = [LEGEND, *comparison_lines(args.minutes, timings)]
    report.write([*lines, *(lengths_lines(by_length) if by_length else [])])


if __name__ == "__main__":
    main()
