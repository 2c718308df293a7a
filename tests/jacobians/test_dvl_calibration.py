"""The beam of a miscalibrated DVL: Jacobians, the stated instrument, the ping before its stamp."""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, V, X
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

import factors.dvl_calibration
from factors.dvl_beam import beam_residual
from factors.dvl_calibration import (
    Motion,
    calibrated_beam_error,
    calibrated_beam_factor,
    calibrated_beam_residual,
    led_back,
    no_way_back,
    turned_instrument,
)
from ssm_graph.base.frozen import Array
from tests.helpers import assert_jacobians_match, rotation

OMEGA_IE_N = 7.292115e-5 * np.array([0.0, math.cos(0.8), math.sin(0.8)])
G_N = np.array([0.0, 0.0, -9.81])
ATTITUDES = {
    "near identity": np.array([1e-7, 2e-7, -1e-7]),
    "random": np.array([0.3, -1.1, 0.8]),
    "near 180 degrees": (math.pi - 1e-6) * np.array([2.0, -1.0, 2.0]) / 3.0,
}
AXIS = np.array([0.6, 0.0, 0.8])


def rate(t: float) -> Array:
    """Return the body rate at ``t`` s, turning about one axis, rad/s."""
    return AXIS * (0.4 + 0.5 * t)


def angle(t: float) -> Array:
    """Return the rotation vector from time 0 to ``t``."""
    return AXIS * (0.4 * t + 0.25 * t**2)


def force(t: float) -> Array:
    """Return the specific force at ``t``, m/s^2."""
    return np.array([0.5 + t, -0.3, -9.8 + 2.0 * t])


def motion_before(late_s: float) -> Motion:
    """Return the exact motion of a ping ``late_s`` before its keyframe, which is at time 0."""
    turn = angle(0.0) - angle(-late_s)
    # Body at s to body at 0: Exp(angle(0) - angle(s))', which commute about one axis.
    gain, _ = quad_vec(
        lambda s: rotation(angle(s) - angle(0.0)) @ force(s), -late_s, 0.0, epsabs=1e-14
    )
    return Motion(turn, gain, rate(-late_s), force(-late_s), AXIS * 0.5)


def stated(rng: np.random.Generator) -> dict[str, Any]:
    """Return what is written about one beam."""
    beam_b = rng.normal(size=3)
    return {
        "beam_b": beam_b / np.linalg.norm(beam_b),
        "R_bd": rotation(np.array([0.02, -0.3, 1.1])),
        "lever_arm_b": rng.normal(size=3),
        "omega_ie_n": OMEGA_IE_N,
        "g_n": G_N,
    }


@pytest.mark.parametrize("attitude", ATTITUDES.values(), ids=ATTITUDES)
@pytest.mark.parametrize("late_s", [0.0, 0.08, -0.15])
def test_jacobians_through_gtsam(attitude: Array, late_s: float) -> None:
    """Every block, of the state and of each calibration, at large values of all of them."""
    rng = np.random.default_rng(5)
    factor = calibrated_beam_factor(
        (X(0), V(0), B(0)),
        mounting=C(0),
        scale=C(1),
        lever_arm=C(2),
        time_offset=C(3),
        motion=motion_before,
        sigma=0.005,
        speed=0.7,
        **stated(rng),
    )
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3(rotation(attitude)), np.array([1.0, 2.0, 3.0])))
    values.insert(V(0), rng.normal(size=3))
    values.insert(B(0), gtsam.imuBias.ConstantBias(1e-5 * rng.normal(size=3), np.zeros(3)))
    values.insert(C(0), np.array([0.1, -0.2, 0.3]))
    values.insert(C(1), np.array([-0.03]))
    values.insert(C(2), np.array([0.2, 0.5, -0.1]))
    values.insert(C(3), np.array([late_s]))
    assert_jacobians_match(factor, values, rtol=2e-6)


def test_as_stated_it_is_the_beam_factor() -> None:
    """With every calibration at zero, error and blocks are those of the plain beam."""
    rng = np.random.default_rng(1)
    how = stated(rng)
    R_nb, v_n, bias, gyro_b = rotation([0.3, 1.0, 2.0]), *rng.normal(size=(2, 3)), np.ones(3)
    bias = np.concatenate([bias, 0.1 * bias])
    got = calibrated_beam_residual(
        R_nb,
        v_n,
        bias,
        instrument=turned_instrument(
            np.zeros(3), how["beam_b"], R_bd=how["R_bd"], lever_arm_b=how["lever_arm_b"]
        ),
        scale=np.zeros(()),
        back=no_way_back(gyro_b),
        speed=np.asarray(0.4),
        omega_ie_n=OMEGA_IE_N,
        g_n=G_N,
    )
    plain = {name: how[name] for name in ("beam_b", "lever_arm_b", "omega_ie_n")}
    want = beam_residual(R_nb, v_n, bias[3:], speed=np.asarray(0.4), gyro_b=gyro_b, **plain)
    for name in ("error", "error_D_rotation", "error_D_velocity_n", "error_D_gyro_bias"):
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), atol=1e-15)
    np.testing.assert_array_equal(got.error_D_accel_bias, 0.0)


def test_many_beams_at_once_are_the_same_as_one_by_one() -> None:
    """Leading axes broadcast, with a scale of its own for each row."""
    rng = np.random.default_rng(2)
    n = 7
    R_nb = Rotation.from_rotvec(rng.normal(size=(n, 3))).as_matrix()
    v_n, bias = rng.normal(size=(n, 3)), 0.01 * rng.normal(size=(n, 6))
    motion = Motion(*(0.05 * rng.normal(size=(n, 3)) for _ in range(5)))
    speed, scale, g_n = rng.normal(size=n), rng.normal(size=n), G_N + rng.normal(size=(n, 3))
    beam_b, late_s = rng.normal(size=(n, 3)), np.asarray(0.1)
    R_bd, mounting, lever = stated(rng)["R_bd"], rng.normal(size=3), np.ones(3)

    def residual(i: Any, function: Any) -> Any:
        return function(
            R_nb[i],
            v_n[i],
            bias[i],
            instrument=turned_instrument(mounting, beam_b[i], R_bd=R_bd, lever_arm_b=lever),
            scale=scale[i],
            back=led_back(Motion(*(column[i] for column in motion)), bias[i], late_s),
            speed=speed[i],
            omega_ie_n=OMEGA_IE_N,
            g_n=g_n[i],
        )

    bulk = residual(np.s_[:], calibrated_beam_residual)
    for i in range(n):
        for got, want in zip(bulk, residual(i, calibrated_beam_residual), strict=True):
            np.testing.assert_allclose(got[i], want, rtol=1e-13, atol=1e-13)
    error = residual(np.s_[:], calibrated_beam_error)
    np.testing.assert_allclose(error, bulk.error, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("late_s", [0.08, -0.3])
def test_the_state_at_the_ping_is_that_of_the_motion(late_s: float) -> None:
    """Attitude and velocity before a keyframe, integrated here, give the speed without error."""
    rng = np.random.default_rng(3)
    how = stated(rng)
    R_nb, v_n = rotation([0.3, -1.1, 0.8]), rng.normal(size=3)
    R_then = R_nb @ rotation(angle(0.0) - angle(-late_s)).T
    change, _ = quad_vec(
        lambda s: R_nb @ rotation(angle(s) - angle(0.0)) @ force(s) + G_N, -late_s, 0.0
    )
    v_then = v_n - change
    speed = how["beam_b"] @ (R_then.T @ v_then + np.cross(rate(-late_s), how["lever_arm_b"]))
    error = calibrated_beam_error(
        R_nb,
        v_n,
        np.zeros(6),
        instrument=turned_instrument(
            np.zeros(3), how["beam_b"], R_bd=how["R_bd"], lever_arm_b=how["lever_arm_b"]
        ),
        scale=np.zeros(()),
        back=led_back(motion_before(late_s), np.zeros(6), np.asarray(late_s)),
        speed=np.asarray(speed),
        omega_ie_n=np.zeros(3),
        g_n=G_N,
    )
    assert abs(float(error)) < 1e-9


def test_no_jacobian_work_when_none_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error alone costs no derivative."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("Jacobians were not asked for")

    monkeypatch.setattr(factors.dvl_calibration, "calibrated_beam_residual", refuse)
    factor = calibrated_beam_factor(
        (X(0), V(0), B(0)),
        mounting=C(0),
        scale=C(1),
        lever_arm=C(2),
        time_offset=C(3),
        motion=motion_before,
        sigma=1.0,
        speed=0.0,
        **stated(np.random.default_rng(0)),
    )
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(V(0), np.ones(3))
    values.insert(B(0), gtsam.imuBias.ConstantBias())
    for i, size in enumerate((3, 1, 3, 1)):
        values.insert(C(i), np.zeros(size))
    assert np.isfinite(factor.error(values))
