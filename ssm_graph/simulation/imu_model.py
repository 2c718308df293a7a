"""What an inertial measurement unit reads: averages over its samples, with errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss

from ssm_graph.base.frozen import Array
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation.randomness import Streams
from ssm_graph.simulation.trajectory import Trajectory

N_NODES = 3
"""Nodes of the Gauss-Legendre quadrature per sample. Its error for a sine of frequency ``w`` is
``(w dt)^6 / 2e6`` of the amplitude: 1e-18 for 6 s waves at 100 Hz, 1e-12 at 10 Hz."""
_CHUNK = 2048
"""Samples evaluated at once: the working set stays in the processor's cache."""


class ImuErrors(NamedTuple):
    """Errors of the gyros or of the accelerometers."""

    bias: Array
    """(N, 3) turn-on bias and its walk, as added to each sample."""
    noise: Array
    """(N, 3) white noise of each averaged sample."""


def averaged_imu(
    trajectory: Trajectory, *, rate_hz: float, n_samples: int, n_nodes: int = N_NODES
) -> tuple[Array, Array]:
    """Return the true mean body rate and specific force over each sample.

    Sample ``k`` covers ``(k, k + 1] / rate_hz``. Both are averages of vectors in body axes as the
    body turns, which is what a strapped-down triad reports; the estimators have to undo coning
    and sculling themselves.

    Returns
    -------
    gyro_b : (n_samples, 3) rad/s relative to inertial space.
    accel_b : (n_samples, 3) m/s^2 specific force.
    """
    nodes, weights = leggauss(n_nodes)
    fractions, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    gyro_b, accel_b = np.empty((n_samples, 3)), np.empty((n_samples, 3))
    for begin in range(0, n_samples, _CHUNK):
        end = min(begin + _CHUNK, n_samples)
        motion = trajectory.at((np.arange(begin, end) + fractions[:, None]) / rate_hz)
        np.einsum("q,qki->ki", weights, motion.omega_ib_b(), out=gyro_b[begin:end])
        np.einsum("q,qki->ki", weights, motion.specific_force_b(), out=accel_b[begin:end])
    return gyro_b, accel_b


def imu_errors(
    noise: ImuNoise, *, rate_hz: float, n_samples: int, streams: Streams
) -> tuple[ImuErrors, ImuErrors]:
    """Draw the errors of the gyros and of the accelerometers.

    A mean over ``dt`` of white noise of density ``q`` has the standard deviation ``q / sqrt(dt)``;
    a bias walks by ``q sqrt(dt)`` per sample.
    """
    gyro = _triad_errors(
        (noise.gyro_bias_sigma, noise.gyro_density, noise.gyro_bias_density),
        (streams.gyro_bias, streams.gyro_noise, streams.gyro_walk),
        rate_hz,
        n_samples,
    )
    accel = _triad_errors(
        (noise.accel_bias_sigma, noise.accel_density, noise.accel_bias_density),
        (streams.accel_bias, streams.accel_noise, streams.accel_walk),
        rate_hz,
        n_samples,
    )
    return gyro, accel


def _triad_errors(
    sigmas: tuple[float, float, float],
    rngs: tuple[np.random.Generator, np.random.Generator, np.random.Generator],
    rate_hz: float,
    n_samples: int,
) -> ImuErrors:
    """Draw turn-on bias, white noise and bias walk of three axes, each from its own stream."""
    bias_sigma, density, walk_density = sigmas
    bias_rng, noise_rng, walk_rng = rngs
    walk = walk_density / np.sqrt(rate_hz) * walk_rng.standard_normal((n_samples, 3))
    bias = bias_sigma * bias_rng.standard_normal(3) + np.cumsum(walk, axis=0)
    noise = density * np.sqrt(rate_hz) * noise_rng.standard_normal((n_samples, 3))
    return ImuErrors(bias, noise)
