"""What the smoother finds of beacons and compasses lies within what it claims, over many runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import BeaconSettings, SurveyRoute
from ssm_graph.smoothers.batch import SsmSmoother
from ssm_graph.smoothers.fixed_lag import solve_fixed_lag
from tests.aids_fixture import compass, ranging
from tests.helpers import assert_consistent, simulated
from tests.window_fixture import SHORT

pytestmark = pytest.mark.slow
RUNS = 15
WINDOW_RUNS = 10
PRIOR_M = (40.0, 40.0, 6.0)
NEAR_M = (10.0, 10.0, 3.0)
ROUTE = SurveyRoute(line_m=60.0)


def nees(estimate: Estimate, truth: dict[str, Array]) -> float:
    """Return the NEES of some variables of a calibration together."""
    calibration = estimate.calibration
    assert calibration is not None
    kept = [i for i, value in enumerate(calibration.values) if value.variable in truth]
    found = np.array([calibration.values[i].value for i in kept])
    order = dict.fromkeys(calibration.values[i].variable for i in kept)
    error = found - np.concatenate([truth[variable] for variable in order])
    return float(error @ np.linalg.solve(calibration.covariance[np.ix_(kept, kept)], error))


def test_unknown_beacons_lie_where_their_sigmas_say() -> None:
    """Stated with errors drawn from the prior, one range of ten an echo."""
    found = []
    for seed in range(RUNS):
        off = np.random.default_rng([seed, 7]).standard_normal(3) * PRIOR_M
        beacon = BeaconSettings(7, (90.0, -60.0, -50.0), (off[0], off[1], off[2]), PRIOR_M)
        aids = ranging(beacon, rate=0.1, interval_s=2.0)
        sim = simulated(duration_s=120.0, route=ROUTE, aids=aids, seed=seed)
        estimate = SsmSmoother().solve(build_problem(sim.mission))
        found.append(nees(estimate, {"beacon_7": -off}))
    # On clean data the log kernel's errors have 1.1 times the variance that it claims.
    assert_consistent(np.array(found) / 1.1, dof=3)


def test_errors_of_a_compass_lie_where_their_sigmas_say() -> None:
    """Offset, iron and rate, drawn anew in every run."""
    names = ("heading_offset", "heading_one_cycle", "heading_two_cycle", "heading_rate")
    found = []
    for seed in range(RUNS):
        sim = simulated(duration_s=120.0, route=ROUTE, aids=compass(), seed=seed)
        estimate = SsmSmoother().solve(build_problem(sim.mission))
        truth = np.split(sim.aids.heading_errors, [1, 3, 5])
        found.append(nees(estimate, dict(zip(names, truth, strict=True))))
    assert_consistent(np.array(found), dof=6)


def test_a_window_finds_them_where_its_sigmas_say() -> None:
    """A beacon and a compass carried in the state of each keyframe, and the last position."""
    names = ("heading_offset", "heading_one_cycle", "heading_two_cycle", "heading_rate")
    beacons, compasses, placed = [], [], []
    for seed in range(WINDOW_RUNS):
        off = np.random.default_rng([seed, 7]).standard_normal(3) * NEAR_M
        beacon = BeaconSettings(7, (90.0, -60.0, -50.0), (off[0], off[1], off[2]), NEAR_M)
        aids = replace(compass(rate_hz=1.0), ranging=ranging(beacon, interval_s=2.0).ranging)
        sim = simulated(duration_s=60.0, route=ROUTE, aids=aids, seed=seed)
        estimate = solve_fixed_lag(build_problem(sim.mission), SHORT).newest
        beacons.append(nees(estimate, {"beacon_7": -off}))
        truth = np.split(sim.aids.heading_errors, [1, 3, 5])
        compasses.append(nees(estimate, dict(zip(names, truth, strict=True))))
        track, frame = estimate.trajectory, sim.mission.frame
        true = sim.truth_at(track.time_s)
        p, p_true = (frame.p_n_from_geodetic(x.lat, x.lon, x.height)[-1] for x in (track, true))
        error, own = (p - p_true)[:2], track.position_cov_enu[-1, :2, :2]
        placed.append(float(error @ np.linalg.solve(own, error)))
    assert_consistent(np.array(beacons) / 1.1, dof=3)
    assert_consistent(np.array(compasses), dof=6)
    assert_consistent(np.array(placed), dof=2)
