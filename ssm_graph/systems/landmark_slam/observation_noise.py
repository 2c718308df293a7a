"""The noise of observations from the log: how a range's grows, and how alike successive errors are.

Of a range the variance is ``a^2 + (b r)^2``: what an instrument has at any distance, and what grows
with it. Both, and the sigma of bearings, come from the expected squares of the smoothed log,
``r^2 + H P H'``, in turns with the smoother. Errors of successive sightings of one landmark are
often alike (an image at rest, a range in steps): with correlation ``c`` from each to the next, as
of a first-order process, n of them tell as much as ``n (1 - c) / (1 + c)`` that are independent.
So sigmas are multiplied by ``sqrt((1 + c) / (1 - c))``: taken for white, such errors would pass for
motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.kernels import TruncatedKernel
from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.statistics import Interval
from ssm_graph.systems.landmark_slam.noise import GATE, SigmaFound
from ssm_graph.systems.landmark_slam.problem import SlamEstimate, SlamNoise, SlamProblem
from ssm_graph.systems.landmark_slam.smoother import (
    Pass,
    SmootherSettings,
    Values,
    one_pass,
    smooth_landmarks,
)
from ssm_graph.systems.landmark_slam.weights import square_share, weights_of

ROUNDS: Final = 4
"""At most. White noise has settled by then; where errors are alike more rounds let the white noise
of the motion take what the bearings miss: on MRCLAM, 6 robot 1 and 7 robot 4, their sigma goes on
to shrink, past that of their errors against the truth, and nothing improves. Chosen on these two,
with their truth."""
SETTLED_LOG: Final = 0.02
"""Change of the logarithm of any sigma at which they are settled."""
LAW_ROUNDS: Final = 200
"""Of the law of a range's variance: cheap, and slow where one part is small."""
FEWEST: Final = 30
"""Observations, and pairs of them, that can tell a noise: to 13 percent."""
SUCCESSIVE_S: Final = 1.0
"""Sightings of a landmark nearer than this in time are successive."""
MOST_ALIKE: Final = 0.9
"""Correlation; more would leave next to nothing of a log (sigmas 4.4 times as large). A choice: the
ranges of every robot of MRCLAM that was looked at reach it, so that there it sets their sigma."""
GATINGS: Final = 6
"""Of what a pass found, each by the sigmas that the one before asks for: from a third of normal
noise to 1 percent of it."""
_GATED: Final = TruncatedKernel(GATE)
FAR: Final = 3.0
"""Sigmas to which residuals are cut where their correlation is taken."""


class _Law(NamedTuple):
    """Standard deviations, and how alike successive errors are."""

    near_m: float
    """Of a range at no distance."""
    share: float
    """Of the distance."""
    bearing: float
    alike: Array
    """(2,) correlation of successive errors of range and bearing."""

    def sigmas(self, ranges: Array) -> Array:
        """Return sigmas (M, 2) of single observations."""
        of_range = np.sqrt(self.near_m**2 + np.square(self.share * ranges))
        return np.column_stack([of_range, np.full(len(ranges), self.bearing)])

    @property
    def wider(self) -> Array:
        """(2,) by which they are multiplied."""
        return widened(self.alike)


class ObservationsFound(NamedTuple):
    """The log solved with the noise that its observations have."""

    problem: SlamProblem
    """With the sigma of each observation."""
    estimate: SlamEstimate
    sigmas: tuple[SigmaFound, ...]
    notes: tuple[str, ...]


def learn_observations(
    problem: SlamProblem, stated: SlamNoise, first: Values, settings: SmootherSettings | None = None
) -> ObservationsFound:
    """Return the smoothed log with the noise of its observations from itself.

    The noise of the motion stays as stated; observations that are too few keep what was stated.
    """
    how = replace(settings or SmootherSettings(), finds_tail=False)
    given = stated.observation * problem.scales
    there = np.isfinite(problem.measured)
    ranges = np.where(there[:, 0], problem.measured[:, 0], 0.0)
    pairs = successive(problem)
    now, noise, before = problem, stated, given
    law: _Law | None = None
    estimate = smooth_landmarks(now, noise, first, how)
    for _ in range(ROUNDS):
        values = Values(estimate.pose, estimate.landmarks, estimate.drift)
        ones = np.ones(len(now.control))
        found = one_pass(now, noise, how, values, estimate.weights, ones)
        law = _law(found, noise.observation * now.scales, ranges, there, pairs, law)
        wanted = np.where(there.sum(axis=0) >= FEWEST, law.sigmas(ranges) * law.wider, given)
        now, noise = _with_sigmas(problem, stated, wanted, there)
        estimate = smooth_landmarks(now, noise, values, how, weights=estimate.weights)
        change = float(np.max(np.abs(np.log(wanted / before))[there], initial=0.0))
        before = wanted
        if change < SETTLED_LOG:
            break
    assert law is not None
    return ObservationsFound(now, estimate, *_told(law, given, ranges, there))


def _with_sigmas(
    problem: SlamProblem, stated: SlamNoise, sigmas: Array, there: NDArray[np.bool_]
) -> tuple[SlamProblem, SlamNoise]:
    """Return a log whose observations have sigmas (M, 2): their rms, and the share of each."""
    count = np.maximum(there.sum(axis=0), 1)
    rms = np.sqrt(np.where(there, np.square(sigmas), 0.0).sum(axis=0) / count)
    rms = np.where(there.any(axis=0), rms, stated.observation)
    scale = np.where(there, sigmas / rms, 1.0)
    return replace(problem, observation_scale=scale), SlamNoise(stated.control, rms)


def successive(problem: SlamProblem) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows of sightings, each with the next one of the same landmark."""
    order = np.lexsort((problem.keyframe, problem.landmark))
    a, b = order[:-1], order[1:]
    time_s = problem.time_s[problem.keyframe]
    same = (problem.landmark[a] == problem.landmark[b]) & (time_s[b] - time_s[a] < SUCCESSIVE_S)
    return a[same], b[same]


def _law(
    found: Pass,
    used: Array,
    ranges: Array,
    there: NDArray[np.bool_],
    pairs: tuple[NDArray[np.intp], NDArray[np.intp]],
    before: _Law | None,
) -> _Law:
    """Return what the expected squares of a pass ask for; ``used`` (M, 2) sigmas whitened it."""
    squares, n_rows = found.expected.own * used**2, found.rows.n_rows
    mean: list[float] = used.mean(axis=0).tolist()
    law = before or _Law(mean[0], 0.0, mean[1], np.zeros(2))
    share = np.array([1.0, *(square_share(_GATED, dim) for dim in (1, 2))])[n_rows.astype(int)]
    own = law.sigmas(ranges) if before else used
    for _ in range(GATINGS):
        # By what one observation alone may miss. A soft weight would make white noise too small.
        w = weights_of(_GATED, np.where(there, squares / own**2, 0.0).sum(axis=1), n_rows)
        counts = (w > 0.0)[:, None] & there
        near, part, bearing = law[:3]
        if counts[:, 0].sum() >= FEWEST:
            at = counts[:, 0]
            near, part = _growing(squares[at, 0] / share[at], ranges[at], w[at])
        if counts[:, 1].sum() >= FEWEST:
            at = counts[:, 1]
            bearing = float(np.sqrt(np.average(squares[at, 1] / share[at], weights=w[at])))
        law = _Law(near, part, bearing, np.zeros(2))
        own = law.sigmas(ranges)
    return law._replace(alike=correlations(found.rows.own_error * used / own, there, pairs))


def correlations(
    errors: Array, there: NDArray[np.bool_], pairs: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> Array:
    """Return how alike successive errors of range and bearing are, (2,) of 0 to `MOST_ALIKE`.

    Parameters
    ----------
    errors : (M, 2) in sigmas.
    there : (M, 2) whether measured.
    pairs : of `successive`.
    """
    z, alike = np.clip(errors, -FAR, FAR), np.zeros(2)
    for i in range(2):
        a, b = (side[there[pairs[0], i] & there[pairs[1], i]] for side in pairs)
        if len(a) >= FEWEST:
            c = float(np.mean(z[a, i] * z[b, i])) / max(float(np.mean(z[a, i] ** 2)), 1e-300)
            alike[i] = min(c, MOST_ALIKE) if c > 2.0 / np.sqrt(len(a)) else 0.0
    return alike


def widened(alike: Array) -> Array:
    """Return by what sigmas are multiplied where successive errors are alike, (2,)."""
    return np.asarray(np.sqrt((1.0 + alike) / (1.0 - alike)))


def _growing(squares: Array, ranges: Array, weights: Array) -> tuple[float, float]:
    """Return ``a`` and ``b`` of ``a^2 + (b r)^2`` of greatest likelihood.

    By expectation maximisation: each error is the sum of two, one of each part.
    """
    constant = 0.5 * float(np.average(squares, weights=weights))
    square = ranges**2
    grows = 0.5 * float(np.average(squares / square, weights=weights))
    for _ in range(LAW_ROUNDS):
        total = constant + grows * square
        own = constant / total
        of_near = own**2 * squares + constant * (1.0 - own)
        of_far = ((1.0 - own) ** 2 * squares) / square + grows * own
        constant = float(np.average(of_near, weights=weights))
        grows = float(np.average(of_far, weights=weights))
    return float(np.sqrt(constant)), float(np.sqrt(grows))


def _told(
    law: _Law, given: Array, ranges: Array, there: NDArray[np.bool_]
) -> tuple[tuple[SigmaFound, ...], tuple[str, ...]]:
    sigmas, notes = [], []
    middle = float(np.median(ranges[there[:, 0]])) if there[:, 0].any() else 0.0
    own = law.sigmas(np.array([middle]))[0]
    for i, label in enumerate((f"range at {middle:.1f} m, m", "bearing, rad")):
        n = int(there[:, i].sum())
        if n < FEWEST:
            notes.append(f"{n} observations of {label}: too few to learn from, noise as stated")
            continue
        alike = law.alike[i] ** 2  # of squares
        dof = max(n * (1.0 - alike) / (1.0 + alike), 1.0)
        low, high = np.sqrt(dof / chi2.ppf([0.975, 0.025], dof)) * own[i]
        stated = float(np.median(given[there[:, i], i]))
        sigmas.append(SigmaFound(label, stated, Interval(float(own[i]), float(low), float(high))))
        if law.alike[i] > 0.0:
            notes.append(
                f"successive errors of {label.split()[0].rstrip(',')}s are alike by "
                f"{law.alike[i]:.2f}: taken as if their sigma were {law.wider[i]:.2f} times that"
            )
    if there[:, 0].sum() >= FEWEST:
        notes.append(f"sigma of a range r: sqrt({law.near_m:.3g}^2 + ({law.share:.3g} r)^2) m")
    return tuple(sigmas), tuple(notes)
