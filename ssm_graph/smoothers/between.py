"""Answers between keyframes, by the inertial data there, and at other points of the vehicle.

A time ``t`` between the keyframes ``k`` and ``j`` is given both by what is integrated from ``k``
on, and by what was found at ``j``. With the transition ``F`` and noise ``Q`` from ``k`` to ``t``,
``G`` from ``t`` to ``j``, ``S`` the noise from ``k`` to ``j``, and ``d`` by how much the smoothed
keyframe ``j`` lies beside the one that is integrated from ``k``::

    C = Q G' S^-1                                           (gain of a fixed-interval smoother)
    x_t = predicted from x_k, moved by C d
    P_t = [F - C G F, C] P_kj [F - C G F, C]' + Q - C G Q

``P_kj`` is the joint posterior of both keyframes, so that at either one the answer is its own.

References
----------
.. [1] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic
   systems", AIAA Journal 3, 1965.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Final, NamedTuple

import numpy as np

from factors import so3
from factors.inertial import Intervals, predict
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import rotation_zyx
from ssm_graph.base.frozen import Array, ShortRepr
from ssm_graph.base.times import Indices, usual_interval
from ssm_graph.engine.error_state import GYRO_BIAS, POSITION, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.engine.states import NavigationStates
from ssm_graph.imu.ping_motion import PING_WINDOW_S, mean_gyro
from ssm_graph.imu.preintegration import (
    gravity_gradient,
    gtsam_gravity,
    preintegrate,
    without_errors,
)
from ssm_graph.mission.answer import covariance_at, trajectory_at
from ssm_graph.mission.estimate import Trajectory
from ssm_graph.mission.point import Point
from ssm_graph.mission.posterior import Posterior
from ssm_graph.mission.problem import ProblemConfig
from ssm_graph.sensors.imu import ImuLog

NEAR_S: Final = 1e-6
"""Times so close to a keyframe are at it."""
AT_ONCE: Final = 4096
"""So many times are worked on together: some 30 MB."""
_MARGIN_S: Final = 10.0
"""Inertial data around the keyframes, to tell how lively the unseen of a gap may have been."""
_FAR: Final = 64
"""So many keyframes without a time between them, and the next ones are worked on by themselves."""


@dataclass(frozen=True, slots=True, eq=False)
class Answers(ShortRepr):
    """States at any times, with the whole of their covariance."""

    trajectory: Trajectory
    """N times; biases are along the axes of the vehicle, and no beam belongs to a time between."""
    covariance: Array | None
    """(N, 9, 9) of position along east, north, up (m), velocity along the same (m/s), and roll,
    pitch, heading (rad); None if not asked for"""


class _Known(NamedTuple):
    """States with their covariances at some of the times asked for."""

    row: Indices
    """(n,) which of the times"""
    states: NavigationStates
    covariance: Array
    """(n, 15, 15)"""


def answers_at(
    posterior: Posterior,
    imu: ImuLog,
    time_s: Array,
    *,
    point: Point | None = None,
    wants_covariance: bool = False,
    on_progress: Callable[[int, int, int], None] | None = None,
) -> Answers:
    """Return the states at any times within the keyframes.

    Parameters
    ----------
    posterior : of the keyframes.
    imu : the inertial data that they were found with, as the mission has them.
    time_s : (N,) s, increasing.
    point : of the vehicle; the inertial unit when left out. Velocity is that of the point, attitude
        that of its own axes.
    wants_covariance : whether the whole covariance is kept, not only sigmas.
    on_progress : called with how many times are done, were before, and how many there are.

    Raises
    ------
    DataError
        For times that do not increase or lie outside, or inertial data that do not cover them.
    """
    _check(posterior, imu, time_s)
    imu = imu.calibrated
    parts: list[tuple[Indices, Trajectory, Array | None]] = []
    for known in _known(posterior, imu, time_s):
        at = time_s[known.row]
        states, covariance = known.states, known.covariance
        if point is not None:
            states, covariance = _at_point(posterior, imu, known, at, point)
        own = trajectory_at(posterior.frame, at, states, covariance, n_beams=np.zeros(len(at)))
        full = covariance_at(posterior.frame, states, covariance) if wants_covariance else None
        parts.append((known.row, own, full))
        if on_progress is not None:
            done = sum(len(row) for row, _, _ in parts)
            on_progress(done, done - len(known.row), len(time_s))
    order = np.argsort(np.concatenate([row for row, _, _ in parts]))
    columns = (f.name for f in fields(Trajectory))
    joined = (
        np.concatenate([getattr(own, name) for _, own, _ in parts])[order] for name in columns
    )
    wholes = [full for _, _, full in parts if full is not None]
    return Answers(Trajectory(*joined), np.concatenate(wholes)[order] if wholes else None)


def check_rate(rate_hz: float) -> None:
    """Raise :class:`ConfigError` for a rate that is no number from 1e-3 to 1e4 Hz."""
    if not 1e-3 <= rate_hz <= 1e4:
        raise ConfigError(f"--rate: expected 0.001 to 10000 Hz, got {rate_hz:g}")


def even_times(posterior: Posterior, rate_hz: float) -> Array:
    """Return times (N,) at a rate from the first keyframe to the last, s.

    Raises as :func:`check_rate`.
    """
    check_rate(rate_hz)
    begin_s, end_s = posterior.time_s[0], posterior.time_s[-1]
    count = int((end_s - begin_s) * rate_hz + 1e-6) + 1
    return np.asarray(np.minimum(begin_s + np.arange(count) / rate_hz, end_s))


def _check(posterior: Posterior, imu: ImuLog, time_s: Array) -> None:
    begin_s, end_s = posterior.time_s[0], posterior.time_s[-1]
    is_row = time_s.ndim == 1 and len(time_s) > 0 and np.isfinite(time_s).all()
    if not (is_row and np.all(np.diff(time_s) > 0.0)):
        raise DataError(
            "times of answers: expected one or more numbers in a row, each later than the one "
            "before; sort them with numpy.unique"
        )
    if time_s[0] < begin_s - NEAR_S or time_s[-1] > end_s + NEAR_S:
        raise DataError(
            f"times of answers: expected {begin_s:.3f} to {end_s:.3f} s, as far as the keyframes "
            f"go, got {time_s[0]:.3f} to {time_s[-1]:.3f} s"
        )
    if imu.start_s > begin_s + NEAR_S or imu.time_s[-1] < end_s - NEAR_S:
        raise DataError(
            f"inertial data: expected those of the result, {begin_s:.3f} to {end_s:.3f} s, got "
            f"{imu.start_s:.3f} to {imu.time_s[-1]:.3f} s; is it another mission?"
        )


def _known(posterior: Posterior, imu: ImuLog, time_s: Array) -> Iterator[_Known]:
    """Yield the times at keyframes, then those between them, piece by piece."""
    keyframe_s = posterior.time_s
    after = np.clip(np.searchsorted(keyframe_s, time_s), 1, max(len(keyframe_s) - 1, 1))
    nearest = after - (2.0 * time_s < keyframe_s[after - 1] + keyframe_s[after])
    is_at = np.abs(keyframe_s[nearest] - time_s) <= NEAR_S
    states = NavigationStates(posterior.R_nb, posterior.p_n, posterior.v_n, posterior.bias)
    row, at = np.flatnonzero(is_at), nearest[is_at]
    for begin in range(0, len(row), AT_ONCE):
        some = slice(begin, begin + AT_ONCE)
        yield _Known(row[some], states.take(at[some]), posterior.covariance[at[some]])
    row = np.flatnonzero(~is_at)
    interval = after[row] - 1
    for begin, end in _chunks(interval):
        yield _between(posterior, states, imu, row[begin:end], time_s, interval[begin:end])


def _chunks(interval: Indices) -> Iterator[tuple[int, int]]:
    """Yield begin and end of runs of times (N,) that are worked on together."""
    begin = 0
    for end in range(1, len(interval) + 1):
        is_last = end == len(interval)
        is_new = not is_last and interval[end] != interval[end - 1]
        far = is_new and interval[end] - interval[end - 1] > _FAR
        spent = end - begin + (interval[end - 1] - interval[begin])
        if is_last or far or (is_new and spent >= AT_ONCE):
            yield begin, end
            begin = end


def _between(
    posterior: Posterior,
    states: NavigationStates,
    imu: ImuLog,
    row: Indices,
    time_s: Array,
    interval: Indices,
) -> _Known:
    """Return times between keyframes; ``interval`` (n,) is that of each row (n,)."""
    first, last = int(interval[0]), int(interval[-1]) + 1
    keyframe_s = posterior.time_s[first : last + 1]
    node_s = np.concatenate([keyframe_s, time_s[row]])
    order = np.argsort(node_s, kind="stable")
    node_s, place = node_s[order], np.argsort(order)
    measured = _pieces(posterior, imu, node_s)
    keyframe, node = place[: len(keyframe_s)], place[len(keyframe_s) :]
    used = np.unique(interval) - first
    begin, count = keyframe[used], np.diff(keyframe)[used]
    carried = _Carried.along(posterior, states, measured, first + used, begin, count)
    piece = node - 1
    own = np.searchsorted(used, interval - first)  # the interval of each time
    C = carried.gain[piece]
    found = carried.states(piece).displaced(so3.times(C, carried.off[own]))
    k = interval
    by_end = C @ carried.to_end[piece]
    by_begin = carried.from_begin[piece] - by_end @ carried.from_begin[piece]
    crossed = by_begin @ posterior.neighbour_covariance[k] @ C.mT
    covariance = by_begin @ posterior.covariance[k] @ by_begin.mT
    covariance += C @ posterior.covariance[k + 1] @ C.mT + crossed + crossed.mT
    noise = carried.noise[piece]
    bridge = noise - by_end @ noise
    return _Known(row, found, covariance + 0.5 * (bridge + bridge.mT))


def _pieces(posterior: Posterior, imu: ImuLog, node_s: Array) -> Intervals:
    """Return what the inertial data say between successive times."""
    edge = np.searchsorted(imu.time_s, [node_s[0] - _MARGIN_S, node_s[-1] + _MARGIN_S])
    kept = slice(int(edge[0]), int(edge[1]) + 1)
    start_s = imu.start_s if edge[0] == 0 else float(imu.time_s[edge[0] - 1])
    some = replace(
        imu,
        start_s=start_s,
        time_s=imu.time_s[kept],
        gyro_b=imu.gyro_b[kept],
        accel_b=imu.accel_b[kept],
    )
    errors = posterior.imu_errors
    made = preintegrate(
        some,
        node_s,
        frame=posterior.frame,
        rate_hz=ProblemConfig().merge_rate_hz,
        errors=None if errors is None else errors[0],
        cuts_gaps=True,
    ).intervals
    if errors is None:
        return made
    of = np.clip(np.searchsorted(posterior.time_s, node_s[:-1], side="right") - 1, 0, None)
    return made.without_errors(errors[np.minimum(of, len(errors) - 1)])


class _Carried(NamedTuple):
    """What is carried along P pieces, each at its end; I intervals between keyframes."""

    R_nb: Array
    p_n: Array
    v_n: Array
    bias: Array
    from_begin: Array
    """(P, 15, 15) transition from the keyframe before"""
    to_end: Array
    """(P, 15, 15) transition to the keyframe after"""
    noise: Array
    """(P, 15, 15) gathered since the keyframe before"""
    gain: Array
    """(P, 15, 15) how it follows the keyframe after"""
    off: Array
    """(I, 15) of the smoothed keyframe after, from the one that is integrated"""

    def states(self, piece: Indices) -> NavigationStates:
        """Return the integrated states at the ends of some pieces."""
        return NavigationStates(*(column[piece] for column in self[:4]))

    @classmethod
    def along(
        cls,
        posterior: Posterior,
        states: NavigationStates,
        measured: Intervals,
        keyframe: Indices,
        begin: Indices,
        count: Indices,
    ) -> _Carried:
        """Go along I intervals side by side.

        Parameters
        ----------
        keyframe : (I,) at the begin of each.
        begin : (I,) its first piece.
        count : (I,) how many pieces it has.
        """
        n, dim = len(measured.span_s), STATE_DIM
        columns = [np.empty((n, *column.shape[1:])) for column in states]
        columns += [np.empty((n, dim, dim)) for _ in range(4)]
        made = cls._make([*columns, np.empty((len(keyframe), dim))])
        middle_n = 0.5 * (states.p_n[keyframe] + states.p_n[keyframe + 1])
        gravity = gtsam_gravity(posterior.frame, middle_n)
        gradient = gravity_gradient(posterior.frame)
        own = np.empty((n, dim, dim))  # transition of each piece
        now = states.take(keyframe)
        F, Q = np.tile(np.eye(dim), (len(keyframe), 1, 1)), np.zeros((len(keyframe), dim, dim))
        for step in range(int(count.max())):
            going = np.flatnonzero(count > step)
            piece = begin[going] + step
            some = measured.take(piece)
            moved = predict(some, now.take(going), g_n=gravity[going], gradient=gradient)
            Phi = moved.transition
            F[going] = Phi @ F[going]
            Q[going] = Phi @ Q[going] @ Phi.mT + moved.noise(some)
            own[piece], made.from_begin[piece], made.noise[piece] = Phi, F[going], Q[going]
            for column, held, new in zip(made[:4], now, moved.state, strict=True):
                column[piece] = held[going] = new
        made.off[:] = now.deviation_of(states.take(keyframe + 1))
        inverse = _inverse(Q)
        back = np.tile(np.eye(dim), (len(keyframe), 1, 1))
        for step in range(int(count.max()) - 1, -1, -1):
            going = np.flatnonzero(count > step)
            piece = begin[going] + step
            made.to_end[piece] = back[going]
            made.gain[piece] = made.noise[piece] @ back[going].mT @ inverse[going]
            back[going] = back[going] @ own[piece]
        return made


def _inverse(covariance: Array) -> Array:
    """Return inverses of covariances whose sigmas differ by many orders of magnitude."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    scale = 1.0 / (sigma[:, :, None] * sigma[:, None, :])
    return np.asarray(np.linalg.inv(covariance * scale) * scale)


def _at_point(
    posterior: Posterior, imu: ImuLog, known: _Known, time_s: Array, point: Point
) -> tuple[NavigationStates, Array]:
    """Return states and covariances (n, 15, 15) at a point of the vehicle, along its own axes."""
    states, arm = known.states, point.lever_arm_b
    R_bp = rotation_zyx(*point.mounting[::-1])
    reading = _rate(posterior, imu, time_s)
    earth_b = states.R_nb.mT @ posterior.frame.omega_ie_n
    rate_b = reading - states.bias[:, 3:] - earth_b
    swing_b = np.cross(rate_b, arm)
    L = so3.skew(arm)
    T = np.zeros((len(time_s), STATE_DIM, STATE_DIM))
    T[:, ROTATION, ROTATION] = R_bp.T
    T[:, POSITION, ROTATION] = -R_bp.T @ L
    T[:, POSITION, POSITION] = R_bp.T
    # omega x l with omega = gyro - bias - R_bn omega_ie: -l x d(omega); the Earth's turn is small.
    T[:, VELOCITY, ROTATION] = -states.R_nb @ so3.skew(swing_b)
    T[:, VELOCITY, VELOCITY] = np.eye(3)
    T[:, VELOCITY, GYRO_BIAS] = states.R_nb @ L
    T[:, range(9, 15), range(9, 15)] = 1.0
    covariance = T @ known.covariance @ T.mT
    window_s = max(PING_WINDOW_S, usual_interval(imu.time_s))
    swung = states.R_nb @ L
    covariance[:, VELOCITY, VELOCITY] += (imu.noise.gyro_density**2 / window_s) * (swung @ swung.mT)
    turned = states.R_nb @ so3.skew(rate_b)
    arm_sq = point.lever_arm_sigma**2
    covariance[:, VELOCITY, VELOCITY] += arm_sq * (turned @ turned.mT)
    covariance[:, POSITION, POSITION] += arm_sq * np.eye(3)
    covariance[:, ROTATION, ROTATION] += point.mounting_sigma**2 * np.eye(3)
    moved = NavigationStates(
        R_nb=states.R_nb @ R_bp,
        p_n=states.p_n + states.R_nb @ arm,
        v_n=states.v_n + (states.R_nb @ swing_b[..., None])[..., 0],
        bias=states.bias,
    )
    return moved, covariance


def _rate(posterior: Posterior, imu: ImuLog, time_s: Array) -> Array:
    """Return what the gyros read (n, 3) about each time, without the errors that were found."""
    errors = posterior.imu_errors
    return mean_gyro(imu if errors is None else without_errors(imu, errors[-1]), time_s)
