"""The search for what was off, and when.

All hypotheses compete over all stretches of whole blocks. The best one that exceeds its charge has
its edges refined, competes again, is freed, which shows what the others look like without it, and
so on, as in a step-wise regression. What was found before competes anew at every look, for the
first solution may be far off.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.stepwise import Steps
from ssm_graph.smoothers.faults.columns import IMU, Channels
from ssm_graph.smoothers.faults.grid import Grid
from ssm_graph.smoothers.faults.hypotheses import (
    ALLOWED,
    ALLOWED_M,
    SEEN_M,
    Course,
    Hypothesis,
    hypotheses_of,
)
from ssm_graph.smoothers.faults.judged import Candidate, Fault, Judge, Judged
from ssm_graph.smoothers.faults.unstated import Unstated

FINE_S = 1.0
"""s, to which edges are refined."""
NEW_PER_LOOK = 3
"""Faults that one look adds: each bends the solution that the others are judged at."""
STRONG = 300.0
"""Chi-square of a fault after which the solution is made anew before more is looked for."""
HINT = 0.75
"""Share of its charge from which on a stretch of the coarse grid is looked at more closely:
edges off the grid hide most of a fault."""
JOLT = 22.0
"""Chi-square of a jump of velocity, from which on an edge is looked for there: one of three numbers
in 400 places is above it once in 50 missions."""
INERTIAL_SHARE = 0.5
"""Of the merit of an inertial fault, from which on another sensor's is taken instead."""
ANYTHING_SHARE = 0.95
"""Of the merit of readings that may be anything, from which on a few numbers of another sensor are
taken instead. Far from an answer that many explain a little more of all that is wrong there."""
SAME_ONSET = 4.0
"""Chi-square by which another onset of a ramp may be worse, two sigmas, and is freed, too."""
POSSIBLE = 11.0
"""Chi-square from which on a jump of a gyro may be: of three axes and all times one is above it by
chance in 30 pieces. At tactical grade 0.05 deg/s over 200 s without fixes has 11 to 31, and bends
the way by ten of its sigmas."""
SAME_STRETCH = 0.5
SAME_ANSWER_SIGMAS = 1.0
"""Explanations whose answers are nowhere further apart are one."""
MOST_RIVALS = 2
AS_ALONE = 2.0
"""Prior sigma of rivals that are free together, by what each would be alone. Either is at most
one such size off what both make of it, half of that sigma."""


@dataclass(frozen=True, slots=True)
class FaultSearch:
    """Settings of the search."""

    block_s: float = 10.0
    """Stretches are looked for in blocks of this."""
    significance: float = 5.2
    """Sigmas by which one number must differ from zero, 2e-7; more numbers have to be as unlikely,
    and each further one has to earn its keep besides."""
    margin: float = 12.0
    """A rival whose chi-square is less by no more than this explains the data as well."""
    piece_s: float = 600.0
    """A longer mission is searched in pieces of this that overlap by half. Memory grows with its
    square, and time too; longer ones are surer of what is little off for longer."""
    most_looks: int = 8
    """After so many the search ends whatever it finds."""

    def __post_init__(self) -> None:
        for name in ("block_s", "significance", "margin", "piece_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ConfigError(f"{name}: expected a number above zero, got {value}")
        if self.piece_s < 4.0 * self.block_s:
            raise ConfigError(
                f"piece_s: expected four blocks of {self.block_s} s or more, got {self.piece_s}"
            )
        if self.most_looks < 1:
            raise ConfigError(f"most_looks: expected 1 or more, got {self.most_looks}")


class Beside(NamedTuple):
    """What there may be beside the faults of a search."""

    unstated: Unstated | None
    """What instruments err in beyond what they state"""
    instead: list[Fault]
    """Jumps that explain what biases seem to wander by, with rivals"""
    possible: list[Fault]
    """Jumps that may be chance, with their sizes: nothing is taken off"""


class Look:
    """One look at a piece of a linearised mission, with what was found by those before."""

    def __init__(
        self, judge: Judge, channels: Channels, settings: FaultSearch, piece: tuple[int, int]
    ) -> None:
        """Take a piece as its first keyframe and the first one after it."""
        self._judge, self._settings, self._piece = judge, settings, piece
        self._keyframe_s = judge.linear.problem.keyframe_s
        self._first_s, self._last_s = self._keyframe_s[[piece[0], piece[1] - 1]].tolist()
        self._work = 0.2 * (piece[1] - piece[0])
        self.hypotheses = hypotheses_of(channels, significance=settings.significance)

    def beside(self, known: Sequence[Fault]) -> Beside:
        """Return what instruments err in beyond what they state, beside what was found.

        Beside errors of the IMU as stated, and no more, one of its biases may have jumped: at an
        even speed a vehicle that turns by a little more looks like one that is pushed aside, which
        passes for a bias that wanders. Where that jump explains all of it, it comes, too; one that
        may be chance is possible.
        """
        grid, others = self._grid(with_rivals(known)), with_rivals(known)
        found = self._judge.unstated(grid, others)
        left = self._judge.with_steady_biases().on(grid).with_freed(others)
        inertial = [one for one in self.hypotheses if one.channel == IMU]
        best = left.best_of(inertial)[0]
        if not best.is_significant or best.merit <= 0.0:
            return Beside(found, [], self._possible_in(left))
        jump = fault_of(best, left)
        if found is not None and found.has_wandering_biases:
            more = [*others, jump]
            rest = self._judge.unstated(self._grid(more), more)
            if rest is not None and rest.has_wandering_biases:
                return Beside(found, [], [])
        whole = (one for one in inertial if one.sensor != best.hypothesis.sensor)
        rivals = (replace(jump, hypothesis=one) for one in whole if len(one.sigma) > 1)
        jump, *others = [as_large_as_alone(one, left, []) for one in (jump, *rivals)]
        return Beside(found, [replace(jump, rivals=tuple(others))], [])

    def possible(self, known: Sequence[Fault]) -> list[Fault]:
        """Return a jump that may be beside what was found, none that is unlikely."""
        freed = with_rivals(known)
        judge = self._judge.with_steady_biases()
        return self._possible_in(judge.on(self._grid(freed)).with_freed(freed))

    def _possible_in(self, left: Judged) -> list[Fault]:
        """Return the likeliest jump of one gyro that goes on to the end of the piece."""
        edges, found = left.grid.edges, []
        if left.grid.n_blocks == 1:
            return []
        for one in self.hypotheses:
            if one.channel == IMU and len(one.sigma) == 1:
                chi_sq = left.table(one)[0][1:-1, -1]
                begin = int(np.argmax(chi_sq))
                jump = Fault(one, int(edges[1 + begin]), int(edges[-1]), float(chi_sq[begin]))
                found.append(replace(jump, sizes=left.sizes([jump])))
        likeliest = max(found, key=lambda jump: jump.chi_sq)
        return [likeliest] if likeliest.chi_sq > POSSIBLE else []

    def find_steps(self, known: Sequence[Fault]) -> Steps[list[Fault]]:
        """Return what is off: what was before, as it competes now, and what is new."""
        self._judge.fit(self._grid(with_rivals(known)), with_rivals(known))
        yield self._work
        found = list(known)
        for _ in range(NEW_PER_LOOK):
            best = yield from self._next_steps(found)
            if best is None:
                break
            found.append(best)
            if best.chi_sq > STRONG:
                break
        return (yield from self._again_steps(found)) if len(found) > 1 or known else found

    def _next_steps(self, found: Sequence[Fault]) -> Steps[Fault | None]:
        """Return the best of what is left, None for nothing."""
        coarse = self._judge.on(self._grid(with_rivals(found)))
        yield self._work
        left = coarse.with_freed(with_rivals(found))
        ranked = left.best_of(self.hypotheses)
        yield self._work
        first = ranked[0]
        hints = self._jolts(first.hypothesis)
        if first.chi_sq > HINT * first.hypothesis.charge(first.n_numbers()):
            hints.append(fault_of(first, left))
        if not hints:
            return self._allowed_in(left)
        fine = self._judge.on(self._grid(with_rivals(found), around=hints))
        yield self._work
        left = fine.with_freed(with_rivals(found))
        ranked = left.best_of(self.hypotheses)
        yield self._work
        chosen = chosen_of(ranked)
        if chosen is None:
            return self._allowed_in(left)
        best = fault_of(chosen, left)
        best = replace(best, onsets=onsets_of(best, left))
        rivals = rivals_of(best, ranked, left, margin=self._settings.margin)
        return (yield from self._against_steps(best, rivals, fine, found))

    def _jolts(self, hypothesis: Hypothesis) -> list[Fault]:
        """Return the second in which something may begin or end, if there is one.

        Edges off the coarse grid hide most of a fault, but the inertial data show them.
        """
        found = []
        for shift_s in (0.0, FINE_S):
            edges_s = np.arange(self._first_s + shift_s, self._last_s, 2.0 * FINE_S)
            grid = Grid.of(self._keyframe_s, edges_s, piece=self._piece)
            jolts = self._judge.jolts(grid)
            worst = int(np.argmax(jolts))
            begin, end = grid.edges[worst : worst + 2].tolist()
            found.append(Fault(hypothesis, begin, end, float(jolts[worst])))
        worst_of_both = max(found, key=lambda one: one.chi_sq)
        return [worst_of_both] if worst_of_both.chi_sq > JOLT else []

    def _again_steps(self, found: list[Fault]) -> Steps[list[Fault]]:
        """Let each compete anew about where it is, the others being freed; some are none then.

        The strongest come first, and without weaker ones that only make up for their edges.
        """
        kept: list[Fault] = []
        waiting = sorted(found, key=lambda fault: -fault.merit)
        while waiting:
            fault, *waiting = waiting
            if fault.hypothesis.course is Course.ANYTHING:
                kept.append(fault)  # its rows count for nothing and can say no more
                continue
            beside = [one for one in waiting if self._touches(one, fault)]
            others = [*kept, *(one for one in waiting if one not in beside)]
            grid = self._grid(with_rivals([*others, *beside, fault]), around=[fault])
            fine = self._judge.on(grid).restoring(with_rivals([fault, *beside]))
            yield self._work
            left = fine.with_freed(with_rivals(others))
            ranked = left.best_of(self.hypotheses, near=fault)
            yield self._work
            chosen = chosen_of(ranked)
            if chosen is None and fault.hypothesis.is_usual:
                allowed = self._allowed_in(left)
                kept.extend([] if allowed is None else [allowed])
            elif chosen is not None:
                best = fault_of(chosen, left)
                best = replace(best, onsets=onsets_of(best, left))
                rivals = rivals_of(best, ranked, left, margin=self._settings.margin)
                kept.append((yield from self._against_steps(best, rivals, fine, others)))
        return kept

    def _allowed_in(self, judged: Judged) -> Fault | None:
        """Return what healthy instruments are a little off by, too, where the data hint at it.

        It goes on to the end of the mission.
        """
        edges = judged.grid.edges
        if edges[-1] < len(self._keyframe_s):
            return None
        for one in self.hypotheses:
            if not one.is_usual:
                continue
            small = replace(one, sigma=np.full_like(one.sigma, ALLOWED_M))
            # Where the data say little, so small a prior would hide it.
            seen = replace(one, sigma=np.full_like(one.sigma, SEEN_M))
            chi_sq = judged.table(seen)[0][:-1, -1]
            begin = int(np.argmax(chi_sq))
            if chi_sq[begin] > ALLOWED:
                fault = Fault(small, int(edges[begin]), int(edges[-1]), float(chi_sq[begin]))
                return replace(fault, onsets=onsets_of(fault, judged))
        return None

    def _touches(self, one: Fault, other: Fault) -> bool:
        """Return whether an edge of one is near an edge of the other."""
        time_s = np.append(self._keyframe_s, self._keyframe_s[-1])
        edges = time_s[[one.begin, one.end]][:, None] - time_s[[other.begin, other.end]]
        return bool(np.min(np.abs(edges)) <= self._settings.block_s)

    def _against_steps(
        self, best: Fault, rivals: Sequence[Fault], fine: Judged, found: Sequence[Fault]
    ) -> Steps[Fault]:
        """Return a fault with those rivals whose answer is another one."""
        if not rivals:
            return best
        others = with_rivals(found)
        kept, cost_m = [], 0.0
        own = yield from self._judge.way_steps(fine, [*others, best])
        for rival in rivals:
            other = yield from self._judge.way_steps(fine, [*others, rival])
            apart = self._judge.apart(own, other)
            if apart.sigmas > SAME_ANSWER_SIGMAS:
                kept.append(rival)
                cost_m = max(cost_m, apart.level_m)
        if not kept:
            return best
        sized = [as_large_as_alone(one, fine, others) for one in (best, *kept[:MOST_RIVALS])]
        return replace(sized[0], rivals=tuple(sized[1:]), cost_m=cost_m)

    def _grid(self, faults: Iterable[Fault], *, around: Iterable[Fault] = ()) -> Grid:
        """Return blocks that begin and end where faults do, and fine ones about some."""
        step_s = self._settings.block_s
        time_s = np.append(self._keyframe_s, self._keyframe_s[-1] + 1.0)
        edges_s = [np.arange(self._first_s, self._last_s, step_s)]
        edges_s.extend(time_s[[fault.begin, fault.end]] for fault in faults)
        fine_s = np.concatenate(
            [np.arange(-5.0, 6.0) * FINE_S, [-step_s, -0.75 * step_s, 0.75 * step_s, step_s]]
        )
        for fault in around:
            edges_s.extend(edge_s + fine_s for edge_s in time_s[[fault.begin, fault.end]])
        return Grid.of(self._keyframe_s, np.concatenate(edges_s), block_s=step_s, piece=self._piece)


def fault_of(candidate: Candidate, judged: Judged) -> Fault:
    """Return a candidate as a fault: its blocks are those of one grid only."""
    begin, end = judged.grid.edges[[candidate.begin, candidate.end]].tolist()
    return Fault(candidate.hypothesis, begin, end, candidate.chi_sq, candidate.merit)


def chosen_of(ranked: Sequence[Candidate]) -> Candidate | None:
    """Return what is to be freed, None if nothing is significant; inertial data come last.

    Biases over stretches explain a part of anything, as readings do that may be anything. But what
    even such readings explain less well is the inertial data's fault.
    """
    significant = [one for one in ranked if one.is_significant]
    if not significant:
        return None
    best = significant[0]
    is_anything = best.hypothesis.course is Course.ANYTHING
    if best.hypothesis.channel != IMU and not is_anything:
        return best
    share = ANYTHING_SHARE if is_anything else INERTIAL_SHARE
    others = (
        one
        for one in significant
        if one.hypothesis.channel not in (IMU, best.hypothesis.channel)
        and one.hypothesis.course is not Course.ANYTHING
    )
    other = next(others, best)
    return other if other.merit > share * best.merit else best


def rivals_of(
    best: Fault, ranked: Sequence[Candidate], judged: Judged, *, margin: float
) -> list[Fault]:
    """Return other sensors, and other stretches, that explain the data as well."""
    found = [
        fault_of(one, judged)
        for one in ranked
        if one.merit > best.merit - margin
        and not (one.merit > best.merit and one.hypothesis.course is Course.ANYTHING)
    ]
    elsewhere = judged.best_of([best.hypothesis], apart_from=best)[0]
    if elsewhere.merit > best.merit - margin:
        found.append(fault_of(elsewhere, judged))
    by_sensor: dict[tuple[str, bool], Fault] = {}
    for one in found:
        if not is_part_of(one, best):
            by_sensor.setdefault((one.hypothesis.sensor, overlap(one, best) > SAME_STRETCH), one)
    return [replace(one, onsets=onsets_of(one, judged)) for one in by_sensor.values()]


def onsets_of(ramp: Fault, judged: Judged) -> tuple[Fault, ...]:
    """Return a ramp with the first, the likeliest and the last onset that explain the data.

    Only those a block or more away from others count. Of a bias of the inertial data, which begins
    and ends between keyframes, both intervals beside each of its ends have sizes of their own. Of
    what is neither there are none.
    """
    if ramp.hypothesis.channel == IMU:
        return tuple(_beside_edges(ramp, judged))
    if ramp.hypothesis.course is not Course.RAMP:
        return ()
    grid = judged.grid
    edge_s = np.append(grid.middle_s - 0.5 * grid.length_s, np.inf)
    chi_sq = judged.table(ramp.hypothesis)[0][:, np.searchsorted(grid.edges, ramp.end)]
    as_good = np.flatnonzero(chi_sq > chi_sq.max() - SAME_ONSET)
    known = [int(np.searchsorted(grid.edges, ramp.begin))]
    for at in (as_good[0], int(np.argmax(chi_sq)), as_good[-1]):
        if np.min(np.abs(edge_s[known] - edge_s[at])) >= grid.block_s:
            known.append(int(at))
    return tuple(replace(ramp, begin=int(grid.edges[at])) for at in known[1:])


def _beside_edges(bias: Fault, judged: Judged) -> Iterator[Fault]:
    """Yield a bias that begins, or ends, a keyframe before or after, as large as it is at most."""
    first, last = judged.grid.edges[[0, -1]].tolist()
    sized = as_large_as_alone(bias, judged, [])
    for shift in (-1, 1):
        for one in (replace(sized, begin=bias.begin + shift), replace(sized, end=bias.end + shift)):
            is_inside = first < bias.begin if one.end == bias.end else bias.end < last
            if is_inside and first <= one.begin < one.end <= last:
                yield one


def as_large_as_alone(fault: Fault, judged: Judged, others: Sequence[Fault]) -> Fault:
    """Return a fault that is about as large as it would have to be by itself.

    Where it and a rival are both free the data tell their difference alone, and what both have in
    common would be free as well. ``others`` are freed besides.
    """
    hypothesis = fault.hypothesis
    if hypothesis.course is Course.ANYTHING:
        return fault
    own = judged.sizes([*others, replace(fault, onsets=())])[-fault.n_constants :]
    alone = float(np.linalg.norm(own))
    sized = replace(hypothesis, sigma=np.minimum(hypothesis.sigma, AS_ALONE * alone))
    onsets = tuple(replace(ramp, hypothesis=sized) for ramp in fault.onsets)
    return replace(fault, hypothesis=sized, onsets=onsets)


def is_part_of(one: Fault, other: Fault) -> bool:
    """Return whether one of both is the other, or part of it, over about the same stretch."""
    a, b = one.hypothesis, other.hypothesis
    if a.channel != b.channel or overlap(one, other) <= SAME_STRETCH:
        return False
    ranks = [np.linalg.matrix_rank(C) for C in (a.combined, b.combined)]
    return bool(np.linalg.matrix_rank(np.hstack([a.combined, b.combined])) == max(ranks))


def overlap(one: Fault, other: Fault) -> float:
    """Return how much of two stretches they share, of all that they cover."""
    shared = min(one.end, other.end) - max(one.begin, other.begin)
    return max(shared, 0) / (max(one.end, other.end) - min(one.begin, other.begin))


def with_rivals(found: Iterable[Fault]) -> list[Fault]:
    """Return all that is to be freed: what was found, each with its rivals behind it.

    Behind a ramp comes the same from other times on.
    """
    each = (one for fault in found for one in (fault, *fault.rivals))
    return [ramp for one in each for ramp in (one, *one.onsets)]
