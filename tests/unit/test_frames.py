"""Attitude conversions: laws, then hand-turned attitudes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_graph.base.frames import (
    R_ENU_NED,
    R_lb_from_roll_pitch_heading,
    phi_D_roll_pitch_heading,
    roll_pitch_heading_from_R_lb,
    rotation_zyx,
    wrap_to_pi,
)
from ssm_graph.base.frozen import Array
from tests.helpers import STEADY, rotation

rolls = st.floats(-math.pi, math.pi)
pitches = st.floats(-1.55, 1.55)
headings = st.floats(0.0, 2.0 * math.pi)


def elementary(axis: int, angle: float) -> Array:
    """Return the textbook rotation about one axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i] = R[j, j] = math.cos(angle)
    R[i, j], R[j, i] = -math.sin(angle), math.sin(angle)
    return R


@STEADY
@given(roll=rolls, pitch=pitches, heading=headings)
def test_attitude_is_the_chain_of_elementary_turns(
    roll: float, pitch: float, heading: float
) -> None:
    """Heading, pitch, roll from north-east-down axes, then east-north-up."""
    chain = elementary(2, heading) @ elementary(1, pitch) @ elementary(0, roll)
    np.testing.assert_allclose(rotation_zyx(heading, pitch, roll), chain, atol=1e-14)
    R_lb = R_lb_from_roll_pitch_heading(roll, pitch, heading)
    np.testing.assert_allclose(R_lb, R_ENU_NED @ chain, atol=1e-14)
    assert float(np.linalg.det(R_lb)) == pytest.approx(1.0)


@STEADY
@given(roll=rolls, pitch=pitches, heading=headings)
def test_angles_round_trip(roll: float, pitch: float, heading: float) -> None:
    """Angles come back, heading in 0..2 pi, as long as the pitch is not vertical."""
    got = roll_pitch_heading_from_R_lb(R_lb_from_roll_pitch_heading(roll, pitch, heading))
    # Near a vertical pitch its sine loses digits, and roll with it.
    tolerance = 1e-13 / math.cos(pitch) ** 2
    assert abs(float(wrap_to_pi(got[0] - roll))) < tolerance
    assert abs(float(got[1]) - pitch) < tolerance
    assert abs(float(wrap_to_pi(got[2] - heading))) < tolerance
    assert 0.0 <= float(got[2]) <= 2.0 * math.pi


@pytest.mark.parametrize(
    ("heading_deg", "forward"),
    [(0.0, [0, 1, 0]), (90.0, [1, 0, 0]), (180.0, [0, -1, 0]), (270.0, [-1, 0, 0])],
)
def test_heading_counts_clockwise_from_north(heading_deg: float, forward: list[int]) -> None:
    """A level vehicle heading east looks along the first axis, and its z axis points down."""
    R_lb = R_lb_from_roll_pitch_heading(0.0, 0.0, math.radians(heading_deg))
    np.testing.assert_allclose(R_lb[:, 0], forward, atol=1e-15)
    np.testing.assert_allclose(R_lb[:, 2], [0, 0, -1], atol=1e-15)


def test_signs_of_roll_and_pitch() -> None:
    """Positive pitch lifts the bow, positive roll lowers the starboard side."""
    assert R_lb_from_roll_pitch_heading(0.0, 0.1, 1.0)[2, 0] > 0.0
    assert R_lb_from_roll_pitch_heading(0.1, 0.0, 1.0)[2, 1] < 0.0


@STEADY
@given(roll=rolls, pitch=st.floats(-1.4, 1.4), heading=headings)
def test_jacobian_of_the_angles(roll: float, pitch: float, heading: float) -> None:
    """``R(rph + d) = R(rph) Exp(J d)``: what is left is of second order."""
    J = phi_D_roll_pitch_heading(roll, pitch)
    step = 1e-6
    for axis in range(3):
        d = step * np.eye(3)[axis]
        moved = R_lb_from_roll_pitch_heading(roll + d[0], pitch + d[1], heading + d[2])
        expected = R_lb_from_roll_pitch_heading(roll, pitch, heading) @ rotation(J @ d)
        np.testing.assert_allclose(moved, expected, rtol=0.0, atol=2.0 * step**2)


def test_many_attitudes_at_once() -> None:
    """Leading axes broadcast, and each attitude is as if alone."""
    roll, heading = np.array([[0.1], [0.2]]), np.array([0.3, 1.4, 2.5])
    R_lb = R_lb_from_roll_pitch_heading(roll, 0.05, heading)
    assert R_lb.shape == (2, 3, 3, 3)
    np.testing.assert_allclose(R_lb[1, 2], R_lb_from_roll_pitch_heading(0.2, 0.05, 2.5), atol=1e-15)
    assert phi_D_roll_pitch_heading(roll, np.zeros(3)).shape == (2, 3, 3, 3)
    assert roll_pitch_heading_from_R_lb(R_lb)[2].shape == (2, 3)


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0.0, 0.0), (3.0, 3.0), (4.0, 4 - 2 * math.pi), (-math.pi, -math.pi), (9.0, 9 - 2 * math.pi)],
)
def test_wrapping(angle: float, wrapped: float) -> None:
    """Angles end in [-pi, pi)."""
    assert float(wrap_to_pi(angle)) == pytest.approx(wrapped, abs=1e-15)
    assert float(wrap_to_pi(np.pi)) == -np.pi


def test_constant_rotation_cannot_be_changed() -> None:
    """A shared matrix is read-only, and its own inverse."""
    np.testing.assert_array_equal(R_ENU_NED @ R_ENU_NED, np.eye(3))
    with pytest.raises(ValueError, match="read-only"):
        R_ENU_NED[0, 0] = 1.0
