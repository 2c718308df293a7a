"""Preintegration: noise, gravity in place, gaps, and prediction against closed forms."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssm_graph.base.earth import EARTH_RATE, LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.graph.gtsam_graph import gtsam_values, inertial_graph
from ssm_graph.graph.inertial_rows import InertialRows
from ssm_graph.imu.missing_notes import notes_of_missing
from ssm_graph.imu.preintegration import (
    GAP_ACCEL,
    GAP_GYRO_RATE,
    GRAVITY,
    INTEGRATION_DENSITY,
    Unseen,
    bridged,
    gravity_between,
    gtsam_gravity,
    imu_params,
    preintegrate,
)
from ssm_graph.mission.problem import NO_EXTRAS, ProblemConfig, build_problem
from ssm_graph.sensors.imu import ImuLog, ImuNoise, imu_gaps
from ssm_graph.simulation import IMU_NOISE, Grade, SurveyRoute
from tests.helpers import assert_consistent, simulated, true_states

FRAME = LocalFrame(math.radians(45.7), math.radians(126.6), 0.0)
NOISE = ImuNoise(1e-5, 2e-4, 3e-6, 4e-3, 5e-8, 6e-6)


def test_every_covariance_is_set() -> None:
    """Each defaults to identity in GTSAM; densities go in squared, not scaled by time."""
    g_n = np.array([0.0, 0.1, -9.8])
    params = imu_params(NOISE, g_n=g_n, frame=FRAME)
    eye = np.eye(3)
    np.testing.assert_allclose(params.getGyroscopeCovariance(), 1e-10 * eye, rtol=1e-12)
    np.testing.assert_allclose(params.getAccelerometerCovariance(), 4e-8 * eye, rtol=1e-12)
    np.testing.assert_allclose(params.getBiasOmegaCovariance(), 25e-16 * eye, rtol=1e-12)
    np.testing.assert_allclose(params.getBiasAccCovariance(), 36e-12 * eye, rtol=1e-12)
    np.testing.assert_allclose(
        params.getIntegrationCovariance(), INTEGRATION_DENSITY**2 * eye, rtol=1e-12
    )
    np.testing.assert_array_equal(params.getOmegaCoriolis(), FRAME.omega_ie_n)
    np.testing.assert_array_equal(params.n_gravity, g_n)


@pytest.mark.parametrize("noise", IMU_NOISE.values(), ids=[grade.name for grade in IMU_NOISE])
def test_no_covariance_of_an_interval_comes_near_identity(noise: ImuNoise) -> None:
    """The whole 15 x 15 of a one-second interval, at every grade."""
    edges = np.arange(0, 101) / 100.0
    log = ImuLog(0.0, noise, edges[1:], np.zeros((100, 3)), np.tile([0.0, 0.0, -9.8], (100, 1)))
    chain = preintegrate(log, np.array([0.0, 1.0]), frame=FRAME, rate_hz=20.0)
    covariance = chain.intervals.covariance[0]
    assert covariance.shape == (15, 15)
    assert np.all(np.diagonal(covariance) > 0.0)
    assert np.abs(covariance).max() < 1e-4
    assert np.linalg.eigvalsh(covariance / np.sqrt(np.outer(*[np.diagonal(covariance)] * 2)))[0] > 0


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_many_missing_samples_make_sigmas_grow(share: float) -> None:
    """More than 30 % missing here and there; a log says by itself how many there would be."""
    rng = np.random.default_rng(7)
    edges = np.arange(0, 1001) / 100.0
    kept = (edges[1:] <= 4.0) | (edges[1:] > 6.0) | (rng.random(1000) >= share)
    log = ImuLog(
        0.0,
        NOISE,
        edges[1:][kept],
        np.zeros((kept.sum(), 3)),
        np.tile([0, 0, -9.8], (kept.sum(), 1)),
    )
    keyframe_s = np.arange(0.0, 10.5, 0.5)
    chain = preintegrate(log, keyframe_s, frame=FRAME, rate_hz=100.0)
    sigma = np.sqrt([np.diagonal(one)[:9] for one in chain.intervals.covariance])
    is_thin = (keyframe_s[:-1] >= 4.0) & (keyframe_s[1:] <= 6.0) & (share > 0.3)
    assert np.all(sigma[is_thin] > 3.0 * sigma[0])
    np.testing.assert_allclose(
        sigma[~is_thin], np.broadcast_to(sigma[0], sigma[~is_thin].shape), rtol=0.2
    )
    notes = notes_of_missing(log, keyframe_s)
    assert len(notes) == is_thin.any()
    assert all("10 ms in 4 of 20 steps" in note and "4.000 to 6.000 s" in note for note in notes)
    for k in np.flatnonzero(is_thin):  # on the way, by the interval that was usual before
        near = (log.time_s > keyframe_s[k] - 0.2) & (log.time_s < keyframe_s[k + 1] + 0.2)
        some = ImuLog(
            float(log.time_s[near][0]),
            NOISE,
            *(x[near][1:] for x in (log.time_s, log.gyro_b, log.accel_b)),
        )
        own = preintegrate(some, keyframe_s[k : k + 2], frame=FRAME, rate_hz=100.0, period_s=0.01)
        assert own.unseen[0].gap_s == pytest.approx(chain.unseen[k].gap_s)
        assert own.unseen[0][1:] == chain.unseen[k][1:]


def test_a_bias_that_does_not_walk_still_has_a_covariance() -> None:
    """A thousandth of the turn-on sigma within an hour keeps the chain regular."""
    still = ImuNoise(1e-5, 2e-4, gyro_bias_sigma=3e-6, accel_bias_sigma=4e-3)
    params = imu_params(still, g_n=np.zeros(3), frame=FRAME)
    gyro, accel = params.getBiasOmegaCovariance()[0, 0], params.getBiasAccCovariance()[0, 0]
    assert math.sqrt(3600.0 * gyro) == pytest.approx(3e-9)
    assert math.sqrt(3600.0 * accel) == pytest.approx(4e-6)


def test_noise_grows_so_that_a_gap_is_covered() -> None:
    """Over its interval the angle is unknown by the unseen rate times the gap, force likewise.

    An attitude that is off by half of that, in the mean, pulls gravity into the force.
    """
    params = imu_params(NOISE, g_n=np.zeros(3), frame=FRAME, unseen=Unseen(0.4), span_s=2.0)
    angle = math.sqrt(params.getGyroscopeCovariance()[0, 0] * 2.0)
    speed = math.sqrt(params.getAccelerometerCovariance()[0, 0] * 2.0)
    assert angle == pytest.approx(0.4 * GAP_GYRO_RATE, rel=1e-4)
    pulled = 0.5 * GRAVITY * GAP_GYRO_RATE * 0.4
    assert speed == pytest.approx(0.4 * math.hypot(GAP_ACCEL, pulled), rel=1e-4)


def log_with_gap() -> ImuLog:
    """Return 10 s at 20 Hz without the samples between 4.0 s and 4.5 s."""
    time_s = np.arange(1, 201) / 20.0
    time_s = time_s[(time_s <= 4.0 + 1e-9) | (time_s > 4.45)]
    n = len(time_s)
    return ImuLog(0.0, NOISE, time_s, np.zeros((n, 3)), np.tile([0.0, 0.0, -9.8], (n, 1)))


def test_gaps_are_found_and_only_their_intervals_inflated() -> None:
    """A gap split by a keyframe counts in either interval with its own part.

    At rest, as here, a tenth of the largest rate is left.
    """
    log = log_with_gap()
    begin, end = imu_gaps(log)
    np.testing.assert_allclose([begin, end], [[4.0], [4.5]])
    keyframe_s = np.array([0.0, 2.0, 4.2, 6.0, 10.0])
    chain = preintegrate(log, keyframe_s, frame=FRAME, rate_hz=20.0)
    angle_sigma = np.sqrt(chain.intervals.covariance[:, 0, 0]).tolist()
    plain = [NOISE.gyro_density * math.sqrt(span) for span in np.diff(keyframe_s)]
    assert angle_sigma[0] == pytest.approx(plain[0], rel=1e-3)
    assert angle_sigma[1] == pytest.approx(0.02 * GAP_GYRO_RATE, rel=1e-2)
    assert angle_sigma[2] == pytest.approx(0.03 * GAP_GYRO_RATE, rel=1e-2)
    assert angle_sigma[3] == pytest.approx(plain[3], rel=1e-3)


def test_an_axis_that_repeats_itself_is_led_on() -> None:
    """A gyro stuck in a turn that ends meanwhile: by both sides, and a turn's rate lasts."""
    rng, time_s = np.random.default_rng(0), np.arange(1, 2001) / 100.0
    gyro_b = 1e-3 * rng.standard_normal((2000, 3))
    gyro_b[time_s < 8.0, 2] += 0.4
    gyro_b[700:1300, 2] = gyro_b[700, 2]
    accel_b = np.tile([0.0, 0.0, -9.8], (2000, 1)) + 1e-3 * rng.standard_normal((2000, 3))
    log = ImuLog(0.0, NOISE, time_s, gyro_b, accel_b)
    chain = preintegrate(log, np.arange(0.0, 21.0), frame=FRAME, rate_hz=20.0)
    turned = Rotation.from_matrix(chain.intervals.delta_R).as_rotvec()[7:13, 2]
    assert float(np.sum(turned)) == pytest.approx(0.4 * 6.0 / 2.0, rel=0.05)
    sigma = float(np.sqrt(np.sum(chain.intervals.covariance[7:13, 2, 2])))
    assert sigma == pytest.approx(GAP_GYRO_RATE * math.sqrt(5.0 * 6.0), rel=0.05)


def test_a_gap_in_waves_is_bridged_within_what_is_covered() -> None:
    """Rolling by 4 degrees in 6 s: half a second is missed at any phase of the wave."""
    omega = 2.0 * math.pi / 6.0
    for begin_s in np.arange(8.0, 14.0, 0.7):
        time_s = np.arange(1, 401) / 20.0
        kept = (time_s <= begin_s) | (time_s > begin_s + 0.5)
        edges = np.concatenate([[0.0], time_s])
        angle = math.radians(4.0) * np.sin(omega * edges)
        gyro_b = np.zeros((400, 3))
        gyro_b[:, 0] = np.diff(angle) / np.diff(edges)
        log = ImuLog(0.0, NOISE, time_s[kept], gyro_b[kept], np.zeros((kept.sum(), 3)))
        gaps = imu_gaps(log)
        (begin,), (end,) = gaps
        turned = np.interp([begin, end], edges, angle)
        k = int(np.searchsorted(log.time_s, end))
        left = bridged(log, gaps).gyro_b[k, 0] * (end - begin) - (turned[1] - turned[0])
        as_it_stood = log.gyro_b[k, 0] * (end - begin) - (turned[1] - turned[0])
        assert abs(left) < max(0.2 * abs(as_it_stood), math.radians(0.15))
        chain = preintegrate(log, np.array([begin - 0.1, end + 0.1]), frame=FRAME, rate_hz=20.0)
        assert abs(left) < 3.0 * math.sqrt(chain.intervals.covariance[0, 0, 0])


def test_regular_data_have_no_gaps() -> None:
    """Jitter of the stamps and slow rates are no gaps."""
    jitter = np.random.default_rng(0).uniform(-0.02, 0.02, 200)
    for time_s in (np.arange(1, 201) / 20.0 + jitter, np.arange(1, 201) / 2.0):
        log = ImuLog(0.0, NOISE, time_s, np.zeros((200, 3)), np.zeros((200, 3)))
        assert len(imu_gaps(log)[0]) == 0


def resting_log(p_n: Array, R_nb: Array, *, duration_s: float) -> ImuLog:
    """Return what perfect sensors read that do not move over ground."""
    n = round(10.0 * duration_s)
    gyro_b, accel_b = R_nb.T @ FRAME.omega_ie_n, -R_nb.T @ FRAME.g_n_at(p_n)
    return ImuLog(
        0.0, NOISE, np.arange(1, n + 1) / 10.0, np.tile(gyro_b, (n, 1)), np.tile(accel_b, (n, 1))
    )


@pytest.mark.parametrize("p_n", [[0.0, 0.0, 0.0], [7e3, -4e3, -40.0], [0.0, 5e4, 10.0]])
def test_rest_stays_at_rest(p_n: list[float]) -> None:
    """10 min at rest, at the frame's origin and far from it: within 0.1 mm.

    Gravity without its term ``omega x (omega x p)`` would be 6 m off at 7 km.
    """
    R_nb = gtsam.Rot3.RzRyRx(0.1, -0.2, 2.3).matrix()
    keyframe_s = np.linspace(0.0, 600.0, 11)
    log = resting_log(np.array(p_n), R_nb, duration_s=600.0)
    chain = preintegrate(log, keyframe_s, frame=FRAME, rate_hz=10.0)
    state = gtsam.NavState(gtsam.Rot3(R_nb), np.array(p_n), np.zeros(3))
    for measured in chain.measured(gravity_between(FRAME, np.tile(p_n, (11, 1)))):
        state = measured.predict(state, gtsam.imuBias.ConstantBias())
    np.testing.assert_allclose(state.position(), p_n, rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(state.velocity(), 0.0, atol=1e-6)
    np.testing.assert_allclose(state.attitude().matrix(), R_nb, rtol=0.0, atol=1e-10)


def test_gravity_is_that_of_the_plumb_line_plus_the_axis_distance() -> None:
    """By hand, on the equator: ``-omega^2 p`` for 1 km up, nothing for 1 km along the axis."""
    frame = LocalFrame(0.0, 0.0, 0.0)
    p_n = np.array([0.0, 0.0, 1e3])
    added = gtsam_gravity(frame, p_n) - frame.g_n_at(p_n)
    np.testing.assert_allclose(added, [0.0, 0.0, -(EARTH_RATE**2) * 1e3], rtol=1e-6, atol=1e-14)
    p_n = np.array([0.0, 1e3, 0.0])
    np.testing.assert_allclose(gtsam_gravity(frame, p_n) - frame.g_n_at(p_n), 0.0, atol=1e-14)


def test_gravity_moves_the_error_by_its_change_and_no_more() -> None:
    """10 km up gravity is weaker by 0.031 m/s^2; the error is in body axes."""
    sim = simulated(duration_s=3.0, perfect_sensors=True)
    problem = build_problem(sim.mission)
    states = true_states(problem, sim)
    raised = states._replace(p_n=states.p_n + np.array([0.0, 0.0, 1e4]))
    errors = []
    for graph in (inertial_graph(problem, states), inertial_graph(problem, raised)):
        factor = graph.at(0)
        assert isinstance(factor, gtsam.NoiseModelFactor)
        errors.append(factor.unwhitenedError(gtsam_values(states)))
    span = problem.keyframe_s[1] - problem.keyframe_s[0]
    change = np.linalg.norm((errors[1] - errors[0])[6:9])
    assert change == pytest.approx(0.0308 * span, rel=0.01)


def test_gravity_is_taken_midway() -> None:
    """Each interval has the gravity of the middle between its keyframes."""
    p_n = np.array([[0.0, 0.0, 0.0], [1e3, 0.0, 0.0], [5e3, 2e3, 100.0]])
    found = gravity_between(FRAME, p_n)
    for k, middle in enumerate(([500.0, 0.0, 0.0], [3e3, 1e3, 50.0])):
        expected = gtsam_gravity(FRAME, np.array(middle))
        # One component is zero but for rounding: of gravity as a whole, then.
        np.testing.assert_allclose(found[k], expected, rtol=0.0, atol=1e-13)


def test_bias_of_linearisation_is_kept() -> None:
    """Preintegrated about a bias, the measurement says so and predicts as if it were removed."""
    bias = np.array([0.1, 0.2, 0.3, 1e-3, 2e-3, 3e-3])
    edges = np.arange(0, 11) / 10.0
    log = ImuLog(0.0, NOISE, edges[1:], np.tile(bias[3:], (10, 1)), np.tile(bias[:3], (10, 1)))
    chain = preintegrate(log, edges[[0, -1]], frame=FRAME, rate_hz=10.0, bias=bias)
    np.testing.assert_allclose(chain.intervals.bias[0], bias)
    np.testing.assert_allclose(chain.intervals.delta_pv[0, 1], 0.0, atol=1e-15)
    np.testing.assert_allclose(chain.intervals.delta_R[0], np.eye(3), atol=1e-15)


@pytest.mark.parametrize("grade", Grade, ids=lambda grade: grade.name)
def test_inertial_errors_at_the_truth_are_as_large_as_stated(grade: Grade) -> None:
    """300 intervals merged from 100 to 20 Hz, in waves: chi-square of 15 degrees each."""
    sim = simulated(duration_s=300.0, imu_rate_hz=100.0, grade=grade, route=SurveyRoute())
    problem = build_problem(sim.mission, ProblemConfig(merge_rate_hz=20.0))
    states = true_states(problem, sim)
    whitened = InertialRows(problem.frame, NO_EXTRAS).errors(problem.chain.intervals, states)
    # INTEGRATION_DENSITY covers a loss that is no noise; position along with it is left out.
    rest = np.delete(whitened, [3, 4, 5], axis=1)
    assert_consistent(np.sum(rest**2, axis=1), dof=12)
    assert np.mean(whitened[:, 3:6] ** 2) < 1.3
