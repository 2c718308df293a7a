"""Landmarks for a log that names none: several first opinions, each mended, and the best of them.

A filter that goes along cannot take back what it paired wrongly, and a little more or less trust in
the observations leads it elsewhere. So it goes along several times; one time it remembers no
landmark for long, so that it closes nothing, and what is met again stands in the map anew. And
particles go along, which pair in many ways at once (`particles`), and again with the drift of the
odometry that the best opinion yet tells, for as long as that finds a better one. With all of the
log smoothed, scans are paired anew along the path (`reassociation`), and landmarks that may be one
by their joint covariance are taken as one (`merging`), where that costs less: where it bends the
odometry less and explains more, with fewer landmarks, and with fewer that are in view and not seen
(`sight`). All opinions have one noise, so that their costs compare. Of the cheapest, and of those
that cannot be told from it, the map is then made simpler, and stretches are tied to the rest anew,
where that gains more than chance does (`is_better`). Where the others put the path tells whether it
is sure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.association import (
    Associated,
    AssociationSettings,
    associate,
    density,
)
from ssm_graph.systems.landmark_slam.merging import Map, all_merged, mergers
from ssm_graph.systems.landmark_slam.observation_noise import (
    MOST_ALIKE,
    correlations,
    successive,
    widened,
)
from ssm_graph.systems.landmark_slam.particles import pair_by_particles
from ssm_graph.systems.landmark_slam.problem import UNKNOWN, SlamNoise, SlamProblem
from ssm_graph.systems.landmark_slam.reassociation import (
    FITS,
    MEMORY_S,
    missed,
    price,
    reassociate,
)
from ssm_graph.systems.landmark_slam.sight import View, unseen
from ssm_graph.systems.landmark_slam.smoother import (
    SmootherSettings,
    Values,
)
from ssm_graph.systems.landmark_slam.sparse import Quick, smooth_quickly

TRUSTS: Final = ((1.0, 1.0), (1.5, 1.0), (1.0, 1.5))
"""By which the sigmas of ranges and bearings are multiplied while a first opinion is formed."""
SWARMS: Final = 4
"""Of particles: each of them ends with one pairing, and by chance another."""
MOST_GENERATIONS: Final = 6
"""Of swarms. A better pairing tells better how the odometry drifts, and with that particles find a
better one still; so it goes on until neither a generation nor what is improved then is better."""
SIGMA_OF_MEDIAN: Final = 1.4826
"""A Gaussian's standard deviation over its median absolute value."""
ALIKE: Final = 0.3
"""Correlation of successive errors from which they are taken for as alike as may be: landmarks that
are there twice hide how alike they are."""
DOUBT: Final = 2.0
"""By which sigmas of the map are multiplied where its landmarks may be one: errors of successive
observations are alike, and some are of other landmarks."""
TELLS: Final = 5.0
"""Logarithm of the odds, 150 to one, from which mergers are tried all at once."""
MOST_TRIED: Final = 4
"""Single mergers tried before no better one is thought to be there."""
MOST_PAIRINGS: Final = 2
"""Of all scans, after one another."""
BLURS: Final = (2.0, 4.0)
"""By which sigmas are multiplied for a map with fewer landmarks."""
SURE: Final = 3.0
"""Times the noise of a difference of costs: of some ten steps tried chance passes one in a hundred
times."""
AS_GOOD: Final = 1.0
"""Times the same noise: within it opinions are equally good, and the simpler one is taken."""
MOST_SWEEPS: Final = 3
"""Over all stretches, each tied to the rest anew."""
MOST_ROUNDS: Final = 30
"""Of mergers."""
MOST_IMPROVED: Final = 4
"""Opinions whose stretches are tied anew, the cheapest ones."""


class Opinion(NamedTuple):
    """A log with landmarks, and where it stands."""

    problem: SlamProblem
    values: Values
    landmark: NDArray[np.intp]
    """(M,) of the log that came, `problem.UNKNOWN` of observations left out"""
    cost: float
    """Of what observations and odometry are missed by, of the landmarks that it takes, and of those
    that are in view and not seen."""
    cov: Array
    """(2 L, 2 L) m^2 of its landmarks"""
    of_blocks: Array
    """The cost of each block of `MEMORY_S`, landmarks left out"""
    elsewhere_m: Array
    """(K,) by which the paths of the other opinions are off this one's, at most"""


def best_opinion(
    problem: SlamProblem, noise: SlamNoise, how: AssociationSettings, settings: SmootherSettings
) -> Opinion:
    """Return the opinion of least cost on a log; names it has are not looked at."""
    forgets = replace(how, memory_s=MEMORY_S)
    opened = associate(problem, noise, forgets)
    if not len(opened.places):  # nothing was seen three times: what the filter says is all there is
        values, none = Values(opened.pose, opened.places), np.zeros(0)
        elsewhere = np.zeros(len(opened.pose))
        return Opinion(opened.problem, values, opened.landmark, np.inf, np.eye(0), none, elsewhere)
    told, drift = _told(opened, noise, settings)
    short, its_noise, kept = problem.condensed(told)
    judge = _Judge(short, its_noise, settings)
    firsts = [(associate(problem, told, forgets), True)]
    for trust in TRUSTS:
        wider = SlamNoise(noise.control, noise.observation * trust)
        firsts.append((associate(problem, wider, how), False))
    new = [
        judge.begun(first.landmark, Values(first.pose[kept], first.places), is_open)
        for first, is_open in firsts
    ]
    found: list[Opinion] = []
    for generation in range(MOST_GENERATIONS):
        for seed in range(SWARMS):
            drawn = pair_by_particles(short, its_noise, drift, seed=generation * SWARMS + seed)
            if len(drawn.values.landmarks):
                new.append(judge.begun(drawn.landmark, drawn.values, False))
        was, found, new = found, judge.mended(new, found, judge.simplified), []
        if _is_same(found, was) or generation == MOST_GENERATIONS - 1:
            found = judge.mended(found[:MOST_IMPROVED], found[MOST_IMPROVED:], judge.improved)
            if _is_same(found, was):
                break
        drift = found[0].values.drift
    best = found[0]
    pose = problem.expanded(best.values.pose, kept)
    apart = [problem.expanded(one.values.pose, kept) - pose for one in found]
    return best._replace(
        problem=problem.associated(best.landmark, best.problem.names),
        values=best.values._replace(pose=pose),
        elsewhere_m=np.linalg.norm(np.array(apart)[..., :2], axis=2).max(axis=0),
    )


def _is_same(found: list[Opinion], was: list[Opinion]) -> bool:
    """Return whether the cheapest opinion is the one that it was."""
    return bool(was) and found[0] is was[0]


class _Judge:
    """Makes opinions on a log, and better ones of them."""

    def __init__(self, problem: SlamProblem, noise: SlamNoise, settings: SmootherSettings) -> None:
        self._problem, self._noise, self._settings = problem, noise, settings
        self._block = ((problem.time_s - problem.time_s[0]) // MEMORY_S).astype(np.intp)
        self._view = View.of(problem)

    def begun(self, landmark: NDArray[np.intp], begin: Values, is_open: bool) -> Opinion:
        """Return what comes of a first opinion, which may have closed nothing."""
        opinion = self._judged(landmark, begin)
        if is_open:  # where the path is wrong yet, what is met again is not known
            opinion = self._all_merged(self._paired(opinion, True), True)
        return self._all_merged(self._paired(opinion, False), False)

    def mended(
        self, new: list[Opinion], others: list[Opinion], better: Callable[[Opinion], Opinion]
    ) -> list[Opinion]:
        """Return all opinions, the cheapest first; new ones that are as good are made better."""
        new = sorted(new, key=lambda one: one.cost)
        cheapest = min([*new, *others], key=lambda one: one.cost)
        for number, one in enumerate(new):
            if one.cost - cheapest.cost <= SURE * _noise(one, cheapest):
                new[number] = better(one)
        return sorted([*new, *others], key=lambda one: one.cost)

    def simplified(self, opinion: Opinion) -> Opinion:
        """Return what comes of one opinion with fewer landmarks."""
        for times in BLURS:
            new = self._coarser(opinion, times)
            opinion = new if is_better(new, opinion) else opinion
        return opinion

    def improved(self, opinion: Opinion) -> Opinion:
        """Return what comes of one opinion with fewer landmarks and stretches tied anew."""
        steps = [partial(self._coarser, times=times) for times in BLURS]
        steps += [partial(self._closed_anew, rows=rows) for rows in self._stretches()]
        unchanged = 0
        for step in MOST_SWEEPS * steps:
            new = step(opinion)
            unchanged += 1
            if is_better(new, opinion):
                opinion, unchanged = new, 0
            if unchanged == len(steps):
                break
        return opinion

    def _stretches(self) -> list[NDArray[np.intp]]:
        """Return the observations of each stretch between those in which nothing was seen."""
        time_s = self._problem.time_s[self._problem.keyframe]
        ends = np.flatnonzero(np.diff(time_s) > MEMORY_S) + 1
        return np.split(np.arange(len(time_s)), ends)

    def _closed_anew(self, opinion: Opinion, rows: NDArray[np.intp]) -> Opinion:
        """Return an opinion that ties a stretch to the rest anew."""
        inside, outside = opinion.landmark[rows], np.delete(opinion.landmark, rows)
        both = np.intersect1d(inside[inside >= 0], outside)
        places, landmark = opinion.values.landmarks, opinion.landmark.copy()
        if not len(both):
            return opinion
        for number, one in enumerate(both.tolist()):
            landmark[rows[inside == one]] = len(places) + number
        begin = opinion.values._replace(landmarks=np.vstack([places, places[both]]))
        opened = self._all_merged(self._judged(landmark, begin), True)
        return self._all_merged(self._paired(opened, False), False)

    def _coarser(self, opinion: Opinion, times: float) -> Opinion:
        """Return an opinion of a coarser map.

        With sigmas so many ``times`` as large what stands close together is one; then, along the
        path of that, what is more than one comes apart again.
        """
        noise = SlamNoise(self._noise.control, times * self._noise.observation)
        coarse = _Judge(self._problem, noise, self._settings)
        few = coarse._judged(opinion.landmark, opinion.values)
        few = coarse._all_merged(coarse._paired(few, False), False)
        new = self._paired(self._judged(few.landmark, few.values), False)
        return self._all_merged(new, False)

    def _all_merged(self, opinion: Opinion, is_open: bool) -> Opinion:
        for _ in range(MOST_ROUNDS):
            better = self._merged(opinion, is_open)
            if better is None:
                break
            opinion = better
        return opinion

    def _judged(self, landmark: NDArray[np.intp], begin: Values) -> Opinion:
        """Return the smoothed log with some landmarks and what that costs."""
        names = tuple(str(i) for i in range(len(begin.landmarks)))
        problem = self._problem.associated(landmark, names)
        found = smooth_quickly(problem, self._noise, begin, self._settings)
        of_blocks = self._of_blocks(found, landmark)
        cost = float(of_blocks.sum()) + price(len(landmark)) * len(names)
        elsewhere = np.zeros(len(found.values.pose))
        return Opinion(problem, found.values, landmark, cost, found.cov, of_blocks, elsewhere)

    def _of_blocks(self, found: Quick, landmark: NDArray[np.intp]) -> Array:
        """Return twice the negative logarithms of the likelihoods of blocks.

        Observations left out are at the limit of what fits.
        """
        squares = np.full(len(landmark), FITS)
        squares[landmark >= 0] = np.square(found.rows.own_error).sum(axis=1)
        block = self._block
        odometry = np.square(found.rows.between_error).sum(axis=1)
        places = found.values.pose, found.values.landmarks
        of_blocks = unseen(self._view, self._problem, block, *places, landmark)
        of_blocks += np.bincount(block[self._problem.keyframe], missed(squares), len(of_blocks))
        of_blocks += np.bincount(block[1:], odometry, block[-1] + 1)
        of_blocks[0] += np.sum(np.square(found.values.drift / self._problem.drift_sigma))
        return of_blocks

    def _paired(self, opinion: Opinion, is_open: bool) -> Opinion:
        """Return an opinion with its scans paired anew for as long as that costs less."""
        for _ in range(MOST_PAIRINGS):
            values, landmark = opinion.values, opinion.landmark
            again = reassociate(
                self._problem,
                self._noise.observation * self._problem.scales,
                values.pose,
                values.landmarks,
                landmark if is_open else None,
            )
            if not len(again.places):
                break
            new = self._judged(again.landmark, values._replace(landmarks=again.places))
            if new.cost >= opinion.cost:
                break
            opinion = new
        return opinion

    def _merged(self, opinion: Opinion, is_open: bool) -> Opinion | None:
        """Return an opinion that takes landmarks as one and costs less, or None."""
        places, L = opinion.values.landmarks, len(opinion.values.landmarks)
        seen = np.zeros((len(self._problem.time_s), L))
        seen[opinion.problem.keyframe, opinion.problem.landmark] = 1.0
        together = (seen.T @ seen).astype(np.intp)  # of integers it takes 20 times as long
        now = Map(places, DOUBT**2 * opinion.cov, together, np.arange(L))
        per_m2 = density(places)
        single = [one.map for one in mergers(now, per_m2)[:MOST_TRIED]]
        for tried in (all_merged(now, per_m2, TELLS), *single):
            kept, number = np.unique(tried.one, return_inverse=True)
            if len(kept) == L:
                continue
            landmark = np.where(opinion.landmark >= 0, number[opinion.landmark], UNKNOWN)
            begin = opinion.values._replace(landmarks=tried.places[kept])
            new = self._paired(self._judged(landmark, begin), is_open)
            if new.cost < opinion.cost:
                return new
        return None


def _told(
    first: Associated, noise: SlamNoise, settings: SmootherSettings
) -> tuple[SlamNoise, Array]:
    """Return noise whose observations have sigmas that what is missed asks for, and the drift (d,).

    By its medians, and by how alike successive errors are; none is smaller than stated.
    """
    problem, begin = first.problem, Values(first.pose, first.places)
    smoothed = smooth_quickly(problem, noise, begin, settings)
    errors = smoothed.rows.own_error
    more = np.maximum(SIGMA_OF_MEDIAN * np.median(np.abs(errors), axis=0), 1.0)
    there = np.isfinite(problem.measured)
    alike = correlations(errors / more, there, successive(problem))
    alike = np.where(alike > ALIKE, MOST_ALIKE, alike)
    told = SlamNoise(noise.control, noise.observation * more * widened(alike))
    return told, smoothed.values.drift


def is_better(new: Opinion, old: Opinion) -> bool:
    """Return whether an opinion is to be preferred.

    One with fewer landmarks may cost `AS_GOOD` of the noise more, another has to gain `SURE` of it.
    """
    has_fewer = len(new.values.landmarks) < len(old.values.landmarks)
    return old.cost - new.cost > (-AS_GOOD if has_fewer else SURE) * _noise(new, old)


def _noise(new: Opinion, old: Opinion) -> float:
    """Return the noise of a difference of costs: a sum over blocks, by its squares (Vuong 1989)."""
    return float(np.linalg.norm(old.of_blocks - new.of_blocks))
