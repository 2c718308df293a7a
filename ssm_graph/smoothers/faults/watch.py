"""Looks for faults while a solution is iterated, and keeps the graph free of what was found."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from factors.similarity import WEIGHT_FLOOR
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.reweighting import NEAR_SIGMAS
from ssm_graph.engine.states import States
from ssm_graph.graph.freed import FAULTS, Freed
from ssm_graph.graph.inertial_rows import InertialFit, inertial_fit
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.graph.measurements import aids_of
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.problem import Problem
from ssm_graph.smoothers.faults.columns import (
    BEAM,
    CLOCK,
    IMU,
    TREND_S,
    Channels,
    columns_of_biases,
    linear_of_steps,
)
from ssm_graph.smoothers.faults.freeing import columns_of, freed_of, inside_of
from ssm_graph.smoothers.faults.hypotheses import Course, chi_sq_at
from ssm_graph.smoothers.faults.judged import Fault, Judge
from ssm_graph.smoothers.faults.nuisances import Nuisances
from ssm_graph.smoothers.faults.of_start import without_start
from ssm_graph.smoothers.faults.pieces import PieceSearch
from ssm_graph.smoothers.faults.search import Beside, FaultSearch, with_rivals
from ssm_graph.smoothers.faults.unstated import Unstated
from ssm_graph.smoothers.faults.windows import noisier_than_stated
from ssm_graph.smoothers.unwound import unwound_steps

SLOW: Final = 0.7
"""Of the update before, from which on a pass hardly comes nearer, and"""
SLOW_PASSES: Final = 3
"""how many such passes in a row are waited for."""


CHANCE: Final = 1e-3
"""Probability of what is left of a fault by chance once the start is hardly known."""
LOOK_AT_START: Final = "look at the start, [initial] where it is stated"


class Changed(NamedTuple):
    """The graph once something else is freed, and the states to go on from."""

    linearizer: GraphLinearizer
    states: States
    weights: Array
    """(M,) of the beams: a lie that lasts has turned those that contradict it away"""
    aid_weights: Array
    """(A,)"""


class FaultWatch:
    """Keeps a solution free of what a search finds, while it is iterated."""

    def __init__(self, problem: Problem, search: FaultSearch | None) -> None:
        """Take the problem as the smoother solves it; without a search nothing is ever found."""
        self._problem, self._search = problem, None if search is None else PieceSearch(search)
        self._bare = None if search is None else GraphLinearizer(problem)
        self._found: list[Fault] = []
        self._gone: list[Fault] = []
        """What the last of all looks let go, and"""
        self._new: list[Fault] = []
        """what it found, if the search ended without settling"""
        self._unstated: Unstated | None = None
        """What instruments were found to err in beyond what they state"""
        self._undecided: list[Fault] = []
        """The last of what was found: what may be instead of that, which is judged no more"""
        self._possible: list[Fault] = []
        """What may be chance: nothing is taken off, the sigmas allow for it"""
        self._contradicted: list[DetectedFault] = []
        """What the inertial data contradicted before that was allowed for"""
        self._is_statement_judged = self._is_let_back = self._is_unwound = False
        self._beams_out = np.zeros(len(problem.beams.speed), bool)
        self.aids_out = np.zeros(sum(len(aid) for aid in aids_of(problem)), bool)
        """(A,) measurements of aids that may have read anything"""
        self._looks_left = 0 if search is None else search.most_looks
        self._is_done = search is None
        self._last_update, self._n_slow = np.inf, 0

    def leave_out(self, weights: Array) -> Array:
        """Return the weights (M,) with the floor for beams that may have read anything."""
        return np.where(self._beams_out, WEIGHT_FLOOR, weights)

    def leave_aids_out(self, weights: Array) -> Array:
        """Return the weights (A,) with the floor for measurements that may have read anything."""
        return np.where(self.aids_out, WEIGHT_FLOOR, weights)

    def look_steps(
        self,
        linearizer: GraphLinearizer,
        states: States,
        weights: Array,
        aid_weights: Array,
        *,
        update_sigmas: float,
    ) -> Steps[Changed | None]:
        """Look once the solution is near; return what has changed, None for nothing.

        First for circles that nobody saw. Then what is found by a search is freed, and it is
        searched again at what the solution has become, until nothing changes any more.
        ``linearizer`` is that of the pass, the weights (M,) and (A,) are those that it led to.
        """
        is_near = update_sigmas < NEAR_SIGMAS
        if is_near and not self._is_unwound:
            self._is_unwound, wound = True, states
            states = yield from unwound_steps(linearizer, states, weights, aid_weights)
            if states is not wound:
                return Changed(linearizer, states, weights, aid_weights)
        if self._is_done or not (is_near or self._is_slow(update_sigmas)):
            return None
        return (yield from self._search_steps(linearizer, states, is_near=is_near))

    def _search_steps(
        self, linearizer: GraphLinearizer, states: States, *, is_near: bool
    ) -> Steps[Changed | None]:
        """Search at the states, and free what is found; far from an answer nothing ends it."""
        assert self._bare is not None
        assert self._search is not None
        self._looks_left -= 1
        own = states.constants[: self._problem.extras.n_constants]
        bare_states = states._replace(constants=own)
        yield from self._bare.integrate_steps(bare_states)
        self._bare.follow(bare_states)
        linear = yield from linear_of_steps(
            self._bare, linearizer, states, self._beams_out, self.aids_out
        )
        channels = Channels(linear)
        judge = Judge(linear, channels, Nuisances(linear, channels))
        yield 0.02 * self._problem.n_keyframes
        known = self._sized(states)[: len(self._found) - len(self._undecided)]
        found = yield from self._search.find_steps(judge, channels, known)
        is_same = same_faults([*found, *self._undecided], self._found, self._problem.keyframe_s)
        if is_same and not is_near:
            return None
        if is_same and not self._is_let_back:
            self._is_let_back, n_found = True, len(found)
            found = let_back(found)
            is_same = len(found) == n_found
        if is_same and not self._is_statement_judged:
            is_same = self._judge_statement(self._search.beside(judge, channels, known), judge)
        found.extend(self._undecided)
        self._is_done = is_same or self._looks_left == 0
        if is_same:
            return None
        if self._is_done:
            self._gone = beside(self._found, found, self._problem.keyframe_s)
            self._new = beside(found, self._found, self._problem.keyframe_s)
        n_decided = len(found) - len(self._undecided)
        decided = sorted(found[:n_decided], key=lambda fault: (fault.begin, fault.end))
        self._found = [*decided, *self._undecided]
        self._leave_out(channels)
        problem = self._problem
        freed = freed_of(self._found, channels, problem, self._unstated)
        if len(freed.sigma):
            blocks = (*problem.extras.blocks, freed.variable)
            problem = replace(problem, extras=Extras(blocks))
        constants = np.concatenate([bare_states.constants, np.zeros(len(freed.sigma))])
        return Changed(
            GraphLinearizer(problem, freed if len(freed.sigma) else None),
            bare_states._replace(constants=constants),
            self.leave_out(linear.beam_weights),
            self.leave_aids_out(np.concatenate([np.zeros(0), *linear.aid_weights.values()])),
        )

    def _judge_statement(self, found: Beside, judge: Judge) -> bool:
        """Keep what there may be beside the faults; return whether the answer stays as it is."""
        self._is_statement_judged = True
        self._unstated, self._undecided, self._possible = found
        if self._unstated is None:
            return not self._undecided
        fit = inertial_fit(judge.linear.inertial_rows(), judge.linear.solution)
        self._contradicted = noisier_than_stated(fit, self._problem.keyframe_s)
        self._problem = replace(self._problem, chain=self._unstated.widened(self._problem.chain))
        self._bare = GraphLinearizer(self._problem)
        return False

    def _is_slow(self, update_sigmas: float) -> bool:
        """Return whether passes come no nearer: what is off bends the answer beyond their reach."""
        is_slower = update_sigmas > SLOW * self._last_update
        self._n_slow = (self._n_slow + 1) % SLOW_PASSES if is_slower else 0
        self._last_update = update_sigmas
        return is_slower and self._n_slow == 0

    def allowing_steps(
        self, linearizer: GraphLinearizer, states: States
    ) -> Steps[tuple[GraphLinearizer, States]]:
        """Return a linearizer and states with what may be chance as further constants, of zero."""
        if not self._possible:
            return linearizer, states
        sigma = np.concatenate([one.hypothesis.sigma for one in self._possible])
        freed, extras = linearizer.freed or Freed.nothing(self._problem), linearizer.problem.extras
        between = columns_of_biases(linearizer.inertial_rows(states), extras.state_dim)
        at = np.arange(len(between)), self._problem.keyframe_s
        wide = freed.with_between(sigma, columns_of(self._possible, {IMU: between}, *at))
        extras = extras.without({FAULTS})
        problem = replace(linearizer.problem, extras=Extras((*extras.blocks, wide.variable)))
        constants = np.concatenate([states.constants, np.zeros(len(sigma))])
        linearizer, states = GraphLinearizer(problem, wide), states._replace(constants=constants)
        yield from linearizer.integrate_steps(states)
        linearizer.follow(states)
        return linearizer, states

    def covering(self, step: ChainSolution) -> ChainSolution:
        """Return a solution of :meth:`allowing` whose sigmas are those of an answer without it.

        They hold if it is as large as it seems, and nobody took it off.
        """
        sizes = np.concatenate(
            [np.zeros(0), *(s.sizes for s in self._possible if s.sizes is not None)]
        )
        covariance = step.constants_cov.copy()
        at = np.arange(len(covariance) - len(sizes), len(covariance))
        covariance[at, at] += sizes**2
        return step._replace(constants_cov=covariance)

    def inflation_of(self, name: str) -> float:
        """Return by how much readings of the DVL, or of an aid, say less than white noise would."""
        return 1.0 if self._unstated is None else self._unstated.inflation_of(name)

    def _sized(self, states: States) -> list[Fault]:
        """Return what was found with the sizes that the states give it."""
        sizes = iter(states.constants[self._problem.extras.n_constants :].tolist())

        def sized(one: Fault) -> Fault:
            own = list(itertools.islice(sizes, one.n_constants))
            onsets = tuple(sized(ramp) for ramp in one.onsets)
            return replace(one, sizes=np.array(own) if own else None, onsets=onsets)

        found = []
        for fault in self._found:
            first, *rivals = [sized(one) for one in (fault, *fault.rivals)]
            found.append(replace(first, rivals=tuple(rivals)))
        return found

    def _leave_out(self, channels: Channels) -> None:
        """Note which measurements may have read anything."""
        beams = self._problem.beams
        self._beams_out = np.zeros(len(beams.speed), bool)
        aids_out = {name: np.zeros(len(own), bool) for name, own in channels.aid_keyframe.items()}
        for fault in with_rivals(self._found):
            name = fault.hypothesis.channel
            if fault.n_constants:
                continue
            if name == BEAM:
                own = np.flatnonzero(fault.hypothesis.combined.any(axis=1))
                self._beams_out |= np.isin(beams.beam, own) & inside_of(beams.keyframe, fault)
            else:
                aids_out[name] |= inside_of(channels.aid_keyframe[name], fault)
        self.aids_out = np.concatenate([np.zeros(0, bool), *aids_out.values()])

    def faults(
        self, states: States, step: ChainSolution, inertial: InertialFit
    ) -> tuple[DetectedFault, ...]:
        """Return what was found, with the sizes that the answer gives it, and what is left over."""
        if self._search is None:
            return ()
        end_s = np.append(self._problem.keyframe_s, self._problem.keyframe_s[-1])
        found = []
        new = [(one.hypothesis, one.begin, one.end) for one in self._new]
        for fault in [*self._sized(states), *self._gone]:
            hypothesis = fault.hypothesis
            rivals = [
                f"{one.hypothesis.sensor}, {end_s[one.begin]:.0f}-{end_s[one.end]:.0f} s, "
                f"{said(one)}"
                for one in fault.rivals
            ]
            treatment = Treatment.FREED if fault.n_constants else Treatment.LEFT_OUT
            treatment = Treatment.ALLOWED if fault.is_allowed_for else treatment
            treatment = Treatment.COVERED if rivals else treatment
            if any(fault is one for one in self._gone):
                treatment = Treatment.SAID
            elif (hypothesis, fault.begin, fault.end) in new:
                treatment = Treatment.CHANGING
            found.append(
                DetectedFault(
                    sensor=hypothesis.sensor,
                    what=said(fault),
                    begin_s=float(end_s[fault.begin]),
                    end_s=float(end_s[fault.end]),
                    chi_sq=fault.chi_sq,
                    dof=hypothesis.n_numbers,
                    treatment=treatment,
                    rivals=tuple(rivals),
                    cost_m=fault.cost_m,
                    late_s=late_of(fault),
                )
            )
        found = [*self._or_the_start(found, states, step)]
        if self._unstated is not None:
            end = len(states.constants) - len(self._possible)
            errors = states.constants[end - len(self._unstated.errors_sigma) : end]
            found.extend(self._unstated.faults(errors, float(end_s[0]), float(end_s[-1])))
        found.extend(
            DetectedFault(
                sensor=one.hypothesis.sensor,
                what=f"may be {said(one)}",
                begin_s=float(end_s[one.begin]),
                end_s=float(end_s[one.end]),
                chi_sq=one.chi_sq,
                dof=one.n_constants,
                treatment=Treatment.ALLOWED,
            )
            for one in self._possible
        )
        left = noisier_than_stated(inertial, self._problem.keyframe_s)
        lines = [one.remedy for one in found if one.treatment is Treatment.WIDENED]
        before = [
            replace(one, remedy="; ".join([*lines, one.remedy])) for one in self._contradicted
        ]
        return (*found, *(left or before))

    def _or_the_start(
        self, said: Sequence[DetectedFault], states: States, step: ChainSolution
    ) -> Iterator[DetectedFault]:
        """Yield what is said, with the start as a rival where it alone speaks for a fault.

        Of clocks it does not: on a straight way a start that is off looks like fixes that are late,
        but these the logs tell by themselves.
        """
        assert self._bare is not None
        prior, first = self._bare.prior, self._problem.extras.n_constants
        for fault, one in itertools.zip_longest(self._found, said):
            end = first + (sum(f.n_constants for f in with_rivals([fault])) if fault else 0)
            at, first = slice(first, end), end
            is_clock = fault is not None and fault.hypothesis.channel.endswith(CLOCK)
            if at.start == at.stop or fault.is_allowed_for or is_clock:
                yield one
                continue
            left = without_start(prior, states, step, at)
            if left.chi_sq < chi_sq_at(CHANCE, at.stop - at.start):
                rivals = (*one.rivals, f"the start: {left.off}")
                one = replace(one, rivals=rivals, remedy=LOOK_AT_START)
            yield one


def let_back(found: list[Fault]) -> list[Fault]:
    """Return what was found without what may have read anything, unless that is all.

    Rows that count for nothing say no more, and they were left out before the others were found.
    """
    others = [fault for fault in found if fault.hypothesis.course is not Course.ANYTHING]
    return others or found


def late_of(fault: Fault) -> float | None:
    """Return the delay of a clock, s, None of what is none."""
    is_clock = fault.hypothesis.channel.endswith(CLOCK) and fault.sizes is not None
    return float(fault.sizes[0]) if is_clock and fault.sizes is not None else None


def said(fault: Fault) -> str:
    """Return words for what a fault is."""
    hypothesis, sizes = fault.hypothesis, fault.sizes
    if sizes is None:
        return "reads what nothing else agrees with"
    d, minute = hypothesis.combined.shape[1], 60.0 / TREND_S
    sizes = sum((other.sizes for other in fault.onsets if other.sizes is not None), sizes)
    if hypothesis.course is Course.RAMP:
        return f"from nothing on, and within each minute by {hypothesis.say(minute * sizes)}"
    text = hypothesis.say(sizes[:d])
    if hypothesis.course is Course.TREND:
        text += f", and within a minute more by {hypothesis.say(minute * sizes[d:])}"
    return text


def same_faults(some: Sequence[Fault], others: Sequence[Fault], keyframe_s: Array) -> bool:
    """Return whether these are the same faults, to the second; but for other onsets of ramps."""
    time_s = np.append(keyframe_s, keyframe_s[-1])

    def keys(faults: Sequence[Fault]) -> list[tuple[str, str, str, float, float]]:
        return sorted(
            (
                f.hypothesis.sensor,
                f.hypothesis.channel,
                f.hypothesis.course.name,
                round(float(time_s[f.begin])),
                round(float(time_s[f.end])),
            )
            for fault in faults
            for f in (fault, *fault.rivals)
        )

    return keys(some) == keys(others)


def beside(some: Sequence[Fault], others: Sequence[Fault], keyframe_s: Array) -> list[Fault]:
    """Return those of some that are not among others."""
    return [
        one for one in some if not any(same_faults([one], [other], keyframe_s) for other in others)
    ]
