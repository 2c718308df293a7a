"""One fault put into a mission's messages: what is done, what must happen, what did; verdicts."""

from __future__ import annotations

import math
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.mission.mission import Reference
from ssm_graph.mission.navigation import Event, Health, Navigation
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.messages import Message
from ssm_graph.simulation import (
    DvlSettings,
    GnssSettings,
    Grade,
    SimulatedMission,
    SimulationConfig,
    SurveyRoute,
    simulate,
)

LAG_S: Final = 10.0
LOOK_S: Final = 0.5
"""The newest answer is looked at so often, s."""
BEGIN_S: Final = 65.0
"""When most faults begin."""
GROUPS: Final = ("position", "velocity", "attitude")
INSIDE: Final = 3.0
"""Sigmas."""
WORSE: Final = {Health.GOOD: 0, Health.DEGRADED: 1, Health.BAD: 2, Health.ALIGNING: 3}


@dataclass(frozen=True, slots=True)
class Stage:
    """The mission that a fault is put into: survey lines of 60 m, so that the vehicle turns."""

    duration_s: float = 110.0
    gnss: tuple[tuple[float, float], ...] = ((0.0, 60.0),)
    """s, when there are fixes"""
    seed: int = 5


class Sent(NamedTuple):
    """A message on its way."""

    true_s: float
    """When it is sent, whatever its stamp says."""
    message: Message


Stream = list[Sent]
Transform = Callable[[Stream, np.random.Generator], Stream]


@dataclass(frozen=True, slots=True)
class Rule:
    """What has to happen, besides the rules that hold for all."""

    worst: Health = Health.GOOD
    """The health has to be at least so bad once ..."""
    within_s: float = 10.0
    """... so long after the fault has begun."""
    good_after_s: float | None = 10.0
    """So long after its end it has to be good, and to stay so; None where it cannot be."""
    told: str = ""
    """Begin of the kind of an event that has to be told."""
    is_harmless: bool = False
    """The last answer has to be that of the undisturbed mission, to 1e-6 sigmas."""


@dataclass(frozen=True, slots=True)
class Case:
    """A fault."""

    name: str
    injected: str
    transform: Transform
    rule: Rule
    begin_s: float = BEGIN_S
    end_s: float = math.inf
    clock_s: float = 0.0
    """How far stamps are off the truth while the fault lasts, where it is the clock's."""
    stage: Stage = Stage()
    vehicle: Callable[[Vehicle], Vehicle] | None = None


class Look(NamedTuple):
    """The newest answer at one time."""

    true_s: float
    health: Health
    reason: str
    navigation: Navigation | None


class Run(NamedTuple):
    """What an estimator made of a stream."""

    looks: list[Look]
    events: tuple[Event, ...]
    counts: dict[str, int]
    n_silent: int
    """Messages neither used nor counted as refused."""
    failure: str | None


class Errors(NamedTuple):
    """Errors of answers against the truth or each other, and their sigmas."""

    error: Array
    """(N, 9) position m, velocity m/s, attitude rad"""
    sigma: Array

    @property
    def sigmas(self) -> Array:
        """(N, 9) errors in their sigmas."""
        return np.abs(self.error) / self.sigma


def stage_config(stage: Stage) -> SimulationConfig:
    """Return what is simulated."""
    return SimulationConfig(
        route=SurveyRoute(line_m=60.0),
        duration_s=stage.duration_s,
        grade=Grade.TACTICAL,
        dvl=DvlSettings(rate_hz=2.0),
        gnss=GnssSettings(windows=stage.gnss),
        seed=stage.seed,
    )


@cache
def simulated_stage(stage: Stage) -> tuple[SimulatedMission, Vehicle, tuple[Message, ...]]:
    """Return the mission, its vehicle and its messages."""
    sim = simulate(stage_config(stage))
    return sim, vehicle_of(sim.mission), tuple(messages_of(sim.mission))


def undisturbed_stream(stage: Stage) -> Stream:
    """Return the messages of a mission as they were sent."""
    return [Sent(message.time_s, message) for message in simulated_stage(stage)[2]]


@cache
def undisturbed(stage: Stage) -> Run:
    """Return what the estimator makes of the mission as it is."""
    return run(undisturbed_stream(stage), simulated_stage(stage)[1])


def run_case(case: Case) -> Run:
    """Return what the estimator makes of a mission with the fault."""
    stream = case.transform(undisturbed_stream(case.stage), np.random.default_rng(0))
    vehicle = simulated_stage(case.stage)[1]
    return run(stream, case.vehicle(vehicle) if case.vehicle else vehicle)


def run(stream: Stream, vehicle: Vehicle, *, lag_s: float = LAG_S) -> Run:
    """Push all messages, looking at the newest answer on the way."""
    smoother = FixedLagSmoother(vehicle, replace(ONLINE, lag_s=lag_s))
    n_used = _count_used(smoother)
    looks: list[Look] = []
    events: tuple[Event, ...] = ()
    n_sent, next_s, failure = 0, LOOK_S, None
    try:
        for true_s, message in stream:
            n_sent += 1
            smoother.push(message)
            if true_s >= next_s:
                next_s = LOOK_S * (math.floor(true_s / LOOK_S + 1e-6) + 1)
                looks.append(Look(true_s, *smoother.status(), smoother.newest()))
                events += smoother.take_events()
        looks.append(Look(stream[-1].true_s, *smoother.status(), smoother.newest()))
    except Exception:  # what the estimator promises never to do
        failure = traceback.format_exc(limit=-3)
    events += smoother.take_events()
    counts = {name: n for name, n in smoother.counts.items() if n}
    n_whole = sum(n for name, n in counts.items() if not name.startswith("dvl ident"))
    n_silent = max(n_sent - n_used[0] - n_whole, 0)
    return Run(looks, events, counts, n_silent, failure)


def _count_used(smoother: FixedLagSmoother) -> list[int]:
    """Count the rows that the estimator takes into its buffers."""
    buffers, count = smoother._intake.buffers, [0]
    add = buffers.add

    def counting(message: Message) -> bool:
        is_new = add(message)
        count[0] += is_new
        return is_new

    buffers.add = counting  # type: ignore[method-assign]
    return count


def errors_of(looks: list[Look], case: Case) -> Errors:
    """Return the errors of answers against the truth of the times that they are meant for."""
    sim = simulated_stage(case.stage)[0]
    answers = [look.navigation for look in looks if look.navigation is not None]
    now_s = [look.true_s for look in looks if look.navigation is not None]
    stamps = np.array([answer.time_s for answer in answers])
    moved = stamps - case.clock_s
    # Around the jump of a clock an answer may still be on the old one.
    true_s = np.where(np.abs(moved - now_s) < np.abs(stamps - now_s), moved, stamps)
    return differences(answers, sim.truth_at(true_s))


def differences(answers: list[Navigation], other: Reference | Navigation) -> Errors:
    """Return the differences of answers from the truth at their times, or from another answer."""

    def columns(*names: str) -> Array:
        return np.array(
            [np.hstack([getattr(answer, name) for name in names]) for answer in answers]
        )

    lat, lon, height = columns("lat", "lon", "height").T
    radius = 6.371e6
    east = (lon - other.lon) * radius * np.cos(lat)
    position = np.stack([east, (lat - other.lat) * radius, height - other.height], axis=-1)
    turn = columns("roll_pitch_heading") - other.roll_pitch_heading
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    velocity = columns("velocity_enu") - other.velocity_enu
    sigmas = columns("position_sigma_enu", "velocity_sigma_enu", "attitude_sigma")
    return Errors(np.hstack([position, velocity, turn]), sigmas)


def shares_inside(looks: list[Look], case: Case, health: Health) -> tuple[float, ...]:
    """Return the share of the truth inside three sigmas while the health was so, by group."""
    found = [look for look in looks if look.health is health and look.navigation is not None]
    if not found:
        return (math.nan,) * len(GROUPS)
    inside = errors_of(found, case).sigmas < INSIDE
    return tuple(float(inside[:, 3 * k : 3 * k + 3].mean()) for k in range(len(GROUPS)))


def spells(looks: list[Look]) -> list[tuple[float, Health]]:
    """Return when which health began."""
    return [(next(group).true_s, health) for health, group in groupby(looks, lambda x: x.health)]


def good_from(looks: list[Look]) -> float:
    """Return since when the health has been good at the end, infinity if it is not."""
    begin_s, health = spells(looks)[-1]
    return begin_s if health is Health.GOOD else math.inf


LEAST_SHARE: Final = 0.95
SAME: Final = 1e-6
"""Sigmas."""
HEADER: Final = (
    *("fault", "injected", "events told", "health from, s", "good again after, s", "lost"),
    *("off undisturbed at the end", "truth inside 3 σ while GOOD", "verdict"),
)
_PERCENT: Final = f"{100.0 * LEAST_SHARE:.0f} %"
RULES: Final = f"""\
A row passes if (1) nothing raised; (2) while the health is GOOD the truth is inside three sigmas in
at least {_PERCENT} of all components of position, of velocity and of attitude; (3) no message is
lost in silence: each is used or counted as refused; (4) where the fault can be seen, the health is
as bad as it has to be in time, and the event that names it is told; (5) where the fault ends, or
can be lived with, the health is GOOD in time and stays so; (6) where it is GOOD at the end, the
answer is within three of its sigmas of that of the undisturbed mission in every component, and
where the fault takes nothing away it is the same answer to {SAME:g} sigmas.

An absolute sensor that goes off for good, depth or GNSS, is followed in the end, for nothing else
sees what it measures. The answer is BAD before, `recovered` is told, and it is not GOOD for ten
minutes; the runs here end before, and after that it would be GOOD at the wrong place.
"""


class Row(NamedTuple):
    """A row of the table."""

    cells: tuple[str, ...]
    faults: tuple[str, ...]
    """What is wrong with it."""

    @property
    def has_passed(self) -> bool:
        """Whether nothing is."""
        return not self.faults

    @property
    def texts(self) -> list[str]:
        """The cells and the verdict."""
        return [*self.cells, "pass" if self.has_passed else f"**fail**: {'; '.join(self.faults)}"]


def judge(case: Case, run: Run) -> Row:
    """Return the row of a case."""
    faults = [] if run.failure is None else [f"raised: {run.failure.splitlines()[-1]}"]
    shares = shares_inside(run.looks, case, Health.GOOD)
    for name, share in zip(GROUPS, shares, strict=True):
        if share < LEAST_SHARE:
            faults.append(f"{name} inside in {100 * share:.0f} % while GOOD")
    if run.n_silent:
        faults.append(f"{run.n_silent} messages lost in silence")
    faults += _told(case, run)
    after_s = good_from(run.looks) - (case.end_s if case.end_s < math.inf else case.begin_s)
    wanted_s = case.rule.good_after_s
    if wanted_s is not None and after_s > wanted_s:
        faults.append(f"not good within {wanted_s:g} s")
    off, problem = _off(case, run)
    faults += [problem] if problem else []
    told = Counter(event.kind for event in run.events if event.kind not in ("aligning", "aligned"))
    cells = (
        case.name,
        case.injected,
        ", ".join(f"{kind} {n}" for kind, n in told.items()) or "none",
        health_text(run),
        "–" if math.isinf(after_s) else f"{max(after_s, 0.0):.1f}",
        ", ".join(f"{name}: {n}" for name, n in run.counts.items()) or "none",
        off,
        share_text(shares),
    )
    return Row(cells, tuple(faults))


def _told(case: Case, run: Run) -> list[str]:
    rule, faults = case.rule, []
    span = [x for x in run.looks if case.begin_s <= x.true_s <= case.begin_s + rule.within_s]
    if max((WORSE[x.health] for x in span), default=0) < WORSE[rule.worst]:
        faults.append(f"never {rule.worst.name} within {rule.within_s:g} s")
    if rule.told and not any(event.kind.startswith(rule.told) for event in run.events):
        faults.append(f"{rule.told} not told")
    return faults


def _off(case: Case, run: Run) -> tuple[str, str]:
    """Return how far the last answer is off the undisturbed one, and what is wrong with that."""
    last, other = run.looks[-1], undisturbed(case.stage).looks[-1].navigation
    assert other is not None
    if last.navigation is None:
        return "no answer", ""
    difference = differences([last.navigation], other)
    sigmas = float(np.max(difference.sigmas))
    text = f"{np.linalg.norm(difference.error[0, :3]):.2f} m, {sigmas:.2g} σ"
    if case.rule.is_harmless and not sigmas < SAME:
        return text, f"another answer, by {sigmas:.1g} sigmas"
    if last.health is Health.GOOD and not sigmas < INSIDE:
        return text, f"GOOD at {sigmas:.1f} sigmas"
    return text, ""


def health_text(run: Run) -> str:
    """Return the health in time, without the first alignment."""
    found = spells(run.looks)
    first = int(len(found) > 1 and found[0][1] is Health.ALIGNING)
    parts = [f"{begin_s:.1f} {health.name}" for begin_s, health in found[first:]]
    if len(parts) > 8:
        parts = [*parts[:4], f"… {len(parts) - 7} more …", *parts[-3:]]
    return "; ".join(parts)


def share_text(shares: tuple[float, ...]) -> str:
    """Return three shares in percent."""
    return " / ".join("–" if math.isnan(share) else f"{100 * share:.0f}" for share in shares) + " %"
