"""The lane-line factor: truth, Jacobians, no work unasked, a closed form, bad input."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.lane_line import curve_covariance, lane_line_factor, line_residual


def a_case(yaw: float) -> tuple[gtsam.Values, gtsam.CustomFactor]:
    """Return a pose with a factor of four points beside crooked lines."""
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(4, 2))
    normal /= np.hypot(*normal.T)[:, None]
    points = rng.uniform(-5, 40, (4, 2))
    weight = np.array([1.0, 0.5, 0.1, 1.2])
    cov = curve_covariance(points[:, 0], weight, offset=0.05, slope=0.004, scatter=0.03)
    values = gtsam.Values()
    values.insert(7, gtsam.Pose2(3.0, -2.0, yaw))
    feet = rng.normal(size=(4, 2))
    factor = lane_line_factor(7, point_b=points, foot=feet, normal=normal, covariance=cov)
    return values, factor


@pytest.mark.parametrize("yaw", [0.3, 1e-9, np.pi - 1e-7])
def test_jacobian(yaw: float) -> None:
    """Against central differences on the manifold, whitened."""
    values, factor = a_case(yaw)
    columns = []
    for axis in np.eye(3):
        error = []
        for step in (1e-6, -1e-6):
            delta = gtsam.VectorValues()
            delta.insert(7, step * axis)
            error.append(factor.whitenedError(values.retract(delta)))
        columns.append((error[0] - error[1]) / 2e-6)
    analytic, _ = factor.linearize(values).jacobian()
    np.testing.assert_allclose(analytic, np.column_stack(columns), atol=1e-4, rtol=1e-7)


def test_points_on_their_lines_have_no_error() -> None:
    """A line along x at y = 2, seen from a pose that is turned by half a right angle."""
    c = np.sqrt(0.5)
    point_b = np.array([[c, c], [3.0 * c, c]])  # at (0, 1) and (1, 2) from the pose
    found = line_residual(
        np.array([5.0, 1.0]),
        0.25 * np.pi,
        point_b=point_b,
        foot=np.array([[4.0, 2.0], [40.0, 2.0]]),
        normal=np.array([[0.0, 1.0], [0.0, 1.0]]),
    )
    np.testing.assert_allclose(found.error, [0.0, 1.0], atol=1e-12)


def test_along_a_straight_line_nothing_is_measured() -> None:
    """The block has no part along the line, whatever the yaw."""
    normal = np.array([0.6, 0.8])
    for yaw in (0.0, 1.0, -2.5):
        found = line_residual(
            np.zeros(2), yaw, point_b=np.array([10.0, 1.0]), foot=np.ones(2), normal=normal
        )
        R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        along = R.T @ [0.8, -0.6]
        assert found.error_D_pose[:2] @ along == pytest.approx(0.0, abs=1e-12)


def test_no_jacobian_unless_asked_for() -> None:
    """The error alone is the pure function's."""
    values, factor = a_case(0.3)
    error = factor.unwhitenedError(values)
    assert error.shape == (4,)
    assert factor.error(values) > 0.0


def test_common_errors_do_not_average_out() -> None:
    """The mean of many points is no better known than the curve's offset."""
    x = np.linspace(-1.0, 1.0, 200)
    cov = curve_covariance(x, np.ones(200), offset=0.05, slope=0.0, scatter=0.03)
    mean = np.full(200, 1 / 200)
    assert np.sqrt(mean @ cov @ mean) == pytest.approx(np.hypot(0.05, 0.03 / np.sqrt(200)))
    down = curve_covariance(x, np.full(200, 1e-6), offset=0.05, slope=0.0, scatter=0.03)
    assert down[0, 0] == pytest.approx(0.05**2 + 900.0)


def test_shapes_are_checked() -> None:
    """Feet and points that are not as many."""
    with pytest.raises(ValueError, match=r"one shape \(m, 2\)"):
        lane_line_factor(
            0,
            point_b=np.ones((3, 2)),
            foot=np.ones((2, 2)),
            normal=np.ones((3, 2)),
            covariance=np.eye(3),
        )
