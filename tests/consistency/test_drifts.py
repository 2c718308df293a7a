"""Slow errors of DVL and GNSS that the simulator draws: sigmas hold where they are modelled."""

from __future__ import annotations

import numpy as np
import pytest

from factors.similarity import GaussianKernel
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.drift import Drift
from ssm_graph.simulation import (
    DriftSettings,
    DvlSettings,
    GnssSettings,
    Grade,
    SimulatedMission,
    StartSigmas,
)
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from tests.helpers import assert_consistent, drifting, simulated

RUNS, UNTOLD = 12, range(3)
SPEED, PLACE = (0.02, 20.0), (0.5, 60.0)
"""Sigma in m/s and m, and correlation time in s, of the drifts of DVL and fixes."""
START = StartSigmas(position=5.0, velocity=0.1, roll_pitch=0.001, heading=0.02)


def drifted(seed: int) -> SimulatedMission:
    """Return two minutes, fixes in the first, with drifts ten times the white noise and more."""
    return simulated(
        seed=seed,
        duration_s=120.0,
        grade=Grade.TACTICAL,
        start_sigmas=START,
        dvl=DvlSettings(drift=DriftSettings(*SPEED)),
        gnss=GnssSettings(
            sigma_horizontal=0.05,
            sigma_vertical=0.05,
            windows=((0.0, 60.0),),
            drift=DriftSettings(*PLACE),
        ),
    )


def nees(sim: SimulatedMission, mission: Mission) -> Array:
    """Return position and velocity NEES, horizontal, with the last fixes and at the end."""
    config = SmootherConfig(GaussianKernel())
    track = SsmSmoother(config).solve(build_problem(mission)).trajectory
    truth, frame = sim.truth_at(track.time_s), mission.frame
    p, p_true = (frame.p_n_from_geodetic(x.lat, x.lon, x.height) for x in (track, truth))
    off = (p - p_true)[:, :2]
    fast = (track.velocity_enu - truth.velocity_enu)[:, :2] / track.velocity_sigma_enu[:, :2]
    found = []
    for k in (int(np.searchsorted(track.time_s, 50.0)), len(off) - 1):
        cov = track.position_cov_enu[k, :2, :2]
        found += [off[k] @ np.linalg.solve(cov, off[k]), fast[k] @ fast[k]]
    return np.array(found)


@pytest.mark.slow
def test_sigmas_hold_with_slow_errors() -> None:
    """Position and velocity, under GNSS and a minute after it; as white noise they do not."""
    told, untold = [], []
    for seed in range(RUNS):
        sim = drifted(seed)
        told.append(nees(sim, drifting(sim.mission, Drift(*SPEED), Drift(*PLACE))))
        if seed in UNTOLD:
            untold.append(nees(sim, sim.mission))
    for samples in np.array(told).T:
        assert_consistent(samples, dof=2)
    assert np.all(np.mean(untold, axis=0)[[0, 1, 3]] > 10.0)
