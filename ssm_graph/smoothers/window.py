"""The window of a fixed-lag smoother: its keyframes, its prior, and their iteration."""

from __future__ import annotations

import copy
from typing import Self

import numpy as np
from scipy.linalg import solve_triangular

from factors.similarity import Similarity, expected_mahalanobis_sq
from ssm_graph.data import Array
from ssm_graph.graph.first_values import settle_weights
from ssm_graph.graph.marginal_prior import MarginalPrior, moved_chart, prior_at_start, prior_on_last
from ssm_graph.problem.error_state import STATE_DIM, InitialMoments, Linearised
from ssm_graph.problem.states import NavigationStates
from ssm_graph.problem.timeline import MIN_SPACING_S
from ssm_graph.smoothers.chain import Chain
from ssm_graph.smoothers.fixed_lag_config import FixedLagConfig
from ssm_graph.smoothers.keyframe import BeamSpeeds, Keyframe, Sensors
from ssm_graph.smoothers.mixing import Mixing
from ssm_graph.smoothers.stretch import Stretch
from ssm_graph.smoothers.window_rows import (
    InertialRows,
    beam_rows,
    depth_rows,
    depth_targets,
    fix_rows,
)

_NO_ROWS = np.zeros((0, STATE_DIM + 1))
_BENDING = np.repeat([1.0, 0.1], [3, 12])
ROUNDING = 1e-7
"""Posterior sigmas: updates of a window of several keyframes come down to a few 1e-8 and stay."""


def _largest(step: Array, covariance: Array) -> float:
    """Return the largest component of a step (K, 15) in its posterior sigmas."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return float(np.max(np.abs(step) / sigma))


class Window:
    """The keyframes that are not yet settled, and the prior on the first of them.

    Each keyframe is linearised at a state of its own, ``at``, and lies a ``step`` off it. Arrays
    are replaced, never written into, so that a copy of the window costs no more than its lists.
    """

    def __init__(
        self, sensors: Sensors, config: FixedLagConfig, first: Keyframe, start: InitialMoments
    ) -> None:
        self.config, self._sensors = config, sensors
        self.keyframes: list[Keyframe] = [first]
        self._at = NavigationStates(*(column[None] for column in start[:4]))
        self._step = np.zeros((1, STATE_DIM))
        self._covariance = start.covariance[None]
        self._prior: MarginalPrior = prior_at_start(start)
        self._beams = BeamSpeeds.none()
        self._error, self._jacobian = np.zeros(0), np.zeros((0, STATE_DIM))
        self._innovation, self._weights, self._t = np.zeros((3, 0))
        self._depths: list[Array] = []
        self._fixes: list[Array] = []
        self._inertial = InertialRows(sensors.frame)
        self._between: list[Array] = []
        self._targets = depth_targets(sensors, [first], self._at, first_rise=0.0)
        self._chain = Chain()
        self._stale = 0
        self._measure(first)

    def copy(self) -> Self:
        """Return a window that goes its own way from here."""
        twin = copy.copy(self)
        for name in ("keyframes", "_depths", "_fixes", "_between"):
            setattr(twin, name, getattr(self, name).copy())
        twin._chain, twin._stale = Chain(), 0
        return twin

    @property
    def states(self) -> NavigationStates:
        """The estimate of all keyframes."""
        return self._at.moved(self._step)

    @property
    def newest(self) -> Stretch:
        """The newest keyframe."""
        return self._stretch(len(self.keyframes) - 1, len(self.keyframes))

    @property
    def all(self) -> Stretch:
        """All keyframes."""
        return self._stretch(0, len(self.keyframes))

    def _stretch(self, begin: int, end: int) -> Stretch:
        first = self._first_row
        b = slice(first[begin], first[end])
        at = slice(begin, end)
        return Stretch(
            np.array([keyframe.time_s for keyframe in self.keyframes[at]]),
            self._at.take(at).moved(self._step[at]),
            self._covariance[at],
            np.diff(first[begin : end + 1]).astype(float),
            self._innovation[b],
            self._t[b],
            self._weights[b],
        )

    @property
    def _first_row(self) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        counts = [len(keyframe.beams.speed) for keyframe in self.keyframes]
        return np.concatenate([[0], np.cumsum(counts, dtype=np.intp)])

    def advance(self, keyframe: Keyframe) -> Stretch:
        """Predict a new keyframe, marginalise what the lag leaves behind, and return that."""
        oldest_s = keyframe.time_s - self.config.lag_s - MIN_SPACING_S
        leaving = sum(known.time_s < oldest_s for known in self.keyframes)
        left = self._stretch(0, leaving)
        if leaving == len(self.keyframes):
            # Of a window that goes as a whole, the posterior of its end is all that counts.
            self._keep_posterior()
            leaving = 1
        self._append(keyframe)
        if leaving:
            self._marginalise(leaving)
        if len(self.keyframes) > 1:
            self._meet_prediction()
        return left

    def _keep_posterior(self) -> None:
        last = self.states.take(np.s_[-1:])
        self._prior = prior_on_last(last, self._chain.root, step=np.zeros(STATE_DIM))
        self._at, self._step = last, np.zeros((1, STATE_DIM))
        self._covariance = self._covariance[-1:]
        self.keyframes = [self.keyframes[-1].without_measurements()]
        self._drop_rows(len(self._weights))
        self._depths, self._fixes, self._between = [_NO_ROWS], [_NO_ROWS], []
        self._targets = self._targets.take(np.s_[-1:])
        self._stale = 0

    def _append(self, keyframe: Keyframe) -> None:
        last = self.states.take(np.s_[-1:])
        predicted = self._inertial.predict(keyframe, last)
        self._at = self._at.followed_by(predicted)
        self._step = np.concatenate([self._step, np.zeros((1, STATE_DIM))])
        self._covariance = np.concatenate([self._covariance, self._covariance[-1:]])
        pair = self._at.take(np.s_[-2:])
        self._between += self._inertial.rows([keyframe], pair)
        self._stale = min(self._stale, len(self.keyframes) - 1)
        self.keyframes.append(keyframe)
        targets = depth_targets(
            self._sensors, self.keyframes[-2:], last.followed_by(predicted), first_rise=0.0
        )
        self._targets = self._targets.followed_by(targets.take(np.s_[1:]))
        self._measure(keyframe)

    def _measure(self, keyframe: Keyframe) -> None:
        """Linearise what was measured at the newest keyframe."""
        at = self._at.take(np.s_[-1:])
        rows = np.zeros(len(keyframe.beams.speed), np.intp)
        error, jacobian = beam_rows(self._sensors, keyframe.beams, at.take(rows))
        self._beams = self._beams.followed_by(keyframe.beams)
        self._error = np.append(self._error, error)
        self._jacobian = np.concatenate([self._jacobian, jacobian])
        self._innovation = np.append(self._innovation, -error)
        self._weights = np.append(self._weights, np.ones(len(error)))
        self._t = np.append(self._t, np.zeros(len(error)))
        self._depths += depth_rows(self._sensors, [keyframe], at, self._targets.take(np.s_[-1:]))
        self._fixes += fix_rows(self._sensors, [keyframe], at)

    def _marginalise(self, count: int) -> None:
        """Leave a prior on what will be the first keyframe, made at the present states."""
        self._eliminate()
        carried = self._chain.carried[count]
        kept = self._at.take(np.s_[count : count + 1])
        R_nb, p_n, v_n, bias = (column[0] for column in kept)
        root, offset = carried[:, :STATE_DIM], carried[:, STATE_DIM]
        self._prior = MarginalPrior(R_nb, p_n, v_n, bias, root, offset)
        self._drop_rows(int(self._first_row[count]))
        self._chain.drop(count)
        self._stale = len(self.keyframes) - count
        self._at = self._at.take(np.s_[count:])
        self._step, self._covariance = self._step[count:], self._covariance[count:]
        self._targets = self._targets.take(np.s_[count:])
        for name in ("keyframes", "_depths", "_fixes", "_between"):
            setattr(self, name, getattr(self, name)[count:])

    def _meet_prediction(self) -> None:
        """Let the beams of the newest keyframe meet what all before it predict.

        Beams start as they agree with that and with each other: with full weight one bad beam would
        throw the whole window off, which then takes many passes to come back.
        """
        self._eliminate()
        row = self._first_row[-2]
        if row == len(self._weights):
            return
        carried = self._chain.carried[-1]
        solved = solve_triangular(
            carried[:, :STATE_DIM], np.column_stack([np.eye(STATE_DIM), carried[:, STATE_DIM]])
        )
        H = self._jacobian[row:]
        root = H @ solved[:, :STATE_DIM]
        innovation = -self._error[row:] - H @ solved[:, STATE_DIM]
        weights = settle_weights(
            innovation, root @ root.T, self._beams.sigma[row:] ** 2, self.config.kernel
        )
        self._weights = np.concatenate([self._weights[:row], weights])
        self._stale = min(self._stale, len(self.keyframes) - 1)

    def _drop_rows(self, count: int) -> None:
        self._beams = self._beams.without_first(count)
        for name in ("_error", "_jacobian", "_innovation", "_weights", "_t"):
            setattr(self, name, getattr(self, name)[count:])

    def iterate(self) -> int:
        """Reweight and solve until the window has settled; return the number of passes."""
        is_linear = self.config.linearised is Linearised.ONCE
        n_passes = self._reweigh() if is_linear else self._settle()
        is_idle = len(self.keyframes) == 1 and not self.keyframes[0].is_measured
        return 0 if is_idle else n_passes

    def _settle(self) -> int:
        """Solve and reweigh; what has moved is linearised anew at each pass."""
        config, n_keyframes = self.config, len(self.keyframes)
        tolerance = max(config.tolerance, ROUNDING) if n_keyframes > 1 else config.tolerance
        mixing = Mixing()
        for number in range(1, config.max_iterations + 1):
            self._eliminate()
            step, self._covariance = self._chain.solve()
            update, self._step = step - self._step, step
            self._relinearise()
            self._t = self._mahalanobis_sq()
            if _largest(update, self._covariance) < tolerance:
                break
            if number < config.max_iterations:
                settled = config.kernel.weight(self._t)
                # A single keyframe's weights are those of the filter, pass by pass.
                if n_keyframes > 1:
                    settled = mixing.next_weights(self._weights, settled)
                self._renew(settled)
        return number

    def _reweigh(self) -> int:
        """Solve and reweigh a single keyframe, linearised at its prediction only."""
        config = self.config
        for number in range(1, config.max_iterations + 1):
            self._eliminate()
            step, self._covariance = self._chain.solve()
            update, self._step = step - self._step, step
            self._t = self._mahalanobis_sq()
            if _largest(update, self._covariance) < config.tolerance:
                break
            if number < config.max_iterations:
                self._renew(config.kernel.weight(self._t))
        J = moved_chart(self._step[0])
        self._covariance = J @ self._covariance @ J.T
        self._chain.root = self._chain.root @ np.linalg.inv(J)
        return number

    def _eliminate(self) -> None:
        """Bring the chain up to date from the first keyframe that has changed."""
        begin = self._stale
        if begin == len(self.keyframes):
            return
        first = self._first_row[begin:]
        b = slice(first[0], None)
        rows = np.column_stack([self._jacobian[b], -self._error[b]])
        rows *= (np.sqrt(self._weights[b]) / self._beams.sigma[b])[:, None]
        first = first - first[0]
        own = [
            np.concatenate([rows[first[i] : first[i + 1]], *aids])
            for i, aids in enumerate(zip(self._depths[begin:], self._fixes[begin:], strict=True))
        ]
        carried = self._prior.rows(self._at) if begin == 0 else self._chain.carried[begin]
        self._chain.eliminate(carried, own, self._between[begin:], begin=begin)
        self._stale = len(self.keyframes)

    def _relinearise(self) -> None:
        """Linearise anew from the first keyframe that has moved."""
        sigma = np.sqrt(np.diagonal(self._covariance, axis1=1, axis2=2))
        is_single = len(self.keyframes) == 1
        threshold = 0.0 if is_single else self.config.relinearise_sigmas
        moved = np.max(np.abs(self._step) / sigma * _BENDING, axis=1) > threshold
        if self.config.first_estimates and not is_single:
            moved[0] = False
        if not moved.any():
            return
        begin = int(np.argmax(moved))
        before = max(begin - 1, 0)
        head, tail = (self._at.take(np.s_[part]) for part in (slice(begin), slice(begin, None)))
        self._at = head.followed_by(tail.moved(self._step[begin:]))
        self._step = np.concatenate([self._step[:begin], np.zeros_like(self._step[begin:])])
        near = self._at.take(np.s_[before:])
        if not is_single:  # a single keyframe keeps what its prediction came with
            keyframes = self.keyframes[before:]
            self._inertial.set_gravity(keyframes[1:], near)
            rows = self._inertial.rows(keyframes[1:], near)
            self._between = self._between[:before] + rows
            targets = depth_targets(
                self._sensors, keyframes, near, first_rise=float(self._targets.rise[before])
            )
            self._targets = self._targets.take(np.s_[:before]).followed_by(targets)
        self._measure_again(begin)
        self._stale = min(self._stale, before)

    def _measure_again(self, begin: int) -> None:
        """Linearise the measurements of the keyframes from ``begin`` on."""
        first = self._first_row
        row = first[begin]
        keyframe = np.repeat(np.arange(begin, len(self.keyframes)), np.diff(first[begin:]))
        error, jacobian = beam_rows(
            self._sensors, self._beams.without_first(row), self._at.take(keyframe)
        )
        self._error = np.concatenate([self._error[:row], error])
        self._jacobian = np.concatenate([self._jacobian[:row], jacobian])
        keyframes, at = self.keyframes[begin:], self._at.take(np.s_[begin:])
        depths = depth_rows(self._sensors, keyframes, at, self._targets.take(np.s_[begin:]))
        self._depths = self._depths[:begin] + depths
        self._fixes = self._fixes[:begin] + fix_rows(self._sensors, keyframes, at)

    def _renew(self, settled: Array) -> None:
        """Take the weights that have changed enough."""
        threshold = 0.0 if len(self.keyframes) == 1 else self.config.reweigh
        changed = np.abs(settled - self._weights) > threshold
        if not changed.any():
            return
        self._weights = np.where(changed, settled, self._weights)
        k = int(np.searchsorted(self._first_row, np.argmax(changed), side="right")) - 1
        self._stale = min(self._stale, k)

    def _mahalanobis_sq(self) -> Array:
        keyframe = np.repeat(np.arange(len(self.keyframes)), np.diff(self._first_row))
        H = self._jacobian
        error = self._error + (H * self._step[keyframe]).sum(axis=1)
        spread = np.zeros(len(H))
        if self.config.similarity is Similarity.EXPECTED:
            spread = ((H[:, None, :] @ self._covariance[keyframe])[:, 0] * H).sum(axis=1)
        return expected_mahalanobis_sq(error, spread, sigma=self._beams.sigma)
