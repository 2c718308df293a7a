"""Clocks, units and axes that a mission's own logs contradict."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.fault import DetectedFault
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.suspects.families import SET_S, clock_families, scale_families
from ssm_graph.mission.suspects.hypothesis import NOTHING, Delay, Hypothesis
from ssm_graph.mission.suspects.motion import is_enough
from ssm_graph.mission.suspects.plain import (
    fault_of,
    of_gravity,
    of_heights,
    order_by_parity,
    reordered,
)
from ssm_graph.mission.suspects.say import said, said_order
from ssm_graph.mission.suspects.search import (
    JUMP_AS_GOOD,
    STEP_BETTER,
    Evidence,
    Family,
    Found,
)

MOST: Final = 3
"""Suspects of one mission; with more, nothing is known."""


AS_GOOD: Final = 10.0
"""Less gain by so much is as good an explanation."""


def find_suspects(mission: Mission) -> tuple[DetectedFault, ...]:
    """Return clocks, scales, units and axes that the logs of a mission contradict.

    Nothing is said of a mission whose logs are short or say little: a straight run has no turn to
    compare. The rate of false alarms is in ``docs/method-details.md``.
    """
    plain = tuple(of_gravity(mission))
    if plain or not is_enough(mission):
        return plain
    by_parity = order_by_parity(mission)
    order = None if by_parity is None else by_parity[0]
    found = search(mission if order is None else reordered(mission, order))
    faults = [said(one, mission, order) for one in found]
    if (
        by_parity is not None
        and order is not None
        and not any(one.family.name == "DVL axes" for one in found)
    ):
        what, remedy = said_order(order, 1.0)
        faults.insert(0, fault_of(mission, "DVL", what, remedy, by_parity[1]))
    if not any(one.family.name == "depth scale" for one in found):
        faults += of_heights(mission)
    return tuple(faults)


def with_suspects(estimate: Estimate, suspects: tuple[DetectedFault, ...]) -> Estimate:
    """Return an estimate that says what is suspect, first of all."""
    if not suspects:
        return estimate
    unsettled = [] if estimate.status is Status.CONVERGED else [estimate.reason]
    return replace(
        estimate,
        status=Status.SUSPECT,
        reason="; ".join([*(suspect.sentence for suspect in suspects), *unsettled]),
        faults=(*suspects, *estimate.faults),
    )


def search(mission: Mission) -> list[Found]:
    """Return the hypotheses that the logs ask for, the best first, each beside those before."""
    evidence, base = Evidence.of(mission), NOTHING
    families = [*clock_families(mission), *scale_families(mission)]
    found: list[Found] = []
    for _ in range(MOST):
        poor = evidence.poor(base)
        tried = [evidence.best_of(family, base, poor) for family in families]
        sure = [best for best in tried if best is not None and best.is_sure]
        sure = [best for best in sure if not (best.is_far and _is_poor(evidence, best))]
        sure += _set_clocks(evidence, families, base, poor, sure)
        if not sure:
            break
        most = max(one.gain for one in sure)
        good = [one for one in sure if one.gain > most - AS_GOOD]
        best = max(good, key=lambda one: (one.is_cared_for, one.gain))
        if not best.is_cared_for:
            found.append(replace(best, rivals=tuple(one for one in good if one is not best)))
        base = best.hypothesis
        families = [family for family in families if family is not best.family]
    return found


def _is_poor(evidence: Evidence, clock: Found) -> bool:
    """Return whether logs still disagree with a clock put right by seconds: then it is another."""
    return clock.family.part in evidence.poor(clock.hypothesis)


def _set_clocks(
    evidence: Evidence, families: list[Family], base: Hypothesis, poor: set[str], sure: list[Found]
) -> list[Found]:
    """Return clocks that were set in mid-run, where that says more than any constant."""
    best = max((one.gain for one in sure), default=0.0)
    found = []
    for family in families:
        is_worth = family.part in poor or any(one.family is family for one in sure)
        if not family.clocks or not is_worth:
            continue
        step = evidence.set_clock(family, base, SET_S)
        if step is None or not step.is_sure or step.gain < best + STEP_BETTER:
            continue
        if _is_poor(evidence, step):
            continue
        if family.clocks == ("gnss",):
            switch_s = step.hypothesis.gnss.switch_s
            jump = replace(base, gnss=Delay(), jump_s=switch_s)
            of_step, of_jump = evidence.total([step.hypothesis, jump])
            if of_step > of_jump + JUMP_AS_GOOD:
                continue
        found.append(step)
    return found
