"""The live estimator on one stream, beside GTSAM's own fixed-lag smoothers; then lags and logs.

``python benchmarks/online.py --keep`` streams two hours; a quick look is ``--hours 0.1
--their-minutes 2 --lag-minutes 2 --seeds 2 --parts stream``.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.online_report import (
    lag_lines,
    log_lines,
    setting_lines,
    stream_lines,
    verdict_lines,
)
from benchmarks.online_tasks import (
    CONFIGS,
    SettingRow,
    StreamRun,
    log_rows,
    offline,
    settings_rows,
    stream_ours,
    stream_theirs,
)
from benchmarks.online_theirs import Kind, TheirConfig
from benchmarks.report import machine
from benchmarks.speed import in_fresh_process
from ssm_graph.live.estimator import ONLINE

RESULTS = Path(__file__).resolve().parent / "results"
DATA = Path(__file__).resolve().parents[1] / "../shared/data"
LOGS = ("log_auto_square_2025-05-07_14_55_13.mcap", "log_grid_01_05_scaled.mcap")
PARTS = ("stream", "lags", "settings", "logs")
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


def parse_args(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the settings given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--hours", type=float, default=2.0, help="of ours on the long stream")
    parser.add_argument("--their-minutes", type=float, default=10.0, help="of the comparison")
    parser.add_argument("--their-wall", type=float, default=600.0, help="s, at most for each")
    parser.add_argument("--dvl-hz", type=float, default=5.0)
    parser.add_argument("--lags", default="0,5,30,120", help="s")
    parser.add_argument("--lag-minutes", type=float, default=10.0)
    parser.add_argument("--seeds", type=int, default=6, help="of the settings, each grade")
    parser.add_argument("--duration", type=float, default=300.0, help="of the settings, s")
    parser.add_argument("--seed", type=int, default=0, help="of the streams")
    parser.add_argument("--jobs", type=int, default=2, help="of the settings only")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real logs")
    parser.add_argument("--out", type=Path, default=Path("out/online"))
    parser.add_argument(
        "--keep", action="store_true", help="write benchmarks/results/online_PART.md"
    )
    return parser.parse_args(argv)


def note(text: str) -> None:
    """Say on the way what is done next."""
    print(f"{text} ...", file=sys.stderr, flush=True)


def run_streams(args: argparse.Namespace) -> list[str]:
    """Compare on the short stream, then follow ours over the long one."""
    short_s, stream = 60.0 * args.their_minutes, (args.seed, args.dvl_hz)
    note(f"ours, {args.their_minutes:g} min")
    short = [in_fresh_process(stream_ours, short_s, *stream, ONLINE)]
    for config in THEIRS:
        note(str(config))
        short.append(in_fresh_process(stream_theirs, short_s, *stream, config, args.their_wall))
    note(f"ours, {args.hours:g} h")
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
    runs: list[StreamRun] = []
    for lag in lags_of(args):
        note(f"lag {lag:g} s")
        config = replace(ONLINE, lag_s=lag)
        runs.append(in_fresh_process(stream_ours, duration_s, *stream, config))
    note("filters and batch")
    others = in_fresh_process(offline, duration_s, *stream)
    title = f"## Lags, the first {args.lag_minutes:g} min of the stream"
    return [title, "", *lag_lines(runs, others)]


def run_settings(args: argparse.Namespace) -> list[str]:
    """Run all settings on several missions of both grades."""
    rows: list[SettingRow] = []
    cases = list(product(GRADES, range(args.seeds)))
    with ProcessPoolExecutor(args.jobs, multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(settings_rows, *case, args.duration) for case in cases]
        for number, future in enumerate(futures, start=1):
            rows += future.result()
            note(f"settings: {number} of {len(cases)} missions done")
    title = f"## Settings, newest states, {args.seeds} missions of {args.duration:g} s, 1 Hz DVL"
    return [title, "", *setting_lines(rows, GRADES, list(CONFIGS))]


def run_logs(args: argparse.Namespace) -> list[str]:
    """Run the real logs, with several lags."""
    rows = []
    configs = [replace(ONLINE, lag_s=lag) for lag in lags_of(args)]
    for name in LOGS:
        note(name)
        rows += in_fresh_process(log_rows, args.data / "blueye_x3" / name, configs)
    return ["## Real logs, GNSS withheld after 70 s", "", *log_lines(rows)]


TITLES = {
    "stream": "latency, beside GTSAM's own fixed-lag smoothers",
    "lags": "lags",
    "settings": "settings",
    "logs": "real logs",
}
SECTIONS: dict[str, Callable[[argparse.Namespace], list[str]]] = {
    "stream": run_streams,
    "lags": run_lags,
    "settings": run_settings,
    "logs": run_logs,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark and write a report of each part."""
    args = parse_args(argv)
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # for the processes that are begun from here
    command = shlex.join(["python", "benchmarks/online.py", *(argv or sys.argv[1:])])
    folders = [args.out, *([RESULTS] if args.keep else [])]
    for part in (part for part in PARTS if part in args.parts):
        load = os.getloadavg()[0]
        body = SECTIONS[part](args)
        about = f"{machine()}; load average before {load:.1f}, after {os.getloadavg()[0]:.1f}."
        title = f"# The live estimator: {TITLES[part]}"
        text = "\n".join([title, "", f"    {command}", "", about, "", *body])
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"online_{part}.md").write_text(text, encoding="utf-8")
        print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
