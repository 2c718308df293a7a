"""The first pass: weights of outliers, doubt after a lock-out, dead reckoning, aids."""

from __future__ import annotations

import numpy as np
import pytest

from factors.similarity import LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, ROTATION
from ssm_graph.graph.first_values import LOCKED_OUT_PINGS, _ForwardPass, first_values
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import (
    CALM,
    DepthProfile,
    DepthSettings,
    Fault,
    GnssSettings,
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
    TransitRoute,
    Waves,
)
from tests.helpers import (
    rotation,
    simulated,
    state_errors,
    true_states,
    with_initial,
    without_beams,
)

KERNEL = LogKernel()
each_grade = pytest.mark.parametrize("grade", Grade, ids=lambda grade: grade.name)


def errors_after(sim: SimulatedMission, **initial: object) -> tuple[Array, Array, int]:
    """Return state errors (K, 15), weights (M,) and doubts of the first pass."""
    mission = with_initial(sim.mission, **initial) if initial else sim.mission
    problem = build_problem(mission)
    first = first_values(problem, kernel=KERNEL)
    errors = state_errors(first.states, true_states(problem, sim))
    return errors, first.weights, first.n_doubts


@each_grade
@pytest.mark.parametrize("kind", [OutlierKind.SPARSE, OutlierKind.TWO_BEAMS, OutlierKind.ONE_BEAM])
def test_outliers_end_with_hardly_any_weight(grade: Grade, kind: OutlierKind) -> None:
    """100 sigma and more off: below 0.01 at once; good beams keep theirs."""
    sim = simulated(duration_s=60.0, grade=grade, outliers=Outliers(kind, rate=0.2), seed=3)
    _, weights, n_doubts = errors_after(sim)
    bad = sim.is_outlier[np.isfinite(sim.mission.dvl.speed)]
    assert bad.sum() >= 12
    assert weights[bad].max() < 0.01
    assert 0.9 < weights[~bad].mean() < 1.1
    assert n_doubts == 0


def test_a_long_fault_of_one_beam_does_not_fool_it() -> None:
    """1 m/s off for 25 s: the culprit has no weight, the three others keep theirs."""
    fault = Fault(beams=(2,), start_s=3.0, end_s=28.0, offset_m_per_s=1.0)
    sim = simulated(faults=(fault,), grade=Grade.MEMS)
    errors, weights, _ = errors_after(sim)
    assert weights[sim.is_outlier.ravel()].max() < 0.01
    assert weights[~sim.is_outlier.ravel()].mean() > 0.9
    assert np.abs(errors[:, 6:9]).max() < 0.5


@each_grade
def test_a_wrong_start_velocity_is_doubted_and_recovered(grade: Grade) -> None:
    """20 sigma off at the start: all beams are locked out until the prediction is doubted.

    From then on the velocity is that of the beams again.
    """
    sim = simulated(grade=grade)
    assert sim.mission.initial is not None
    sigma = float(sim.mission.initial.velocity_sigma_enu[0])
    velocity = sim.mission.initial.velocity_enu + 20.0 * sigma * np.array([1.0, 0.0, 0.0])
    errors, weights, _ = errors_after(sim, velocity_enu=velocity)
    assert np.linalg.norm(errors[-1, 6:9]) < 0.25
    assert weights[-20:].mean() > 0.6


def test_lock_out_is_counted() -> None:
    """Beams wrong together are first without weight; the third such ping is believed."""
    sim = simulated()
    assert sim.mission.initial is not None
    # Up, so that every beam sees it.
    velocity = sim.mission.initial.velocity_enu + np.array([0.3, -0.2, 2.0])
    _, weights, n_doubts = errors_after(sim, velocity_enu=velocity)
    by_ping = weights.reshape(-1, 4)
    assert n_doubts == 1
    assert by_ping[: LOCKED_OUT_PINGS - 1].max() < 0.01
    assert by_ping[LOCKED_OUT_PINGS - 1].min() > 0.5


def test_a_clean_mission_is_never_doubted() -> None:
    """Over all grades and three seeds."""
    for grade in Grade:
        for seed in range(3):
            sim = simulated(duration_s=15.0, grade=grade, seed=seed)
            assert first_values(build_problem(sim.mission), kernel=KERNEL).n_doubts == 0


def test_without_beams_it_is_dead_reckoning() -> None:
    """Perfect sensors and no aid at all: 30 s end where they should."""
    sim = simulated(perfect_sensors=True, draw_initial_errors=False, depth=None)
    problem = build_problem(without_beams(sim.mission))
    first = first_values(problem, kernel=KERNEL)
    errors = state_errors(first.states, true_states(problem, sim))
    assert len(first.weights) == 0
    assert np.abs(errors[:, 3:6]).max() < 1e-3
    assert np.abs(errors[:, 6:9]).max() < 1e-4


def test_depth_and_gnss_pull_a_wrong_start_in() -> None:
    """5 m off at the start: fixes and depth at the keyframes, none of them gated."""
    sim = simulated(gnss=GnssSettings(windows=((0.0, 30.0),), sigma_horizontal=0.1), seed=2)
    assert sim.mission.initial is not None
    mission = with_initial(
        sim.mission,
        height=sim.mission.initial.height + 5.0,
        lat=sim.mission.initial.lat + 5.0 / 6.4e6,
        position_sigma_enu=np.full(3, 5.0),
    )
    problem = build_problem(mission)
    first = first_values(problem, kernel=KERNEL)
    errors = state_errors(first.states, true_states(problem, sim))
    assert np.linalg.norm(errors[0, 3:6]) > 4.5  # depth has corrected the height already
    assert np.linalg.norm(errors[-1, 3:6]) < 0.3


@pytest.mark.parametrize("free", [ROTATION, POSITION], ids=["rotation", "position"])
def test_one_exact_fix_moves_what_is_free_until_the_antenna_meets_it(free: slice) -> None:
    """With only attitude or only position in doubt, tilted, the correction closes the gap."""
    settings = GnssSettings(
        windows=((0.0, 3.0),), sigma_horizontal=1e-6, sigma_vertical=1e-6, lever_arm_b=(3, -2, 4)
    )
    sim = simulated(duration_s=3.0, gnss=settings, waves=Waves(roll=0.5, pitch=0.4), seed=4)
    problem = build_problem(sim.mission)
    state = _ForwardPass(problem, KERNEL)
    assert problem.fixes is not None
    lever, k = problem.fixes.lever_arm_b, int(problem.fixes.keyframe[0])
    truth = true_states(problem, sim)
    state.R_nb, state.p_n = truth.R_nb[k] @ rotation([0.01, -0.02, 0.015]), truth.p_n[k]
    if free == POSITION:
        state.p_n = state.p_n + np.array([0.5, -0.7, 0.3])
    state.P = np.diag(np.full(15, 1e-20))
    state.P[free, free] += np.eye(3)
    target = problem.fixes.position_n[0]
    if free == ROTATION:
        # As far from the body origin as the antenna is: a rotation can reach it.
        target = truth.p_n[k] + truth.R_nb[k] @ lever
    gap = np.linalg.norm(state.p_n + state.R_nb @ lever - target)
    state._update_aids(k)
    left = np.linalg.norm(state.p_n + state.R_nb @ lever - target)
    assert left < 0.02 * gap


@pytest.mark.parametrize("free", [ROTATION, POSITION], ids=["rotation", "position"])
def test_one_exact_depth_moves_what_is_free_until_the_sensor_meets_it(free: slice) -> None:
    """The same for the height of the pressure sensor, 8 km from the frame's origin."""
    sim = simulated(
        duration_s=800.0,
        imu_rate_hz=10.0,
        route=TransitRoute(speed=10.0),
        waves=Waves(roll=0.5, pitch=0.4),
        perfect_sensors=True,
        depth=DepthSettings(rate_hz=1.0, sigma=1e-4, lever_arm_b=(3.0, -2.0, 4.0)),
    )
    problem = build_problem(sim.mission)
    state = _ForwardPass(problem, KERNEL)
    assert problem.depths is not None
    k, row = 800, 799
    truth = true_states(problem, sim)
    state.R_nb, state.p_n, state.v_n = truth.R_nb[k], truth.p_n[k], truth.v_n[k]
    if free == POSITION:
        state.p_n = state.p_n + np.array([0.0, 0.0, 0.5])
    else:
        state.R_nb = state.R_nb @ rotation([0.06, 0.05, 0.0])
    state.P = np.diag(np.full(15, 1e-20))
    state.P[free, free] += np.eye(3)

    def too_high() -> float:
        assert problem.depths is not None
        sensor_n = state.p_n + state.R_nb @ problem.depths.lever_arm_b
        height = problem.frame.geodetic_from_p_n(sensor_n)[2]
        return float(height + problem.depths.depth[row])

    before = too_high()
    assert abs(before) > 0.1
    state._update_aids(k)
    # The Earth as a sphere: the ellipsoid's radii differ by 0.3 % of a fall of 5 m.
    assert abs(too_high()) < 0.02 * abs(before) + 0.02


def test_depth_read_late_is_carried_to_its_keyframe() -> None:
    """Diving at 0.2 m/s with readings up to half a second from the pings: no centimetres lost."""
    sim = simulated(
        duration_s=60.0,
        route=TransitRoute(depth=DepthProfile(10.0, 22.0, mid_s=30.0, tau_s=30.0)),
        waves=CALM,
        perfect_sensors=True,
        draw_initial_errors=False,
        depth=DepthSettings(rate_hz=0.7, sigma=1e-3),
    )
    errors, _, _ = errors_after(sim)
    assert np.abs(errors[:, 3:6]).max() < 5e-3


def test_states_follow_the_beams_more_closely_than_dead_reckoning() -> None:
    """MEMS for a minute: beams hold the velocity to centimetres per second."""
    sim = simulated(duration_s=60.0, grade=Grade.MEMS, seed=1)
    errors, _, _ = errors_after(sim)
    problem = build_problem(without_beams(sim.mission))
    alone = first_values(problem, kernel=KERNEL)
    free = state_errors(alone.states, true_states(problem, sim))
    assert np.linalg.norm(errors[-1, 6:9]) < 0.1 * np.linalg.norm(free[-1, 6:9])
