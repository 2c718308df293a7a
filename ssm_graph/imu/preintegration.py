"""Preintegrated inertial measurements of GTSAM, over a rotating Earth with its real gravity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, finished
from ssm_graph.imu.increments import MergedSamples, merge_samples_steps
from ssm_graph.sensors.imu import ImuLog, ImuNoise

INTEGRATION_DENSITY = 1e-4
"""m/sqrt(s): what the integration itself loses. At 20 Hz a constant force within each sample costs
0.15 mm of position a wave; this density costs 6 mm in an hour. It also keeps intervals of one
sample well-conditioned."""
GAP_GYRO_RATE = 0.2
"""rad/s, 1 sigma of the unseen body rate inside a gap of the inertial data."""
GAP_ACCEL = 1.0
"""m/s^2, 1 sigma of the unseen specific force inside a gap of the inertial data."""
GRAVITY = 9.8
"""m/s^2"""
GRADIENT_REACH = 1000.0
"""m, over which the gradient of gravity is taken."""
ORIGIN = np.zeros(3)
"""Of the navigation frame."""
ORIGIN.setflags(write=False)
LIVELY_S = 5.0
"""Before and after a gap, what is seen tells how lively the unseen may have been."""
LIVELIER = 1.5
LIVELY_GAP_S = 1.0
"""By so much more than what is seen, by less in gaps shorter than that, and by a tenth of the above
besides."""
LEAST_SEEN = 50
"""Samples that have to be seen, or the above is taken."""

Preintegrated = gtsam.PreintegratedCombinedMeasurementsG


@dataclass(frozen=True, slots=True)
class InertialChain:
    """Preintegrated measurements between successive keyframes, each with its own parameters.

    The parameters are held apart because gravity follows the estimate: see :meth:`set_gravity`.
    """

    measurements: tuple[Preintegrated, ...]
    params: tuple[gtsam.PreintegrationCombinedParams, ...]
    frame: LocalFrame

    def set_gravity(self, p_n: Array) -> None:
        """Evaluate gravity of each interval at the middle of its keyframes' positions (K, 3).

        GTSAM's Coriolis term holds ``omega x (omega x p)`` with ``p`` from the origin of ``n``,
        and plumb-line gravity holds the centrifugal acceleration already, so that term is added
        back: ``n_gravity = g_n(p) + omega x (omega x p)``.
        """
        gravity = gtsam_gravity(self.frame, 0.5 * (p_n[:-1] + p_n[1:]))
        for params, g_n in zip(self.params, gravity, strict=True):
            params.n_gravity = g_n


def gtsam_gravity(frame: LocalFrame, p_n: Array) -> Array:
    """Return the gravity (..., 3) to hand to GTSAM at positions ``p_n``, m/s^2."""
    omega = frame.omega_ie_n
    return np.asarray(frame.g_n_at(p_n) + np.cross(omega, np.cross(omega, p_n)))


def gravity_gradient(frame: LocalFrame, p_n: Array = ORIGIN) -> Array:
    """Return how that gravity changes with position (3, 3), 1/s^2, about ``p_n`` (3,)."""
    around = p_n + GRADIENT_REACH * np.vstack([np.eye(3), -np.eye(3)])
    at = gtsam_gravity(frame, around)
    return np.asarray((at[:3] - at[3:]).T / (2.0 * GRADIENT_REACH))


def preintegrate(
    imu: ImuLog, keyframe_s: Array, *, frame: LocalFrame, rate_hz: float, bias: Array | None = None
) -> InertialChain:
    """Preintegrate the inertial data between keyframes.

    Parameters
    ----------
    imu : raw samples.
    keyframe_s : (K,) times of the keyframes, s.
    frame : navigation frame; gives the Earth rate.
    rate_hz : rate to which raw samples are merged first.
    bias : (6,) accelerometer and gyro bias about which to linearise, m/s^2 and rad/s.

    Returns
    -------
    InertialChain
        Of K - 1 measurements, gravity set for the origin of ``frame``.
    """
    return finished(preintegrate_steps(imu, keyframe_s, frame=frame, rate_hz=rate_hz, bias=bias))


def preintegrate_steps(
    imu: ImuLog, keyframe_s: Array, *, frame: LocalFrame, rate_hz: float, bias: Array | None = None
) -> Steps[InertialChain]:
    """Make :func:`preintegrate` in steps."""
    gaps = imu_gaps(imu)
    unseen = _unseen(imu, keyframe_s, gaps)
    yield 3e-4 * len(imu.time_s)
    merged = yield from merge_samples_steps(bridged(imu, gaps), keyframe_s, rate_hz=rate_hz)
    g_n = gtsam_gravity(frame, ORIGIN)
    bias = np.zeros(6) if bias is None else bias
    bias_hat = gtsam.imuBias.ConstantBias(bias[:3], bias[3:])
    params = tuple(
        imu_params(imu.noise, g_n=g_n, frame=frame, unseen=motion, span_s=span)
        for motion, span in zip(unseen, np.diff(keyframe_s), strict=True)
    )
    yield 0.02 * len(params)
    measurements = yield from _integrate_steps(merged, params, bias_hat)
    return InertialChain(measurements, params, frame)


def _integrate_steps(
    merged: MergedSamples,
    params: Sequence[gtsam.PreintegrationCombinedParams],
    bias: gtsam.imuBias.ConstantBias,
) -> Steps[tuple[Preintegrated, ...]]:
    measurements = []
    dts = merged.dt.tolist()
    for k, interval_params in enumerate(params):
        measured = Preintegrated(interval_params, bias)
        for i in range(merged.first[k], merged.first[k + 1]):
            measured.integrateMeasurement(merged.accel_b[i], merged.gyro_b[i], dts[i])
        measurements.append(measured)
        yield 0.02
    return tuple(measurements)


class Unseen(NamedTuple):
    """Motion inside a gap of the inertial data, 1 sigma off what bridges it."""

    gap_s: float = 0.0
    rate: float = GAP_GYRO_RATE
    """rad/s"""
    force: float = GAP_ACCEL
    """m/s^2"""


def imu_params(
    noise: ImuNoise,
    *,
    g_n: Array,
    frame: LocalFrame,
    unseen: Unseen | None = None,
    span_s: float = 1.0,
) -> gtsam.PreintegrationCombinedParams:
    """Return GTSAM's parameters of one interval.

    Over a gap within an interval of ``span_s`` the motion is bridged by the mean of the samples on
    both sides; the noise grows so that the interval's covariance covers what is unseen.
    """
    gap_s, rate, force = unseen or Unseen()
    # GTSAM takes continuous-time densities squared and divides by dt itself: do not pre-scale.
    # Every covariance defaults to identity, so each one is set.
    gyro_sq = noise.gyro_density**2 + (rate * gap_s) ** 2 / span_s
    # What the attitude is off, gravity pulls into the force.
    force = math.hypot(force, 0.5 * GRAVITY * rate * gap_s)
    accel_sq = noise.accel_density**2 + (force * gap_s) ** 2 / span_s
    eye = np.eye(3)
    params = gtsam.PreintegrationCombinedParams(g_n)
    params.setOmegaCoriolis(frame.omega_ie_n)
    params.setGyroscopeCovariance(gyro_sq * eye)
    params.setAccelerometerCovariance(accel_sq * eye)
    params.setIntegrationCovariance(INTEGRATION_DENSITY**2 * eye)
    # A bias that does not walk still needs a regular covariance: a thousandth of its turn-on
    # sigma in an hour is none.
    floor = 1e-3 / 60.0
    params.setBiasOmegaCovariance(
        max(noise.gyro_bias_density, floor * noise.gyro_bias_sigma) ** 2 * eye
    )
    params.setBiasAccCovariance(
        max(noise.accel_bias_density, floor * noise.accel_bias_sigma) ** 2 * eye
    )
    return params


def imu_gaps(imu: ImuLog) -> tuple[Array, Array]:
    """Return begin and end of every gap: an interval far longer than the usual one, s."""
    edges = np.concatenate([[imu.start_s], imu.time_s])
    spacing = np.diff(edges)
    is_gap = spacing > max(0.1, 5.0 * float(np.median(spacing)))
    return edges[:-1][is_gap], edges[1:][is_gap]


def _unseen(imu: ImuLog, keyframe_s: Array, gaps: tuple[Array, Array]) -> list[Unseen]:
    """Return what is not seen of each interval between keyframes: its longest stretch of a gap."""
    unseen = [Unseen()] * (len(keyframe_s) - 1)
    for begin, end in zip(*gaps, strict=True):
        rate, force = _liveliness(imu, begin, end)
        overlap = np.minimum(end, keyframe_s[1:]) - np.maximum(begin, keyframe_s[:-1])
        for k in np.flatnonzero(overlap > 0.0).tolist():
            if overlap[k] > unseen[k].gap_s:
                unseen[k] = Unseen(float(overlap[k]), rate, force)
    return unseen


def _liveliness(imu: ImuLog, begin: float, end: float) -> tuple[float, float]:
    """Return how far rate and force may be off what bridges a gap, by what is seen around it."""
    near = (imu.time_s > begin - LIVELY_S) & (imu.time_s <= end + LIVELY_S)
    # The sample that ends the gap claims to be the mean over it; it is no more than a bridge.
    near &= imu.time_s != end
    if near.sum() < LEAST_SEEN:
        return GAP_GYRO_RATE, GAP_ACCEL
    more = min(LIVELIER, (end - begin) / LIVELY_GAP_S)
    rate, force = (more * float(seen[near].std(axis=0).max()) for seen in (imu.gyro_b, imu.accel_b))
    return (
        min(rate + 0.1 * GAP_GYRO_RATE, GAP_GYRO_RATE),
        min(force + 0.1 * GAP_ACCEL, GAP_ACCEL),
    )


def bridged(imu: ImuLog, gaps: tuple[Array, Array]) -> ImuLog:
    """Return the log with the sample that ends a gap as the mean of what is seen on both sides.

    As it stands it would claim its own reading for the whole of the gap, also that of gravity in
    axes that have turned meanwhile.
    """
    _, end = gaps
    k = np.searchsorted(imu.time_s, end)
    k = k[k > 0]
    if len(k) == 0:
        return imu
    columns = {name: getattr(imu, name).copy() for name in ("gyro_b", "accel_b")}
    for name, column in columns.items():
        column[k] = 0.5 * (getattr(imu, name)[k - 1] + getattr(imu, name)[k])
    return replace(imu, **columns)
