"""``ssm-graph network-run``: the nodes of a network as processes that talk by UDP."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from rich.console import Console

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say

DESCRIPTION = """\
Start a process for every node of a study (see ssm-graph network --help), let them talk by UDP on
this machine, and show their sets. Nodes share measurements; the study says how much is lost and of
how many bits an index is.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("study", type=Path, metavar="STUDY.toml", help="what to run")
    number_option(parser, "--period", "S", "seconds from step to step", 0.2)
    number_option(parser, "--seed", "N", "of the robot and its noise", 0, kind=int)
    parser.add_argument(
        "--secret-file",
        type=Path,
        metavar="FILE",
        help="encrypt and sign packets with the bytes of this file, 16 or more (HMAC-SHA256)",
    )
    parser.add_argument(
        "--wrong-key",
        type=int,
        metavar="NODE",
        help="give this node another key, to see its packets refused",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Run all nodes and show their sets; good if each held its truth without an alarm."""
    from ssm_graph.systems.sensor_network.processes import Ended, Report, run_processes
    from ssm_graph.systems.sensor_network.study import read_network_study

    setting = read_network_study(arguments.study).setting
    secrets = _secrets(arguments, setting.n_nodes)
    last: dict[int, Report] = {}
    ended: list[Ended] = []
    n_outside = n_checks = 0
    for report in run_processes(
        setting, period_s=arguments.period, seed=arguments.seed, secrets=secrets
    ):
        if isinstance(report, Ended):
            ended.append(report)
            say(errors, f"node {report.node}, after step {report.k}: {report.reason}")
            continue
        new = report.alarms[len(last[report.node].alarms) :] if report.node in last else ()
        for alarm in new or (() if report.node in last else report.alarms):
            say(errors, f"alarm: {alarm}")
        last[report.node] = report
        n_checks, n_outside = n_checks + 1, n_outside + (not report.holds_truth)
        gone = {one.node for one in ended}
        going = {node: one for node, one in last.items() if node not in gone}
        is_whole = len(going) == setting.n_nodes - len(gone)
        if is_whole and {one.k for one in going.values()} == {report.k}:
            say(console, _line(going))
    say(console, f"{'node':>4} {'east, m':>18} {'north, m':>18} {'heading, rad':>18}  packets")
    for node, report in sorted(last.items()):
        cells = [
            f"{m:9.3f} ± {h:6.3f}" for m, h in zip(report.middle, report.half_widths, strict=True)
        ]
        tail = f"{report.n_heard} heard, {report.n_refused} refused, {report.n_bytes} bytes each"
        say(console, f"{node:>4} {' '.join(f'{cell:>18}' for cell in cells)}  {tail}")
    say(console, f"the truth was inside {n_checks - n_outside} of {n_checks} times")
    is_quiet = not any(report.alarms for report in last.values())
    return n_outside == 0 and is_quiet and not ended


def _line(last: dict[int, Any]) -> str:
    cells = [f"{max(r.half_widths[:2]):.3f}" for _, r in sorted(last.items())]
    step = max(report.k for report in last.values())
    return f"step {step}: position known to ± {', '.join(cells)} m"


def _secrets(arguments: argparse.Namespace, n_nodes: int) -> tuple[bytes | None, ...] | None:
    if arguments.secret_file is None:
        if arguments.wrong_key is not None:
            raise ConfigError("--wrong-key: expected with --secret-file; give that, too")
        return None
    try:
        key = arguments.secret_file.read_bytes().strip()
    except OSError as error:
        raise ConfigError(
            f"--secret-file {arguments.secret_file}: cannot be read: {error.strerror or error}"
        ) from error
    keys = [key] * n_nodes
    if arguments.wrong_key is not None:
        if not 1 <= arguments.wrong_key <= n_nodes:
            raise ConfigError(f"--wrong-key: expected 1 to {n_nodes}, got {arguments.wrong_key}")
        keys[arguments.wrong_key - 1] = os.urandom(16)
    return tuple(keys)
