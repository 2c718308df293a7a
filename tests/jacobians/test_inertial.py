"""The inertial residual: GTSAM's Galilean factor, and its derivatives by differences."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from factors.inertial import (
    InertialState,
    Intervals,
    predict,
    whitened_error,
    whitened_rows,
)
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import NavigationStates
from ssm_graph.imu.preintegration import (
    Preintegrated,
    gravity_gradient,
    imu_params,
    intervals_of,
)
from ssm_graph.simulation import IMU_NOISE, Grade

COLUMNS = np.r_[0:9, 18:24, 9:18, 24:30, 30]
"""Of GTSAM's factor, x_i v_i x_j v_j b_i b_j and b, as two error states and b."""
ATTITUDES = {"any": 1.2, "near identity": 1e-9, "near pi": np.pi - 1e-7}
G_N = np.array([0.01, -0.02, -9.79])


class StillFrame(LocalFrame):
    """A frame on an Earth that does not turn."""

    @property
    def omega_ie_n(self) -> Array:
        """(3,) rad/s."""
        return np.zeros(3)


FRAMES = {"turning Earth": LocalFrame(0.8, 0.3, 0.0), "at rest": StillFrame(0.8, 0.3, 0.0)}


def measured(frame: LocalFrame, *, seed: int = 0) -> Preintegrated:
    """Return a second of rolling and pitching, integrated about a bias that is not zero."""
    rng = np.random.default_rng(seed)
    params = imu_params(IMU_NOISE[Grade.MEMS], g_n=G_N, frame=frame)
    about = gtsam.imuBias.ConstantBias(0.1 * rng.normal(size=3), 0.01 * rng.normal(size=3))
    pim = Preintegrated(params, about)
    for _ in range(20):
        force = np.array([0.0, 0.0, -9.8]) + 2.0 * rng.normal(size=3)
        pim.integrateMeasurement(force, 0.5 * rng.normal(size=3), 0.05)
    return pim


def ends(
    pim: Preintegrated, *, turn: float, off: float, seed: int = 1
) -> tuple[NavigationStates, NavigationStates]:
    """Return a state turned by so much, and one that is ``off`` where the data lead from there."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    R_nb = gtsam.Rot3.Expmap(turn * axis / np.linalg.norm(axis))
    begin = gtsam.NavState(R_nb, 300.0 * rng.normal(size=3), rng.normal(size=3))
    biases = rng.normal(size=(2, 6)) * np.repeat([0.1, 0.01], 3)
    bias = gtsam.imuBias.ConstantBias(biases[0, :3], biases[0, 3:])
    end = pim.predict(begin, bias).retract(off * rng.normal(size=9))
    made = (
        NavigationStates(
            state.attitude().matrix()[None],
            state.position()[None],
            state.velocity()[None],
            own[None],
        )
        for state, own in zip((begin, end), biases, strict=True)
    )
    return next(made), next(made)


def gtsam_rows(pim: Preintegrated, begin: NavigationStates, end: NavigationStates) -> Array:
    """Return the whitened rows (15, 31) of GTSAM's factor."""
    values = gtsam.Values()
    for i, state in enumerate((begin, end)):
        values.insert(X(i), pose3=gtsam.Pose3(gtsam.Rot3(state.R_nb[0]), state.p_n[0]))
        values.insert(V(i), state.v_n[0])
        own = gtsam.imuBias.ConstantBias(state.bias[0, :3], state.bias[0, 3:])
        values.insert(B(i), constant_bias=own)
    factor = gtsam.GalileanCombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), pim)
    return np.asarray(factor.linearize(values).augmentedJacobian()[:, COLUMNS])


@pytest.mark.parametrize("off", [1e-6, 0.3, 1.0])
@pytest.mark.parametrize("turn", ATTITUDES.values(), ids=ATTITUDES)
@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES)
def test_it_is_gtsams_factor(frame: LocalFrame, turn: float, off: float) -> None:
    """Error and Jacobian to rounding, row by row, gravity the same everywhere."""
    pim = measured(frame)
    begin, end = ends(pim, turn=turn, off=off)
    intervals = intervals_of([pim], frame)
    rows = whitened_rows(intervals, begin, end, g_n=G_N[None], gradient=np.zeros((3, 3)))[0]
    expected = gtsam_rows(pim, begin, end)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(rows / scale, expected / scale, rtol=0.0, atol=1e-12)
    error = whitened_error(intervals, begin, end, g_n=G_N[None])[0]
    np.testing.assert_allclose(error, -rows[:, -1], rtol=1e-12, atol=1e-12 * np.abs(error).max())


@pytest.mark.parametrize("turn", ATTITUDES.values(), ids=ATTITUDES)
def test_jacobians_against_differences(turn: float) -> None:
    """At both ends, gravity led after the middle of the positions."""
    frame = FRAMES["turning Earth"]
    intervals = intervals_of([measured(frame)], frame)
    begin, end = ends(measured(frame), turn=turn, off=0.3)
    gradient = 1e3 * gravity_gradient(frame)  # to be seen beside everything else
    middle = 0.5 * (begin.p_n + end.p_n)

    def error(a: NavigationStates, b: NavigationStates) -> Array:
        g_n = G_N + (0.5 * (a.p_n + b.p_n) - middle) @ gradient.T
        return np.asarray(whitened_error(intervals, a, b, g_n=g_n)[0])

    rows = whitened_rows(intervals, begin, end, g_n=G_N[None], gradient=gradient)[0]
    for column in range(30):
        step = np.zeros((1, 15))
        step[0, column % 15] = 1e-5
        moved = [
            error(begin.moved(s * step), end) if column < 15 else error(begin, end.moved(s * step))
            for s in (1.0, -1.0)
        ]
        slope, expected = (moved[0] - moved[1]) / 2e-5, rows[:, column]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(slope / scale, expected / scale, rtol=0.0, atol=2e-6)


def test_the_prediction_has_no_error_and_its_rows_are_those_there() -> None:
    """State, transition and noise of a prediction are what the rows at it say."""
    frame = FRAMES["turning Earth"]
    intervals, gradient = intervals_of([measured(frame)], frame), gravity_gradient(frame)
    begin, _ = ends(measured(frame), turn=1.2, off=0.0)
    ahead = predict(intervals, begin, g_n=G_N[None], gradient=gradient)
    rows = whitened_rows(intervals, begin, ahead.state, g_n=G_N[None], gradient=gradient)[0]
    scale = np.abs(rows).max(axis=1, keepdims=True)
    np.testing.assert_allclose(ahead.rows(intervals)[0] / scale, rows / scale, atol=1e-12)
    A_i, A_j = rows[:, :15], rows[:, 15:30]
    solved = np.linalg.solve(A_j, np.hstack([-A_i, np.eye(15)]))
    np.testing.assert_allclose(ahead.transition[0], solved[:, :15], rtol=0.0, atol=1e-12)
    noise = solved[:, 15:] @ solved[:, 15:].T
    sigma = np.sqrt(np.diag(noise))
    unit = sigma[:, None] * sigma
    np.testing.assert_allclose(ahead.noise(intervals)[0] / unit, noise / unit, atol=1e-10)


def test_many_intervals_are_each_alone() -> None:
    """More than are done at once; the last is as it is by itself."""
    frame, n = FRAMES["turning Earth"], 300
    one = intervals_of([measured(frame)], frame)
    begin, end = ends(measured(frame), turn=1.2, off=0.3)
    rows = whitened_rows(
        Intervals.joined([one] * n),
        InertialState(*(np.repeat(column, n, axis=0) for column in begin)),
        InertialState(*(np.repeat(column, n, axis=0) for column in end)),
        g_n=np.repeat(G_N[None], n, axis=0),
        gradient=np.zeros((3, 3)),
    )
    alone = whitened_rows(one, begin, end, g_n=G_N[None], gradient=np.zeros((3, 3)))
    np.testing.assert_allclose(rows[[0, 150, -1]], np.repeat(alone, 3, axis=0), rtol=1e-12)
