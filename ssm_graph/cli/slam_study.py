"""``ssm-graph slam-study``: noise-adaptive filters of landmark SLAM, in every kind of noise."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from pathlib import Path
from typing import Final

from rich.console import Console

from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say
from ssm_graph.io.tables.append_file import write_through

DESCRIPTION: Final = """\
The study of Wang, Qin and Liang (2014) on a vehicle in 40 x 40 m among landmarks: extended,
unscented and noise-adaptive filters, and those that are worth using, with noise as stated, with
more of it in every reading of the paper's lost units, and with sigmas that are three times wrong.

Finished batches of runs are kept: interrupted and started again, only what is missing is done.

files in DIR:
  trials.jsonl    finished batches; from here an interrupted study goes on
  summary.md      what reproduces and what does not; tables with intervals and paired tests
  figures/*.png   figures 2 to 13 of the paper

cases: stated, G1, U1, E1, A1, R3, Q3 (the study), gross10, gross30; docs/landmark-slam.md
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    parser.add_argument("--methods", metavar="A,B", help="methods (default: all filters)")
    parser.add_argument("--cases", metavar="A,B", help="cases (default: the seven of the study)")
    number_option(parser, "--runs", "N", "runs of each case", 50, kind=int)
    number_option(parser, "--steps", "N", "steps of each run", 2000, kind=int)
    number_option(parser, "--first-seed", "N", "seed of the first run", 1000, kind=int)
    number_option(parser, "--jobs", "N", "processes", os.cpu_count() or 1, kind=int)
    parser.add_argument("--fresh", action="store_true", help="throw earlier runs in DIR away")
    parser.add_argument("--no-figures", action="store_true", help="draw no figures")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Run what is missing, then write summary and figures."""
    from ssm_graph.cli.compare_run import FIGURES_NAME, StudyDisplay
    from ssm_graph.study.ledger import ERROR, Key, Ledger, run_trials
    from ssm_graph.study.runner import Progress
    from ssm_graph.systems.landmark_slam.methods import DEFAULT_STUDY
    from ssm_graph.systems.landmark_slam.page import study_page
    from ssm_graph.systems.landmark_slam.study import STUDY_CASES, StudyPlan, cells_of, run_batch

    plan = StudyPlan(
        tuple(_names(arguments.cases, STUDY_CASES)),
        tuple(_names(arguments.methods, DEFAULT_STUDY)),
        arguments.runs,
        arguments.steps,
        arguments.first_seed,
    )
    ledger = Ledger(arguments.out / "trials.jsonl", {"kind": "slam-study"}, fresh=arguments.fresh)
    for note in ledger.notes:
        say(errors, f"note: {note}")
    with StudyDisplay(errors) as show:

        def done(count: int, wanted: int, key: Key) -> None:
            show(Progress(count, wanted, f"{key[1]} in {key[0]}"))

        rows = run_trials(run_batch, plan.keys(), ledger, n_jobs=arguments.jobs, on_progress=done)
    failed = [(key, row[ERROR]) for key, row in rows.items() if ERROR in row]
    for key, text in failed:
        say(errors, f"{key[1]} in {key[0]}: {text}")
    cells = cells_of(plan, rows)
    text = study_page(plan, cells, command=shlex.join(["ssm-graph", *sys.argv[1:]]))
    write_through(arguments.out / "summary.md", text.encode())
    if not arguments.no_figures:
        from ssm_graph.systems.landmark_slam.figures import save_study_figures

        save_study_figures(arguments.out / FIGURES_NAME, plan, cells)
    say(console, text)
    return not failed


def _names(text: str | None, default: tuple[str, ...]) -> list[str]:
    return [name.strip() for name in text.split(",")] if text else list(default)
