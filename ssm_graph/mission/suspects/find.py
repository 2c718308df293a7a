"""Clocks, units and axes that a mission's own logs contradict."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.base.times import is_inside
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.fault import DetectedFault, Treatment
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
from ssm_graph.mission.suspects.regression import Mask
from ssm_graph.mission.suspects.say import said, said_order
from ssm_graph.mission.suspects.search import (
    JUMP_AS_GOOD,
    STEP_BETTER,
    Evidence,
    Family,
    Found,
)
from ssm_graph.sensors.imu import imu_gaps

MOST: Final = 3
"""Suspects of one mission; with more, nothing is known."""


TAKEN_OFF_S: Final = 2.0
"""A longer delay is no linear function of the speed in a turn."""
SAME_DELAY_S: Final = 0.2
AT_ENDS_S: Final = 2.0


REST: Final = 0.3
"""Share of the pings that has to be left for a second look, beside what was off for a while."""
INERTIAL: Final = "IMU"
OF_IMU: Final = frozenset({"gyros", "gyro", "accelerometers", "accelerometer"})
"""First words of what people call it by its parts."""

UNSEEN_S: Final = 3.0
"""Longest gap of inertial data over which logs are compared. Of 16 simulated missions with a gap of
0.3 to 4 s none accused anybody; with 8 s each of four accused the depth's clock, of tens of s."""

AS_GOOD: Final = 10.0
"""Less gain by so much is as good an explanation."""


def find_suspects(mission: Mission) -> tuple[DetectedFault, ...]:
    """Return clocks, scales, units and axes that the logs of a mission contradict.

    Nothing is said of a mission whose logs are short or say little: a straight run has no turn to
    compare. The rate of false alarms is in ``docs/method-details.md``.
    """
    logs = _seen(replace(mission, imu=mission.imu.calibrated))
    plain = tuple(of_gravity(logs))
    if plain or not is_enough(logs):
        return plain
    by_parity = order_by_parity(logs)
    order = None if by_parity is None else by_parity[0]
    found = search(logs if order is None else reordered(logs, order))
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


def _seen(mission: Mission) -> Mission:
    """Return the longest stretch of inertial data without a long gap, and the pings during it.

    How the vehicle turned in a gap nobody knows: what comes after it contradicts what was before.
    Before the inertial data and after them it is the same, but for stamps that are off.
    """
    imu = mission.imu
    gap_s = np.stack(imu_gaps(imu))
    gap_s = gap_s[:, gap_s[1] - gap_s[0] > UNSEEN_S]
    begins_s, ends_s = np.append(imu.start_s, gap_s[1]), np.append(gap_s[0], imu.time_s[-1])
    longest = int(np.argmax(ends_s - begins_s))
    first_s, last_s = float(begins_s[longest]), float(ends_s[longest])
    own = (imu.time_s > first_s) & (imu.time_s <= last_s)
    rows = {name: getattr(imu, name)[own] for name in ("time_s", "gyro_b", "accel_b")}
    off_s = 0.0 if gap_s.size else UNSEEN_S
    dvl = mission.dvl.rows(is_inside(mission.dvl.valid_s, first_s - off_s, last_s + off_s))
    return replace(mission, imu=replace(imu, start_s=first_s, **rows), dvl=dvl)


def with_suspects(
    estimate: Estimate, suspects: tuple[DetectedFault, ...], mission: Mission
) -> Estimate:
    """Return an estimate that says what is suspect, first of all.

    A clock that the estimate has taken off by as much is none any more: its line stays. What the
    logs of ``mission`` contradict only while another instrument was off is none either.
    """
    suspects = tuple(one for one in suspects if _is_all_the_time(one, estimate, mission))
    known = [one for one in suspects if _is_taken_off(one, estimate)]
    suspects = tuple(one for one in suspects if one not in known)
    if known:
        done = tuple(replace(one, treatment=Treatment.FREED) for one in known)
        others = (one for one in estimate.faults if not any(_is_same(one, own) for own in known))
        estimate = replace(estimate, faults=(*done, *others))
    if not suspects:
        return estimate
    unsettled = [] if estimate.status is Status.CONVERGED else [estimate.reason]
    return replace(
        estimate,
        status=Status.SUSPECT,
        reason="; ".join([*(suspect.sentence for suspect in suspects), *unsettled]),
        faults=(*suspects, *estimate.faults),
    )


def _is_all_the_time(suspect: DetectedFault, estimate: Estimate, mission: Mission) -> bool:
    """Return whether the logs contradict a sensor without what another was off by for a while.

    Clocks, scales and axes are off all the time. A sound sensor seems to be so where another one
    that it is compared with lies, which the answer finds by itself.
    """
    own = _instrument(suspect.sensor)
    others = [
        one
        for one in estimate.faults
        if one.treatment.is_blame and one.is_decided and _instrument(one.sensor) != own
    ]
    if not others:
        return True
    rest = _without(mission, others)
    is_little = len(rest.dvl.time_s) < REST * len(mission.dvl.time_s)
    return is_little or any(_instrument(one.sensor) == own for one in find_suspects(rest))


def _instrument(sensor: str) -> str:
    first = sensor.split()[0]
    return INERTIAL if first in OF_IMU else first


def _without(mission: Mission, faults: list[DetectedFault]) -> Mission:
    """Return a mission without the readings that faults befell; of inertial ones without pings."""

    def is_sound(time_s: Array, *instruments: str) -> Mask:
        sound = np.ones(len(time_s), bool)
        for one in faults:
            if _instrument(one.sensor) in instruments:
                sound &= ~is_inside(time_s, one.begin_s, one.end_s)
        return sound

    dvl, gnss, depth = mission.dvl, mission.gnss, mission.depth
    dvl = dvl.rows(is_sound(dvl.time_s, "DVL", INERTIAL))
    gnss = None if gnss is None else gnss.rows(is_sound(gnss.time_s, "GNSS"))
    depth = None if depth is None else depth.rows(is_sound(depth.time_s, "depth"))
    return replace(mission, dvl=dvl, gnss=gnss, depth=depth)


def _is_taken_off(suspect: DetectedFault, estimate: Estimate) -> bool:
    return any(one.is_decided and _is_same(one, suspect) for one in estimate.faults)


def _is_same(one: DetectedFault, suspect: DetectedFault) -> bool:
    """Return whether a clock is taken off all the time, by what the logs alone say."""
    if one.late_s is None or suspect.late_s is None or one.treatment is not Treatment.FREED:
        return False
    is_whole = one.begin_s <= suspect.begin_s + AT_ENDS_S and one.end_s >= suspect.end_s - AT_ENDS_S
    is_small = abs(suspect.late_s) <= TAKEN_OFF_S
    is_like = abs(one.late_s - suspect.late_s) <= SAME_DELAY_S
    return one.sensor == suspect.sensor and is_whole and is_small and is_like


def search(mission: Mission) -> list[Found]:
    """Return the hypotheses that the logs ask for, the best first, each beside those before."""
    evidence, base = Evidence.of(mission), NOTHING
    families = [*clock_families(mission), *scale_families(mission)]
    found: list[Found] = []
    for _ in range(MOST):
        poor = evidence.poor(base)
        every = told(families, len(families))
        tried = [evidence.best_of(family, base, poor) for family in every]
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
