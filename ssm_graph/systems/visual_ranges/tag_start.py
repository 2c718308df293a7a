"""The path from marks and ranges, grown both ways from where marks are seen most.

What comes is predicted by constant velocity, new marks are placed by their disparity, and all so
far is solved again; so no start from elsewhere is needed. Ranges take part from the beginning, by
each of the places that their anchors may have by then; what fits best after a while goes on.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from factors.so3 import exp
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.systems.visual_ranges.contradictions import misfits
from ssm_graph.systems.visual_ranges.range_rows import largest_turn
from ssm_graph.systems.visual_ranges.range_terms import FramePoses, hang, places_of
from ssm_graph.systems.visual_ranges.ranges import Indices, Ranges
from ssm_graph.systems.visual_ranges.start import StartRules, StartState, find_start
from ssm_graph.systems.visual_ranges.tag_path import (
    DENSITY,
    TagPass,
    TagWeights,
    deviance,
    settle,
    widened,
)
from ssm_graph.systems.visual_ranges.tag_rows import TagProblem, TagSightings, TagValues

PIXEL_SIGMA: Final = 1.0
"""Of the centre of a mark, pixels, before residuals show it."""
KNOT_S: Final = 0.15
"""Longest time between two knots: 1 m/s^2 moves a place by 3 mm within half of it."""
DRIFT: Final = 0.03
"""Of a path that few marks hold, as a share of its length; see :data:`.range_fit.DRIFT`."""
DEPTH_SHARE: Final = 0.10
"""Of a map's unit by disparities alone, which 3 pixels of 30 may be off."""
ROUGH: Final = 0.3
"""Sigmas by which the last step moves anything at most, while more is to come."""
SEED_S: Final = 6.0
"""Of the path from which it grows: what a start of ranges needs, and a second."""
PAUSE_S: Final = 0.5
"""Between images, from which it counts as one."""
STILL: Final = 0.05
"""Sightings that the predicted axes count for, about the line of sight."""
GROW_S: Final = 1.0
"""What is added before all so far is solved again."""
RIVALS_S: Final = 12.0
"""Of the path from which only what fits best goes on."""
SOFT: Final = 20.0
"""Times its sigma that a sighting has while the path grows: sharp ones make narrow valleys."""
SHARPER: Final = (10.0, 5.0, 2.0, 1.0)
"""The same while the whole path settles."""
WIDENINGS: Final = 4
"""Rounds in which sigmas are made no better than residuals show them."""
LEAST_SHARP: Final = 4
"""Marks and anchors that are known, for their size to be."""
HOPELESS: Final = 30.0
"""Deviance by which one path is so much worse than another that it is left."""
NOT_SEARCHED: Final = (
    "path and anchors together may have other places that fit as well: not all were tried"
)
NEAREST_M: Final = 0.3
"""Disparities beyond that of a mark at this distance are no sightings of it."""


@dataclass(frozen=True, repr=False)
class TagPath(ReadOnlyArrays):
    """What came out, in metres where the state has a scale."""

    state: StartState
    reasons: tuple[str, ...]
    """Why it is not ready, a sentence each."""
    time_s: Array
    """(K,) of the knots, which all images are"""
    R_mc: Array
    """(K, 3, 3) camera to map; the map's axes are those of a camera on the way"""
    place: Array
    """(K, 3) of the left camera"""
    covariance: Array
    """(K, 6, 6) of rotation ``R_mc @ Exp(phi)`` and a shift along the camera's axes"""
    sigma_log_scale: float
    """Of the size of all marks and anchors; NaN without anchors."""
    names: tuple[int, ...]
    """(T,) numbers of the marks"""
    tags: Array
    """(T, 3)"""
    anchors: Array
    """(J, 3), or none"""
    anchor_covariance: Array
    """(J, 3, 3)"""
    clock_s: float
    """Time of a range less its stamp."""
    sighting_weight: Array
    """(n,)"""
    range_weight: Array
    """(M,) of the ranges between the first image and the last"""


def tag_problem(
    sightings: TagSightings, ranges: Ranges, lever_arm_m: Array
) -> tuple[TagProblem, tuple[int, ...]]:
    """Return the problem, and the marks' numbers.

    Knots are at the images, and between them where they are further apart than ``KNOT_S``; ranges
    before the first and after the last image are left out.
    """
    if not len(sightings.time_s):
        raise DataError("no marks: expected sightings (time, number, pixel), got none")
    images = np.unique(sightings.time_s)
    extra = [
        np.linspace(a, b, int(np.ceil((b - a) / KNOT_S)) + 1)[1:-1]
        for a, b in itertools.pairwise(images.tolist())
    ]
    time_s = np.sort(np.concatenate([images, *extra]))
    names, tag = np.unique(sightings.tag, return_inverse=True)
    camera = sightings.camera
    both = np.stack([camera.normalise(sightings.left), camera.normalise(sightings.right)], axis=1)
    own = ranges.rows((ranges.time_s >= time_s[0]) & (ranges.time_s <= time_s[-1]))
    knot = np.searchsorted(0.5 * (time_s[1:] + time_s[:-1]), own.time_s)
    problem = TagProblem(
        time_s,
        np.searchsorted(time_s, sightings.time_s),
        tag,
        both,
        PIXEL_SIGMA / camera.fx,
        sightings.baseline_m,
        knot,
        own.time_s - time_s[knot],
        own.anchor,
        own.range_m,
        own.sigma_m,
        np.asarray(lever_arm_m, dtype=np.float64),
    )
    return problem, tuple(names.tolist())


def tag_path(sightings: TagSightings, ranges: Ranges, lever_arm_m: Array) -> TagPath:
    """Return path, marks and anchors from the centres of marks and from ranges.

    Parameters
    ----------
    sightings : of marks at places that are not known; with a right camera, for depth.
    ranges : to anchors at places that are not known.
    lever_arm_m : (3,) left camera to antenna, camera axes.

    Raises :class:`DataError` where no mark is seen, and :class:`SolverError` for what does not
    determine a path.
    """
    problem, names = tag_problem(sightings, ranges, lever_arm_m)
    grown = _Growth(problem).seeded().with_ranges(ranges)
    again_s = RIVALS_S
    while not grown[0].is_whole:
        for one in grown:
            one.grow()
        least = min(one.deviance for one in grown)
        grown = [one for one in grown if one.deviance < least + HOPELESS]
        if grown[0].lasts_s > again_s or grown[0].is_whole:
            # Where anchors are is told better by now: other places are tried as well.
            best = min(grown, key=lambda one: one.deviance)
            grown = [min((best, *best.with_ranges(ranges)), key=lambda one: one.deviance)]
            again_s = np.inf
    return grown[0].finished(ranges, names)


class _Growth:
    """A path of some knots, and what may be added to it."""

    def __init__(self, problem: TagProblem) -> None:
        self.whole = problem
        self.begin = self.end = 0
        self.tags: Indices = np.zeros(0, dtype=np.intp)
        none = np.zeros((0, 3))
        self.values = TagValues(
            np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)), none, none,
            np.zeros((1, 0)), 0.0, np.zeros(3),
        )  # fmt: skip
        self.density = np.array(DENSITY)
        self.last: TagPass | None = None

    @property
    def is_whole(self) -> bool:
        """Whether nothing is left to be added."""
        return self.begin == 0 and self.end == len(self.whole.time_s)

    @property
    def lasts_s(self) -> float:
        """From the first knot to the last."""
        return float(self.whole.time_s[self.end - 1] - self.whole.time_s[self.begin])

    @property
    def deviance(self) -> float:
        """How badly all so far fits."""
        problem = self.whole.window(self.begin, self.end, self.tags)
        problem = replace(problem, seen_sigma=SOFT * problem.seen_sigma)
        return deviance(problem, self.values, self.density)

    def seeded(self) -> _Growth:
        """Begin with the seconds in which marks are seen with least pause, and most of them."""
        time_s = self.whole.time_s
        at = time_s[self.whole.knot] - time_s[0]
        after = np.arange(0.0, SEED_S, PAUSE_S) + (time_s - time_s[0])[:, None]
        seen = np.searchsorted(at, after + PAUSE_S) - np.searchsorted(at, after)
        self.begin = int(np.argmax(np.count_nonzero(seen, axis=1) + 1e-3 * seen.sum(axis=1)))
        self.end = self.begin + 1
        last = min(float(time_s[self.begin]) + SEED_S, float(time_s[-1]))
        while self.whole.time_s[self.end - 1] < last:
            self.extend(self.begin, self.until(self.end, GROW_S))
        return self

    def with_ranges(self, ranges: Ranges) -> list[_Growth]:
        """Return a path for each place that the anchors may have by the ranges so far."""
        at = self.values
        R_cw = at.R_mc.mT
        t_cw = -np.einsum("kij,kj->ki", R_cw, at.place)
        seen = np.unique(self.whole.window(self.begin, self.end, self.tags).knot)
        frames = FramePoses(
            self.whole.time_s[self.begin : self.end][seen], R_cw[seen], t_cw[seen], seen
        )
        terms = hang(
            ranges, frames, R_cw, t_cw, lever_arm_m=self.whole.lever_arm_m, longest_gap_s=1.0
        )
        places = places_of(terms, R_cw, t_cw, ranges.time_s)
        start = find_start(
            places, ranges.names, StartRules(least_s=3.0, least_ranges=20, drift=DRIFT),
            turned_rad=largest_turn(R_cw), scale_prior=(0.0, DEPTH_SHARE),
        )  # fmt: skip
        if start.solution is None:
            return [self]
        return [
            self.at(
                at.times(one.scale)._replace(
                    anchors=one.anchors.copy(),
                    biases=np.tile(one.biases, (len(at.place), 1)),
                    clock_s=one.clock_s,
                )
            )
            for one in (start.solution, *start.alternatives)
        ]

    def at(self, values: TagValues) -> _Growth:
        """Return the path of the same knots that is nearest to some values."""
        grown = _Growth(self.whole)
        grown.begin, grown.end, grown.tags = self.begin, self.end, self.tags
        grown.values = values
        grown.settle()
        return grown

    def until(self, knot: int, span_s: float) -> int:
        """Return the knot so much later (or earlier) than the one before ``knot``."""
        time_s = self.whole.time_s
        if span_s < 0.0:
            return int(np.searchsorted(time_s, time_s[knot] + span_s))
        return int(np.searchsorted(time_s, time_s[knot - 1] + span_s, side="right"))

    def grow(self) -> None:
        """Add a second on the side where the next mark is seen sooner."""
        time_s, n = self.whole.time_s, len(self.whole.time_s)
        seen = np.unique(self.whole.knot)
        later, earlier = seen[seen >= self.end], seen[seen < self.begin]
        ahead = time_s[later[0]] - time_s[self.end - 1] if len(later) else np.inf
        back = time_s[self.begin] - time_s[earlier[-1]] if len(earlier) else np.inf
        if ahead <= back:
            self.extend(self.begin, min(max(self.until(self.end, GROW_S), self.end + 1), n))
        else:
            self.extend(max(min(self.until(self.begin, -GROW_S), self.begin - 1), 0), self.end)

    def extend(self, begin: int, end: int) -> None:
        """Add knots at both sides, and solve all so far."""
        self.predict(self.whole.time_s[self.end : end], -1, self.whole.time_s[self.end - 1])
        self.predict(self.whole.time_s[begin : self.begin], 0, self.whole.time_s[self.begin])
        self.face(begin, range(self.end, end))
        self.face(begin, range(self.begin - 1, begin - 1, -1))
        self.begin, self.end = begin, end
        self.add_tags()
        self.settle()

    def settle(self) -> None:
        """Solve all so far."""
        problem = self.whole.window(self.begin, self.end, self.tags)
        problem = replace(problem, seen_sigma=SOFT * problem.seen_sigma)
        ones = np.ones(len(problem.knot)), np.ones(len(problem.range_m))
        self.last = settle(
            problem, self.values, TagWeights(*ones, self.density, True), most=6, settled=ROUGH
        )
        self.values = self.last.values

    def predict(self, time_s: Array, near: int, near_s: float) -> None:
        """Add knots by constant velocity and turn rate, after the last (-1) or before the first."""
        if not len(time_s):
            return
        R, p, v, w = (column[near] for column in self.values[:4])
        after = (time_s - near_s)[:, None]
        n = len(after)
        new = (
            R @ exp(after * w), p + after * v, np.tile(v, (n, 1)), np.tile(w, (n, 1)),
            np.tile(self.values.biases[near], (n, 1)),
        )  # fmt: skip
        old = (*self.values[:4], self.values.biases)
        R, p, v, w, b = (
            np.concatenate([two, one] if near == 0 else [one, two])
            for one, two in zip(old, new, strict=True)
        )
        self.values = self.values._replace(R_mc=R, place=p, velocity=v, rate=w, biases=b)

    def face(self, begin: int, knots: range) -> None:
        """Turn new knots to the marks that they see and that have a place already."""
        R = self.values.R_mc
        turn = np.eye(3)
        for k in knots:
            R[k - begin] = turn @ R[k - begin]
            rows = np.arange(*np.searchsorted(self.whole.knot, (k, k + 1)))
            at = [np.flatnonzero(self.tags == j) for j in self.whole.tag[rows]]
            rows = rows[[len(found) > 0 for found in at]]
            if not len(rows):
                continue
            line = self.values.tags[np.concatenate(at)] - self.values.place[k - begin]
            ray = np.column_stack([self.whole.seen[rows, 0], np.ones(len(rows))]) @ R[k - begin].T
            wanted = line / np.linalg.norm(line, axis=1)[:, None]
            seen = ray / np.linalg.norm(ray, axis=1)[:, None]
            U, _, Vt = np.linalg.svd(wanted.T @ seen + STILL * np.eye(3))
            more = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
            R[k - begin], turn = more @ R[k - begin], more @ turn

    def add_tags(self) -> None:
        """Place marks that are new by their disparity where they are seen best, that is widest."""
        rows = np.arange(*np.searchsorted(self.whole.knot, (self.begin, self.end)))
        seen = self.whole.seen[rows]
        base = self.whole.baseline_m * np.exp(self.values.log_base)
        disparity = np.nan_to_num(seen[:, 0, 0] - seen[:, 1, 0])
        fresh = np.setdiff1d(self.whole.tag[rows], self.tags)
        if not len(fresh):
            return
        best = [
            int(own[np.argmax(disparity[own])])
            for own in (np.flatnonzero(self.whole.tag[rows] == j) for j in fresh)
        ]
        depth = base / np.clip(disparity[best], base / 10.0, base / NEAREST_M)
        x_c = depth[:, None] * np.column_stack([seen[best, 0], np.ones(len(best))])
        k = self.whole.knot[rows][best] - self.begin
        placed = np.einsum("kij,kj->ki", self.values.R_mc[k], x_c) + self.values.place[k]
        self.tags = np.concatenate([self.tags, fresh])
        self.values = self.values._replace(tags=np.concatenate([self.values.tags, placed]))

    def finished(self, ranges: Ranges, names: tuple[int, ...]) -> TagPath:
        """Return the path with sightings as sharp as they are, and every weight renewed."""
        assert self.last is not None
        stated, found = self.whole.window(self.begin, self.end, self.tags), self.last
        for soft in SHARPER:
            own = replace(stated, seen_sigma=soft * stated.seen_sigma)
            found = settle(own, found.values, found.weights, most=20)
        problem = stated
        for _ in range(WIDENINGS):
            problem = widened(problem, found)
            found = settle(problem, found.values, replace(found.weights, is_trusting=False), most=5)
        at, solution = found.values, found.solution
        J, tags = len(at.anchors), 3 * len(at.tags)
        placed = solution.constants_cov[tags : tags + 3 * J, tags : tags + 3 * J]
        of_anchors = placed.reshape(J, 3, J, 3)[np.arange(J), :, np.arange(J)]
        sigma = scale_sigma(at, solution.constants_cov) if J else np.nan
        state, reasons = _judged(stated, problem, found, ranges.names, sigma, of_anchors)
        return TagPath(
            state, reasons, problem.time_s, at.R_mc, at.place, solution.covariance(6), sigma,
            tuple(names[j] for j in self.tags), at.tags, at.anchors, of_anchors, at.clock_s,
            found.weights.sighting, found.weights.range,
        )  # fmt: skip


def scale_sigma(values: TagValues, covariance: Array) -> float:
    """Return the relative standard deviation of the size of marks and anchors that are known."""
    points = np.concatenate([values.tags, values.anchors])
    P = covariance[: points.size, : points.size]
    sharp = np.sqrt(P.diagonal().reshape(-1, 3).sum(axis=1)) < StartRules().anchor_sigma_m
    if sharp.sum() < LEAST_SHARP:
        return float("inf")
    line = np.where(sharp[:, None], points - points[sharp].mean(axis=0), 0.0).ravel()
    along = line / float(line @ line)
    return float(np.sqrt(along @ P @ along))


def _judged(
    stated: TagProblem,
    problem: TagProblem,
    found: TagPass,
    names: tuple[str, ...],
    sigma: float,
    of_anchors: Array,
) -> tuple[StartState, tuple[str, ...]]:
    """Return what the answer is worth by the rules of a start, and why not more."""
    rules, J = StartRules(), len(found.values.anchors)
    if not J:
        return StartState.AMBIGUOUS, ("the ranges place no anchor: the map is in no known unit",)
    against = misfits(
        names, problem.anchor, found.ranges.error * problem.range_sigma, problem.range_sigma,
        np.median(found.values.biases, axis=0), stated_m=stated.range_sigma,
        rms_sigmas=rules.rms_sigmas, long_share=rules.long_share,
    )  # fmt: skip
    if against:
        return StartState.REFUSED, (*against,)
    if sigma > rules.ready_sigma:
        state = StartState.COARSE if sigma <= rules.scale_sigma else StartState.AMBIGUOUS
        return state, (rules.coarse(sigma),)
    reasons = [NOT_SEARCHED]
    for name, j in zip(names, range(J), strict=True):
        own = float(np.sqrt(np.trace(of_anchors[j])))
        median = float(np.median(problem.range_m[problem.anchor == j]))
        limit = max(rules.anchor_sigma_m, rules.anchor_sigma_share * median)
        if own > limit:
            reasons.append(f"anchor {name} known to {own:.2f} m, {limit:.2f} m are needed")
    return StartState.MIRROR, (*reasons,)
