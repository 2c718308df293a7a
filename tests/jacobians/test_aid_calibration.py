"""Position fixes and heights with their calibrations: Jacobians, and GTSAM's own as stated."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from factors.depth_height import height_residual
from factors.gnss_position import fix_residual
from ssm_graph.base.frozen import Array
from tests.helpers import rotation

R_NB = rotation([0.3, -1.1, 0.8])
P_N, V_N = np.array([10.0, -20.0, -3.0]), np.array([1.2, -0.4, 0.3])
LEVER, OMEGA, FIX = np.array([0.4, -0.7, 1.1]), np.array([0.2, -0.5, 0.9]), np.ones(3)


def numeric(error: Callable[[Array], Array], size: int = 3, step: float = 1e-6) -> Array:
    """Return the derivative of ``error`` at zero by central differences."""
    columns = [(error(d) - error(-d)) / (2.0 * step) for d in step * np.eye(size)]
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_jacobians_of_a_fix(late_s: float) -> None:
    """Every block."""

    def error(
        phi: Array | None = None,
        shift: Array | None = None,
        dv: Array | None = None,
        dl: Array | None = None,
        late: float = 0.0,
    ) -> Array:
        R = R_NB if phi is None else R_NB @ rotation(phi)
        p = P_N if shift is None else P_N + R_NB @ shift
        return fix_residual(
            R,
            p,
            V_N if dv is None else V_N + dv,
            lever_arm_b=LEVER if dl is None else LEVER + dl,
            time_offset=np.asarray(late_s + late),
            omega_b=OMEGA,
            position_n=FIX,
        ).error

    at = fix_residual(
        R_NB,
        P_N,
        V_N,
        lever_arm_b=LEVER,
        time_offset=np.asarray(late_s),
        omega_b=OMEGA,
        position_n=FIX,
    )
    for block, want in (
        (at.error_D_rotation, numeric(lambda d: error(phi=d))),
        (at.error_D_position, numeric(lambda d: error(shift=d))),
        (at.error_D_velocity_n, numeric(lambda d: error(dv=d))),
        (at.error_D_lever_arm_b, numeric(lambda d: error(dl=d))),
        (at.error_D_time_offset[:, None], numeric(lambda d: error(late=float(d[0])), 1)),
    ):
        np.testing.assert_allclose(block, want, atol=1e-8)


def test_each_fix_has_the_clock_of_its_own_keyframe() -> None:
    """Several at once are those one by one, where the clock is carried in the states."""
    late_s, each = np.array([0.0, 0.3]), []
    fixed = {"lever_arm_b": LEVER, "omega_b": OMEGA, "position_n": FIX}
    for tau in late_s:
        each.append(fix_residual(R_NB, P_N, V_N, time_offset=np.asarray(tau), **fixed))
    R, p, v = (np.stack([x, x]) for x in (R_NB, P_N, V_N))
    both = fix_residual(R, p, v, time_offset=late_s, **fixed)
    for together, *alone in zip(both, *each, strict=True):
        np.testing.assert_allclose(together, np.stack(alone), rtol=0.0, atol=1e-14)


def test_a_late_fix_lies_behind() -> None:
    """Of an antenna on a turning vehicle, half a second late; the turn is of second order."""
    late_s, turn = 0.5, 0.01 * OMEGA
    R_then = R_NB @ rotation(late_s * turn).T
    fix = P_N - late_s * V_N + R_then @ LEVER
    error = fix_residual(
        R_NB,
        P_N,
        V_N,
        lever_arm_b=LEVER,
        time_offset=np.asarray(late_s),
        omega_b=turn,
        position_n=fix,
    ).error
    np.testing.assert_allclose(error, 0.0, atol=1e-4)


def test_as_stated_a_fix_is_that_of_gtsam() -> None:
    """Error and pose block are those of GTSAM's factor with a lever arm."""
    ours = fix_residual(
        R_NB,
        P_N,
        V_N,
        lever_arm_b=LEVER,
        time_offset=np.zeros(()),
        omega_b=OMEGA,
        position_n=FIX,
    )
    factor = gtsam.GPSFactorArm(X(0), FIX, LEVER, gtsam.noiseModel.Unit.Create(3))
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3(R_NB), P_N))
    jacobian, b = factor.linearize(values).jacobian()
    np.testing.assert_allclose(ours.error, -b, atol=1e-12)
    both = np.hstack([ours.error_D_rotation, ours.error_D_position])
    np.testing.assert_allclose(both, jacobian, atol=1e-12)


def test_jacobians_of_a_height() -> None:
    """Every block; a depth read too large puts the sensor too low."""
    up_n = np.array([0.01, -0.02, 1.0]) / np.linalg.norm([0.01, -0.02, 1.0])

    def error(phi: Array, shift: Array, offset: float = 0.0) -> Array:
        R = R_NB @ rotation(phi)
        return height_residual(
            R,
            P_N + R_NB @ shift,
            lever_arm_b=LEVER,
            offset=np.asarray(0.2 + offset),
            up_n=up_n,
            target_n=FIX,
        ).error

    still = np.zeros(3)
    at = height_residual(
        R_NB, P_N, lever_arm_b=LEVER, offset=np.asarray(0.2), up_n=up_n, target_n=FIX
    )
    np.testing.assert_allclose(at.error_D_rotation, numeric(lambda d: error(d, still)), atol=1e-8)
    np.testing.assert_allclose(at.error_D_position, numeric(lambda d: error(still, d)), atol=1e-8)
    slope = (error(still, still, 1e-3) - error(still, still, -1e-3)) / 2e-3
    np.testing.assert_allclose(at.error_D_offset, slope)
    low = height_residual(
        np.eye(3),
        np.array([0.0, 0.0, -10.0]),
        lever_arm_b=still,
        offset=np.asarray(0.3),
        up_n=np.array([0.0, 0.0, 1.0]),
        target_n=np.array([0.0, 0.0, -10.3]),
    )
    assert abs(float(low.error)) < 1e-12
