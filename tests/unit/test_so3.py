"""Rotation algebra against SciPy and against quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factors import so3
from ssm_graph.base.frozen import Array

ANGLES = (1e-12, 1e-6, 0.009, 0.011, 0.099, 0.101, 1.0, 3.0)


def vectors(angle: float) -> Array:
    """Return five rotation vectors of one angle."""
    directions = np.random.default_rng(1).normal(size=(5, 3))
    return np.asarray(angle * directions / np.linalg.norm(directions, axis=1, keepdims=True))


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_log_are_those_of_scipy(angle: float) -> None:
    """On both sides of every change of formula."""
    phi = vectors(angle)
    R = Rotation.from_rotvec(phi).as_matrix()
    np.testing.assert_allclose(so3.exp(phi), R, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(so3.log(R), phi, rtol=1e-9, atol=1e-13 * angle)


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_is_the_mean_rotation(angle: float) -> None:
    """``int_0^1 Exp(s phi) ds``, by Gauss-Legendre, and its inverse."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    share = 0.5 * (nodes + 1.0)
    for phi in vectors(angle):
        turned = Rotation.from_rotvec(share[:, None] * phi).as_matrix()
        mean = np.tensordot(0.5 * weights, turned, axes=1)
        np.testing.assert_allclose(so3.left_jacobian(phi), mean, rtol=0.0, atol=1e-13)
    phi, arm = vectors(angle), vectors(1.0)[::-1]
    moved = so3.left_jacobian_times(phi, arm)
    np.testing.assert_allclose(moved, (so3.left_jacobian(phi) @ arm[..., None])[..., 0], atol=1e-15)
    np.testing.assert_allclose(so3.left_jacobian_solve(phi, moved), arm, rtol=0.0, atol=1e-12)


def test_skew_is_the_cross_product() -> None:
    """``[a x] b = a x b``."""
    a, b = vectors(1.3), vectors(0.4)[::-1]
    product = (so3.skew(a) @ b[..., None])[..., 0]
    np.testing.assert_allclose(product, np.cross(a, b), rtol=0.0, atol=1e-16)
