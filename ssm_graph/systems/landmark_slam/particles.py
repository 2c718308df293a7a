"""Landmarks for a log that names none, by particles: many ways to pair it side by side (FastSLAM).

Each particle has a path of its own. Given that, its landmarks know nothing of each other, so that
each has a small filter of its own. Which landmark an observation is of is drawn: by the likelihood
of each that is there, of one that was not met yet, and of an error. What one scan leaves open later
ones decide: particles that paired it wrongly explain them worse, and die out. What is in view again
and is not seen speaks against a particle as well (`sight`).

References
----------
.. [1] M. Montemerlo, S. Thrun, "FastSLAM: A Scalable Method for the Simultaneous Localization and
   Mapping Problem in Robotics", Springer 2007, chapters 3 and 4.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import half_turn
from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.association import MOST_LANDMARKS
from ssm_graph.systems.landmark_slam.models import composed
from ssm_graph.systems.landmark_slam.problem import UNKNOWN, SlamNoise, SlamProblem
from ssm_graph.systems.landmark_slam.sight import View
from ssm_graph.systems.landmark_slam.smoother import Values

PARTICLES: Final = 200
ERRORS_PER_M2: Final = 0.04
"""Density of observations that are of no landmark, where these would put one."""
NEW_PER_ERROR: Final = 1.0 / 80.0
"""Odds of what fits none to be a landmark not met yet: it will be seen again and again."""
FITS: Final = float(chi2.ppf(1.0 - 3e-4, 2))
"""Square of sigmas within which an observation may be of a landmark."""
FEWEST: Final = 3
"""Sightings of a landmark that stays, and"""
PATIENCE_S: Final = 5.0
"""for how long one with less is remembered."""
FAR: Final = 2.0
"""Times what was measured, or the view, from which on landmarks are not looked at."""
AGAIN_S: Final = 10.0
"""Since a landmark was seen, from which on it speaks that it is not."""
MISSED: Final = 0.12
"""Logarithm of the odds lost by each scan that has a landmark in view and not in it: of some 25 of
a visit they are those of one visit in twenty without a sighting."""
OF_DRIFT: Final = 0.4
"""Spread of the odometry's drift over what it may be, about what the log tells without closing."""
KICK: Final = 0.05
"""The same, of that spread, at each choice of particles: those that are left would all have one."""
TINY: Final = 1e-12
"""m^2 and rad^2 of the odometry's covariance, which may have no full rank."""


class Drawn(NamedTuple):
    """The pairing of the likeliest particle."""

    landmark: NDArray[np.intp]
    """(M,) `UNKNOWN` of errors"""
    values: Values


class _Step(NamedTuple):
    """What particles were at a pose."""

    pose: Array
    """(N, 3)"""
    landmark: NDArray[np.intp]
    """(N, m) of its observations"""
    chosen: NDArray[np.intp] | None
    """(N,) from which those after it come; None: from themselves"""


class _Seen(NamedTuple):
    """How landmarks (A,) of particles fit an observation."""

    error: Array
    """(N, A, 2)"""
    jacobian: Array
    """(N, A, 2, 2) by the landmark"""
    covariance: Array
    """(N, A, 2, 2)"""
    log_likelihood: Array
    """(N, A), -inf where it does not fit"""


def pair_by_particles(problem: SlamProblem, noise: SlamNoise, drift: Array, *, seed: int) -> Drawn:
    """Return landmarks of a log; names it has are not looked at, nor what is a range alone.

    Parameters
    ----------
    drift : (3,) of the odometry, about; (0,) where it has none.
    """
    cloud = _Cloud(problem, noise, drift, seed)
    steps = [cloud.step(k) for k in range(len(problem.time_s))]
    return cloud.likeliest(steps)


class _Cloud:
    """N particles that go along a log."""

    def __init__(self, problem: SlamProblem, noise: SlamNoise, drift: Array, seed: int) -> None:
        self._problem, self._rng = problem, np.random.default_rng(seed)
        self._view, self._first = View.of(problem), problem.first_of.tolist()
        self._whole = np.all(np.isfinite(problem.measured), axis=1)
        self._variance = np.square(noise.observation * problem.scales)
        self._increments, self._slopes = problem.steps(), problem.slopes
        self._roots = problem.motion.basis(problem.control) * noise.control
        N, L = PARTICLES, MOST_LANDMARKS
        self._spread = OF_DRIFT * problem.drift_sigma
        self.drift = drift + self._rng.standard_normal((N, len(drift))) * self._spread
        self.pose = np.tile(problem.start, (N, 1))
        self.places, self.cov = np.zeros((N, L, 2)), np.zeros((N, L, 2, 2))
        self.last_s, self.count = np.full((N, L), -np.inf), np.zeros((N, L), dtype=np.intp)
        self.n = np.zeros(N, dtype=np.intp)
        self.log_weight = np.zeros(N)

    def step(self, k: int) -> _Step:
        """Go on to pose k with all that it saw."""
        P = self._predict(k)
        rows = np.arange(self._first[k], self._first[k + 1])
        landmark = np.full((PARTICLES, len(rows)), UNKNOWN)
        whole = np.flatnonzero(self._whole[rows])
        for slot in whole.tolist():
            landmark[:, slot], P = self._draw(k, rows[slot], landmark[:, :slot], P)
        root = np.linalg.cholesky(0.5 * (P + P.mT) + TINY * np.eye(3))
        self.pose += (root @ self._rng.standard_normal((PARTICLES, 3, 1)))[..., 0]
        self.pose[:, 2] = half_turn(self.pose[:, 2])
        for slot in whole.tolist():
            self._learn(k, rows[slot], landmark[:, slot])
        if len(whole):
            now_s = self._problem.time_s[k]
            used = slice(0, int(self.n.max()))
            is_known = (self.count[:, used] >= FEWEST) & (now_s - self.last_s[:, used] > AGAIN_S)
            in_view = self._view.has(self.pose, self.places[:, used])
            self.log_weight -= MISSED * (is_known & in_view).sum(axis=1)
        return _Step(self.pose.copy(), landmark, self._chosen())

    def _predict(self, k: int) -> Array:
        """Move by odometry; return the covariance (N, 3, 3) of where that may be."""
        if k == 0:
            P = np.diag(np.square(self._problem.start_sigma))
            return np.tile(P, (PARTICLES, 1, 1))
        step = np.tile(self._increments[k - 1], (PARTICLES, 1))
        if self.drift.shape[1]:
            step += self.drift @ self._slopes[k - 1].T
        c, s = np.cos(self.pose[:, 2]), np.sin(self.pose[:, 2])
        turn = np.zeros((PARTICLES, 3, 3))
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = c, -s, s, c
        turn[:, 2, 2] = 1.0
        root = turn @ self._roots[k - 1]
        self.pose = composed(self.pose, step)
        return np.asarray(root @ root.mT)

    def _draw(
        self, k: int, row: int, taken: NDArray[np.intp], P: Array
    ) -> tuple[NDArray[np.intp], Array]:
        """Draw which landmark (N,) a row is of, and put the poses right by it.

        A new one has the number ``n`` of its particle, and is not there yet; a scan begins one at
        most. ``taken`` (N, m) are those of the scan's rows before. Also returns the covariance
        (N, 3, 3) of the poses.
        """
        now_s, at_m = self._problem.time_s[k], float(self._problem.measured[row, 0])
        used = slice(0, int(self.n.max()))
        lives = self.count[:, used] >= FEWEST
        lives |= now_s - self.last_s[:, used] < PATIENCE_S
        away_m = np.abs(self.places[:, used] - self.pose[:, None, :2]).max(axis=2)
        lives &= away_m < FAR * max(at_m, self._view.farthest_m)
        near = np.flatnonzero(lives.any(axis=0))
        lives = lives[:, near]
        for one in taken.T:
            lives &= near != one[:, None]
        seen = self._seen(row, near, P)
        A = len(near)
        odds = np.empty((PARTICLES, A + 2))
        odds[:, :A] = np.where(lives, seen.log_likelihood, -np.inf)
        odds[:, A] = np.log(NEW_PER_ERROR * ERRORS_PER_M2 * at_m)
        odds[:, A + 1] = np.log(ERRORS_PER_M2 * at_m)
        largest = odds.max(axis=1)
        share = np.cumsum(np.exp(odds - largest[:, None]), axis=1)
        self.log_weight += largest + np.log(share[:, -1])
        drawn = (self._rng.random(PARTICLES)[:, None] * share[:, -1:] > share).sum(axis=1)
        is_new = (drawn == A) & (self.n < MOST_LANDMARKS) & ~(taken == self.n[:, None]).any(axis=1)
        own = np.flatnonzero(drawn < A)
        landmark = np.where(is_new, self.n, UNKNOWN)
        landmark[own] = near[drawn[own]]
        H = np.concatenate([-seen.jacobian, np.zeros((PARTICLES, A, 2, 1))], axis=3)
        H[..., 1, 2] = -1.0
        at = own, drawn[own]
        gain = P[own] @ H[at].mT @ np.linalg.inv(seen.covariance[at])
        self.pose[own] += (gain @ seen.error[at][..., None])[..., 0]
        P[own] -= gain @ H[at] @ P[own]
        return landmark, P

    def _seen(self, row: int, near: NDArray[np.intp], P: Array) -> _Seen:
        """Return how landmarks (A,) fit a row, of poses with a covariance (N, 3, 3)."""
        z, places = self._problem.measured[row], self.places[:, near]
        off = places - self.pose[:, None, :2]
        away = np.maximum(np.hypot(off[..., 0], off[..., 1]), 1e-3)
        error = np.empty(off.shape)
        error[..., 0] = z[0] - away
        error[..., 1] = half_turn(z[1] - np.arctan2(off[..., 1], off[..., 0]) + self.pose[:, 2:])
        x, y = off[..., 0] / away, off[..., 1] / away
        J = np.empty((*off.shape, 2))
        J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1] = x, y, -y / away, x / away
        # Both the landmark and where the pose is move the sight; the heading turns it.
        spread = self.cov[:, near] + P[:, None, :2, :2]
        xx, xy, yy = spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]
        own = [[J[..., i, 0], J[..., i, 1]] for i in range(2)]
        turned = [a * P[:, None, 0, 2] + b * P[:, None, 1, 2] for a, b in own]
        S = np.empty(J.shape)
        for i, j in ((0, 0), (0, 1), (1, 1)):
            (a, b), (c, d) = own[i], own[j]
            S[..., i, j] = a * c * xx + (a * d + b * c) * xy + b * d * yy
        S[..., 0, 0] += self._variance[row, 0]
        S[..., 0, 1] += turned[0]
        S[..., 1, 0] = S[..., 0, 1]
        S[..., 1, 1] += 2.0 * turned[1] + P[:, None, 2, 2] + self._variance[row, 1]
        det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] ** 2
        square = S[..., 1, 1] * error[..., 0] ** 2 + S[..., 0, 0] * error[..., 1] ** 2
        square = (square - 2.0 * S[..., 0, 1] * error[..., 0] * error[..., 1]) / det
        fits = np.where(square < FITS, -0.5 * (square + np.log(4.0 * np.pi**2 * det)), -np.inf)
        return _Seen(error, J, S, fits)

    def _learn(self, k: int, row: int, landmark: NDArray[np.intp]) -> None:
        """Put landmarks (N,) right by a row, and begin those that are new."""
        z, R = self._problem.measured[row], np.diag(self._variance[row])
        for is_new in (False, True):
            own = np.flatnonzero((landmark >= 0) & ((landmark == self.n) == is_new))
            at, pose = (own, landmark[own]), self.pose[own]
            if is_new:
                angle = pose[:, 2] + z[1]
                ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
                J = np.stack([ray, z[0] * np.stack([-ray[:, 1], ray[:, 0]], axis=1)], axis=2)
                self.places[at] = pose[:, :2] + z[0] * ray
                self.cov[at], self.count[at] = J @ R @ J.mT, 0
                self.n[own] += 1
            else:
                off = self.places[at] - pose[:, :2]
                away = np.maximum(np.hypot(off[:, 0], off[:, 1]), 1e-3)
                x, y = off[:, 0] / away, off[:, 1] / away
                J = np.stack([np.stack([x, y], 1), np.stack([-y, x], 1) / away[:, None]], axis=1)
                bearing = np.arctan2(off[:, 1], off[:, 0]) - pose[:, 2]
                error = np.stack([z[0] - away, half_turn(z[1] - bearing)], axis=1)
                P = self.cov[at]
                gain = P @ J.mT @ np.linalg.inv(J @ P @ J.mT + R)
                self.places[at] += (gain @ error[..., None])[..., 0]
                self.cov[at] = P - gain @ J @ P
            self.count[at] += 1
            self.last_s[at] = self._problem.time_s[k]

    def _chosen(self) -> NDArray[np.intp] | None:
        """Choose particles by their weights once these differ much; return which (N,), or None."""
        share = np.exp(self.log_weight - self.log_weight.max())
        share /= share.sum()
        if 1.0 / np.sum(share**2) > 0.5 * PARTICLES:
            return None
        at = (self._rng.random() + np.arange(PARTICLES)) / PARTICLES
        chosen = np.minimum(np.searchsorted(np.cumsum(share), at), PARTICLES - 1)
        used = slice(0, int(self.n.max()))
        for values in (self.pose, self.drift, self.n):
            values[:] = values[chosen]
        for of_landmarks in (self.places, self.cov, self.last_s, self.count):
            of_landmarks[:, used] = of_landmarks[chosen, used]
        self.log_weight[:] = 0.0
        self.drift += KICK * self._rng.standard_normal(self.drift.shape) * self._spread
        return chosen

    def likeliest(self, steps: list[_Step]) -> Drawn:
        """Return the particle of the largest weight, with all that it comes from."""
        best = here = int(np.argmax(self.log_weight))
        pose, landmark = [], []
        for step in reversed(steps):
            here = here if step.chosen is None else int(step.chosen[here])
            pose.append(step.pose[here])
            landmark.append(step.landmark[here])
        found = np.concatenate(landmark[::-1])
        stays = self.count[best] >= FEWEST
        number = np.where(stays, np.cumsum(stays) - 1, UNKNOWN)
        values = Values(np.array(pose[::-1]), self.places[best, stays], self.drift[best])
        return Drawn(np.where(found >= 0, number[found], UNKNOWN), values)
