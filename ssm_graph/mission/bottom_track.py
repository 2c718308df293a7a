"""The problem of an estimator that has no current: pings off the water are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.mission.current import CURRENTS
from ssm_graph.mission.problem import Problem


def without_water_track(problem: Problem) -> Problem:
    """Return the problem with the pings off the ground alone, and a note of those left out."""
    beams = problem.beams
    if not beams.is_water.any():
        return problem
    kept = ~beams.is_water
    n_pings = len(np.unique(beams.ping[beams.is_water]))
    rows = {
        name: getattr(beams, name)[kept]
        for name in ("keyframe", "beam", "speed", "sigma", "gyro_b", "beam_b", "ping", "is_water")
    }
    return replace(
        problem,
        beams=replace(beams, **rows),
        extras=problem.extras.without(CURRENTS),
        notes=(*problem.notes, _note(n_pings)),
    )


def require_bottom_track(problem: Problem) -> None:
    """Raise :class:`ConfigError` for a problem with pings off the water."""
    if problem.beams.is_water.any():
        raise ConfigError(
            "this estimator has no current: expected pings off the ground, got some off the water; "
            "leave them out by without_water_track"
        )


def _note(n_pings: int) -> str:
    return (
        f"{n_pings} pings off the water are left out: this estimator has no current, and would "
        "take them for pings off the ground; ssm-graph smooth uses them"
    )
