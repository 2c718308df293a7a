"""Filters of pose and map that linearise elsewhere, or keep the covariance in another form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import half_turn
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.unscented import root_of
from ssm_graph.systems.landmark_slam.filters import (
    POSE,
    Linear,
    MapFilter,
    Seen,
    spread_over,
)
from ssm_graph.systems.landmark_slam.unscented_filters import UnscentedFilter

ITERATIONS: Final = 3
"""Of the iterated filter; the first is that of the extended one."""


@final
class IteratedFilter(MapFilter):
    """The extended filter, linearised again where the update leads to: Gauss-Newton.

    References
    ----------
    .. [1] B. M. Bell, F. W. Cathey, "The Iterated Kalman Filter Update as a Gauss-Newton Method",
       IEEE Transactions on Automatic Control 38, 1993.
    """

    def _linear(self, states: NDArray[np.intp], told: Array | None) -> Linear:
        first = self._mean[:, states]
        linear = super()._linear(states, told)
        if told is None:
            return linear
        cov, at = self._block(states), first
        R = spread_over(self.noise.observation, np.ones(told.shape[:2]))
        for _ in range(ITERATIONS - 1):
            nu = _wrapped_rows(told.reshape(len(told), -1) - linear.predicted)
            Pht = cov @ linear.slopes.mT
            step = (Pht @ np.linalg.solve(linear.slopes @ Pht + R, nu[..., None]))[..., 0]
            at = first + step
            linear = self._linear_about(at[:, :POSE], at[:, POSE:])
            # As seen from the prediction: what the linear function there says of it.
            back = (linear.slopes @ (first - at)[..., None])[..., 0]
            linear = linear._replace(predicted=linear.predicted + back)
        return linear


def _wrapped_rows(nu: Array) -> Array:
    nu[:, 1::2] = half_turn(nu[:, 1::2])
    return nu


@final
class InvariantFilter(MapFilter):
    """The right-invariant extended filter: consistent under turns of the whole map.

    Errors are kept as ``h = h^ + a``, ``p = R(a) p^ + V(a) b``, the same for every landmark, so
    that a turn of everything is one state and gains no information from observations [1]_. The
    covariance of the state, `cov`, is that of the usual errors.

    References
    ----------
    .. [1] A. Barrau, S. Bonnabel, "An EKF-SLAM Algorithm with Consistency Properties", 2015,
       arXiv:1510.06263.
    .. [2] T. Zhang, K. Wu, J. Song, S. Huang, G. Dissanayake, "Convergence and Consistency Analysis
       for a 3-D Invariant-EKF SLAM", RA-L 2, 2017.
    """

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._swing_pose(-1.0)

    def _swing(self, states: NDArray[np.intp]) -> Array:
        """Return ``J p`` (B, a) of each state: how it follows a turn of everything."""
        values = self._mean[:, : self._n]
        follows = np.zeros_like(values)
        follows[:, 0], follows[:, 1] = -values[:, 1], values[:, 0]
        follows[:, POSE::2], follows[:, POSE + 1 :: 2] = (
            -values[:, POSE + 1 :: 2],
            values[:, POSE::2],
        )
        return follows[:, states]

    def _swing_pose(self, sign: float) -> None:
        """Turn the first covariance from usual errors into these."""
        T = np.repeat(np.eye(POSE)[None], len(self._mean), axis=0)
        T[:, :, 2] += sign * self._swing(np.arange(POSE))
        P = self._cov[:, :POSE, :POSE]
        self._cov[:, :POSE, :POSE] = T @ P @ T.mT

    def _block(self, states: NDArray[np.intp]) -> Array:
        """Return the covariance of the usual errors ``e + J p a``."""
        P, j = self._cov[:, : self._n, : self._n], self._swing(states)
        inner = P[:, states[:, None], states]
        with_turn = P[:, states, 2]
        turn = P[:, 2, 2][:, None, None]
        cross = with_turn[:, :, None] * j[:, None, :]
        return np.asarray(inner + cross + cross.mT + turn * j[:, :, None] * j[:, None, :])

    def predict(self, control: Array) -> None:
        """Move by controls (B, c): without noise these errors stay what they are."""
        moved, _, by_noise = self._motion.slopes(self.pose, control)
        self._mean[:, :POSE] = moved
        n = self._n
        slopes = np.zeros((len(moved), n, by_noise.shape[2]))
        slopes[:, :POSE] = by_noise
        slopes -= self._swing(np.arange(n))[..., None] * by_noise[:, 2:3]
        self._cov[:, :n, :n] += slopes @ self.noise.control @ slopes.mT

    def _seen_by(self, states: NDArray[np.intp], linear: Linear) -> Seen:
        slopes = linear.slopes.copy()
        swing = self._swing(states)
        slopes[:, :, 2] += (linear.slopes @ swing[..., None])[..., 0]
        PHt = self._cov[:, : self._n, : self._n][:, :, states] @ slopes.mT
        return Seen(linear.predicted, slopes @ PHt[:, states], PHt, states, slopes)

    def _apply(self, step: Array) -> None:
        a = step[:, 2]
        c, s = np.cos(a), np.sin(a)
        small = np.abs(a) < 1e-8
        safe = np.where(small, 1.0, a)
        along = np.where(small, 1.0, s / safe)
        across = np.where(small, 0.5 * a, (1.0 - c) / safe)
        for x, y in ((0, 1), *((i, i + 1) for i in range(POSE, self._n, 2))):
            px, py, bx, by = self._mean[:, x], self._mean[:, y], step[:, x], step[:, y]
            self._mean[:, x], self._mean[:, y] = (
                c * px - s * py + along * bx - across * by,
                s * px + c * py + across * bx + along * by,
            )
        self._mean[:, 2] = half_turn(self._mean[:, 2] + a)

    def _append(self, ids: Sequence[int], places: Array, by_pose: Array, noise: Array) -> None:
        """Add landmarks: errors ``m - J m a`` begin as that of the pose, with own noise."""
        del by_pose
        slopes = np.zeros((*places.shape[:2], 2, POSE))
        slopes[..., 0, 0] = slopes[..., 1, 1] = 1.0
        super()._append(ids, places, slopes, noise)


@final
class SquareRootFilter(UnscentedFilter):
    """The unscented filter that keeps a root of the covariance: it cannot become indefinite.

    What a transform adds to the linear part is taken by its positive part.

    References
    ----------
    .. [1] R. van der Merwe, E. A. Wan, "The Square-Root Unscented Kalman Filter for State and
       Parameter-Estimation", ICASSP 2001.
    """

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        first = root_of(self._cov[:, :POSE, :POSE])
        self._cov[:, :POSE, :POSE] = first.root  # from here on the root

    def _block(self, states: NDArray[np.intp]) -> Array:
        rows = self._cov[:, states, : self._n]
        return np.asarray(rows @ rows.mT)

    def _columns(self, states: NDArray[np.intp]) -> Array:
        n = self._n
        return np.asarray(self._cov[:, :n, :n] @ self._cov[:, states, :n].mT)

    def _keep(self, wide: Array) -> None:
        """Keep the root of ``wide wide'`` (B, n, more)."""
        n = wide.shape[1]
        self._cov[:, :n, :n] = np.asarray(np.linalg.qr(wide.mT, mode="r")).mT

    def _move(self, by_pose: Array, noise: Array) -> None:
        n = self._n
        wide = np.zeros((len(noise), n, n + POSE))
        wide[:, :, :n] = self._cov[:, :n, :n]
        wide[:, :POSE, :n] = by_pose @ wide[:, :POSE, :n]
        wide[:, :POSE, n:] = _positive_root(noise)
        self._keep(wide)

    def _downdate(self, seen: Seen, S: Array, R: Array) -> None:
        n, states = self._n, seen.states
        gain = np.linalg.solve(S, seen.PHt.mT).mT
        L = self._cov[:, :n, :n]
        # (I - K H) P (I - K H)' + K (R + excess) K': a sum of squares.
        kept = L - gain @ (seen.slopes @ L[:, states])
        excess = S - (seen.slopes @ L[:, states]) @ (seen.slopes @ L[:, states]).mT
        self._keep(np.concatenate([kept, gain @ _positive_root(excess)], axis=2))
        del R

    def _append(self, ids: Sequence[int], places: Array, by_pose: Array, noise: Array) -> None:
        begin, m = self._n, len(ids)
        slopes = by_pose.reshape(len(places), 2 * m, POSE)
        L = self._cov
        L[:, begin : begin + 2 * m, :begin] = slopes @ L[:, :POSE, :begin]
        for i in range(m):
            at = slice(begin + 2 * i, begin + 2 * i + 2)
            L[:, at, at] = _positive_root(noise[:, i])
        self._name(ids, places)


def _positive_root(cov: Array) -> Array:
    values, vectors = np.linalg.eigh(0.5 * (cov + cov.mT))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])
