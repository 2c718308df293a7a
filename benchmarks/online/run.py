"""The live estimator on one stream, beside GTSAM's own fixed-lag smoothers; then lags and logs.

``python -m benchmarks.online.run --keep`` streams two hours; a quick look is ``--hours 0.1
--their-minutes 2 --lag-minutes 2 --seeds 2 --parts stream``.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from benchmarks.online.stream import Accuracy
from benchmarks.online.tasks import (
    CONFIGS,
    LogRow,
    SettingRow,
    StreamRun,
    log_rows,
    offline,
    settings_rows,
    stream_ours,
    stream_theirs,
)
from benchmarks.online.theirs import Kind, TheirConfig
from benchmarks.processes import in_fresh_process, side_by_side
from benchmarks.report import (
    ROOT,
    Option,
    Report,
    interval_text,
    note,
    number_text,
    ratio_text,
    spread_text,
    table,
)
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.statistics import Interval
from ssm_graph.live.estimator import ONLINE

P99_MS = 20.0
MEDIAN_TIMES = 3.0
BLOCK_S = 30.0
"""Latencies of one block depend on each other: whole blocks are drawn"""
ACCURACY = ("velocity", "horizontal", "heading", "nees_position", "nees_velocity", "nees_heading")
ACCURACY_HEADER = ["velocity, mm/s", "horizontal, m", "heading, deg"]
ACCURACY_HEADER += ["NEES position", "NEES velocity", "NEES heading"]


def percentiles_ms(seconds: Array) -> tuple[float, float, float]:
    """Return median, 99th percentile and largest, ms; NaN where nothing was timed."""
    finite = 1e3 * seconds[np.isfinite(seconds)]
    if len(finite) == 0:
        return (np.nan,) * 3
    median, p99, largest = np.percentile(finite, [50.0, 99.0, 100.0]).tolist()
    return median, p99, largest


def growth(
    time_s: Array, latency_s: Array, *, begin_s: float, resamples: int = 2000
) -> Interval | None:
    """Return the median of the last tenth of a run over that of the first, with its interval.

    Both tenths are cut into blocks, and blocks are drawn anew; None for a run too short for that.
    """
    late = time_s >= begin_s
    time_s, latency_s = time_s[late], latency_s[late]
    tenth = (time_s[-1] - time_s[0]) / 10.0 if len(time_s) else 0.0
    if tenth < 2.0 * BLOCK_S:
        return None
    first = _blocks(latency_s[time_s < time_s[0] + tenth], time_s[time_s < time_s[0] + tenth])
    last = _blocks(latency_s[time_s > time_s[-1] - tenth], time_s[time_s > time_s[-1] - tenth])
    rng = np.random.default_rng(0)
    drawn = [_drawn_median(last, rng) / _drawn_median(first, rng) for _ in range(resamples)]
    low, high = np.quantile(drawn, [0.025, 0.975]).tolist()
    value = np.median(np.concatenate(last)) / np.median(np.concatenate(first))
    return Interval(float(value), low, high)


def _blocks(values: Array, time_s: Array) -> list[Array]:
    block = ((time_s - time_s[0]) / BLOCK_S).astype(int)
    return [values[block == i] for i in np.unique(block)]


def _drawn_median(blocks: list[Array], rng: np.random.Generator) -> float:
    chosen = rng.integers(len(blocks), size=len(blocks))
    return float(np.median(np.concatenate([blocks[i] for i in chosen])))


def verdict_lines(short: Sequence[StreamRun], long: StreamRun, *, lag_s: float) -> list[str]:
    """Return what became of the goals, and how latency and memory went over the long run."""
    ours, theirs = short[0], [run for run in short[1:] if len(run.latency_s)]
    median, p99, largest = percentiles_ms(long.latency_s)
    cpu = percentiles_ms(long.cpu_s)
    hours = (long.keyframe_s[-1] - long.keyframe_s[0]) / 3600.0
    grown = growth(long.keyframe_s, long.latency_s, begin_s=2.0 * lag_s)
    told = "too short to tell" if grown is None else interval_text(grown, ".3f")
    begin_mb, end_mb = long.rss_mb
    lines = [
        f"**Over {hours:.2g} h: latency median {median:.1f} ms, 99th percentile {p99:.1f} ms, "
        f"largest {largest:.1f} ms ({_met(p99 < P99_MS)}: 99th percentile below {P99_MS:g} ms); of "
        f"processor time {cpu[0]:.1f}, {cpu[1]:.1f} and {cpu[2]:.1f} ms. "
        f"Median of the last tenth over that of the first: {told}. Resident size {begin_mb:.0f} MB "
        f"with the window full, {end_mb:.0f} MB at the end.**",
        "",
        f"Newest: {_told(long.newest)}. Delayed: {_told(long.delayed)}. {long.remark}.",
        "",
    ]
    if theirs:
        fastest = min(theirs, key=lambda run: percentiles_ms(run.latency_s)[0])
        times = percentiles_ms(ours.latency_s)[0] / percentiles_ms(fastest.latency_s)[0]
        ratio = ours.newest.velocity / fastest.newest.velocity
        across = ours.newest.horizontal / fastest.newest.horizontal
        lines += [
            f"**Fastest of theirs: {fastest.name}. Our median is {times:.2f} times its "
            f"({_met(times <= MEDIAN_TIMES)}: within {MEDIAN_TIMES:g} times); our error is "
            f"{ratio:.2f} times its in velocity and {across:.2f} times in horizontal position "
            f"({_met(max(ratio, across) <= 1.0)}: equal or better).**",
            "",
        ]
    return lines


def _met(is_met: bool) -> str:
    return "met" if is_met else "MISSED"


def _told(x: Accuracy) -> str:
    return (
        f"velocity {x.velocity:.2f} mm/s, horizontal {x.horizontal:.2f} m, heading "
        f"{x.heading:.3f} deg, NEES position {x.nees_position:.2f}, velocity "
        f"{x.nees_velocity:.2f}, heading {x.nees_heading:.2f}"
    )


def stream_lines(runs: Sequence[StreamRun]) -> list[str]:
    """Return the tables of the comparison: the first run is ours."""
    ours = runs[0]
    base = percentiles_ms(ours.latency_s)
    header = ["", "keyframes", "median, ms", "99 %, ms", "largest, ms", "median / ours"]
    header += ["99 % / ours", "processor: median, ms", "99 %, ms", "MB begin", "MB end"]
    header += ["wall, s", "remark"]
    rows = []
    for run in runs:
        ms = percentiles_ms(run.latency_s)
        cells = [run.name, str(len(run.latency_s)), *(f"{x:.1f}" for x in ms)]
        cells += [f"{ms[0] / base[0]:.2f}", f"{ms[1] / base[1]:.2f}"]
        cells += [f"{x:.1f}" for x in percentiles_ms(run.cpu_s)[:2]]
        cells += [f"{x:.0f}" for x in (*run.rss_mb, run.wall_s)]
        rows.append([*cells, run.remark or "–"])
    lines = [*table(header, rows), ""]
    accuracy = [[run.name, *_cells(run.newest)] for run in runs]
    lines += ["Newest states:", "", *table(["", *ACCURACY_HEADER], accuracy), ""]
    parts = [
        [run.name, name, *(number_text(x) for x in percentiles_ms(seconds))]
        for run in runs
        for name, seconds in run.parts_s.items()
    ]
    header = ["", "part", "median, ms", "99 %, ms", "largest, ms"]
    return [*lines, *table(header, parts), ""]


def _cells(x: Accuracy) -> list[str]:
    return [number_text(getattr(x, name)) for name in ACCURACY]


def lag_lines(runs: Sequence[StreamRun], others: Sequence[tuple[str, Accuracy]]) -> list[str]:
    """Return the table of lags."""
    header = ["", "states", *ACCURACY_HEADER, "median, ms", "99 %, ms", "MB at the end"]
    rows = [[name, "filtered", *_cells(x), "–", "–", "–"] for name, x in others[:-1]]
    for run in runs:
        median, p99, _ = percentiles_ms(run.latency_s)
        costs = [f"{median:.1f}", f"{p99:.1f}", f"{run.rss_mb[1]:.0f}"]
        rows.append([run.name, "newest", *_cells(run.newest), *costs])
        rows.append([run.name, "delayed", *_cells(run.delayed), "–", "–", "–"])
    name, x = others[-1]
    rows.append([name, "smoothed", *_cells(x), "–", "–", "–"])
    return [*table(header, rows), ""]


def setting_lines(
    rows: Sequence[SettingRow], grades: Sequence[str], names: Sequence[str]
) -> list[str]:
    """Return means over missions, and ratios to the first setting on the same missions."""
    lines = []
    for grade in grades:
        header = [grade.lower(), *ACCURACY_HEADER, "velocity / first", "horizontal / first"]
        cells = []
        for name in names:
            of, first = (
                [r for r in rows if (r.grade, r.name) == (grade, x)] for x in (name, names[0])
            )
            values, base = (
                {field: [getattr(r.accuracy, field) for r in x] for field in ACCURACY}
                for x in (of, first)
            )
            means = [spread_text(values[field]) for field in ACCURACY]
            ratios = [ratio_text(values[field], base[field]) for field in ACCURACY[:2]]
            ms = float(np.median([r.ms_per_keyframe for r in of]))
            cells.append([name, *means, *ratios, f"{ms:.1f}"])
        lines += [*table([*header, "ms a keyframe"], cells), ""]
    note = "Mean over missions ± half of its 95 % interval (Student's t); ratios with their 95 % "
    return [*lines, note + "bootstrap interval.", ""]


def log_lines(rows: Sequence[LogRow]) -> list[str]:
    """Return the table of the real logs."""
    header = ["log", "", "horizontal rms, m", "median, m", "compared"]
    cells = []
    for row in rows:
        numbers = [row.horizontal, row.median, row.n_fixes]
        cells.append([row.log[:16], row.name, *map(number_text, numbers), row.remark or "–"])
    return [*table([*header, "remark"], cells), ""]


DATA = ROOT.parent / "shared" / "data"
LOGS = ("log_auto_square_2025-05-07_14_55_13.mcap", "log_grid_01_05_scaled.mcap")
GRADES = ("NAVIGATION", "TACTICAL")
THEIRS = (
    TheirConfig(),
    TheirConfig(relinearize_skip=1),
    TheirConfig(relinearize_threshold=0.03, relinearize_skip=1),
    TheirConfig(relinearize_threshold=0.01, relinearize_skip=1),
    TheirConfig(relinearize_skip=1, extra_updates=1),
    TheirConfig(Kind.BATCH, max_iterations=2),
    TheirConfig(Kind.BATCH),
)

LEGEND = """\
Scenario `survey`, navigation grade: 100 Hz inertial, depth 2 Hz, sparse outliers in 20 % of the
pings, no GNSS; lag 30 s; one BLAS thread; each row is a process of its own, one after the other.

Ours: `FixedLagSmoother` with `ONLINE`; messages are pushed one by one, and the newest state with
its sigmas is asked for at 20 Hz. Latency of a keyframe: what the `push` cost that made it, from the
message in to the smoothed window out; asking for the newest state is listed by itself. Theirs: the
same keyframes, made by the same code from the same messages (its time is part of theirs too), with
`GalileanCombinedImuFactor`, a `CustomFactor` a beam with Cauchy noise (2.3849), depth along the
vertical, the same prior; QR, `findUnusedFactorSlots`, one stamp for X, V, B of an epoch. Their
latency ends with the newest state and, where they can give it, the marginal covariances of its
three variables; `BatchFixedLagSmoother` has none to give. Errors are those of the newest states
from the first ping on: ours at the sample that completed the keyframe, 0.05 s after it, theirs at
the keyframe. NEES: mean square of errors in their own sigmas, over epochs and axes, 1 is expected;
of one stream, whose epochs depend on each other. Theirs is what all of its settings that were
tried gave; GTSAM's defaults are threshold 0.1, skip 10, and 100 iterations.
"""


def run_streams(args: argparse.Namespace) -> list[str]:
    """Compare on the short stream, then follow ours over the long one."""
    short_s, stream = 60.0 * args.their_minutes, (args.seed, args.dvl_hz)
    note(f"ours, {args.their_minutes:g} min ...")
    short = [in_fresh_process(stream_ours, short_s, *stream, ONLINE)]
    for config in THEIRS:
        note(f"{config} ...")
        short.append(in_fresh_process(stream_theirs, short_s, *stream, config, args.their_wall))
    note(f"ours, {args.hours:g} h ...")
    long = in_fresh_process(stream_ours, 3600.0 * args.hours, *stream, ONLINE)
    lines = [*verdict_lines(short, long, lag_s=ONLINE.lag_s), LEGEND]
    lines += [f"## {args.their_minutes:g} min, {args.dvl_hz:g} Hz DVL", ""]
    return [*lines, *stream_lines(short)]


def run_lags(args: argparse.Namespace) -> list[str]:
    """Run ours with several lags, and what goes offline."""
    duration_s, stream = 60.0 * args.lag_minutes, (args.seed, args.dvl_hz)
    runs = []
    for lag in map(float, args.lags.split(",")):
        note(f"lag {lag:g} s ...")
        config = replace(ONLINE, lag_s=lag)
        runs.append(in_fresh_process(stream_ours, duration_s, *stream, config))
    note("filters and batch ...")
    others = in_fresh_process(offline, duration_s, *stream)
    title = f"## Lags, the first {args.lag_minutes:g} min of the stream"
    return [title, "", *lag_lines(runs, others)]


def run_settings(args: argparse.Namespace) -> list[str]:
    """Run all settings on several missions of both grades."""
    cases = [(*case, args.duration) for case in product(GRADES, range(args.seeds))]
    rows = [row for rows in side_by_side(settings_rows, cases, args.jobs) for row in rows]
    title = f"## Settings, newest states, {args.seeds} missions of {args.duration:g} s, 1 Hz DVL"
    return [title, "", *setting_lines(rows, GRADES, list(CONFIGS))]


def run_logs(args: argparse.Namespace) -> list[str]:
    """Run the real logs, with several lags."""
    rows = []
    configs = [replace(ONLINE, lag_s=lag) for lag in map(float, args.lags.split(","))]
    for name in LOGS:
        note(f"{name} ...")
        rows += in_fresh_process(log_rows, args.data / "blueye_x3" / name, configs)
    return ["## Real logs, GNSS withheld after 70 s", "", *log_lines(rows)]


PARTS: dict[str, tuple[str, Callable[[argparse.Namespace], list[str]]]] = {
    "stream": ("latency, beside GTSAM's own fixed-lag smoothers", run_streams),
    "lags": ("lags", run_lags),
    "settings": ("settings", run_settings),
    "logs": ("real logs", run_logs),
}


def main() -> None:
    """Run the benchmark and write a report of each part."""
    report = Report(
        *(__file__, "The live estimator", __doc__),
        Option("--hours", 2.0, "of ours on the long stream"),
        Option("--their-minutes", 10.0, "of the comparison"),
        Option("--their-wall", 600.0, "s, at most for each"),
        Option("--dvl-hz", 5.0, "pings a second"),
        Option("--lags", "0,5,30,120", "s"),
        Option("--lag-minutes", 10.0, "of the comparison of lags"),
        Option("--seeds", 6, "of the settings, each grade"),
        Option("--duration", 300.0, "of the settings, s"),
        Option("--seed", 0, "of the streams"),
        Option("--jobs", 2, "of the settings only"),
        Option("--parts", list(PARTS), "a page each", PARTS),
        Option("--data", DATA, "folder of the real logs"),
    )
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # for the processes that are begun from here
    for part, (title, lines_of) in PARTS.items():
        if part in report.args.parts:
            report.write(lines_of(report.args), part=part, of=title)


if __name__ == "__main__":
    main()
