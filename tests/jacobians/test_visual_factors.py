"""Ranges over a scaled map and reprojections as factors in anyone's graph of GTSAM's."""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, B, C, L, S, X

from factors.reprojection import reprojection_factor
from factors.scaled_range import scaled_range_factor
from ssm_graph.base.frozen import Array
from tests.helpers import assert_jacobians_match, rotation

ATTITUDES = {
    "random": rotation([0.3, -1.1, 0.8]),
    "near identity": rotation([1e-6, -2e-6, 1e-6]),
    "near pi": rotation([0.02, -0.03, math.pi - 1e-3]),
}
P_M = np.array([0.4, -0.7, 0.2])
IN_CAMERA = np.array([0.5, -0.3, 2.0])
RANGE: dict[str, Any] = {
    "sigma": 0.08,
    "range_m": 6.0,
    "lever_arm_c": np.array([0.1, -0.2, 0.05]),
    "velocity_m": np.array([0.3, 0.1, -0.2]),
}
KEYS = (X(0), S(0), A(0), B(0), C(0))


def at(R_mc: Array, *, scale: float = 2.5, bias: float = 0.05, clock: float = 0.02) -> gtsam.Values:
    """Return a camera, a point before it, and all that a range needs."""
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3(R_mc), P_M))
    values.insert(L(0), P_M + R_mc @ IN_CAMERA)
    for key, value in ((S(0), math.log(scale)), (B(0), bias), (C(0), clock)):
        values.insert(key, np.array([value]))
    values.insert(A(0), np.array([4.0, 1.0, -2.0]))
    return values


@pytest.mark.parametrize("R_mc", ATTITUDES.values(), ids=ATTITUDES)
def test_jacobians(R_mc: Array) -> None:
    """Against central differences."""
    seen = np.array([0.2, -0.1])
    for factor in (
        scaled_range_factor(KEYS, **RANGE),
        reprojection_factor(X(0), L(0), sigma=0.5, seen=seen),
    ):
        assert_jacobians_match(factor, at(R_mc))


def test_at_scale_one_it_is_the_range_factor_of_gtsam() -> None:
    """Without bias and clock; the antenna stands where the lever arm says."""
    R_mc = ATTITUDES["random"]
    values = at(R_mc, scale=1.0, bias=0.0, clock=0.0)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, RANGE["sigma"])
    arm = gtsam.Pose3(gtsam.Rot3(), RANGE["lever_arm_c"])
    theirs = gtsam.RangeFactorWithTransform3D(X(0), A(1), RANGE["range_m"], noise, arm)
    values.insert(A(1), gtsam.Pose3(gtsam.Rot3(), values.atVector(A(0))))
    try:
        expected = theirs.error(values)
    except RuntimeError:  # this GTSAM wants a point
        values.erase(A(1))
        values.insert(A(1), values.atVector(A(0)))
        expected = theirs.error(values)
    assert scaled_range_factor(KEYS, **RANGE).error(values) == pytest.approx(expected, rel=1e-12)


def test_a_reprojection_is_that_of_gtsam() -> None:
    """With a calibration of ones."""
    values, seen = at(ATTITUDES["random"]), np.array([0.2, -0.1])
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
    theirs = gtsam.GenericProjectionFactorCal3_S2(seen, noise, X(0), L(0), gtsam.Cal3_S2())
    ours = reprojection_factor(X(0), L(0), sigma=0.5, seen=seen)
    assert ours.error(values) == pytest.approx(theirs.error(values), rel=1e-12)
    np.testing.assert_allclose(
        ours.linearize(values).jacobian()[0], theirs.linearize(values).jacobian()[0], atol=1e-12
    )


def test_a_weight_divides_the_variance() -> None:
    """A quarter of it costs a quarter."""
    values = at(ATTITUDES["random"])
    for weight, share in ((1.0, 1.0), (0.25, 0.25)):
        found = scaled_range_factor(KEYS, **RANGE, weight=weight).error(values)
        whole = scaled_range_factor(KEYS, **RANGE).error(values)
        assert found == pytest.approx(share * whole)


def test_what_is_not_finite_is_refused() -> None:
    """Before GTSAM sees it."""
    with pytest.raises(ValueError, match="range_m"):
        scaled_range_factor(KEYS, **(RANGE | {"range_m": math.nan}))
    with pytest.raises(ValueError, match="seen"):
        reprojection_factor(X(0), L(0), sigma=1.0, seen=np.zeros(3))
