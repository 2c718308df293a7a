"""``ssm-graph locate-study``: many simulated drives over maps, by several methods."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Final

from rich.console import Console

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say
from ssm_graph.systems.road_map.cases import CASES, METHODS

DESCRIPTION: Final = """\
Simulate drives over maps and Argoverse 2 logs, locate them, and tell how often the lane is right,
declared, and declared wrongly. Finished drives are kept in DIR: interrupted and started again, only
what is missing is done. Seeds below 100 were used to choose settings.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("maps", type=Path, nargs="+", metavar="MAP", help="maps or log folders")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    parser.add_argument("--case", default="plain", help=f"{', '.join(CASES)} (default: plain)")
    parser.add_argument("--methods", default="annealed", metavar="A,B", help=", ".join(METHODS))
    number_option(parser, "--first-seed", "N", "the first drive", 1000, kind=int)
    number_option(parser, "--seeds", "N", "drives on each map", 200, kind=int)
    number_option(parser, "--jobs", "N", "processes", os.cpu_count() or 1, kind=int)
    parser.add_argument("--fresh", action="store_true", help="throw earlier drives in DIR away")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Simulate, locate, and tell how often it is right."""
    from ssm_graph.study.ledger import ERROR, Ledger, run_trials
    from ssm_graph.systems.road_map.study import HEADER, keys_of, settings_of, summary, trial

    methods = [name.strip() for name in arguments.methods.split(",")]
    unknown = [name for name in methods if name not in METHODS]
    if unknown:
        raise ConfigError(
            f"--methods: expected some of {', '.join(METHODS)}, got {', '.join(unknown)}"
        )
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    path = arguments.out / f"{arguments.case}.jsonl"
    ledger = Ledger(path, settings_of(arguments.case), fresh=arguments.fresh)
    keys = keys_of(arguments.maps, arguments.case, methods, seeds)

    def told(done: int, wanted: int, _: object) -> None:
        if done % 20 == 0 or done == wanted:
            say(errors, f"{done} of {wanted} drives")

    rows = run_trials(trial, keys, ledger, n_jobs=arguments.jobs, on_progress=told)
    lines = [
        "| " + " | ".join(cells) + " |" for cells in (HEADER, ["---"] * len(HEADER), *summary(rows))
    ]
    for line in lines:
        say(console, line)
    (arguments.out / f"{arguments.case}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    failed = [str(row[ERROR]) for row in rows.values() if ERROR in row]
    for text in dict.fromkeys(failed):
        say(errors, f"{failed.count(text)} drives without a result: {text}")
    return not failed
