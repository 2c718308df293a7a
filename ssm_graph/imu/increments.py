"""Merge raw inertial samples into coning- and sculling-compensated ones that end at the keyframes.

A raw sample is the mean rate and the mean specific force over its interval. Preintegration treats
both as constant within a sample, so what is lost is their change: coning and sculling. The change
is recovered here from the neighbouring samples, whose spacing may be irregular.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import so3
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, finished
from ssm_graph.sensors.imu import ImuLog


class MergedSamples(NamedTuple):
    """Merged samples of all intervals between keyframes, in time order."""

    dt: Array
    """(M,) s"""
    gyro_b: Array
    """(M, 3) equivalent constant body rate, rad/s."""
    accel_b: Array
    """(M, 3) equivalent constant specific force, m/s^2."""
    first: NDArray[np.intp]
    """(K,) index of the first merged sample of each of the K - 1 intervals, and M."""


def merge_samples(imu: ImuLog, keyframe_s: Array, *, rate_hz: float) -> MergedSamples:
    """Cut the raw samples at the keyframe times and merge them to about ``rate_hz``.

    Each piece of a raw sample, of length ``h``, is first made equivalent to one of constant rate
    and force, with the slopes ``omega', f'`` taken from the neighbours (coning and sculling)::

        theta = omega h + h^3/12 omega x omega'
        v     = f h     + h^3/12 (omega x f' + f x omega')

    The pieces of a merged sample are then composed without approximation. The turn of the specific
    force by the sample's own rotation stays out: the Galilean preintegration does it.

    Parameters
    ----------
    imu : raw samples, body axes.
    keyframe_s : (K,) strictly increasing times inside the span of ``imu``, s.
    rate_hz : an interval of length T becomes at most ``max(1, ceil(T * rate_hz))`` samples. A rate
        above that of the raw samples merges nothing.

    Raises
    ------
    DataError
        If the keyframes reach outside the inertial data.
    ConfigError
        If ``rate_hz`` is not a positive number.

    References
    ----------
    .. [1] P. G. Savage, "Strapdown Inertial Navigation Integration Algorithm Design", parts 1 and
       2, Journal of Guidance, Control, and Dynamics 21, 1998.
    """
    return finished(merge_samples_steps(imu, keyframe_s, rate_hz=rate_hz))


def merge_samples_steps(imu: ImuLog, keyframe_s: Array, *, rate_hz: float) -> Steps[MergedSamples]:
    """Make :func:`merge_samples` in steps."""
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise ConfigError(f"merge rate: expected a positive rate in Hz, got {rate_hz}")
    edges = np.concatenate([[imu.start_s], imu.time_s])
    if keyframe_s[0] < edges[0] or keyframe_s[-1] > edges[-1]:
        raise DataError(
            f"keyframes {keyframe_s[0]:.3f}..{keyframe_s[-1]:.3f} s reach outside the inertial "
            f"data {edges[0]:.3f}..{edges[-1]:.3f} s"
        )
    piece_edges, sample = _cut(edges, keyframe_s)
    yield 3e-4 * len(sample)
    h = np.diff(piece_edges)[:, None]
    rates = np.concatenate([imu.gyro_b, imu.accel_b], axis=1)
    slopes = _slopes(edges, rates)[sample]
    # The mean over a piece differs from that over its whole sample by the slope.
    mid = 0.5 * (edges[sample] + edges[sample + 1])
    shift = (piece_edges[:-1] + 0.5 * h[:, 0] - mid)[:, None]
    means = rates[sample] + slopes * shift
    omega, force = means[:, :3], means[:, 3:]
    omega_slope, force_slope = slopes[:, :3], slopes[:, 3:]

    yield 3e-4 * len(sample)
    first = _group_starts(piece_edges, keyframe_s, rate_hz)
    scale = h**3 / 12.0
    theta = omega * h + scale * so3.cross(omega, omega_slope)
    v = force * h + scale * (so3.cross(omega, force_slope) + so3.cross(force, omega_slope))
    yield 5e-4 * len(sample)
    theta, v = yield from _merge_steps(theta, v, first)
    dt = np.add.reduceat(h[:, 0], first)
    intervals = np.searchsorted(piece_edges[first], keyframe_s[:-1])
    return MergedSamples(
        dt, theta / dt[:, None], v / dt[:, None], np.concatenate([intervals, [len(dt)]])
    )


def _cut(edges: Array, cuts: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the edges of the pieces between the first and last cut, and each piece's sample."""
    inner = edges[(edges > cuts[0]) & (edges < cuts[-1])]
    piece_edges = np.union1d(inner, cuts)
    mid = 0.5 * (piece_edges[:-1] + piece_edges[1:])
    return piece_edges, np.searchsorted(edges, mid) - 1


def _slopes(edges: Array, rate: Array) -> Array:
    """Return the time derivative (N, d) of rates at the middle of each sample.

    That of the parabola through three of them; at both ends of the line through two.
    """
    if len(rate) < 2:
        return np.zeros_like(rate)
    middle = 0.5 * (edges[:-1] + edges[1:])
    span = np.diff(middle)[:, None]
    steep = np.diff(rate, axis=0) / span
    before, after = span[:-1], span[1:]
    inner = (after * steep[:-1] + before * steep[1:]) / (before + after)
    return np.concatenate([steep[:1], inner, steep[-1:]])


def _group_starts(piece_edges: Array, keyframe_s: Array, rate_hz: float) -> NDArray[np.intp]:
    """Return the first piece of every merged sample; no group crosses a keyframe."""
    interval = np.searchsorted(keyframe_s, piece_edges[:-1], side="right") - 1
    span = np.diff(keyframe_s)
    n_groups = np.maximum(np.ceil(span * rate_hz - 1e-6), 1.0)
    # A piece belongs to the group in which it ends.
    elapsed = piece_edges[1:] - keyframe_s[interval]
    group = np.ceil(elapsed / span[interval] * n_groups[interval] - 1e-6)
    # A piece of mere rounding at the begin belongs to the first group.
    group = np.maximum(group, 1.0)
    is_first = np.ones(len(interval), bool)
    is_first[1:] = (interval[1:] != interval[:-1]) | (group[1:] != group[:-1])
    return np.flatnonzero(is_first)


def _merge_steps(theta: Array, v: Array, first: NDArray[np.intp]) -> Steps[tuple[Array, Array]]:
    """Compose the pieces of each group that begins at ``first``.

    Returns the rotation vector (M, 3) of the whole, and the velocity increment (M, 3) that a
    constant specific force along with a constant rate would need to give the same velocity change.
    """
    size = np.diff(np.append(first, len(theta)))
    turn, gain = so3.exp(theta), so3.left_jacobian_times(theta, v)
    yield 3e-4 * len(theta)
    turned, gained = turn[first], gain[first]
    for step in range(1, int(size.max())):
        longer = np.flatnonzero(step < size)
        piece = first[longer] + step
        gained[longer] += so3.times(turned[longer], gain[piece])
        turned[longer] = turned[longer] @ turn[piece]
        yield 3e-4 * len(longer)
    theta_all = so3.log(turned)
    return theta_all, so3.left_jacobian_solve(theta_all, gained)
