"""Filters of pose and map together: what all of them share, and the extended one.

The state is (x, y, heading, x and y of every landmark seen so far), of B runs that see the same
landmarks at once; a log is a batch of one. Only the pose moves, and an observation sees the pose
and its landmarks, so that a step costs as much as the square of the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import half_turn, range_bearing, range_bearing_slopes
from factors.similarity import Kernel
from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.noise_adaptive import Evidence, Noise
from ssm_graph.filters.rules.unscented import root_of
from ssm_graph.systems.landmark_slam.models import Motion

POSE: Final = 3
"""States of the pose."""
LEFT_OUT: Final = 1e-8
"""Weight of an observation that a gate rejects: none, but regular."""
REVISIONS: Final = 3
"""How often weights, or noise, and an update take turns."""


@dataclass(frozen=True, slots=True)
class Gate:
    """A chi-square gate on each observation; it opens for a landmark that is refused for long."""

    confidence: float = 0.999
    """Share of good observations that pass; 13.8 for two rows."""
    reacquire: int = 10
    """After so many refusals in a row the next one passes with a sigma that makes it just fit."""


class SlamFilter(Protocol):
    """What a filter of one's own has to have to take part in studies, and to run on logs."""

    noise: Noise
    n_repaired: int

    def predict(self, control: Array) -> None:
        """Move by controls (B, c)."""

    def update(self, ids: Sequence[int], observed: Array, scale: Array | None = None) -> Update:
        """Take ranges and bearings (B, m, 2) of landmarks; those not seen before are added.

        ``scale`` (m, 2) multiplies the sigmas of each; None: by 1.
        """

    @property
    def pose(self) -> Array:
        """(B, 3) m, m, rad."""

    @property
    def pose_cov(self) -> Array:
        """(B, 3, 3)."""

    def landmark(self, name: int) -> tuple[Array, Array]:
        """Return place (B, 2) and covariance (B, 2, 2) of a landmark."""


class Update(NamedTuple):
    """What an update found."""

    nis: Array
    """(B,) of the observations that were used; zero without any."""
    dof: Array
    """(B,) rows behind it."""
    weights: Array
    """(B, m) of the observations of landmarks that were known."""
    known: NDArray[np.intp]
    """(m,) which of the observations these are."""


class Linear(NamedTuple):
    """Observations as linear functions of some states."""

    predicted: Array
    """(B, r)"""
    slopes: Array
    """(B, r, a)"""
    excess: Array | None = None
    """(B, r, r) of their covariance beyond ``H P H'``."""


class Seen(NamedTuple):
    """What is expected of the landmarks in view."""

    predicted: Array
    """(B, r)"""
    inner: Array
    """(B, r, r) its covariance, without the noise of the observations."""
    PHt: Array
    """(B, n, r) the covariance of the state with it."""
    states: NDArray[np.intp]
    """(a,) that it depends on."""
    slopes: Array
    """(B, r, a)"""


class MapFilter:
    """The extended Kalman filter of pose and map; others change one of its pieces."""

    def __init__(
        self,
        motion: Motion,
        noise: Noise,
        start: Array,
        *,
        start_cov: Array,
        capacity: int,
        robust: Gate | Kernel | None = None,
    ) -> None:
        """Begin.

        Parameters
        ----------
        motion : how controls move a pose.
        noise : stated or learnt, of as many runs.
        start, start_cov : (B, 3) and (3, 3), m and rad.
        capacity : landmarks that there may be.
        robust : a gate, or a kernel that weighs each observation by residual and variance.
        """
        runs, most = len(start), POSE + 2 * capacity
        self._motion, self.noise, self._robust = motion, noise, robust
        self._mean = np.zeros((runs, most))
        self._cov = np.zeros((runs, most, most))
        self._mean[:, :POSE], self._cov[:, :POSE, :POSE] = start, start_cov
        self._n, self._first_place = POSE, POSE
        self._slot: dict[int, int] = {}
        self._refused = np.zeros((runs, capacity), dtype=np.intp)
        self.n_repaired = 0

    @property
    def pose(self) -> Array:
        """(B, 3) m, m, rad."""
        return self._mean[:, :POSE]

    @property
    def pose_cov(self) -> Array:
        """(B, 3, 3)."""
        return self._block(np.arange(POSE))

    @property
    def ids(self) -> tuple[int, ...]:
        """Of the landmarks in the map, in the order of the state."""
        return tuple(self._slot)

    @property
    def mean(self) -> Array:
        """(B, n)."""
        return self._mean[:, : self._n]

    @property
    def cov(self) -> Array:
        """(B, n, n)."""
        return self._block(np.arange(self._n))

    def landmark(self, name: int) -> tuple[Array, Array]:
        """Return place (B, 2) and covariance (B, 2, 2) of a landmark."""
        at = self._states([name])
        return self._mean[:, at], self._block(at)

    def landmarks(self) -> Array:
        """Return the places (B, L, 2) of all landmarks, in the order of `ids`."""
        return self.mean[:, self._first_place :].reshape(len(self._mean), -1, 2)

    def predict(self, control: Array) -> None:
        """Move by controls (B, c)."""
        moved, by_pose, by_noise = self._motion.slopes(self.pose, control)
        self._mean[:, :POSE] = moved
        self._move(by_pose, by_noise @ self.noise.control @ by_noise.mT)

    def update(self, ids: Sequence[int], observed: Array, scale: Array | None = None) -> Update:
        """Take ranges and bearings (B, m, 2) of landmarks; those not seen before are added.

        ``scale`` (m, 2) multiplies the sigmas of each; None: by 1.
        """
        known = np.array([i for i, name in enumerate(ids) if name in self._slot], dtype=np.intp)
        new = [i for i, name in enumerate(ids) if name not in self._slot]
        told = observed - self.noise.mean[:, None, :]
        runs = len(observed)
        found = Update(np.zeros(runs), np.zeros(runs), np.zeros((runs, 0)), known)
        if len(known):
            own = None if scale is None else scale[known]
            found = self._correct([ids[i] for i in known], told[:, known], known, own)
        if new:
            own = np.ones((len(new), 2)) if scale is None else scale[new]
            self._augment([ids[i] for i in new], told[:, new], own)
        return found

    def predicted(self, ids: Sequence[int]) -> tuple[Array, Array]:
        """Return what is expected of landmarks in the map, (B, m, 2), and its covariance.

        That is (B, 2 m, 2 m), without the noise of the observations.
        """
        seen = self._seen(ids, None)
        return seen.predicted.reshape(len(seen.inner), -1, 2), seen.inner

    def _states(self, ids: Sequence[int]) -> NDArray[np.intp]:
        first = self._first_place + 2 * np.array([self._slot[name] for name in ids], dtype=np.intp)
        return (first[:, None] + np.arange(2)).ravel()

    def _correct(
        self, ids: Sequence[int], told: Array, known: NDArray[np.intp], scale: Array | None
    ) -> Update:
        seen = self._seen(ids, told)
        nu = told.reshape(len(told), -1) - seen.predicted
        nu[:, 1::2] = half_turn(nu[:, 1::2])
        slots = np.array([self._slot[name] for name in ids])
        R, weights = self._weighed(nu, seen.inner, slots, scale)
        S = seen.inner + R
        gain_nu = np.linalg.solve(S, nu[..., None])
        self._apply((seen.PHt @ gain_nu)[..., 0])
        self._downdate(seen, S, R)
        used = weights > LEFT_OUT
        nis = (nu[..., None].mT @ gain_nu)[:, 0, 0]
        dof = 2.0 * used.sum(axis=1)
        residual = told - range_bearing(self._mean[:, None, :POSE], self._places(ids))
        residual[..., 1] = half_turn(residual[..., 1])
        evidence = self._evidence(nu, seen.inner, S, weights * used)
        self.noise.take(evidence._replace(residual=residual, nis=nis, dof=dof))
        return Update(nis, dof, weights * used, known)

    def _places(self, ids: Sequence[int]) -> Array:
        return self._mean[:, self._states(ids)].reshape(len(self._mean), -1, 2)

    def _weighed(
        self, nu: Array, inner: Array, slots: NDArray[np.intp], scale: Array | None
    ) -> tuple[Array, Array]:
        """Return the covariance (B, 2 m, 2 m) of the observations and the weight of each."""
        runs, m = len(nu), nu.shape[1] // 2
        weights = np.ones((runs, m))
        if isinstance(self._robust, Gate):
            weights = self._gated(nu, inner, slots, self._robust, scale)
        R = spread_over(self.noise.observation, weights, scale)
        for _ in range(REVISIONS):
            found = self._evidence(nu, inner, inner + R, weights)
            revised = self.noise.revised(found)
            if isinstance(self._robust, Kernel):
                # Of residual and variance after the update, in stated sigmas.
                squares = found.residual[..., :, None] * found.residual[..., None, :]
                inverse = np.linalg.inv(_scaled(self.noise.observation, m, scale))
                t = np.einsum("bmij,bmji->bm", inverse, squares + found.after)
                weights = self._robust.weight(t, dim=2)
            elif revised is None:
                break
            R = spread_over(self.noise.observation if revised is None else revised, weights, scale)
        return R, weights

    def _gated(
        self, nu: Array, inner: Array, slots: NDArray[np.intp], gate: Gate, scale: Array | None
    ) -> Array:
        runs, m = len(nu), len(slots)
        own = _blocks(inner) + _scaled(self.noise.observation, m, scale)
        v = nu.reshape(runs, m, 2)
        nis = np.einsum("bmi,bmi->bm", v, np.linalg.solve(own, v[..., None])[..., 0])
        limit = float(chi2.ppf(gate.confidence, 2))
        is_far = nis > limit
        opens = is_far & (self._refused[:, slots] >= gate.reacquire)
        self._refused[:, slots] = np.where(is_far & ~opens, self._refused[:, slots] + 1, 0)
        return np.where(opens, limit / np.maximum(nis, limit), np.where(is_far, LEFT_OUT, 1.0))

    def _evidence(self, nu: Array, inner: Array, S: Array, weights: Array) -> Evidence:
        """Return what follows if the update is linear."""
        runs, m = weights.shape
        solved = np.linalg.solve(S, np.concatenate([nu[..., None], inner], axis=2))
        residual = nu - (inner @ solved[..., :1])[..., 0]
        after = inner - inner @ solved[..., 1:]
        return Evidence(
            nu.reshape(runs, m, 2),
            residual.reshape(runs, m, 2),
            _blocks(inner),
            _blocks(after),
            weights,
            np.zeros(runs),
            np.zeros(runs),
        )

    # ---- what the kinds of filters differ in ----

    def _seen(self, ids: Sequence[int], told: Array | None) -> Seen:
        """Return what is expected of landmarks; ``told`` is what was seen where it is known."""
        states = np.concatenate([np.arange(POSE), self._states(ids)])
        return self._seen_by(states, self._linear(states, told))

    def _seen_by(self, states: NDArray[np.intp], linear: Linear) -> Seen:
        PHt = self._columns(states) @ linear.slopes.mT
        inner = linear.slopes @ PHt[:, states]
        if linear.excess is not None:
            inner = inner + linear.excess
        return Seen(linear.predicted, inner, PHt, states, linear.slopes)

    def _linear(self, states: NDArray[np.intp], told: Array | None) -> Linear:
        """Return the observations as functions of pose and landmarks in view."""
        del told
        return self._linear_about(self._mean[:, :POSE], self._mean[:, states[POSE:]])

    def _linear_about(self, pose: Array, places: Array) -> Linear:
        runs, m = len(pose), places.shape[1] // 2
        at = places.reshape(runs, m, 2)
        predicted = range_bearing(pose[:, None], at)
        by_pose, by_place = range_bearing_slopes(pose[:, None], at)
        slopes = np.zeros((runs, 2 * m, POSE + 2 * m))
        slopes[:, :, :POSE] = by_pose.reshape(runs, 2 * m, POSE)
        for i in range(m):
            slopes[:, 2 * i : 2 * i + 2, POSE + 2 * i : POSE + 2 * i + 2] = by_place[:, i]
        return Linear(predicted.reshape(runs, -1), slopes)

    def _apply(self, step: Array) -> None:
        self._mean[:, : self._n] += step
        self._mean[:, 2] = half_turn(self._mean[:, 2])

    def _augment(self, ids: Sequence[int], told: Array, scale: Array) -> None:
        """Add landmarks where they were seen."""
        heading = self._mean[:, None, 2] + told[..., 1]
        c, s = np.cos(heading), np.sin(heading)
        r = told[..., 0]
        places = self._mean[:, None, :2] + r[..., None] * np.stack([c, s], axis=-1)
        by_pose = np.zeros((*r.shape, 2, POSE))
        by_pose[..., 0, 0] = by_pose[..., 1, 1] = 1.0
        by_pose[..., 0, 2], by_pose[..., 1, 2] = -r * s, r * c
        by_told = np.stack([np.stack([c, -r * s], axis=-1), np.stack([s, r * c], axis=-1)], axis=-2)
        R = _scaled(self.noise.observation, len(ids), scale)
        noise = by_told @ R @ by_told.mT
        self._append(ids, places, by_pose, noise)

    # ---- how the covariance is kept ----

    def _block(self, states: NDArray[np.intp]) -> Array:
        return self._cov[:, states[:, None], states]

    def _columns(self, states: NDArray[np.intp]) -> Array:
        return self._cov[:, : self._n][:, :, states]

    def _move(self, by_pose: Array, noise: Array) -> None:
        """Let the pose move by its slopes (B, 3, 3), with noise (B, 3, 3)."""
        n, P = self._n, self._cov
        P[:, :POSE, :POSE] = by_pose @ P[:, :POSE, :POSE] @ by_pose.mT + noise
        P[:, :POSE, POSE:n] = by_pose @ P[:, :POSE, POSE:n]
        P[:, POSE:n, :POSE] = P[:, :POSE, POSE:n].mT

    def _downdate(self, seen: Seen, S: Array, R: Array) -> None:
        del R
        root, repaired = root_of(S)
        self.n_repaired += repaired
        half = np.linalg.solve(root, seen.PHt.mT)
        self._cov[:, : self._n, : self._n] -= half.mT @ half

    def _append(self, ids: Sequence[int], places: Array, by_pose: Array, noise: Array) -> None:
        """Add landmarks (B, m, 2) with slopes (B, m, 2, 3) by the pose and noise (B, m, 2, 2)."""
        begin, m = self._n, len(ids)
        new = slice(begin, begin + 2 * m)
        slopes = by_pose.reshape(len(places), 2 * m, POSE)
        P = self._cov
        P[:, new, :begin] = slopes @ P[:, :POSE, :begin]
        P[:, :begin, new] = P[:, new, :begin].mT
        P[:, new, new] = slopes @ P[:, :POSE, :POSE] @ slopes.mT
        for i in range(m):
            at = slice(begin + 2 * i, begin + 2 * i + 2)
            P[:, at, at] += noise[:, i]
        self._name(ids, places)

    def _name(self, ids: Sequence[int], places: Array) -> None:
        begin, m = self._n, len(ids)
        self._mean[:, begin : begin + 2 * m] = places.reshape(len(places), -1)
        self._slot |= {name: (begin - self._first_place) // 2 + i for i, name in enumerate(ids)}
        self._n += 2 * m


def _blocks(matrices: Array) -> Array:
    """Return the blocks of two (B, m, 2, 2) on the diagonals of (B, 2 m, 2 m)."""
    runs, size = matrices.shape[:2]
    split = matrices.reshape(runs, size // 2, 2, size // 2, 2)
    return np.asarray(np.einsum("bmimj->bmij", split))


def _scaled(observation: Array, m: int, scale: Array | None) -> Array:
    """Return the covariance (B, 2, 2) for each of m observations, its sigmas scaled by (m, 2)."""
    each = np.repeat(observation[:, None], m, axis=1)
    return each if scale is None else each * (scale[:, :, None] * scale[:, None, :])


def spread_over(observation: Array, weights: Array, scale: Array | None = None) -> Array:
    """Return (B, 2 m, 2 m): the covariance (B, 2, 2) over each weight (B, m) on the diagonal."""
    runs, m = weights.shape
    R = np.zeros((runs, m, 2, m, 2))
    at = np.arange(m)
    each = _scaled(observation, m, scale) / weights[..., None, None]
    R[:, at, :, at] = np.moveaxis(each, 1, 0)
    return R.reshape(runs, 2 * m, 2 * m)
