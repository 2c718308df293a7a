"""The batch smoother: a weight for every beam by iteratively reweighted least squares.

The loop, :meth:`SsmSmoother._solve`: weights of the forward pass, then again and again ::

    linearise all measurements at the states, each row scaled by the root of its weight
    eliminate the chain by QR; move, half as far for as long as that raises the cost
    marginal covariance of every keyframe, and H P H' of every row
    t and weight of every measurement

until the largest update is below the tolerance in its own posterior sigmas, no weight changes by
more, and the kernel in force is the one that was asked for.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.similarity import Kernel, Similarity, expected_mahalanobis_sq
from ssm_graph.base.errors import SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, at_once
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.states import States
from ssm_graph.graph.beacon_start import ambiguous_beacons
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.first_values import FirstValues, first_values, first_values_steps
from ssm_graph.graph.inertial_rows import InertialFit, inertial_fit
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.graph.measurements import JudgedAid, aid_table, doubts_of_aids, without
from ssm_graph.mission.answer import trajectory_from_states
from ssm_graph.mission.estimate import BeamTable, Estimate, Iteration, NoiseFound, Status
from ssm_graph.mission.fault import DetectedFault
from ssm_graph.mission.imu_variables import columns_of_errors, imu_errors
from ssm_graph.mission.posterior import Posterior
from ssm_graph.mission.problem import Problem, with_white_noise
from ssm_graph.smoothers.descent import descend_steps
from ssm_graph.smoothers.faults.nuisances import DVL
from ssm_graph.smoothers.faults.watch import FaultWatch
from ssm_graph.smoothers.faults.windows import (
    disagreeing,
    informative,
    noisy_or_compared,
    readings_of,
)
from ssm_graph.smoothers.passes import Pass, Weights
from ssm_graph.smoothers.settings import WARM_KERNEL, SmootherConfig
from ssm_graph.smoothers.track import calibration_of, current_of, undetermined
from ssm_graph.smoothers.verdict import (
    MAX_ADAPTATIONS,
    adaptation,
    contradictions,
    noise_found,
    noise_notes,
    with_sigmas,
)

__all__ = ["OnIteration", "Similarity", "SmootherConfig", "SsmSmoother"]

OnIteration = Callable[[int, int, Iteration], None]
"""Called after each iteration with its number, the limit, and what happened."""

RUNAWAY_SPEED = 1e4
"""m/s; ten silent minutes of a MEMS unit may begin with 100 m/s and still come back."""


def _notes_of(first: FirstValues) -> tuple[str, ...]:
    said = "the first pass doubted its prediction {} times: the beams contradicted it together"
    return (said.format(first.n_doubts),) if first.n_doubts else ()


def warm_start(problem: Problem) -> FirstValues:
    """Return the states and weights that every smoother of this problem starts from."""
    return first_values(with_white_noise(problem), kernel=WARM_KERNEL)


class Solved(NamedTuple):
    """How a solution ended."""

    linearizer: GraphLinearizer
    last: Pass
    iterations: tuple[Iteration, ...]
    status: Status
    kernel: Kernel
    """That of the answer"""
    aid_kernels: tuple[Kernel, ...]
    """Those of each weighted aid"""
    notes: tuple[str, ...]
    first: FirstValues
    faults: tuple[DetectedFault, ...]
    aids_out: NDArray[np.bool_]
    """(A,) measurements of aids that are left out"""
    inertial: InertialFit

    def again(self) -> FirstValues:
        """Return where another solution may start."""
        return replace(
            self.first,
            states=self.last.states,
            weights=self.last.weights,
            aid_weights=self.last.aid_weights,
        )


class SsmSmoother:
    """Smooth a whole mission; see :func:`ssm_graph.build_problem` for its input."""

    def __init__(self, config: SmootherConfig | None = None) -> None:
        self.config = config or SmootherConfig()

    def solve_steps(
        self,
        problem: Problem,
        *,
        first: FirstValues | None = None,
        on_iteration: OnIteration | None = None,
    ) -> Steps[Estimate]:
        """Return the smoothed trajectory with the weight of every beam.

        An interrupt from the keyboard ends the loop with what the last iteration found.

        Parameters
        ----------
        problem : the mission.
        first : where to start, from :func:`warm_start`; made here when left out. Several methods
            on one problem can share it.
        on_iteration : called after each iteration.

        Raises
        ------
        SolverError
            If no finite solution was found.
        """
        begin, used = time.perf_counter(), np.ones(problem.beams.n_beams)
        iterations: tuple[Iteration, ...] = ()
        for adaptations in range(MAX_ADAPTATIONS + 1):
            solved = yield from self._solve_steps(problem, first, on_iteration)
            iterations += solved.iterations
            noise = noise_of(solved, used)
            is_wanted = self.config.adapt_noise and solved.status is not Status.INTERRUPTED
            change = adaptation(noise) if is_wanted and adaptations < MAX_ADAPTATIONS else None
            if change is None:
                break
            used, problem, first = used * change, with_sigmas(problem, change), solved.again()
        solved = solved._replace(iterations=iterations)
        yield 0.01 * problem.n_keyframes
        estimate = self._estimate(solved, noise, wall_s=time.perf_counter() - begin)
        yield 0.015 * problem.n_keyframes
        return estimate

    solve = at_once(solve_steps)

    def _solve_steps(
        self, problem: Problem, first: FirstValues | None, on_iteration: OnIteration | None
    ) -> Steps[Solved]:
        """Iterate states and weights until both have settled."""
        white = with_white_noise(problem)
        linearizer = GraphLinearizer(white)
        yield 0.03 * problem.n_keyframes
        if first is None:
            first = yield from first_values_steps(white, kernel=WARM_KERNEL)
        own = first.states.constants[: white.extras.n_constants]
        states = first.states._replace(constants=own)
        rows = linearizer.beam_rows(states)
        faults = FaultWatch(white, self.config.fault_search)
        yield 0.03 * problem.n_keyframes
        weights = Weights.begin(self.config, first, linearizer.weighted)
        iterations: list[Iteration] = []
        status = Status.MAX_ITERATIONS
        for number in range(self.config.max_iterations):
            try:
                this = yield from self._iterate(linearizer, states, rows, weights, faults)
            except KeyboardInterrupt:
                if not iterations:
                    raise
                status = Status.INTERRUPTED
                break
            states, rows = this.states, this.beam_rows
            in_force = str(weights.of_beams.kernel)
            iterations.append(Iteration(this.update_sigmas, this.weight_change, in_force))
            if on_iteration is not None:
                on_iteration(number + 1, self.config.max_iterations, iterations[-1])
            is_settled = max(this.update_sigmas, this.weight_change) < self.config.tolerance
            is_settled = is_settled and weights.may_end(this)
            changed = None
            if number + 1 < self.config.max_iterations:
                to, size = (this.weights, this.aid_weights), this.update_sigmas
                changed = yield from faults.look_steps(linearizer, states, *to, update_sigmas=size)
            if changed is not None:
                linearizer, states = changed.linearizer, changed.states
                rows, anew = linearizer.beam_rows(states), self.config.schedule()
                of_aids = weights.of_aids.anew()
                weights = Weights(changed.weights, changed.aid_weights, anew, of_aids)
                continue
            if is_settled:
                status = Status.CONVERGED
                break
            yield 0.007 * problem.n_keyframes
            weights = weights.after(this, faults)
        left: list[DetectedFault] = []
        if self.config.fault_search is not None:
            linearizer, this, left = yield from self._with_sigmas_steps(
                linearizer, this, weights, faults
            )
        inertial = inertial_fit(linearizer.inertial_rows(this.states), this.step)
        yield 0.02 * problem.n_keyframes
        freed = faults.faults(this.states, this.step, inertial)
        found = (*problem.faults, *freed, *(one for one in left if not one.is_rest_of(freed)))
        kernel = weights.of_beams.wanted
        notes = (*problem.notes, *(fault.sentence for fault in found), *_notes_of(first))
        ended = (linearizer, this, tuple(iterations), status)
        kernels = kernel, weights.of_aids.kernels
        return Solved(*ended, *kernels, notes, first, found, faults.aids_out, inertial)

    def _with_sigmas_steps(
        self, linearizer: GraphLinearizer, last: Pass, used: Weights, faults: FaultWatch
    ) -> Steps[tuple[GraphLinearizer, Pass, list[DetectedFault]]]:
        """Return the last pass with the covariance that residuals ask for, and who errs more.

        Its linearizer has what may be chance besides.
        """
        linearizer, states = yield from faults.allowing_steps(linearizer, last.states)
        last = last._replace(states=states, beam_rows=linearizer.beam_rows(states))
        problem, aids, known = linearizer.problem, linearizer.weighted, np.ones(len(used.aids))
        t, weights, keyframe_s = last.mahalanobis_sq, last.weights, problem.keyframe_s
        beams_s = keyframe_s[problem.beams.keyframe]
        freed, beam = linearizer.has_freed_beam, problem.beams.beam
        says, noisy = informative(
            DVL, t, weights, beams_s, used.of_beams.kernel, freed=freed, beam=beam
        )
        found = [*noisy]
        if len(noisy) > 1 or any(one.sensor == DVL for one in noisy):  # no motion is in one beam
            found = [noisy_or_compared(one, problem.beams, beams_s) for one in noisy]
        beams = says / faults.inflation_of(DVL)
        for aid, kernel in zip(aids.all, used.of_aids.kernels, strict=True):
            own = aids.of(aid, last.aid_lengths.square), aids.of(aid, last.aid_weights)
            says, noisy = informative(aid.name, *own, keyframe_s[aid.keyframe], kernel, dim=aid.dim)
            aids.of(aid, known)[:] = says / faults.inflation_of(aid.name)
            found.extend(noisy)
        step = yield from linearizer.solve_steps(
            last.states, last.beam_rows, beams * last.weights, known * last.aid_weights
        )
        readings = readings_of(
            linearizer, last.states, last.beam_rows.error, last.weights, last.aid_weights
        )
        left = [*found, *disagreeing(readings, keyframe_s)]
        return linearizer, last._replace(step=faults.covering(step)), left

    def _iterate(
        self,
        linearizer: GraphLinearizer,
        states: States,
        rows: BeamRows,
        used: Weights,
        faults: FaultWatch,
    ) -> Steps[Pass]:
        problem = linearizer.problem
        yield from linearizer.integrate_steps(states)
        if linearizer.follow(states):
            rows = linearizer.beam_rows(states)
        yield 0.004 * problem.n_keyframes
        step = yield from linearizer.solve_steps(states, rows, used.beams, used.aids)
        cost = linearizer.cost(states, rows, used.beams, used.aids)
        yield 0.005 * problem.n_keyframes
        states, rows = yield from descend_steps(
            linearizer, states, step, used.beams, cost, aid_weights=used.aids
        )
        # What is judged as settled is the step that was wanted, however little of it was taken.
        wanted, sigma = np.concatenate([step.step.ravel(), step.constants_step]), step.sigma
        speed = float(np.max(np.abs(states.v_n)))
        if not (np.all(np.isfinite(sigma)) and speed < RUNAWAY_SPEED):
            raise SolverError(
                f"{Status.DIVERGED.value}: largest velocity {speed:.3g} m/s; check time stamps and "
                "noise of [imu], and the initial heading"
            )
        t = self._mahalanobis_sq(problem, rows, step)
        settled = faults.leave_out(used.of_beams.kernel.weight(t))
        aids = linearizer.weighted
        lengths = aids.lengths(states, step, self.config.judged_by)
        aid_settled = faults.leave_aids_out(used.of_aids.weight(lengths.square))
        change = np.concatenate([settled - used.beams, aid_settled - used.aids])
        return Pass(
            states,
            step,
            rows,
            t,
            settled,
            lengths,
            aid_settled,
            update_sigmas=float(np.max(np.abs(wanted) / sigma)),
            weight_change=float(np.max(np.abs(change), initial=0.0)),
        )

    def _mahalanobis_sq(self, problem: Problem, rows: BeamRows, step: ChainSolution) -> Array:
        H, beams = rows.jacobian, problem.beams
        if self.config.judged_by is Similarity.PLAIN:
            spread = np.zeros(len(H))
        else:
            spread = step.variance(beams.keyframe, H)
        return expected_mahalanobis_sq(rows.error, spread, sigma=beams.sigma)

    def _cost(self, solved: Solved) -> float:
        """Return the cost with the robust losses of beams and aids for their weighted squares."""
        linearizer, last, kernel = solved.linearizer, solved.last, solved.kernel
        rows = last.beam_rows
        t = (rows.error / linearizer.problem.beams.sigma) ** 2
        loss = kernel.similarity(np.zeros_like(t)) - kernel.similarity(t)
        aids = linearizer.weighted
        others = linearizer.cost(last.states, rows, np.zeros_like(t), np.zeros(len(aids)))
        return others + float(np.sum(loss)) + aids.loss(last.states, solved.aid_kernels)

    def _estimate(self, solved: Solved, noise: NoiseFound, *, wall_s: float) -> Estimate:
        linearizer, last, status = solved.linearizer, solved.last, solved.status
        reason = (
            f"{status.value}: last update {last.update_sigmas:.1e} sigma, largest weight change "
            f"{last.weight_change:.1e}"
        )
        judged = linearizer.weighted.judged(
            last.states, linearizer.problem.keyframe_s, last.aid_lengths.square, last.aid_weights
        )
        doubts = self._doubts(solved, judged)
        if doubts:
            unsettled = [] if status is Status.CONVERGED else [reason]
            status, reason = Status.SUSPECT, "; ".join(doubts + unsettled)
        problem, beams = linearizer.problem, linearizer.problem.beams
        calibration = calibration_of(
            problem.extras,
            last.states.walks,
            last.states.constants,
            last.step.end_covariance(STATE_DIM),
            span_s=float(problem.keyframe_s[-1] - problem.keyframe_s[0]),
        )
        return Estimate(
            method="smoother",
            kernel=self.config.weighting,
            status=status,
            reason=reason,
            trajectory=trajectory_from_states(
                problem, last.states, last.step.covariance(STATE_DIM)
            ),
            beams=BeamTable(
                time_s=problem.keyframe_s[beams.keyframe],
                beam=(beams.beam + 1).astype(np.float64),
                innovation=-last.beam_rows.error,
                mahalanobis_sq=last.mahalanobis_sq,
                weight=last.weights,
            ),
            iterations=solved.iterations,
            wall_s=wall_s,
            cost=self._cost(solved),
            start=problem.start,
            faults=solved.faults,
            notes=solved.notes + noise_notes(noise) + undetermined(calibration),
            calibration=calibration,
            aids=aid_table(judged),
            noise=noise,
            current=current_of(
                problem.extras,
                problem.keyframe_s,
                last.states.walks,
                last.step.covariance_of(slice(STATE_DIM, None)),
            ),
            posterior=_posterior(problem, last),
        )

    def _doubts(self, solved: Solved, judged: list[JudgedAid]) -> list[str]:
        """Say in a sentence each what makes the answer doubtful: first who was found to be off."""
        linearizer, last = solved.linearizer, solved.last
        is_searched = self.config.fault_search is not None
        return [
            *(fault.sentence for fault in solved.faults if fault.is_suspect),
            *contradictions(linearizer, last.states, last.beam_rows, last.weights),
            *doubts_of_aids(without(judged, solved.aids_out), is_searched=is_searched),
            *ambiguous_beacons(
                last.states,
                linearizer.weighted,
                linearizer.problem.extras,
                last.step.end_covariance(STATE_DIM),
            ),
        ]


def _posterior(problem: Problem, last: Pass) -> Posterior:
    """Return what is known of the keyframes, with the errors found of the inertial sensors."""
    states, errors = last.states, None
    if len(columns_of_errors(problem.extras)):
        errors = np.atleast_2d(imu_errors(problem.extras, states.walks, states.constants)[0])
    return Posterior(
        problem.frame,
        problem.keyframe_s,
        *states[:4],
        last.step.covariance(STATE_DIM),
        last.step.neighbour_covariance(STATE_DIM),
        errors,
    )


def noise_of(solved: Solved, used: Array) -> NoiseFound:
    """Return what a solution says of the noise; ``used`` (B,) are its sigmas over the stated."""
    linearizer, last = solved.linearizer, solved.last
    return noise_found(
        linearizer.problem,
        error=last.beam_rows.error,
        variance=last.step.variance(linearizer.problem.beams.keyframe, last.beam_rows.jacobian),
        weights=last.weights,
        inertial=solved.inertial,
        used=used,
    )
