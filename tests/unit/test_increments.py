"""Merging of raw inertial samples: totals, cuts, bounds, coning and sculling."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

from factors.so3 import left_jacobian_solve, left_jacobian_times
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.imu.increments import (
    MergedSamples,
    merge_samples,
)
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.simulation import IMU_NOISE, Grade
from tests.helpers import STEADY

NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(10)


def imu_log(edges: Array, gyro_b: Array, accel_b: Array) -> ImuLog:
    """Return samples between ``edges``."""
    return ImuLog(
        start_s=float(edges[0]),
        noise=IMU_NOISE[Grade.NAVIGATION],
        time_s=edges[1:],
        gyro_b=gyro_b,
        accel_b=accel_b,
    )


def constant_log(edges: Array) -> ImuLog:
    """Return samples of a constant rate and force."""
    n = len(edges) - 1
    return imu_log(edges, np.tile([0.3, -0.2, 0.1], (n, 1)), np.tile([1.0, 2.0, -9.8], (n, 1)))


def averaged(signal: Callable[[Array], Array], edges: Array) -> Array:
    """Return the mean of a vector signal over each sample, by Gauss-Legendre quadrature."""
    half, mid = 0.5 * np.diff(edges), 0.5 * (edges[:-1] + edges[1:])
    values = signal(mid[:, None] + half[:, None] * NODES)
    return np.asarray(0.5 * np.einsum("q,kqi->ki", NODE_WEIGHTS, values))


def composed(merged: MergedSamples) -> tuple[Rotation, Array]:
    """Return turn and velocity change over all samples, each of constant rate and force.

    By quadrature over each sample: no formula of the code under test.
    """
    theta = merged.gyro_b * merged.dt[:, None]
    part = 0.5 * (NODES + 1.0)[:, None, None] * theta
    force = np.tile(merged.accel_b, (len(NODES), 1))
    turned = Rotation.from_rotvec(part.reshape(-1, 3)).apply(force).reshape(part.shape)
    gained = 0.5 * np.einsum("q,qki->ki", NODE_WEIGHTS, turned) * merged.dt[:, None]
    R, total = np.eye(3), np.zeros(3)
    for step, v in zip(Rotation.from_rotvec(theta).as_matrix(), gained, strict=True):
        total = total + R @ v
        R = R @ step
    return Rotation.from_matrix(R), total


irregular = st.lists(st.floats(1e-3, 0.2), min_size=3, max_size=60).map(
    lambda steps: np.concatenate([[0.0], np.cumsum(steps)])
)
fractions = st.lists(st.floats(0.0, 1.0), min_size=2, max_size=8, unique=True).map(np.array)


def cuts_inside(edges: Array, fraction: Array) -> Array:
    """Return strictly increasing keyframe times inside the samples."""
    times = np.unique(edges[0] + np.sort(fraction) * (edges[-1] - edges[0]))
    times = times[np.concatenate([[True], np.diff(times) > 1e-3])]
    return times if len(times) > 1 else edges[[0, -1]]


@STEADY
@given(edges=irregular, fraction=fractions, rate_hz=st.floats(1.0, 500.0))
def test_constant_motion_is_kept_exactly(edges: Array, fraction: Array, rate_hz: float) -> None:
    """Whatever the samples and cuts: constant rate and force come out as they went in."""
    keyframe_s = cuts_inside(edges, fraction)
    merged = merge_samples(constant_log(edges), keyframe_s, rate_hz=rate_hz)
    np.testing.assert_allclose(merged.gyro_b, np.tile([0.3, -0.2, 0.1], (len(merged.dt), 1)))
    np.testing.assert_allclose(merged.accel_b, np.tile([1.0, 2.0, -9.8], (len(merged.dt), 1)))


@STEADY
@given(edges=irregular, fraction=fractions, rate_hz=st.floats(1.0, 500.0))
def test_cuts_lie_exactly_at_the_keyframes(edges: Array, fraction: Array, rate_hz: float) -> None:
    """Each interval's samples fill it, and there are not more of them than its length allows."""
    keyframe_s = cuts_inside(edges, fraction)
    merged = merge_samples(constant_log(edges), keyframe_s, rate_hz=rate_hz)
    assert merged.first[0] == 0
    assert merged.first[-1] == len(merged.dt)
    assert np.all(merged.dt > 0.0)
    counts = np.diff(merged.first)
    assert np.all(counts >= 1)
    spans = np.diff(keyframe_s)
    np.testing.assert_allclose(np.add.reduceat(merged.dt, merged.first[:-1]), spans, atol=1e-14)
    assert np.all(counts <= np.maximum(np.ceil(spans * rate_hz - 1e-6), 1.0))


@STEADY
@given(edges=irregular, rate_hz=st.floats(1.0, 500.0), seed=st.integers(0, 99))
def test_totals_of_any_signal_are_kept(edges: Array, rate_hz: float, seed: int) -> None:
    """About a fixed axis nothing turns away: the sums of angle and velocity are those read."""
    rng = np.random.default_rng(seed)
    n = len(edges) - 1
    axis = np.array([0.6, 0.0, 0.8])
    gyro_b, accel_b = rng.normal(size=(n, 1)) * axis, rng.normal(size=(n, 1)) * axis
    keyframe_s = edges[np.unique([0, n // 3, n // 2, n])]
    merged = merge_samples(imu_log(edges, gyro_b, accel_b), keyframe_s, rate_hz=rate_hz)
    dt = np.diff(edges)
    for got, given_b in ((merged.gyro_b, gyro_b), (merged.accel_b, accel_b)):
        np.testing.assert_allclose(merged.dt @ got, dt @ given_b, rtol=0.0, atol=1e-12)


def test_a_cut_sample_keeps_its_own_total() -> None:
    """The slope shifts the two parts of a cut sample against each other, not their sum."""
    edges = np.linspace(0.0, 1.0, 11)
    ramp = averaged(lambda t: t[..., None] ** 2 * [0.0, 0.0, 1.0], edges)
    merged = merge_samples(imu_log(edges, ramp, ramp), np.array([0.0, 0.53, 1.0]), rate_hz=1.0)
    np.testing.assert_allclose(merged.dt @ merged.gyro_b, [0.0, 0.0, 1.0 / 3.0], atol=1e-15)
    # And the first part is that of the signal: t^3/3 to second order in the sample.
    for rates in (merged.gyro_b, merged.accel_b):
        assert rates[0, 2] * 0.53 == pytest.approx(0.53**3 / 3.0, abs=1e-4)


@pytest.mark.parametrize("nudge", [-1e-15, 0.0, 1e-15])
def test_rounding_makes_no_samples_of_its_own(nudge: float) -> None:
    """Keyframes that miss a sample's end by rounding do not add samples of no length."""
    edges = np.arange(0, 1001) / 100.0
    inner = np.arange(1, 10) + nudge * np.arange(1, 10)
    keyframe_s = np.concatenate([[0.0], inner, [10.0]])
    merged = merge_samples(constant_log(edges), keyframe_s, rate_hz=20.0)
    np.testing.assert_array_equal(np.diff(merged.first), 20)
    np.testing.assert_allclose(merged.dt, 0.05, rtol=1e-9)


def test_a_rate_above_that_of_the_samples_merges_nothing() -> None:
    """Without cuts the samples come back, coning and sculling added."""
    edges = np.arange(0, 51) / 100.0
    log = constant_log(edges)
    merged = merge_samples(log, edges[[0, -1]], rate_hz=1e9)
    np.testing.assert_allclose(merged.dt, 0.01, rtol=1e-9)
    np.testing.assert_allclose(merged.gyro_b, log.gyro_b, rtol=1e-12)


CONE, CONE_RATE = 0.1, 2.0 * math.pi / 0.5


def coning_rate(t: Array) -> Array:
    """Return the body rate of a body whose x axis sweeps a cone of half angle CONE."""
    w, angle = CONE_RATE, CONE
    return np.stack(
        [
            np.full_like(t, -2.0 * w * math.sin(0.5 * angle) ** 2),
            -w * math.sin(angle) * np.sin(w * t),
            w * math.sin(angle) * np.cos(w * t),
        ],
        axis=-1,
    )


def coning_attitude(t: float) -> Rotation:
    """Return the closed-form attitude of classical coning."""
    w, half = CONE_RATE, 0.5 * CONE
    s = math.sin(half)
    return Rotation.from_quat([0.0, s * math.cos(w * t), s * math.sin(w * t), math.cos(half)])


def sculling_force(t: Array) -> Array:
    """Return a specific force in step with the coning."""
    w = CONE_RATE
    zero = np.zeros_like(t)
    return np.stack([zero, 3.0 * np.cos(w * t), 2.0 * np.sin(w * t) + 1.0], axis=-1)


def coning_errors(raw_hz: float, rate_hz: float, *, t0: float = 1.0, t1: float = 5.0) -> Any:
    """Return attitude (rad) and velocity errors (m/s) from t0 to t1 against the closed forms."""
    n = round(6.0 * raw_hz)
    edges = np.linspace(0.0, 6.0, n + 1)
    log = imu_log(edges, averaged(coning_rate, edges), averaged(sculling_force, edges))
    turned, gained = composed(merge_samples(log, np.array([t0, t1]), rate_hz=rate_hz))
    start = coning_attitude(t0)
    attitude = float(np.linalg.norm((turned.inv() * start.inv() * coning_attitude(t1)).as_rotvec()))
    velocity, _ = quad_vec(
        lambda t: start.inv().apply(coning_attitude(t).apply(sculling_force(np.array(t)))),
        t0,
        t1,
        epsabs=1e-11,
    )
    return attitude, float(np.linalg.norm(gained - velocity))


def test_coning_and_sculling_errors_fall_with_the_fourth_power() -> None:
    """Slopes from the neighbours leave an error of fourth order; halving the step divides by 16."""
    coarse, fine = (coning_errors(raw_hz, 1e9) for raw_hz in (25.0, 50.0))
    for before, after in zip(coarse, fine, strict=True):
        assert 12.0 < before / after < 20.0


def test_coning_is_far_below_that_of_plain_samples() -> None:
    """Plain samples drift by their classical amount, compensated ones by less than a hundredth."""
    drift = 4.0 * 0.5 * CONE_RATE * math.sin(CONE) ** 2 * (CONE_RATE / 100.0) ** 2 / 6.0
    edges = np.linspace(1.0, 5.0, 401)
    rate = averaged(coning_rate, edges)
    plain, _ = composed(MergedSamples(np.diff(edges), rate, rate, np.array([0, 400])))
    missed = coning_attitude(1.0) * plain * coning_attitude(5.0).inv()
    assert float(missed.magnitude()) == pytest.approx(drift, rel=0.02)
    assert coning_errors(100.0, 1e9)[0] < 0.01 * drift


@pytest.mark.parametrize("rate_hz", [50.0, 20.0, 5.0, 1.0])
def test_merging_adds_no_error(rate_hz: float) -> None:
    """What 100 Hz samples say survives their merging: attitude and velocity agree to rounding."""
    rng = np.random.default_rng(0)
    edges = np.concatenate([[0.0], np.cumsum(rng.uniform(0.005, 0.015, 400))])
    log = imu_log(edges, rng.normal(size=(400, 3)), 10.0 * rng.normal(size=(400, 3)))
    keyframe_s = np.array([0.0131, 1.0, 1.0571, 3.1234])
    raw, merged = (merge_samples(log, keyframe_s, rate_hz=r) for r in (1e9, rate_hz))
    assert len(merged.dt) < 0.6 * len(raw.dt)
    for k in range(3):
        ends = []
        for samples in (raw, merged):
            part = slice(samples.first[k], samples.first[k + 1])
            ends.append(
                composed(
                    MergedSamples(
                        samples.dt[part], samples.gyro_b[part], samples.accel_b[part], samples.first
                    )
                )
            )
        (turned, gained), (merged_turned, merged_gained) = ends
        assert float((turned.inv() * merged_turned).magnitude()) < 1e-13
        np.testing.assert_allclose(merged_gained, gained, rtol=0.0, atol=1e-12)


vectors = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(np.array)


@STEADY
@given(axis=vectors, log_angle=st.floats(-9.0, 0.45), vector=vectors)
def testleft_jacobian_is_the_mean_rotation(axis: Array, log_angle: float, vector: Array) -> None:
    """``int_0^1 Exp(s phi) ds v`` by quadrature, from 1e-9 to 2.8 rad; the solve undoes it."""
    phi = 10.0**log_angle * axis / max(float(np.linalg.norm(axis)), 1e-6)
    s, weights = np.polynomial.legendre.leggauss(16)
    turned = Rotation.from_rotvec(0.5 * (s[:, None] + 1.0) * phi).apply(vector)
    expected = 0.5 * weights @ turned
    got = left_jacobian_times(phi, vector)
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(left_jacobian_solve(phi, got), vector, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("angle", [0.0, 0.00999999, 0.01000001])
def testleft_jacobian_has_no_seam(angle: float) -> None:
    """Either side of the switch to the series both forms agree to rounding."""
    phi, vector = angle * np.array([0.6, 0.0, 0.8]), np.array([1.0, -2.0, 3.0])
    s, weights = np.polynomial.legendre.leggauss(8)
    expected = 0.5 * weights @ Rotation.from_rotvec(0.5 * (s[:, None] + 1.0) * phi).apply(vector)
    np.testing.assert_allclose(left_jacobian_times(phi, vector), expected, rtol=0.0, atol=5e-14)
    np.testing.assert_allclose(left_jacobian_solve(phi, expected), vector, rtol=0.0, atol=5e-14)


@pytest.mark.parametrize("rate_hz", [0.0, -20.0, math.nan, math.inf])
def test_bad_rates_are_refused(rate_hz: float) -> None:
    """The message says what was expected."""
    edges = np.linspace(0.0, 1.0, 11)
    with pytest.raises(ConfigError, match="merge rate: expected a positive rate in Hz"):
        merge_samples(constant_log(edges), edges[[0, -1]], rate_hz=rate_hz)


@pytest.mark.parametrize("ends", [(-0.1, 1.0), (0.0, 1.1)])
def test_keyframes_outside_the_data_are_refused(ends: tuple[float, float]) -> None:
    """No inertial data, no interval; the message gives both spans."""
    edges = np.linspace(0.0, 1.0, 11)
    with pytest.raises(DataError, match=r"outside the inertial data 0\.000\.\.1\.000 s"):
        merge_samples(constant_log(edges), np.array(ends), rate_hz=20.0)


def test_one_sample_is_enough() -> None:
    """Without neighbours there is no slope, and the sample stays as it is."""
    merged = merge_samples(constant_log(np.array([0.0, 0.1])), np.array([0.02, 0.07]), rate_hz=20.0)
    np.testing.assert_allclose(merged.dt, [0.05])
    np.testing.assert_allclose(merged.accel_b, [[1.0, 2.0, -9.8]])
