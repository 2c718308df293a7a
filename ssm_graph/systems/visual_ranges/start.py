"""Scale and anchors from nothing: searches from many places, and tests before any is believed.

Least squares would sit among the ranges that are too long, and its covariance would not tell of
another solution. So all searches are robust from the beginning, the distinct minima are kept, and
a scale counts as ready only where it is sharp, has no rival, fits its ranges and is the same from
both halves of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array, ShortRepr
from ssm_graph.systems.visual_ranges.contradictions import SQUARE_OF_3_SIGMA, contradictions
from ssm_graph.systems.visual_ranges.observability import Motion, Shape, advice, shape_of
from ssm_graph.systems.visual_ranges.range_fit import (
    BIAS_WALK_M,
    DRIFT,
    Problem,
    Solution,
    polished,
    problem_of,
    search,
    solution,
)
from ssm_graph.systems.visual_ranges.range_terms import Places
from ssm_graph.systems.visual_ranges.ranges import Indices
from ssm_graph.systems.visual_ranges.weights import NLOS_WEIGHT, RangeKernel
from ssm_graph.systems.visual_ranges.widening import opened, widened, with_open

DIRECTIONS: Final = 12
SCALES: Final = 4
"""Searches start in as many directions, at as many scales."""
MOST_ROWS: Final = 250
"""Ranges of an anchor that the searches take, spread over all."""
MOST_MINIMA: Final = 6
HOPELESS: Final = 60.0
"""Deviance by which a minimum is so much worse than the best that it is left."""
OPEN_SHAPES: Final = (Motion.PLANE, Motion.LINE, Motion.LINE_THROUGH_ANCHOR)
"""Leave the anchor open, but not the scale."""


class StartState(Enum):
    """What has become of scale and anchor."""

    WAITING = "too few ranges yet"
    AMBIGUOUS = "several solutions, or none that is sharp"
    COARSE = "scale known roughly: used, but not to be relied on yet"
    MIRROR = "scale ready; an anchor has other places that fit as well"
    READY = "scale and anchors ready"
    REFUSED = "the ranges contradict themselves"
    WITHOUT_RANGES = (
        "scale by the vehicle alone: the ranges contradict themselves, and are not used"
    )

    @property
    def has_scale(self) -> bool:
        """Whether map units can be turned into metres."""
        return self not in (StartState.WAITING, StartState.AMBIGUOUS, StartState.REFUSED)


@dataclass(frozen=True, slots=True)
class StartRules:
    """When a start is believed."""

    least_ranges: int = 40
    """Of an anchor."""
    least_s: float = 5.0
    scale_sigma: float = 0.04
    """Relative standard deviation of the scale from which it is used."""
    ready_sigma: float = 0.05 / 3.0
    """And from which it is called ready: at 3 sigma it is right to 5 %."""
    anchor_sigma_m: float = 0.5
    anchor_sigma_share: float = 0.06
    """Of the median range; the larger of both counts."""
    gap: float = 9.0
    """Deviance by which the next distinct minimum is worse, times what a deviance overstates."""
    rms_sigmas: float = 2.0
    """Robust rms of the residuals in stated sigmas."""
    long_share: float = 0.52
    """Of an anchor's ranges that may be too long: 40 % are told as 47 to 53 %, half from 54 %."""
    drift: float = DRIFT
    """Of a path before ranges hold it; see :data:`.range_fit.DRIFT`."""
    ledger_drift: float = 0.001
    """Of a path that its ranges hold."""
    bias_walk_m: float = BIAS_WALK_M
    kernel: RangeKernel = RangeKernel()

    def coarse(self, sigma_log_scale: float) -> str:
        """Say what a scale lacks to be ready."""
        return (
            f"scale known to {100.0 * sigma_log_scale:.1f} %, {100.0 * self.ready_sigma:.1f} % are "
            "needed to rely on it"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Start(ShortRepr):
    """The outcome of a start."""

    state: StartState
    solution: Solution | None
    """The best minimum, ready or not."""
    alternatives: tuple[Solution, ...]
    """Other minima that explain the ranges as well."""
    gap: float
    """Deviance of the next distinct minimum less that of the best; infinite without one."""
    shape: Shape | None
    reasons: tuple[str, ...]
    """Why it is not ready, a sentence each."""
    advice: str
    anchor_ready: tuple[bool, ...]
    """(J,) whether each anchor is sharp and has no rival."""

    @property
    def has_scale(self) -> bool:
        """See :attr:`StartState.has_scale`."""
        return self.state.has_scale


def find_start(
    places: Places,
    names: tuple[str, ...],
    rules: StartRules | None = None,
    *,
    turned_rad: float = 0.0,
    spacing: tuple[tuple[int, int, float], ...] = (),
    scale_prior: tuple[float, float] | None = None,
) -> Start:
    """Return scale and anchors, as far as ranges tell.

    Parameters
    ----------
    places : of the ranges, in order of time; all anchors have some.
    names : (J,) of the anchors.
    turned_rad : largest angle between two of the camera's axes so far.
    spacing : pairs of anchors and their distances, m, where known.
    scale_prior : mean and standard deviation of log s, where something else knows it.
    """
    rules = StartRules() if rules is None else rules
    early = _too_early(places, names, rules, turned_rad)
    if early is not None:
        return early
    picked = _picked(places, len(names))
    problem = problem_of(
        picked,
        len(names),
        rules.kernel,
        drift=rules.drift,
        bias_walk_m=rules.bias_walk_m,
        spacing=spacing,
        scale_prior=scale_prior,
    )
    found = _ends(problem, _candidates(problem))
    stated_m = problem.places.sigma_m
    problem = widened(problem, polished(problem, solution(problem, found[0])))
    ends = [solution(problem, one) for one in _ends(problem, found)]
    ends.sort(key=lambda one: one.cost)
    best, *rivals = (polished(problem, one) for one in ends)
    apart = [rival for rival in rivals if _is_apart(best, rival)]
    gap = min((rival.cost - best.cost for rival in apart), default=np.inf)
    near = [one for one in apart if one.cost - best.cost < rules.gap * best.understated]
    return _judged(problem, names, rules, best, near, gap, turned_rad, stated_m)


def _too_early(
    places: Places, names: tuple[str, ...], rules: StartRules, turned_rad: float
) -> Start | None:
    fewest = int(np.bincount(places.anchor, minlength=len(names)).min()) if names else 0
    lasts = float(np.ptp(places.time_s)) if len(places.time_s) else 0.0
    if fewest < rules.least_ranges or lasts < rules.least_s:
        reason = (
            f"{fewest} ranges over {lasts:.1f} s, {rules.least_ranges} over "
            f"{rules.least_s:g} s are needed"
        )
        none = (False,) * len(names)
        return Start(StartState.WAITING, None, (), np.inf, None, (reason,), "wait", none)
    shape = shape_of(places.camera, scale=1.0, sigma_m=0.0, turned_rad=turned_rad)
    if shape.motion in (Motion.STILL, Motion.ROTATION):
        told = advice(shape, scale=1.0, name=names[0])
        reasons = (f"the path so far: {shape.motion.value}",)
        none = (False,) * len(names)
        return Start(StartState.AMBIGUOUS, None, (), 0.0, shape, reasons, told, none)
    return None


def _picked(places: Places, n_anchors: int) -> Places:
    """Return at most so many ranges of each anchor, spread over all, in order of time."""
    kept: list[Indices] = []
    for j in range(n_anchors):
        own = np.flatnonzero(places.anchor == j)
        take = np.linspace(0, len(own) - 1, min(len(own), MOST_ROWS)).round().astype(np.intp)
        kept.append(own[take])
    return places.rows(np.sort(np.concatenate(kept)))


def _directions(n: int) -> Array:
    """Return unit vectors (n, 3) spread over the sphere."""
    height = 1.0 - 2.0 * (np.arange(n) + 0.5) / n
    angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(n)
    ring = np.sqrt(1.0 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


def _alone(problem: Problem, j: int) -> Problem:
    """Return the problem of one anchor, without modes."""
    own = np.flatnonzero(problem.places.anchor == j)
    places = problem.places.rows(own)
    places = places._replace(anchor=np.zeros(len(own), dtype=np.intp), arm=None)
    none = np.zeros((len(own), 0))
    return replace(problem, places=places, n_anchors=1, drift=none, walk=none, spacing=())


def _starts(problem: Problem) -> Array:
    """Return unknowns (S, 6) of one anchor from which searches begin."""
    at = problem.places
    extent = 2.0 * float(np.sqrt(np.mean(np.sum(at.camera**2, axis=1))))
    low, middle, high = np.percentile(at.range_m, (5.0, 50.0, 95.0))
    # No range changes by more than the way; and the way is seldom longer than a range.
    least = np.log(max(high - low, 0.02 * middle) / extent / 2.0)
    most = max(np.log(2.0 * middle / extent), least + 1.0)
    directions = _directions(DIRECTIONS)
    made = np.zeros((SCALES, DIRECTIONS, 6))
    made[..., 0] = np.linspace(least, most, SCALES)[:, None]
    made[..., 2:5] = middle * directions
    linear = _linear(problem)
    rows = made.reshape(-1, 6)
    return rows if linear is None else np.vstack([linear, rows])


def _linear(problem: Problem) -> Array | None:
    """Return the solution (6,) of the squared ranges, linear in s^2, s a and |a|^2."""
    at = problem.places
    rows = np.column_stack([np.sum(at.camera**2, 1), -2.0 * at.camera, np.ones(len(at.camera))])
    found = np.linalg.lstsq(rows, at.range_m**2, rcond=1e-6)[0]
    if not found[0] > 0.0:
        return None
    s = float(np.sqrt(found[0]))
    return np.array([np.log(s), 0.0, *(found[1:4] / s), 0.0])


def _distinct(unknowns: Array, costs: Array, limit: float) -> list[Array]:
    """Return minima (6,) of one anchor that are apart, best first, down to a limit of the cost."""
    kept: list[Array] = []
    for row in np.argsort(costs):
        if costs[row] > costs.min() + limit or len(kept) == MOST_MINIMA:
            break
        one = unknowns[row]
        reach = 0.1 + 0.03 * float(np.linalg.norm(one[2:5]))
        if all(
            abs(one[0] - old[0]) > 0.03 or float(np.linalg.norm(one[2:5] - old[2:5])) > reach
            for old in kept
        ):
            kept.append(one)
    return kept


def _candidates(problem: Problem) -> list[Array]:
    """Return unknowns (P,) of all anchors together, one set for each candidate of the scale.

    For each scale that one of the anchors finds alone, all anchors are placed anew; then, at the
    best of them, each anchor's other places are tried.
    """
    alone = [_alone(problem, j) for j in range(problem.n_anchors)]
    minima = []
    for one in alone:
        fit = search(one, _starts(one))
        minima.append(_distinct(fit.unknowns, fit.cost, HOPELESS))
    log_scales: list[float] = []
    for each in minima:
        for one_minimum in each:
            if all(abs(one_minimum[0] - old) > 0.03 for old in log_scales):
                log_scales.append(float(one_minimum[0]))
    joint = []
    for log_scale in log_scales[: 2 * MOST_MINIMA]:
        options = [_placed(one, each, log_scale) for one, each in zip(alone, minima, strict=True)]
        total = sum(cost for (_, cost), *_ in options)
        joint.append((total, log_scale, options))
    joint.sort(key=lambda item: item[0])
    sets = [_joined(problem, scale, [own[0][0] for own in options]) for _, scale, options in joint]
    _, scale, options = joint[0]
    for j, own in enumerate(options):
        for other, _ in own[1:]:
            chosen = [each[0][0] for each in options]
            chosen[j] = other
            sets.append(_joined(problem, scale, chosen))
    return sets


def _placed(one: Problem, minima: list[Array], log_scale: float) -> list[tuple[Array, float]]:
    """Return an anchor's distinct places and biases (4,) at a scale, with costs, best first."""
    middle = float(np.median(one.places.range_m))
    starts = np.zeros((DIRECTIONS + len(minima), 6))
    starts[:DIRECTIONS, 2:5] = middle * _directions(DIRECTIONS)
    starts[DIRECTIONS:] = np.array(minima).reshape(-1, 6)
    starts[:, 0] = log_scale
    fit = search(one, starts, held=np.array([0, 1]))
    kept = _distinct(fit.unknowns, fit.cost, HOPELESS)[:3]
    costs = [float(fit.cost[np.flatnonzero((fit.unknowns == row).all(axis=1))[0]]) for row in kept]
    return [(row[2:], cost) for row, cost in zip(kept, costs, strict=True)]


def _joined(problem: Problem, log_scale: float, own: list[Array]) -> Array:
    made = np.zeros(problem.n_unknowns)
    made[0] = log_scale
    made[2 : problem.n_core] = np.concatenate(own)
    return made


def _ends(problem: Problem, starts: list[Array]) -> list[Array]:
    """Return where searches with all modes end, the best first, each once."""
    fit = search(problem, np.array(starts))
    own = fit.unknowns[:, 2 : problem.n_core].reshape(len(starts), -1, 4)[:, :, :3]
    kept: list[int] = []
    for row in np.argsort(fit.cost):
        if fit.cost[row] > fit.cost.min() + HOPELESS:
            break
        same = np.abs(fit.unknowns[kept, 0] - fit.unknowns[row, 0]) < 0.003
        same &= np.abs(own[kept] - own[row]).max(axis=(1, 2), initial=0.0) < 0.02
        if not same.any():
            kept.append(int(row))
    return list(fit.unknowns[kept])


def _is_apart(best: Solution, rival: Solution) -> bool:
    """Return whether two minima differ by more than their sigmas."""
    if abs(np.log(rival.scale / best.scale)) > 3.0 * best.sigma_log_scale:
        return True
    return any(moved(best, rival, j) for j in range(len(best.anchors)))


def moved(best: Solution, rival: Solution, j: int) -> bool:
    """Return whether an anchor is elsewhere in another solution: beyond 3 sigma, and 0.2 m."""
    way = rival.anchors[j] - best.anchors[j]
    square = float(way @ np.linalg.solve(best.anchor_covariance(j), way))
    return bool(square > SQUARE_OF_3_SIGMA and float(np.linalg.norm(way)) > 0.2)


def _judged(
    problem: Problem,
    names: tuple[str, ...],
    rules: StartRules,
    best: Solution,
    near: list[Solution],
    gap: float,
    turned_rad: float,
    stated_m: Array,
) -> Start:
    at = problem.places
    n_anchors = len(names)
    reasons: list[str] = []
    if best.sigma_log_scale > rules.scale_sigma:
        reasons.append(
            f"scale known to {100.0 * best.sigma_log_scale:.1f} %, "
            f"{100.0 * rules.scale_sigma:g} % are needed"
        )
    others = [one for one in near if not _same_scale(best, one, rules)]
    if others:
        told = ", ".join(f"{one.scale / best.scale:.2f}" for one in others)
        reasons.append(f"other scales fit as well: {told} times this one (gap {gap:.1f})")
    scale_is_sharp = not reasons
    wide = with_open(best, opened(problem, best))
    ready, doubts = _sharp_anchors(problem, names, rules, (best, wide), near, gap)
    reasons += doubts
    against = contradictions(
        problem, names, best, stated_m=stated_m, rms_sigmas=rules.rms_sigmas,
        long_share=rules.long_share,
    )  # fmt: skip
    shape = shape_of(
        problem.places.camera,
        scale=best.scale,
        sigma_m=float(np.median(at.sigma_m)),
        turned_rad=turned_rad,
        range_m=np.where((at.anchor == 0) & (best.weight > NLOS_WEIGHT), at.range_m, np.nan),
    )
    # An anchor that is not sharp though the path is in all directions: something else is wrong.
    is_explained = any(ready) or near or shape.motion in OPEN_SHAPES
    leaves_scale = shape.motion.leaves_scale and problem.scale_prior[1] > rules.scale_sigma
    if against:
        state = StartState.REFUSED
    elif not (scale_is_sharp and is_explained) or (leaves_scale and n_anchors == 1):
        state = StartState.AMBIGUOUS
    elif best.sigma_log_scale > rules.ready_sigma:
        state = StartState.COARSE
        reasons.append(rules.coarse(best.sigma_log_scale))
    else:
        state = StartState.READY if all(ready) else StartState.MIRROR
    if state is StartState.READY:
        shape = shape._replace(motion=Motion.GENERAL)
    weakest = np.linalg.eigh(best.anchor_covariance(0))[1][:, -1]
    told = "" if state is StartState.READY else advice(
        shape, scale=best.scale, name=names[0], weakest=weakest
    )  # fmt: skip
    return Start(state, wide, (*near,), gap, shape, (*reasons, *against), told, (*ready,))


def _sharp_anchors(
    problem: Problem,
    names: tuple[str, ...],
    rules: StartRules,
    best_and_wide: tuple[Solution, Solution],
    near: list[Solution],
    gap: float,
) -> tuple[list[bool], list[str]]:
    """Return which anchors are sharp and without a rival, and what the others lack."""
    at, ready, doubts = problem.places, [], []
    best, wide = best_and_wide
    for j, name in enumerate(names):
        rivals = [one for one in near if moved(best, one, j)]
        sigma = float(np.sqrt(np.trace((best if rivals else wide).anchor_covariance(j))))
        median = float(np.median(at.range_m[at.anchor == j]))
        limit = max(rules.anchor_sigma_m, rules.anchor_sigma_share * median)
        if sigma > limit:
            doubts.append(f"anchor {name} known to {sigma:.2f} m, {limit:.2f} m are needed")
        elif rivals:
            way = max(float(np.linalg.norm(one.anchors[j] - best.anchors[j])) for one in rivals)
            doubts.append(f"anchor {name} may as well be {way:.1f} m from there (gap {gap:.1f})")
        ready.append(sigma <= limit and not rivals)
    return ready, doubts


def _same_scale(best: Solution, other: Solution, rules: StartRules) -> bool:
    limit = max(3.0 * best.sigma_log_scale, 0.5 * rules.scale_sigma)
    return bool(abs(np.log(other.scale / best.scale)) < limit)


def later_anchor(
    problem: Problem, log_scale: float, rules: StartRules
) -> list[tuple[Array, Array, float]]:
    """Return places of one anchor whose scale is known: unknowns (4,), covariance (4, 4), deviance.

    Best first, only distinct ones, from the middle of the path as in `Problem`; the problem is of
    this anchor alone and without modes.
    """
    found = _placed(problem, [], log_scale)
    made = np.zeros((len(found), problem.n_unknowns))
    made[:, 0] = log_scale
    made[:, 2:] = [own for own, _ in found]
    kept = [(row, cost) for row, (_, cost) in zip(made, found, strict=True)]
    told = []
    for row, cost in kept:
        one = solution(problem, row, is_near=True)
        if cost > kept[0][1] + rules.gap * one.understated:
            break
        told.append((row[2:], one.covariance[2:, 2:], cost))
    return told
