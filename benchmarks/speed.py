"""How fast the smoother is, beside the plain GTSAM script (a) and the native floor (b).

``python benchmarks/speed.py --keep``  (one hour takes some ten minutes, nearly all of it (a));
``--minutes 2 --lengths`` is a quick look, ``--skip-plain`` leaves (a) out.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.report import Report
from benchmarks.speed_tasks import (
    PlainStart,
    Timing,
    time_floor,
    time_ours,
    time_plain,
    write_mission,
)

RESULTS = Path(__file__).resolve().parent / "results"
OURS, PLAIN, FLOOR = "ours", "(a) plain GTSAM script", "(b) native floor"

T = TypeVar("T")


def parse_args(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the settings given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the comparison")
    parser.add_argument(
        "--lengths", type=float, nargs="*", default=[10.0, 60.0, 240.0], help="minutes"
    )
    parser.add_argument(
        "--repeats", type=int, default=3, help="fastest of so many runs counts, for all but (a)"
    )
    parser.add_argument("--skip-plain", action="store_true", help="leave (a) out")
    parser.add_argument(
        "--plain-tolerance", type=float, help="of (a); about 1e-9 settles as far as ours does"
    )
    parser.add_argument(
        "--plain-start", choices=[x.name for x in PlainStart], default="FIRST_PASS", help="of (a)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/speed"))
    parser.add_argument("--keep", action="store_true", help="write benchmarks/results/speed.md too")
    return parser.parse_args(argv)


def in_fresh_process(task: Callable[..., T], *args: object) -> T:
    """Return what ``task`` returns in a process of its own: peak memory is counted by process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(task, *args).result()


class Bench:
    """Runs tasks on simulated missions, each of which is made once."""

    def __init__(self, folder: Path, *, seed: int, repeats: int) -> None:
        self.folder = folder
        self.seed = seed
        self.repeats = repeats

    def mission(self, minutes: float) -> Path:
        """Return the file of the mission of this length."""
        path = self.folder / f"{minutes:g}.pickle"
        if not path.exists():
            _note(f"simulating {minutes:g} min")
            in_fresh_process(_write, path, minutes, self.seed)
        return path

    def compare(
        self,
        minutes: float,
        *,
        with_plain: bool,
        plain_start: PlainStart,
        plain_tolerance: float | None,
    ) -> dict[str, Timing]:
        """Time ours, (a) and (b) on the same mission."""
        path = self.mission(minutes)
        _note(f"{OURS}, {minutes:g} min")
        timings = {OURS: self._fastest(time_ours, path)}
        _note(FLOOR)
        timings[FLOOR] = self._fastest(time_floor, path, timings[OURS].n_iterations)
        if with_plain:
            _note(PLAIN)
            timings[PLAIN] = in_fresh_process(time_plain, path, plain_start, plain_tolerance)
        return timings

    def lengths(self, lengths: Sequence[float]) -> dict[float, Timing]:
        """Time ours on missions of several lengths, minutes."""
        timings = {}
        for minutes in lengths:
            path = self.mission(minutes)
            _note(f"{OURS}, {minutes:g} min")
            timings[minutes] = self._fastest(time_ours, path)
        return timings

    def _fastest(self, task: Callable[..., Timing], *args: object) -> Timing:
        """Return the run that others on the machine disturbed least."""
        runs = [in_fresh_process(task, *args) for _ in range(self.repeats)]
        return min(runs, key=lambda timing: timing.total)


def _write(path: Path, minutes: float, seed: int) -> None:
    write_mission(path, minutes=minutes, seed=seed)


def _note(text: str) -> None:
    print(f"{text} ...", file=sys.stderr, flush=True)


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


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


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


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark and write its report."""
    args = parse_args(argv)
    page = Report("speed", "Speed", argv)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), seed=args.seed, repeats=args.repeats)
        timings = bench.compare(
            args.minutes,
            with_plain=not args.skip_plain,
            plain_start=PlainStart[args.plain_start],
            plain_tolerance=args.plain_tolerance,
        )
        by_length = bench.lengths(args.lengths)
    lines = [*page.head(), LEGEND]
    lines += comparison_lines(args.minutes, timings)
    if by_length:
        lines += lengths_lines(by_length)
    page.write("\n".join(lines), (args.out, RESULTS)[: 1 + args.keep])
    return 0


if __name__ == "__main__":
    sys.exit(main())
