"""``ssm-graph compare``: many missions by many methods, and what came of it."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Final

from rich.console import Console

from ssm_graph.cli.options import number_option, table_format_option

FOLDER_METHODS: Final = ("smoother-log", "smoother-gaussian")

DESCRIPTION: Final = """\
Run methods on the missions of a study file, or on recorded missions, and compare them.

Finished runs are kept: interrupted and started again, only what is missing is run. A trial is
drawn from its number alone, so that neither --jobs nor --scheduler change any result.

files in DIR:
  runs.jsonl      finished runs, one a line, as they come; from here an interrupted study goes on
  series/*.npz    errors every 10 s of every run, for the figures
  table.csv       one row for every mission and method (or table.parquet): errors, consistency,
                  weights, time
  summary.md      means with intervals, differences between methods, for reading
  summary.tex     the same as LaTeX tables
  figures/*.png   errors over time, consistency, and one example mission

study file (TOML):
  name = "headline"                  # also baseline = "METHOD": others are compared with it
  scenario = "survey"                # as in ssm-graph simulate
  duration_s = 600.0
  grades = ["navigation", "tactical"]
  first_seed = 0
  [[methods]]                        # any number of them
  names = ["smoother-log", "oracle"]
  seeds = 30
  [[cases]]                          # every kind with every rate and every size
  kinds = ["sparse", "burst"]
  rates = [0.05, 0.10]
  sizes_m_per_s = [[0.5, 3.0]]       # if left out: that of the kind
  [[cases]]                          # programmed faults; duration_s may differ
  name = "fault40"
  duration_s = 1200.0
  dropout_rate = 0.0
  faults = [{beams = [0], turn_by_seed = true, start_s = 600.0, length_s = 40.0,
             offset_m_per_s = 1.0}]  # on one line; beams from 0, turned: plus seed, modulo 4;
                                     # shape = "drift" grows to the offset, "covered" reads low
                                     # by a share that grows to share, "stuck" keeps its speed
                                     # of any sensor, and more shapes: docs/mission-folder.md
  realistic = true                   # instruments err as real ones of the grade
  gnss_windows_s = [[0.0, 1200.0]]   # times with fixes
  losses = [{beams = [3], start_s = 300.0, length_s = 180.0}]
  current = {steady_enu_m_per_s = [0.3, 0.0, 0.0], tide_m_per_s = 0.2, tide_period_s = 44714.0,
             sigma_m_per_s = 0.1, vertical_sigma_m_per_s = 0.01, correlation_s = 21600.0}
  water_track = {noise_m_per_s = 0.01, beams = [0, 1, 2, 3], every = 10}  # pings off the water:
                                     # without bottom lock, and every 10th (0: none) with it

methods: ssm-graph help methods
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "inputs", type=Path, nargs="+", metavar="INPUT", help="a study file, or mission folders"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    parser.add_argument(
        "--methods",
        metavar="A,B,C",
        help="methods instead of those of the study file (default for mission folders: "
        f"{','.join(FOLDER_METHODS)})",
    )
    parser.add_argument(
        "--seeds", type=int, metavar="N", help="this many trials instead of the study file's"
    )
    number_option(parser, "--jobs", "N", "processes", os.cpu_count() or 1, kind=int)
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="do the work on the Dask cluster of this scheduler, for example tcp://HOST:8786; its "
        "workers need this very version, one thread each (dask worker --nthreads 1)",
    )
    parser.add_argument("--fresh", action="store_true", help="throw earlier runs in DIR away")
    parser.add_argument("--no-figures", action="store_true", help="draw no figures")
    table_format_option(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Compare; what it takes is loaded now."""
    from ssm_graph.cli.compare_run import compare

    return compare(arguments, console, errors)
