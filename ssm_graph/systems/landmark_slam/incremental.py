"""The log as it comes, by GTSAM's incremental smoother: iSAM2, or with a lag.

After every pose each observation, and each closure, has the weight that its residual and its
posterior variance ask for, as in the smoother of the whole log; one whose weight has changed is
taken out and put back with the other. The variance is that of the update that brought it, and is
taken anew for all of them at the end, until the weights have settled: then path and map are those
of the whole log. With a lag, poses older than that are marginalised with the weights they had, and
landmarks stay.

References
----------
.. [1] M. Kaess, H. Johannsson, R. Roberts, V. Ila, J. J. Leonard, F. Dellaert, "iSAM2: Incremental
   Smoothing and Mapping Using the Bayes Tree", International Journal of Robotics Research 31, 2012.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.similarity import Kernel, LogKernel
from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.graphs import (
    SlamGraph,
    landmark_key,
    pair_factor,
    pose_key,
    problem_of_graph,
    seen_factor,
    whitened_pairs,
    whitened_seen,
)
from ssm_graph.systems.landmark_slam.models import composed, turned
from ssm_graph.systems.landmark_slam.problem import (
    SlamEstimate,
    SlamNoise,
    SlamStatus,
)
from ssm_graph.systems.landmark_slam.range_starts import placed
from ssm_graph.systems.landmark_slam.smoother import FAR_M
from ssm_graph.systems.landmark_slam.weights import weights_of

FOREVER_S: Final = 1e12
"""A lag that drops nothing."""
LAG_S: Final = 20.0
"""Of a fixed lag where none is asked for."""
SETTLED_WEIGHT: Final = 1e-2
"""Change of a weight below which the end has come."""


@dataclass(frozen=True, slots=True)
class IncrementalSettings:
    """How a log is taken as it comes."""

    kernel: Kernel = LogKernel(5.0)
    """Weighs observations and closures."""
    lag_s: float | None = None
    """Poses older than this are marginalised; None: none is."""
    rounds: int = 2
    """Weights and solution take turns so often after each pose."""
    weight_change: float = 0.05
    """A weight that has changed by less stays what it was."""
    relinearize: float = 0.01
    """m, or rad: a variable that has moved farther is linearised anew."""
    closing_rounds: int = 30
    """At the end, until all weights have settled; none with a lag."""


class Incremental(NamedTuple):
    """What came of it."""

    estimate: SlamEstimate
    online: Array
    """(K, 3) each pose as it was known when it came."""
    update_s: Array
    """(K,) CPU time of each pose."""
    closing_s: float
    """CPU time of the end."""
    closure_weights: Array
    """Of the closures, in the order of the graph."""


class IncrementalSmoother:
    """Takes the poses of a graph one by one."""

    def __init__(self, graph: SlamGraph, settings: IncrementalSettings | None = None) -> None:
        """Begin with nothing; ``graph`` is what :meth:`add` takes from."""
        self._graph, self._how = graph, settings or IncrementalSettings()
        lag = FOREVER_S if self._how.lag_s is None else self._how.lag_s
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(self._how.relinearize)
        parameters.relinearizeSkip = 1
        self._lag_s = lag
        E, M, K, L = len(graph.pairs), len(graph.seen), len(graph.time_s), len(graph.names)
        self._is_closure = graph.is_closure
        self._is_weighed = np.append(self._is_closure, np.ones(M, dtype=bool))
        order = np.argsort(graph.pairs[:, 1], kind="stable")
        self._pairs_of = np.split(order, np.searchsorted(graph.pairs[order, 1], np.arange(1, K)))
        self._seen_of = np.split(np.arange(M), np.searchsorted(graph.seen[:, 0], np.arange(1, K)))
        # Closures first, observations after: what has a weight has one index.
        self._n_pairs = E
        self.weights = np.ones(E + M)  # zero of what is not taken
        self._dim = np.append(np.full(E, 3), np.isfinite(graph.measured).sum(axis=1))
        self._spread = np.zeros(E + M)
        self._slot = np.full(E + M, -1, dtype=np.intp)
        self._last_of = np.append(graph.pairs[:, 0], graph.seen[:, 0])
        self.pose, self.landmarks = np.full((K, 3), np.nan), np.full((L, 2), np.nan)
        self.pose_cov = np.full((K, 3, 3), np.nan)
        seen_whole = np.zeros(L, dtype=bool)
        seen_whole[graph.seen[self._dim[E:] == 2, 1]] = True
        self._places = self.landmarks if seen_whole.all() else _far_places(graph)
        # By QR: what is marginalised, far, or rigid has too few digits for Cholesky.
        parameters.setFactorization("QR")
        self._solver = gtsam.IncrementalFixedLagSmoother(lag, parameters)
        self._waiting: dict[int, list[int]] = {}
        self._first, self._count = 0, 0
        self.too_old = 0
        """Closures to poses that were dropped before."""

    def add(self, k: int) -> None:
        """Take pose ``k``, the one after the last, with all that ends there."""
        graph = self._graph
        leaving = self._leaving(k)
        factors, values, added = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
        if k == 0:
            self.pose[0] = graph.start
            model = gtsam.noiseModel.Diagonal.Sigmas(graph.start_sigma)
            factors.add(gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(*graph.start), model))
            added.append(-1)
        for e in self._pairs_of[k].tolist():
            if graph.pairs[e, 0] < self._first:
                self.too_old += 1
                self.weights[e] = 0.0
                continue
            if not self._is_closure[e]:
                self.pose[k] = composed(self.pose[k - 1], graph.step[e])
            factors.add(pair_factor(graph, e))
            added.append(e)
        values.insert(pose_key(k), gtsam.Pose2(*self.pose[k].tolist()))
        for m in self._placed(k, values, factors, added):
            self.weights[self._n_pairs + m] = 1.0
            factors.add(seen_factor(graph, m))
            added.append(self._n_pairs + m)
        self._count = k + 1
        stamps = {pose_key(k): float(graph.time_s[k])}
        if self._how.lag_s is not None:  # landmarks stay
            placed = np.flatnonzero(np.isfinite(self.landmarks[:, 0])).tolist()
            stamps |= {landmark_key(i): float(graph.time_s[k]) for i in placed}
        self._first = leaving
        self._update(factors, values, stamps, added, [])
        self._slot[self._last_of < leaving] = -1
        new = np.array([i for i in added if i >= 0], dtype=np.intp)
        self._take_spreads(new[self._is_weighed[new] & (self._slot[new] >= 0)])
        for _ in range(self._how.rounds):
            if self._reweigh(self._how.weight_change) == 0.0:
                break

    def close(self) -> tuple[bool, int]:
        """Let all weights settle with variances of the whole; return whether, and the rounds."""
        for count in range(1, self._how.closing_rounds + 1):
            self._take_spreads(np.flatnonzero(self._is_weighed & (self._slot >= 0)))
            change = self._reweigh(0.0)
            for _ in range(2):  # as far as iSAM2 goes by itself
                self._update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {}, [], [])
            if change < SETTLED_WEIGHT:
                return True, count
        return False, self._how.closing_rounds

    def _leaving(self, k: int) -> int:
        """Return the first pose that stays once ``k`` is there; keep what is known of the rest."""
        limit, first = self._graph.time_s[k] - self._lag_s, self._first
        while first < self._count and self._graph.time_s[first] < limit:
            self.pose_cov[first] = self.covariance(first)
            first += 1
        return first

    def covariance(self, k: int) -> Array:
        """Return that of a pose (3, 3), in the axes of the map."""
        turn = turned(self.pose[k, 2])
        return np.asarray(turn @ self._solver.marginalCovariance(pose_key(k)) @ turn.T)

    def landmark_covariance(self, i: int) -> Array:
        """Return that of a landmark (2, 2)."""
        return np.asarray(self._solver.marginalCovariance(landmark_key(i)))

    def _placed(
        self,
        k: int,
        values: gtsam.Values,
        factors: gtsam.NonlinearFactorGraph,
        added: list[int],
    ) -> list[int]:
        """Return the observations that can be taken now; new landmarks get a place."""
        graph, taken = self._graph, []
        for m in self._seen_of[k].tolist():
            i = int(graph.seen[m, 1])
            r, b = graph.measured[m]
            if np.isnan(self.landmarks[i, 0]):
                if np.isfinite(r + b):
                    angle = self.pose[k, 2] + b
                    ray = np.array([np.cos(angle), np.sin(angle)])
                    self.landmarks[i] = self.pose[k, :2] + r * ray
                elif np.isnan(self._places[i, 0]):  # until range and bearing are known
                    self._waiting.setdefault(i, []).append(m)
                    self.weights[self._n_pairs + m] = 0.0
                    continue
                else:
                    self.landmarks[i] = self._places[i]
                    model = gtsam.noiseModel.Isotropic.Sigma(2, FAR_M)
                    prior = gtsam.PriorFactorPoint2(landmark_key(i), self._places[i], model)
                    factors.add(prior)
                    added.append(-1)
                values.insert(landmark_key(i), self.landmarks[i])
                old = self._waiting.pop(i, [])
                taken += [o for o in old if graph.seen[o, 0] >= self._first]
            taken.append(m)
        return taken

    def _update(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        stamps: dict[Any, float],
        added: list[int],
        removed: list[int],
    ) -> None:
        try:
            self._solver.update(factors, values, stamps, removed)
            found = self._solver.calculateEstimate()
        except RuntimeError as error:
            raise SolverError(
                f"iSAM2 at pose {self._count - 1}: {str(error).strip().splitlines()[0]}; look for "
                "a landmark seen once by a range or a bearing alone, or sigmas far too small"
            ) from error
        if added:
            slots = self._solver.getISAM2Result().getNewFactorsIndices()
            for i, slot in zip(added, slots, strict=False):
                if i >= 0:
                    self._slot[i] = slot
        self.pose[self._first : self._count] = gtsam.utilities.extractPose2(found)
        placed = np.isfinite(self.landmarks[:, 0])
        if placed.any():
            self.landmarks[placed] = gtsam.utilities.extractPoint2(found)

    def _take_spreads(self, which: NDArray[np.intp]) -> None:
        """Take anew the posterior variances of some closures and observations, in sigmas."""
        graph, solver = self._graph, self._solver.getISAM2()
        for i in which.tolist():
            if i < self._n_pairs:
                a, b = graph.pairs[i].tolist()
                keys, turns = [pose_key(a), pose_key(b)], [turned(self.pose[x, 2]) for x in (a, b)]
                slopes = whitened_pairs(graph, np.array([i]), self.pose)[1][0]
            else:
                a, b = graph.seen[i - self._n_pairs].tolist()
                keys = [pose_key(a), landmark_key(b)]
                turns = [turned(self.pose[a, 2]), np.eye(2)]
                row = np.array([i - self._n_pairs])
                slopes = whitened_seen(graph, row, self.pose, self.landmarks)[1][0]
            first, second = slopes[:, :3] @ turns[0], slopes[:, 3:] @ turns[1]
            own = np.hstack([first, second])
            cov = solver.jointMarginalCovariance(keys).fullMatrix()
            self._spread[i] = float(np.einsum("ri,ij,rj->", own, cov, own))

    def _reweigh(self, least: float) -> float:
        """Give new weights where they have changed by more; return the largest change."""
        graph, E = self._graph, self._n_pairs
        active = np.flatnonzero(self._is_weighed & (self._slot >= 0))
        if len(active) == 0:
            return 0.0
        pairs, seen = active[active < E], active[active >= E] - E
        squares = np.append(
            np.square(whitened_pairs(graph, pairs, self.pose)[0]).sum(axis=1),
            np.square(whitened_seen(graph, seen, self.pose, self.landmarks)[0]).sum(axis=1),
        )
        wanted = weights_of(self._how.kernel, squares + self._spread[active], self._dim[active])
        change = np.abs(wanted - self.weights[active])
        moved = change > least
        if not moved.any():
            return 0.0
        factors = gtsam.NonlinearFactorGraph()
        which: NDArray[np.intp] = active[moved]
        for i, weight in zip(which.tolist(), wanted[moved].tolist(), strict=True):
            self.weights[i] = weight
            factors.add(
                pair_factor(graph, i, weight) if i < E else seen_factor(graph, i - E, weight)
            )
        removed = self._slot[which].tolist()
        self._update(factors, gtsam.Values(), {}, which.tolist(), removed)
        return float(change.max())


def _far_places(graph: SlamGraph) -> Array:
    """Return places (L, 2) of landmarks never seen as a whole, from all of the log's odometry."""
    problem, noise = problem_of_graph(graph)
    places = np.full((len(graph.names), 2), np.nan)
    found = placed(problem, noise.observation, problem.dead_reckoned(), places)
    whole = np.isfinite(graph.measured).all(axis=1)
    found[graph.seen[whole, 1]] = np.nan
    return found


def smooth_incrementally(
    graph: SlamGraph, settings: IncrementalSettings | None = None
) -> Incremental:
    """Return path and map of a graph taken pose by pose.

    Poses are those at the end, or, with a lag, as they were when the lag left them behind.
    """
    how = settings or IncrementalSettings()
    smoother = IncrementalSmoother(graph, how)
    K, E = len(graph.time_s), len(graph.pairs)
    online, took = np.empty((K, 3)), np.empty(K)
    for k in range(K):
        began = time.process_time()
        smoother.add(k)
        took[k] = time.process_time() - began
        online[k] = smoother.pose[k]
    began = time.process_time()
    settled, rounds = (True, 1) if how.lag_s is not None else smoother.close()
    closing = time.process_time() - began
    cov = smoother.pose_cov.copy()
    for k in np.flatnonzero(np.isnan(cov[:, 0, 0])).tolist():
        cov[k] = smoother.covariance(k)
    landmark_cov = np.full((len(graph.names), 2, 2), np.nan)
    for i in np.flatnonzero(np.isfinite(smoother.landmarks[:, 0])).tolist():
        landmark_cov[i] = smoother.landmark_covariance(i)
    notes = [
        f"CPU time of a pose: {1e3 * np.median(took):.1f} ms in the median, "
        f"{1e3 * np.quantile(took, 0.95):.1f} ms at 95 %, {1e3 * took.max():.0f} ms at most; of "
        f"the end: {closing:.1f} s"
    ]
    if smoother.too_old:
        notes.append(f"closures to poses that the lag had dropped, left out: {smoother.too_old}")
    status = SlamStatus.CONVERGED if settled else SlamStatus.MAX_ITERATIONS
    if how.lag_s is not None:
        status = SlamStatus.DONE
    estimate = SlamEstimate(
        smoother.pose,
        cov,
        smoother.landmarks,
        landmark_cov,
        smoother.weights[E:],
        SlamNoise(np.ones(3), graph.typical_sigma),
        status,
        rounds,
        np.zeros(0),
        tuple(notes),
    )
    closures = smoother.weights[:E][graph.is_closure]
    return Incremental(estimate, online, took, closing, closures)
