"""From a mission to its estimate: alignment where it is needed, then the smoother."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ssm_graph.base.errors import SolverError
from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.base.stepwise import Steps, finished
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import Problem, ProblemConfig, build_problem_steps
from ssm_graph.mission.start.alignment import Alignment, align_steps
from ssm_graph.mission.suspects.find import find_suspects, with_suspects
from ssm_graph.mission.usable import require_usable
from ssm_graph.smoothers.batch import OnIteration, SsmSmoother
from ssm_graph.smoothers.faults.search import FaultSearch
from ssm_graph.smoothers.settings import SmootherConfig

AMBIGUOUS_COST = 6.0
"""Another heading whose cost is higher by less than this is as good an explanation (a likelihood
ratio of about 400)."""
FAULT_COST = 20.0
"""What an explanation is charged for each lasting fault that it needs: half of the chi-square of 40
or so from which on the search believes in one. Of a heading that is wrong by 180 degrees a pull of
the fixes explains the rest."""
SAME_HEADING = np.radians(5.0)
"""Headings closer than this, or than three of their sigmas, are one and the same."""
MOST_LOOKS = 3
"""Looks for faults in a mission of which a unit or an axis is wrong. No stretch explains that, so
that one look after the other changes the answer: where gyros read 0.60 of the turn eight took three
times as long, and named them no better."""
SEARCHING = SmootherConfig(fault_search=FaultSearch())
"""Settings of who asks for none."""
POOR_HEADING = np.radians(3.0)
"""A heading with a larger posterior sigma at the start is said to be hardly observable."""

OnStage = Callable[[str], None]


def smooth_steps(
    mission: Mission,
    config: SmootherConfig | None = None,
    *,
    problem_config: ProblemConfig | None = None,
    on_iteration: OnIteration | None = None,
    on_stage: OnStage | None = None,
) -> Steps[Estimate]:
    """Smooth a mission; without an initial state, align first.

    Where alignment finds no safe heading, several are smoothed and the one that explains the data
    best is returned; the notes say so, and an ambiguous choice makes the status suspect.

    Parameters
    ----------
    mission : from :func:`ssm_graph.read_mission` or a simulation.
    config : settings of the similarity loop; without, its defaults and the search for faults
        that last.
    problem_config : rates and intervals of the graph.
    on_iteration : called with number, limit and :class:`ssm_graph.Iteration` after each iteration.
    on_stage : called with a line of text when a new stage begins.

    Raises
    ------
    SsmGraphError
        With a sentence that says what is wrong, if the mission cannot be smoothed.
    """
    say = on_stage or (lambda _: None)
    smoother = SsmSmoother(config or SEARCHING)
    if mission.initial is not None:
        say("preintegrating")
        problem = yield from build_problem_steps(mission, problem_config)
        say(f"smoothing {problem.n_keyframes} keyframes")
        estimate = yield from smoother.solve_steps(problem, on_iteration=on_iteration)
        return _with_notes(estimate, mission.notes)
    say("aligning")
    alignment = yield from align_steps(mission)
    start = alignment.candidates[0]
    problem = yield from build_problem_steps(mission, problem_config, start=start)
    estimates = []
    for i, start in enumerate(alignment.candidates):
        say(
            f"smoothing {problem.n_keyframes} keyframes, start {i + 1} of "
            f"{len(alignment.candidates)}: heading {np.degrees(start.heading):.0f} deg"
        )
        of_start = replace(problem, start=start)
        estimates.append((yield from _try_steps(smoother, of_start, on_iteration)))
        if estimates[-1] is not None and estimates[-1].status is Status.INTERRUPTED:
            break
    chosen = _choose([estimate for estimate in estimates if estimate is not None], alignment)
    return _with_notes(chosen, (*mission.notes, f"aligned: {alignment.method}"))


def smooth(
    mission: Mission,
    config: SmootherConfig | None = None,
    *,
    problem_config: ProblemConfig | None = None,
    on_iteration: OnIteration | None = None,
    on_stage: OnStage | None = None,
) -> Estimate:
    """Smooth a mission as :func:`smooth_steps` does, and look for clocks, units and axes.

    What the logs contradict stands first in the reason, and in the message of a
    :class:`SolverError`.
    """
    require_usable(mission)
    if on_stage is not None:
        on_stage("comparing clocks, units and axes")
    suspects = find_suspects(mission)
    config = config or SEARCHING
    if config.fault_search is not None and any(suspect.late_s is None for suspect in suspects):
        config = replace(config, fault_search=replace(config.fault_search, most_looks=MOST_LOOKS))
    steps = smooth_steps(
        mission,
        config,
        problem_config=problem_config,
        on_iteration=on_iteration,
        on_stage=on_stage,
    )
    try:
        return with_suspects(finished(steps), suspects, mission)
    except SolverError as error:
        said = [suspect.sentence for suspect in suspects]
        raise SolverError("; ".join([*said, str(error)])) from error


def _try_steps(
    smoother: SsmSmoother, problem: Problem, on_iteration: OnIteration | None
) -> Steps[Estimate | None]:
    try:
        return (yield from smoother.solve_steps(problem, on_iteration=on_iteration))
    except SolverError:
        return None


def _choose(estimates: list[Estimate], alignment: Alignment) -> Estimate:
    """Return the estimate of lowest cost, marked where another heading does as well."""
    if not estimates:
        raise SolverError(
            f"none of {len(alignment.candidates)} start headings led to a finite solution; "
            "check signs, units and axes of [imu] and [dvl], or give [initial]"
        )
    best = min(estimates, key=_price)
    heading = best.trajectory.roll_pitch_heading[0, 2]
    sigma = float(best.trajectory.attitude_sigma[0, 2])
    rivals = [
        float(np.degrees(other.trajectory.roll_pitch_heading[0, 2]))
        for other in estimates
        if _price(other) - _price(best) < AMBIGUOUS_COST
        and abs(wrap_to_pi(other.trajectory.roll_pitch_heading[0, 2] - heading))
        > max(SAME_HEADING, 3.0 * sigma)
    ]
    found = (
        f"start heading {np.degrees(heading):.2f} deg, posterior sigma {np.degrees(sigma):.2f} deg"
    )
    if rivals:
        return replace(
            best,
            status=Status.SUSPECT,
            reason=(
                f"heading ambiguous: {found}, but {', '.join(f'{r:.0f}' for r in rivals)} deg "
                "explain the data as well; move more while there are fixes, or give [initial]"
            ),
        )
    if sigma > POOR_HEADING:
        found = (
            f"heading hardly observable: {found}; move more while there are fixes, or give "
            "[initial]"
        )
    return _with_notes(best, (found,))


def _price(estimate: Estimate) -> float:
    """Return the cost of an explanation with that of the faults that it needs."""
    return estimate.cost + FAULT_COST * sum(one.treatment.is_blame for one in estimate.faults)


def _with_notes(estimate: Estimate, notes: tuple[str, ...]) -> Estimate:
    return replace(estimate, notes=notes + estimate.notes)
