"""The mission that most benchmarks are run on."""

from __future__ import annotations

from typing import Any

import ssm_graph as sg


def sparse(rate: float) -> sg.Outliers:
    """Return outliers of 0.5 to 3 m/s on one beam of a share of the pings."""
    return sg.Outliers(sg.OutlierKind.SPARSE, rate=rate) if rate else sg.Outliers()


def survey(
    duration_s: float, grade: sg.Grade, *, seed: int, outliers: float = 0.1, **more: Any
) -> sg.SimulatedMission:
    """Return the scenario `survey`, with an outlier in a share of the pings."""
    settings = {"duration_s": duration_s, "grade": grade, "seed": seed, **more}
    return sg.simulate(sg.scenario_config("survey", outliers=sparse(outliers), **settings))
