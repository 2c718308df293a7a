"""The live estimator on one stream, beside GTSAM's own fixed-lag smoothers; then lags and logs.

``python -m benchmarks.online.run --keep`` streams two hours; a quick look is ``--hours 0.1
--their-minutes 2 --lag-minutes 2 --seeds 2 --parts stream``.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from itertools import product

from benchmarks.online.report import (
    lag_lines,
    log_lines,
    setting_lines,
    stream_lines,
    verdict_lines,
)
from benchmarks.online.tasks import (
    CONFIGS,
    log_rows,
    offline,
    settings_rows,
    stream_ours,
    stream_theirs,
)
from benchmarks.online.theirs import Kind, TheirConfig
from benchmarks.processes import in_fresh_process, side_by_side
from benchmarks.report import ROOT, Option, Report, note
from ssm_graph.live.estimator import ONLINE

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


def lags_of(args: argparse.Namespace) -> list[float]:
    """Return the lags asked for, s."""
    return [float(lag) for lag in args.lags.split(",")]


def run_lags(args: argparse.Namespace) -> list[str]:
    """Run ours with several lags, and what goes offline."""
    duration_s, stream = 60.0 * args.lag_minutes, (args.seed, args.dvl_hz)
    runs = []
    for lag in lags_of(args):
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
    configs = [replace(ONLINE, lag_s=lag) for lag in lags_of(args)]
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
