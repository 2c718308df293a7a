"""Preintegrated inertial measurements of GTSAM, over a rotating Earth with its real gravity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import gtsam
import numpy as np

from factors import so3
from factors.imu_errors import increment_jacobians, taken_off
from factors.inertial import Intervals
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, Vector
from ssm_graph.base.progress import told
from ssm_graph.base.stepwise import Steps, at_once, finished
from ssm_graph.imu.increments import MergedSamples, merge_samples_steps
from ssm_graph.imu.thinned import sampling_interval, unseen_steps
from ssm_graph.sensors.imu import FrozenAxis, ImuLog, ImuNoise, frozen_axes, imu_gaps

AT_ONCE = 16
"""So many intervals are read from GTSAM at a time: some 1.6 ms."""
INTEGRATION_DENSITY = 1e-4
"""m/sqrt(s): what the integration itself loses. At 20 Hz a constant force within each sample costs
0.15 mm of position a wave; this density costs 6 mm in an hour. It also keeps intervals of one
sample well-conditioned."""
GAP_GYRO_RATE = 0.2
"""rad/s, 1 sigma of the unseen body rate inside a gap of the inertial data."""
GAP_ACCEL = 1.0
"""m/s^2, 1 sigma of the unseen specific force inside a gap of the inertial data."""
TURN_S = 5.0
"""An unseen turn about the body's vertical goes on at its rate for as long as this."""
THAW_S = 2.0
"""Before and after a stretch in which an axis repeats itself, what says how it went on there."""
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


class Unseen(NamedTuple):
    """Motion inside a gap of the inertial data, 1 sigma off what bridges it."""

    gap_s: float = 0.0
    rate: Vector = (GAP_GYRO_RATE,) * 3
    """rad/s, about each axis"""
    force: Vector = (GAP_ACCEL,) * 3
    """m/s^2, along each axis"""


class ErrorSource(NamedTuple):
    """What intervals are made of where errors of the sensors are variables, to make them anew."""

    imu: ImuLog
    keyframe_s: Array
    rate_hz: float
    errors: Array
    """(27,) that are taken off already, see :mod:`factors.imu_errors`"""


@dataclass(frozen=True, slots=True, eq=False)
class InertialChain:
    """Preintegrated inertial data between K successive keyframes, and what they were made of."""

    intervals: Intervals
    """Of the K - 1 ways between successive keyframes"""
    frame: LocalFrame
    samples: MergedSamples
    noise: ImuNoise
    unseen: tuple[Unseen, ...]
    """(K - 1) what is bridged in each interval"""
    bias: Array
    """(6,) about which all are preintegrated, accelerometer m/s^2, gyro rad/s"""
    source: ErrorSource | None = None
    """None where no errors of the sensors are variables"""

    def about_steps(self, errors: Array) -> Steps[InertialChain]:
        """Preintegrate anew with errors (27,) taken off; for a chain with a source."""
        assert self.source is not None
        imu, keyframe_s, rate_hz, _ = self.source
        return (
            yield from preintegrate_steps(
                imu,
                keyframe_s,
                frame=self.frame,
                rate_hz=rate_hz,
                bias=self.bias,
                errors=errors,
            )
        )

    def measured(self, g_n: Array) -> list[Preintegrated]:
        """Return GTSAM's measurements, made anew, for gravity (K - 1, 3) that stays theirs."""
        spans_s = self.intervals.span_s.tolist()
        params = [
            imu_params(self.noise, g_n=own, frame=self.frame, unseen=unseen, span_s=span_s)
            for own, unseen, span_s in zip(g_n, self.unseen, spans_s, strict=True)
        ]
        return finished(_integrate_steps(self.samples, params, self.bias))


def gravity_between(frame: LocalFrame, p_n: Array) -> Array:
    """Return gravity (K - 1, 3) at the middles between successive keyframes' positions (K, 3)."""
    return gtsam_gravity(frame, 0.5 * (p_n[:-1] + p_n[1:]))


def gtsam_gravity(frame: LocalFrame, p_n: Array) -> Array:
    """Return gravity (..., 3) without the centrifugal term at positions ``p_n``, m/s^2.

    The inertial factors' Coriolis term holds ``omega x (omega x p)`` with ``p`` from the origin of
    ``n``, and plumb-line gravity holds the centrifugal acceleration already, so that term is added
    back: ``g_n(p) + omega x (omega x p)``.
    """
    turn = so3.skew(frame.omega_ie_n).T
    return np.asarray(frame.g_n_at(p_n) + p_n @ turn @ turn)


def gravity_gradient(frame: LocalFrame, p_n: Array = ORIGIN) -> Array:
    """Return how that gravity changes with position (3, 3), 1/s^2, about ``p_n`` (3,)."""
    around = p_n + GRADIENT_REACH * np.vstack([np.eye(3), -np.eye(3)])
    at = gtsam_gravity(frame, around)
    return np.asarray((at[:3] - at[3:]).T / (2.0 * GRADIENT_REACH))


def preintegrate_steps(
    imu: ImuLog,
    keyframe_s: Array,
    *,
    frame: LocalFrame,
    rate_hz: float,
    bias: Array | None = None,
    errors: Array | None = None,
    frozen: Sequence[FrozenAxis] = (),
    cuts_gaps: bool = False,
    period_s: float | None = None,
) -> Steps[InertialChain]:
    """Preintegrate the inertial data between keyframes.

    Parameters
    ----------
    imu : raw samples.
    keyframe_s : (K,) times of the keyframes, s.
    frame : navigation frame; gives the Earth rate.
    rate_hz : rate to which raw samples are merged first.
    bias : (6,) accelerometer and gyro bias about which to linearise, m/s^2 and rad/s.
    errors : (27,) of the sensors, see :mod:`factors.imu_errors`, that are taken off first, and that
        the increments follow; without them they do not.
    frozen : axes that repeat themselves by what came before these samples; all that they have
        missed is uncertain in the first interval.
    cuts_gaps : the times cut gaps to pieces, which are off together, not each for itself.
    period_s : the interval between samples where all come, s; that of the log when left out.
    """
    source = None
    if errors is not None:
        source = ErrorSource(imu, keyframe_s, rate_hz, errors)
        imu = without_errors(imu, errors)
    gaps, repeating = imu_gaps(imu), frozen_axes(imu)
    motions = _unseen(imu, keyframe_s, gaps, repeating, frozen, cuts_gaps=cuts_gaps)
    if not cuts_gaps:  # pieces are too short to tell what is missing of them
        edges = np.concatenate([[imu.start_s], imu.time_s])
        period_s = sampling_interval(edges) if period_s is None else period_s
        unseen_s = unseen_steps(imu.time_s, keyframe_s, gaps, period_s)
        for k in np.flatnonzero(unseen_s).tolist():
            turn, push = np.full(3, GAP_GYRO_RATE), np.full(3, GAP_ACCEL)
            motions[k] = _more_unseen(motions[k], float(unseen_s[k]), turn, push)
    unseen = tuple(motions)
    imu = thawed(imu, repeating)
    yield 3e-4 * len(imu.time_s)
    samples = yield from merge_samples_steps(bridged(imu, gaps), keyframe_s, rate_hz=rate_hz)
    bias = np.zeros(6) if bias is None else bias
    nowhere = np.zeros(3)  # gravity is no part of what is measured
    without_gap = imu_params(imu.noise, g_n=nowhere, frame=frame)
    params = [
        imu_params(imu.noise, g_n=nowhere, frame=frame, unseen=motion, span_s=span_s)
        if motion.gap_s
        else without_gap
        for motion, span_s in zip(unseen, np.diff(keyframe_s).tolist(), strict=True)
    ]
    measured = yield from _integrate_steps(samples, params, bias)
    parts = []
    for begin in range(0, len(measured), AT_ONCE):
        parts.append(intervals_of(measured[begin : begin + AT_ONCE], frame))
        yield 0.1 * len(parts[-1].span_s)
    intervals = Intervals.joined(parts) if parts else intervals_of([], frame)
    if errors is not None:
        intervals = yield from following_errors_steps(intervals, samples, errors, bias)
    return InertialChain(intervals, frame, samples, imu.noise, unseen, bias, source)


preintegrate = at_once(preintegrate_steps)


def without_errors(imu: ImuLog, errors: Array) -> ImuLog:
    """Return the log with errors (27,) of :mod:`factors.imu_errors` taken off."""
    if not errors.any():
        return imu
    gyro_b, accel_b = taken_off(errors, imu.gyro_b, imu.accel_b)
    return replace(imu, gyro_b=gyro_b, accel_b=accel_b)


def following_errors_steps(
    intervals: Intervals, samples: MergedSamples, errors: Array, bias: Array
) -> Steps[Intervals]:
    """Return intervals that follow the errors of the sensors, made of these samples.

    ``errors`` (27,) are taken off the samples already, ``bias`` (6,) are those integrated about.
    """
    parts = [np.zeros((0, 9, len(errors)))]
    for begin in range(0, len(samples.first) - 1, 2 * AT_ONCE):
        first = samples.first[begin : begin + 2 * AT_ONCE + 1]
        own = slice(int(first[0]), int(first[-1]))
        parts.append(
            increment_jacobians(
                errors,
                dt=samples.dt[own],
                gyro_b=samples.gyro_b[own],
                accel_b=samples.accel_b[own],
                first=first - first[0],
                bias=bias,
            )
        )
        yield 0.1 * len(parts[-1])
    jacobians = np.concatenate(parts)
    taken = np.tile(errors, (len(jacobians), 1))
    return intervals._replace(errors=taken, delta_D_errors=jacobians)


def _integrate_steps(
    merged: MergedSamples, params: Sequence[gtsam.PreintegrationCombinedParams], bias: Array
) -> Steps[list[Preintegrated]]:
    about = gtsam.imuBias.ConstantBias(bias[:3], bias[3:])
    measurements = []
    samples = list(zip(merged.accel_b, merged.gyro_b, merged.dt.tolist(), strict=True))
    intervals = zip(params, pairwise(merged.first.tolist()), strict=True)
    for interval_params, (begin, end) in told(intervals, len(params)):
        measured = Preintegrated(interval_params, about)
        for sample in samples[begin:end]:
            measured.integrateMeasurement(*sample)
        measurements.append(measured)
        yield 0.02
    return measurements


def intervals_of(measurements: Sequence[Preintegrated], frame: LocalFrame) -> Intervals:
    """Read what GTSAM has preintegrated; what gravity its parameters hold does not matter."""
    omega = frame.omega_ie_n
    return Intervals.of(
        span_s=np.array([m.deltaTij() for m in measurements]),
        delta_R=np.array([m.deltaRij().matrix() for m in measurements]).reshape(-1, 3, 3),
        delta_pv=np.array([(m.deltaPij(), m.deltaVij()) for m in measurements]).reshape(-1, 2, 3),
        bias=np.array([m.biasHatVector() for m in measurements]).reshape(-1, 6),
        delta_D_bias=_delta_D_bias(measurements, omega),
        covariance=np.array([m.residualCovariance() for m in measurements]).reshape(-1, 15, 15),
        omega_ie_n=omega,
    )


def _delta_D_bias(measurements: Sequence[Preintegrated], omega_ie_n: Array) -> Array:
    """Return the bias Jacobians (N, 9, 6): those of where a state at rest is led to."""
    at_rest = gtsam.NavState()
    jacobian, R_nb = np.empty((len(measurements), 9, 6)), np.empty((len(measurements), 3, 3))
    for measured, own, R in zip(measurements, jacobian, R_nb, strict=True):
        R[:] = measured.predict(at_rest, measured.biasHat(), H2=own).attitude().matrix()
    # GTSAM's end has its velocity relative to the Earth.
    jacobian[:, 6:] += R_nb.mT @ so3.skew(omega_ie_n) @ R_nb @ jacobian[:, 3:6]
    return jacobian


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
    gyro_sq = noise.gyro_density**2 + (np.array(rate) * gap_s) ** 2 / span_s
    # What roll and pitch are off, gravity pulls into the force.
    pulled = np.hypot(force, 0.5 * GRAVITY * max(rate[:2]) * gap_s)
    accel_sq = noise.accel_density**2 + (pulled * gap_s) ** 2 / span_s
    eye = np.eye(3)
    params = gtsam.PreintegrationCombinedParams(g_n)
    params.setOmegaCoriolis(frame.omega_ie_n)
    params.setGyroscopeCovariance(np.diag(gyro_sq))
    params.setAccelerometerCovariance(np.diag(accel_sq))
    params.setIntegrationCovariance(INTEGRATION_DENSITY**2 * eye)
    # A bias that does not walk still needs a regular covariance: a thousandth of its turn-on
    # sigma in an hour is none.
    floor = 1e-3 / 60.0
    params.setBiasOmegaCovariance(
        max(noise.gyro_bias_walk, floor * noise.gyro_bias_sigma) ** 2 * eye
    )
    params.setBiasAccCovariance(
        max(noise.accel_bias_walk, floor * noise.accel_bias_sigma) ** 2 * eye
    )
    return params


def _unseen(
    imu: ImuLog,
    keyframe_s: Array,
    gaps: tuple[Array, Array],
    frozen: Sequence[FrozenAxis],
    missed: Sequence[FrozenAxis] = (),
    *,
    cuts_gaps: bool,
) -> list[Unseen]:
    """Return what is not seen of each interval between keyframes.

    That is its longest stretch of a gap, or of gyros or accelerometers that repeat themselves; of
    the first one also what others, ``missed``, have missed since before.
    """
    stretches: list[tuple[float, float, Array, Array]] = []
    for gap in zip(*gaps, strict=True):
        lively, pushed = _liveliness(imu, *gap)
        stretches.append((*gap, np.full(3, lively), np.full(3, pushed)))
    n_gaps = len(stretches)
    stretches += [(axis.begin_s, axis.end_s, *_missing(axis)) for axis in frozen]
    unseen = [Unseen()] * (len(keyframe_s) - 1)
    for number, (begin, end, rate, force) in enumerate(stretches):
        overlap = np.minimum(end, keyframe_s[1:]) - np.maximum(begin, keyframe_s[:-1])
        for k in np.flatnonzero(overlap > 0.0).tolist():
            own_s = float(overlap[k])
            # Variances of pieces add up to that of what is off all the time; and while intervals
            # count as independent, a turn is the same in those that follow.
            whole = (end - begin) / own_s if cuts_gaps else 1.0
            lasts = whole if number < n_gaps else max(min(end - begin, TURN_S) / own_s, 1.0)
            turn, push = rate * np.sqrt([whole, whole, lasts]), force * np.sqrt(whole)
            unseen[k] = _more_unseen(unseen[k], own_s, turn, push)
    for axis in missed:
        unseen[0] = _more_unseen(unseen[0], axis.end_s - axis.begin_s, *_missing(axis))
    return unseen


def _missing(axis: FrozenAxis) -> tuple[Array, Array]:
    """Return by how much rate and force (3,) may be off while an axis repeats itself.

    What it does meanwhile, a turn perhaps, need not resemble what it did before.
    """
    own = np.eye(3)[axis.axis]
    return (GAP_GYRO_RATE * own, 0.0 * own) if axis.is_gyro else (0.0 * own, GAP_ACCEL * own)


def _more_unseen(known: Unseen, gap_s: float, rate: Array, force: Array) -> Unseen:
    before = known if known.gap_s else Unseen(0.0, (0.0,) * 3, (0.0,) * 3)
    return Unseen(
        max(gap_s, before.gap_s),
        tuple(np.maximum(rate, before.rate).tolist()),
        tuple(np.maximum(force, before.force).tolist()),
    )


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


def thawed(imu: ImuLog, frozen: Sequence[FrozenAxis]) -> ImuLog:
    """Return the log with axes that repeat themselves led from what they were before to after.

    One reading says less of ten seconds than the means about them do, and in a turn it goes on
    until half a circle is made up for the other way round.
    """
    columns = {name: getattr(imu, name).copy() for name in ("gyro_b", "accel_b")} if frozen else {}
    time_s = imu.time_s
    for axis in frozen:
        values = columns["gyro_b" if axis.is_gyro else "accel_b"][:, axis.axis]
        first, before = np.searchsorted(time_s, [axis.begin_s, axis.begin_s - THAW_S])
        last, after = np.searchsorted(time_s, [axis.end_s, axis.end_s + THAW_S], side="right")
        ends = [own.mean() for own in (values[before:first], values[last:after]) if len(own)]
        if ends:
            span_s = [axis.begin_s, axis.end_s]
            values[first:last] = np.interp(time_s[first:last], span_s, [ends[0], ends[-1]])
    return replace(imu, **columns)
