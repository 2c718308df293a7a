"""Missions as messages for tests of the live estimator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.live.estimator.answers import Delayed
from ssm_graph.mission.navigation import Navigation
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.messages import Message
from ssm_graph.simulation import (
    DvlSettings,
    GnssSettings,
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
)
from ssm_graph.smoothers.window import FixedLagConfig
from tests.helpers import simulated

SHORT = replace(ONLINE, lag_s=3.0)


@cache
def stream(duration_s: float = 12.0, rate_hz: float = 2.0) -> tuple[SimulatedMission, Vehicle]:
    """Return a tactical-grade mission with outliers, GNSS in its first half, and its vehicle."""
    sim = simulated(
        duration_s=duration_s,
        grade=Grade.TACTICAL,
        dvl=DvlSettings(rate_hz=rate_hz),
        gnss=GnssSettings(windows=((0.0, 0.5 * duration_s),)),
        outliers=Outliers(OutlierKind.SPARSE, rate=0.2),
        seed=3,
    )
    return sim, vehicle_of(sim.mission)


@cache
def messages(duration_s: float = 12.0, rate_hz: float = 2.0) -> tuple[Message, ...]:
    """Return the mission's messages in order of time."""
    return tuple(messages_of(stream(duration_s, rate_hz)[0].mission))


def run(
    given: Sequence[Message], vehicle: Vehicle, config: FixedLagConfig = SHORT
) -> tuple[Navigation, list[Delayed], FixedLagSmoother]:
    """Return the newest answer, all delayed states, and the estimator."""
    smoother = FixedLagSmoother(vehicle, config)
    for message in given:
        smoother.push(message)
    newest = smoother.newest()
    assert newest is not None
    return newest, smoother.finish(), smoother


def joined(delayed: Sequence[Delayed], name: str) -> Array:
    """Return a column of the delayed trajectory, or of the beams if it has none of that name."""
    parts = [
        getattr(piece.trajectory, name, None) if name != "weight" else piece.beams.weight
        for piece in delayed
    ]
    return np.concatenate([part for part in parts if part is not None])
