"""Options of the witness beside a live estimator."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from ssm_graph.cli.options import number_option

if TYPE_CHECKING:
    from ssm_graph.live.run.runner import Engine, Estimator


def add_witness(group: argparse._ArgumentGroup) -> None:
    """Add whether a witness goes beside, and what it takes as bounds."""
    group.add_argument(
        "--witness",
        action="store_true",
        help="lead a set of guaranteed bounds on beside the answer: docs/network.md",
    )
    meaning = "bounds of the witness are so many of the stated sigmas"
    number_option(group, "--witness-sigmas", "K", meaning, 5.0)


def witnessed(engine: Engine, arguments: argparse.Namespace, lag_s: float) -> Engine:
    """Return an engine whose estimators have a witness beside them, if it was asked for."""
    if not arguments.witness:
        return engine
    from ssm_graph.live.run.runner import Engine
    from ssm_graph.systems.sensor_network.live import Witnessed
    from ssm_graph.systems.sensor_network.witness import WitnessBounds

    bounds = WitnessBounds(sigmas=arguments.witness_sigmas)

    def beside(estimator: Any) -> Estimator:
        return Witnessed(estimator, bounds, lag_s=lag_s)

    beside(engine.new())  # refuses a lag that is too short before the run
    return Engine(lambda: beside(engine.new()), lambda *packed: beside(engine.restore(*packed)))
