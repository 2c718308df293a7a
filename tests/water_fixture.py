"""Missions in a current, with pings off the water while bottom lock is lost."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.mission.estimate import Estimate
from ssm_graph.simulation import CurrentSettings, Grade, Loss, SimulatedMission, WaterTrack
from tests.helpers import simulated

LOSS = Loss(60.0, 240.0)


def in_current(**changes: Any) -> SimulatedMission:
    """Return five minutes of which three are without bottom lock, in a current of 0.5 m/s."""
    settings: dict[str, Any] = {
        "duration_s": 300.0,
        "grade": Grade.TACTICAL,
        "losses": (LOSS,),
        "current": CurrentSettings(sigma=0.35, vertical_sigma=0.02),
        "water_track": WaterTrack(),
    }
    return simulated(**(settings | changes))


def without_water(sim: SimulatedMission) -> SimulatedMission:
    """Return the run with the pings off the ground alone."""
    mission = replace(sim.mission, dvl=sim.mission.dvl.of_ground(), current=None)
    return replace(sim, mission=mission)


def current_errors(estimate: Estimate, sim: SimulatedMission) -> Array:
    """Return estimated minus true current (K, 3), m/s."""
    assert estimate.current is not None
    return np.asarray(estimate.current.velocity_enu - sim.current.at(estimate.current.time_s))
