"""Preintegrated measurements as arrays, for estimators that are not GTSAM."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from ssm_graph.base.frozen import Array
from ssm_graph.imu.preintegration import InertialChain, Preintegrated


class Intervals(NamedTuple):
    """What the inertial sensors say of N intervals, relative to the attitude at their begin."""

    dt: Array
    """(N,) s"""
    delta_R: Array
    """(N, 3, 3) rotation of the body"""
    delta_p: Array
    """(N, 3) m, displacement by specific force"""
    delta_v: Array
    """(N, 3) m/s, velocity change by specific force"""
    delta_D_bias: Array
    """(N, 9, 6) rotation, position, velocity, all in body axes at the end, with respect to the
    biases: a bias ``b`` moves the increment by ``Exp(delta_D_bias b)``."""
    covariance: Array
    """(N, 15, 15) noise of rotation, position, velocity (body axes at the end) and biases."""


def interval_arrays(chain: InertialChain) -> Intervals:
    """Read the preintegrated measurements of a chain, all preintegrated about zero bias."""
    measurements = chain.measurements
    return Intervals(
        dt=np.array([m.deltaTij() for m in measurements]),
        delta_R=np.array([m.deltaRij().matrix() for m in measurements]),
        delta_p=np.array([m.deltaPij() for m in measurements]),
        delta_v=np.array([m.deltaVij() for m in measurements]),
        delta_D_bias=_delta_D_bias(measurements, chain.frame.omega_ie_n),
        covariance=np.array([m.residualCovariance() for m in measurements]),
    )


# Columns of a linearised factor: x_i 6, v_i 3, x_j 6, v_j 3, b_i 6, b_j 6.
_BEGIN_BIAS, _END = slice(18, 24), np.r_[9:18, 24:30]


def _delta_D_bias(measurements: Sequence[Preintegrated], omega_ie_n: Array) -> Array:
    """Return the bias Jacobians (N, 9, 6), which GTSAM does not show, from linearised factors."""
    at_rest, no_bias = gtsam.NavState(), gtsam.imuBias.ConstantBias()
    values = gtsam.Values()
    values.insert(X(0), pose3=at_rest.pose())
    values.insert(V(0), at_rest.velocity())
    for k in (0, 1):
        values.insert(B(k), constant_bias=no_bias)
    values.insert(X(1), pose3=at_rest.pose())
    values.insert(V(1), at_rest.velocity())
    whitened, R_nb = np.empty((len(measurements), 15, 30)), np.empty((len(measurements), 3, 3))
    for i, measured in enumerate(measurements):
        end = measured.predict(at_rest, no_bias)
        values.update(X(1), pose3=end.pose())
        values.update(V(1), end.velocity())
        factor = gtsam.GalileanCombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), measured)
        whitened[i] = factor.linearize(values).jacobian()[0]
        R_nb[i] = end.attitude().matrix()
    moved = np.linalg.solve(whitened[:, :, _END], -whitened[:, :, _BEGIN_BIAS])[:, :9]
    # The end's velocity is relative to the Earth and along the navigation axes.
    x, y, z = omega_ie_n
    Omega = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    velocity_n = moved[:, 6:] + Omega @ R_nb @ moved[:, 3:6]
    return np.concatenate([moved[:, :6], np.swapaxes(R_nb, 1, 2) @ velocity_n], axis=1)
