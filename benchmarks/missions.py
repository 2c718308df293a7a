"""The mission that most benchmarks are run on."""

from __future__ import annotations

from typing import Any

from ssm_graph.simulation import (
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
    scenario_config,
    simulate,
)


def sparse(rate: float) -> Outliers:
    """Return outliers of 0.5 to 3 m/s on one beam of a share of the pings."""
    return Outliers(OutlierKind.SPARSE, rate=rate) if rate else Outliers()


def survey(
    duration_s: float, grade: Grade, *, seed: int, outliers: float = 0.1, **more: Any
) -> SimulatedMission:
    """Return the scenario `survey`, with an outlier in a share of the pings."""
    settings = {"duration_s": duration_s, "grade": grade, "seed": seed, **more}
    return simulate(scenario_config("survey", outliers=sparse(outliers), **settings))
