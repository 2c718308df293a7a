"""The beam factor: truth, Jacobians, laziness, closed forms, refusal, bulk, the simulator."""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

import factors.dvl_beam
from factors.dvl_beam import beam_error, beam_residual, dvl_beam_factor
from ssm_graph.base.frozen import Array
from ssm_graph.graph.beam_rows import linearize_beams
from ssm_graph.graph.gtsam_graph import gtsam_values
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import DiveRoute, HoverRoute, Route, SpiralRoute, SurveyRoute
from tests.helpers import assert_jacobians_match, rotation, simulated, true_states

OMEGA_IE_N = 7.292115e-5 * np.array([0.0, math.cos(0.8), math.sin(0.8)])
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
ATTITUDES = {
    "identity": np.zeros(3),
    "near identity": 1e-7 * AXIS,
    "small": 1e-3 * AXIS,
    "random 1": np.array([0.3, -1.1, 0.8]),
    "random 2": np.array([-1.9, 0.4, 1.2]),
    "near 180 degrees": (math.pi - 1e-6) * AXIS,
    "180 degrees": math.pi * np.array([1.0, 0.0, 0.0]),
}


def measured(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> dict[str, Array]:
    """Return what one beam, or a shape of them, reads; everything of a size that shows errors."""
    beam_b = rng.normal(size=(*shape, 3))
    return {
        "speed": np.asarray(rng.normal(size=shape)),
        "gyro_b": rng.normal(size=(*shape, 3)),
        "beam_b": beam_b / np.linalg.norm(beam_b, axis=-1, keepdims=True),
        "lever_arm_b": rng.normal(size=3),
        "omega_ie_n": OMEGA_IE_N,
    }


def values_at(R_nb: Array, v_n: Array, gyro_bias: Array) -> gtsam.Values:
    """Return the states of one keyframe."""
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3(R_nb), np.array([10.0, -20.0, -30.0])))
    values.insert(V(0), v_n)
    values.insert(B(0), gtsam.imuBias.ConstantBias(np.array([0.1, 0.2, 0.3]), gyro_bias))
    return values


def one_beam(beam: dict[str, Any], **changes: Any) -> gtsam.CustomFactor:
    """Return the factor of one beam on the keys of keyframe 0."""
    return dvl_beam_factor(X(0), V(0), B(0), **({"sigma": 0.005} | beam | changes))


@pytest.mark.parametrize("attitude", ATTITUDES.values(), ids=ATTITUDES)
def test_truth_has_no_error(attitude: Array) -> None:
    """A speed made element by element from the vehicle's motion leaves nothing."""
    rng = np.random.default_rng(1)
    beam, R_nb, v_n, bias = (
        measured(rng),
        rotation(attitude),
        rng.normal(size=3),
        rng.normal(size=3),
    )
    rate = beam["gyro_b"] - bias - R_nb.T @ OMEGA_IE_N
    lever = beam["lever_arm_b"]
    turning = np.array(
        [
            rate[1] * lever[2] - rate[2] * lever[1],
            rate[2] * lever[0] - rate[0] * lever[2],
            rate[0] * lever[1] - rate[1] * lever[0],
        ]
    )
    speed = float(beam["beam_b"] @ (R_nb.T @ v_n + turning))
    factor = one_beam(beam, speed=speed)
    assert abs(float(factor.unwhitenedError(values_at(R_nb, v_n, bias))[0])) < 1e-14


@pytest.mark.parametrize("attitude", ATTITUDES.values(), ids=ATTITUDES)
@pytest.mark.parametrize("seed", range(3))
def test_jacobians_of_the_pure_function(attitude: Array, seed: int) -> None:
    """Every block agrees with central differences, many beams at once."""
    rng = np.random.default_rng(seed)
    beam = measured(rng, (5, 4))
    R_nb = np.broadcast_to(rotation(attitude), (5, 4, 3, 3))
    v_n, bias = rng.normal(size=(5, 4, 3)), rng.normal(size=(5, 4, 3))
    analytic = beam_residual(R_nb, v_n, bias, **beam)

    def moved(d_phi: Array, d_v: Array, d_bias: Array) -> Array:
        return beam_error(R_nb @ rotation(d_phi), v_n + d_v, bias + d_bias, **beam)

    step, zero = 1e-5, np.zeros(3)
    for axis, unit in enumerate(step * np.eye(3)):
        for block, ends in (
            (analytic.error_D_rotation, (moved(unit, zero, zero), moved(-unit, zero, zero))),
            (analytic.error_D_velocity_n, (moved(zero, unit, zero), moved(zero, -unit, zero))),
            (analytic.error_D_gyro_bias, (moved(zero, zero, unit), moved(zero, zero, -unit))),
        ):
            numeric = (ends[0] - ends[1]) / (2.0 * step)
            np.testing.assert_allclose(block[..., axis], numeric, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("attitude", ATTITUDES.values(), ids=ATTITUDES)
@pytest.mark.parametrize("seed", range(3))
def test_jacobians_through_gtsam(attitude: Array, seed: int) -> None:
    """The adapter places the blocks in GTSAM's tangent spaces of pose, velocity and bias."""
    rng = np.random.default_rng(seed)
    factor = one_beam(measured(rng), weight=0.3)
    values = values_at(rotation(attitude), rng.normal(size=3), rng.normal(size=3))
    assert_jacobians_match(factor, values)


def test_jacobian_check_notices_a_wrong_block() -> None:
    """The check of the tests above is able to fail: here for a factor with one sign turned."""
    beam = measured(np.random.default_rng(0))

    def wrong(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        R_nb = values.atPose3(this.keys()[0]).rotation().matrix()
        residual = beam_residual(R_nb, np.ones(3), np.zeros(3), **beam)
        if jacobians is not None:
            jacobians[0] = np.hstack([-residual.error_D_rotation, np.zeros(3)])[None, :]
        return np.atleast_1d(residual.error)

    factor = gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, 0.1), [X(0)], wrong)
    with pytest.raises(AssertionError):
        assert_jacobians_match(factor, values_at(np.eye(3), np.ones(3), np.zeros(3)))


def test_no_jacobian_work_unless_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error alone never calls the function that makes Jacobians."""
    rng = np.random.default_rng(2)
    factor = one_beam(measured(rng))
    values = values_at(rotation([0.1, 0.2, 0.3]), rng.normal(size=3), np.zeros(3))
    calls = []
    original = beam_residual

    def counted(*args: Any, **kwargs: Any) -> Any:
        calls.append(1)
        return original(*args, **kwargs)

    monkeypatch.setattr(factors.dvl_beam, "beam_residual", counted)
    factor.error(values)
    factor.unwhitenedError(values)
    assert calls == []
    factor.linearize(values)
    assert calls == [1]


def test_three_beams_without_lever_arm_equal_a_prior_on_velocity() -> None:
    """Level, unbiased, with beams along the axes, beams are GTSAM's own prior on the velocity."""
    v_n = np.array([1.3, -0.4, 0.2])
    values = values_at(np.eye(3), v_n, np.zeros(3))
    beams, prior = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    speed = np.array([1.0, 0.0, 0.1])
    for axis in range(3):
        beams.add(
            dvl_beam_factor(
                X(0),
                V(0),
                B(0),
                sigma=0.02,
                speed=speed[axis],
                gyro_b=np.full(3, np.pi),
                beam_b=np.eye(3)[axis],
                lever_arm_b=np.zeros(3),
                omega_ie_n=OMEGA_IE_N,
            )
        )
    prior.addPriorVector(V(0), speed, gtsam.noiseModel.Isotropic.Sigma(3, 0.02))
    assert beams.error(values) == pytest.approx(prior.error(values), rel=1e-12)
    keys = gtsam.Ordering()
    for key in (B(0), V(0), X(0)):
        keys.push_back(key)
    jacobian, rhs = beams.linearize(values).jacobian(keys)
    expected, expected_rhs = prior.linearize(values).jacobian()
    np.testing.assert_allclose(jacobian[:, 6:9], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rhs, expected_rhs, rtol=1e-12)
    np.testing.assert_array_equal(jacobian[:, :6], 0.0)


def test_error_does_not_depend_on_position_or_accelerometer_bias() -> None:
    """What has no part in a beam speed may even be NaN."""
    rng = np.random.default_rng(3)
    factor = one_beam(measured(rng))
    values = values_at(rotation([0.5, 0.1, -0.9]), rng.normal(size=3), rng.normal(size=3))
    expected = factor.unwhitenedError(values)
    pose, bias = values.atPose3(X(0)), values.atConstantBias(B(0))
    values.update(X(0), gtsam.Pose3(pose.rotation(), np.full(3, np.nan)))
    values.update(B(0), gtsam.imuBias.ConstantBias(np.full(3, np.nan), bias.gyroscope()))
    np.testing.assert_array_equal(factor.unwhitenedError(values), expected)


@pytest.mark.parametrize("weight", [1.0, 0.04, 1e-8])
def test_weight_divides_the_variance(weight: float) -> None:
    """The cost is half of weight times the squared residual in sigmas."""
    rng = np.random.default_rng(4)
    beam = measured(rng)
    values = values_at(rotation([0.5, 0.1, -0.9]), rng.normal(size=3), rng.normal(size=3))
    error = float(one_beam(beam).unwhitenedError(values)[0])
    cost = one_beam(beam, sigma=0.07, weight=weight).error(values)
    assert cost == pytest.approx(0.5 * weight * (error / 0.07) ** 2, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, np.array([0.0, np.nan, 0.0])) for name in ("gyro_b", "beam_b", "lever_arm_b")),
        *((name, np.array([0.0, np.inf, 0.0])) for name in ("omega_ie_n", "beam_b")),
        *((name, np.zeros(shape)) for name in ("gyro_b", "beam_b") for shape in (2, 4, (1, 3))),
        *(("sigma", value) for value in (0.0, -0.1, math.nan, math.inf)),
        *(("weight", value) for value in (0.0, -1.0, math.nan, math.inf)),
        *(("speed", value) for value in (math.nan, math.inf, -math.inf)),
    ],
)
def test_bad_input_is_refused_by_name(name: str, value: Any) -> None:
    """Nothing that could become NaN, or a block of the wrong shape, reaches GTSAM."""
    beam = measured(np.random.default_rng(5))
    with pytest.raises(ValueError, match=rf"dvl_beam_factor: .*{name}"):
        one_beam(beam, **{name: value})


def test_factor_keeps_its_own_copy_of_the_measurement() -> None:
    """Arrays changed after the call do not change the factor."""
    rng = np.random.default_rng(6)
    beam = measured(rng)
    values = values_at(rotation([0.2, 0.1, -0.4]), rng.normal(size=3), rng.normal(size=3))
    factor = one_beam(beam)
    before = factor.error(values)
    for name in ("gyro_b", "beam_b", "lever_arm_b"):
        beam[name][:] = np.nan
    assert factor.error(values) == before


def test_bulk_and_one_by_one_agree() -> None:
    """All beams in one call and one CustomFactor each give the same whitened rows."""
    sim = simulated(dropout_rate=0.2)
    problem = build_problem(sim.mission)
    states, beams = true_states(problem, sim), problem.beams
    weights = np.random.default_rng(7).uniform(1e-8, 1.1, len(beams.speed))
    k = beams.keyframe
    bulk = linearize_beams(
        beams,
        rows=slice(None),
        R_nb=states.R_nb[k],
        v_n=states.v_n[k],
        bias=states.bias[k],
        omega_ie_n=problem.frame.omega_ie_n,
    )
    scale = np.sqrt(weights) / beams.sigma
    for row in range(len(k)):
        factor = dvl_beam_factor(
            X(k[row]),
            V(k[row]),
            B(k[row]),
            sigma=beams.sigma[row],
            speed=beams.speed[row],
            gyro_b=beams.gyro_b[row],
            beam_b=beams.beam_b[row],
            lever_arm_b=beams.lever_arm_b,
            omega_ie_n=problem.frame.omega_ie_n,
            weight=weights[row],
        )
        jacobian, rhs = factor.linearize(gtsam_values(states)).jacobian()
        expected = scale[row] * bulk.jacobian[row]
        largest = np.abs(expected).max()
        np.testing.assert_allclose(jacobian[0], expected, rtol=0.0, atol=1e-12 * largest)
        assert float(rhs[0]) == pytest.approx(-scale[row] * bulk.error[row], rel=1e-12)


@pytest.mark.parametrize(
    "route",
    [SurveyRoute(), SpiralRoute(), DiveRoute(), HoverRoute()],
    ids=lambda r: type(r).__name__,
)
def test_agrees_with_the_simulators_own_beam_speeds(route: Route) -> None:
    """The simulator differentiates the instrument's path and knows no ``v + omega x l``.

    True states and the true rate at the ping, and series in place of differences on the
    simulator's side: what is left is rounding.
    """
    sim = simulated(route=route, duration_s=200.0, perfect_sensors=True, imu_rate_hz=10.0)
    problem = build_problem(sim.mission)
    states, beams = true_states(problem, sim), problem.beams
    k = beams.keyframe
    error = beam_error(
        states.R_nb[k],
        states.v_n[k],
        np.zeros(3),
        speed=sim.true_speed.ravel(),
        gyro_b=sim.trajectory.at(problem.keyframe_s[k]).omega_ib_b(),
        beam_b=beams.beam_b,
        lever_arm_b=beams.lever_arm_b,
        omega_ie_n=problem.frame.omega_ie_n,
    )
    assert np.abs(error).max() < 1e-12


def test_a_loss_of_gtsam_goes_around_the_noise() -> None:
    """With Cauchy the cost of a residual of r sigmas is ``k^2/2 ln(1 + r^2/k^2)``."""
    setting: dict[str, Any] = {
        "gyro_b": np.zeros(3),
        "beam_b": np.array([0.0, 0.0, 1.0]),
        "lever_arm_b": np.zeros(3),
        "omega_ie_n": np.zeros(3),
    }
    k, sigma = 2.0, 0.1
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(k)
    factor = dvl_beam_factor(X(0), V(0), B(0), sigma=sigma, speed=0.5, loss=loss, **setting)
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(V(0), np.zeros(3))
    values.insert(B(0), gtsam.imuBias.ConstantBias())
    expected = 0.5 * k**2 * np.log1p((0.5 / sigma) ** 2 / k**2)
    assert factor.error(values) == pytest.approx(expected)
