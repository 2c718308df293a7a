"""The magnetometer's factor: Jacobians, closed forms, GTSAM's own factor, bad input."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from factors.magnetic_field import field_residual, magnetic_field_factor
from ssm_graph.base.frozen import Array
from tests.helpers import rotation

ATTITUDES = {
    "random": rotation([0.3, -1.1, 0.8]),
    "near identity": rotation([1e-6, -2e-6, 1e-6]),
    "near pi": rotation([0.02, -0.03, math.pi - 1e-3]),
}
FIELD_N = np.array([2e-6, 18e-6, -45e-6])
HARD_B, SOFT = np.array([3e-6, -2e-6, 1e-6]), np.array([0.05, -0.03, 0.02, 0.01, -0.02, 0.04])
READING_B = np.array([10e-6, 5e-6, 40e-6])


def error(R: Array, field: Array = FIELD_N, hard: Array = HARD_B, soft: Array = SOFT) -> Array:
    """Return the error of the reading."""
    return field_residual(
        R, field_n=field, hard_iron_b=hard, soft_iron=soft, reading_b=READING_B
    ).error


def slopes(moved: Callable[[Array], Array], size: int, step: float) -> Array:
    """Return the derivative (3, size) at zero by central differences."""
    return np.array([(moved(d) - moved(-d)) / (2 * step) for d in step * np.eye(size)]).T


@pytest.mark.parametrize("R_nb", ATTITUDES.values(), ids=ATTITUDES)
def test_jacobians(R_nb: Array) -> None:
    """Every block against central differences."""
    at = field_residual(
        R_nb, field_n=FIELD_N, hard_iron_b=HARD_B, soft_iron=SOFT, reading_b=READING_B
    )
    for block, moved, size, step in (
        (at.error_D_rotation, lambda d: error(R_nb @ rotation(d)), 3, 1e-5),
        (at.error_D_field_n, lambda d: error(R_nb, FIELD_N + d), 3, 1e-6),
        (at.error_D_soft_iron, lambda d: error(R_nb, soft=SOFT + d), 6, 1e-4),
        (np.eye(3), lambda d: error(R_nb, hard=HARD_B + d), 3, 1e-6),
    ):
        np.testing.assert_allclose(
            block, slopes(moved, size, step), atol=1e-6 * np.abs(block).max()
        )


def test_zero_at_the_truth_and_many_at_once() -> None:
    """A reading made of its own model has no error; rows broadcast."""
    R_nb = np.array(list(ATTITUDES.values()))
    S = np.array([[0.05, 0.01, -0.02], [0.01, -0.03, 0.04], [-0.02, 0.04, 0.02]])
    readings = np.array([(np.eye(3) + S) @ R.T @ FIELD_N + HARD_B for R in R_nb])
    at = field_residual(
        R_nb, field_n=FIELD_N, hard_iron_b=HARD_B, soft_iron=SOFT, reading_b=readings
    )
    np.testing.assert_allclose(at.error, 0.0, atol=1e-20)
    assert at.error_D_soft_iron.shape == (3, 3, 6)
    for i, R in enumerate(R_nb):
        one = field_residual(
            R, field_n=FIELD_N, hard_iron_b=HARD_B, soft_iron=SOFT, reading_b=readings[i]
        )
        np.testing.assert_array_equal(at.error_D_soft_iron[i], one.error_D_soft_iron)


@pytest.mark.parametrize("R_nb", ATTITUDES.values(), ids=ATTITUDES)
def test_without_iron_it_is_that_of_gtsam(R_nb: Array) -> None:
    """GTSAM's own factor of a magnetometer, on a rotation alone."""
    scale, direction = float(np.linalg.norm(FIELD_N)), gtsam.Unit3(FIELD_N)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1e-7)
    theirs = gtsam.MagFactor1(X(0), READING_B, scale, direction, np.zeros(3), noise)
    rotations, poses = gtsam.Values(), gtsam.Values()
    rotations.insert(X(0), gtsam.Rot3(R_nb))
    poses.insert(X(0), gtsam.Pose3(gtsam.Rot3(R_nb), np.ones(3)))
    ours = magnetic_field_factor(X(0), sigma=1e-7, reading_b=READING_B, field_n=FIELD_N)
    expected, b = theirs.linearize(rotations).jacobian()
    found, b_ours = ours.linearize(poses).jacobian()
    np.testing.assert_allclose(found[:, :3], expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(b_ours, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(found[:, 3:], 0.0)
    weighted = magnetic_field_factor(
        X(0), sigma=1e-7, reading_b=READING_B, field_n=FIELD_N, weight=0.25
    )
    assert weighted.error(poses) == pytest.approx(0.25 * ours.error(poses))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sigma": 0.0}, "sigma and weight above zero"),
        ({"weight": -1.0}, "sigma and weight above zero"),
        ({"reading_b": np.zeros(2)}, "reading_b: expected 3 finite numbers"),
        ({"field_n": np.array([0.0, np.nan, 0.0])}, "field_n: expected 3 finite numbers"),
    ],
)
def test_bad_input_is_refused(wrong: dict[str, Any], message: str) -> None:
    """A wrong shape would crash the process."""
    given: dict[str, Any] = {"sigma": 1e-7, "reading_b": READING_B, "field_n": FIELD_N, **wrong}
    with pytest.raises(ValueError, match=message):
        magnetic_field_factor(X(0), **given)
