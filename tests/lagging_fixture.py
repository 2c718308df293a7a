"""A vehicle whose clock is set while it reads late: arrivals are given, no clock is looked at."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.live.sockets.clocks import RunClock, StampClocks
from ssm_graph.mission.navigation import Health
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from ssm_graph.simulation import SimulatedMission

EPOCH_S: Final = 1_700_000_000.0
STEADY_S: Final = 5000.0
SOURCES: Final = tuple(kind.__name__ for kind in (ImuSample, Ping, DepthReading, Fix))
LOOK_S: Final = 0.02
"""From one look at the sockets to the next where nothing holds the process up."""


@dataclass(frozen=True, slots=True)
class Lag:
    """How late a machine is.

    After a look it is held up once in ``every`` looks, for times of the mean ``stall_s``, none of
    them longer than ``longest_s``; what comes over a link is on its way for ``link_s`` and up to
    ``jitter_s`` more.
    """

    every: float = 20.0
    stall_s: float = 0.3
    longest_s: float = 3.0
    link_s: float = 0.02
    jitter_s: float = 0.1

    def looks(self, end_s: float, rng: np.random.Generator) -> Iterator[float]:
        """Yield the times of the looks, s."""
        time_s = 0.0
        while time_s < end_s:
            time_s += LOOK_S
            if rng.random() < 1.0 / self.every:
                time_s += min(rng.exponential(self.stall_s), self.longest_s)
            yield time_s


class Answer(NamedTuple):
    """One answer against the truth."""

    time_s: float
    is_good: bool
    sigmas: float
    """The larger of the horizontal errors of position and of velocity in their sigmas."""


class Sailed(NamedTuple):
    """What came of a run."""

    answers: list[Answer]
    misread_s: float
    """The furthest that a message passed at another time than it was measured at, s."""
    n_sent: int
    n_passed: int
    n_refused: int

    @property
    def worst(self) -> float:
        """The largest error of a good answer, in its sigmas."""
        return max((x.sigmas for x in self.answers if x.is_good), default=0.0)


def sail(
    sim: SimulatedMission,
    settings: Sequence[tuple[float, float]],
    lag: Lag,
    *,
    seed: int,
    gnss_follows: bool,
) -> Sailed:
    """Run the live estimator over a mission whose clock is set.

    Parameters
    ----------
    settings : when, s of the mission, and by how much the vehicle's clock is set, s.
    gnss_follows : whether fixes are stamped by the vehicle's clock, or by one that is right.
    """
    rng = np.random.default_rng(seed)

    def set_by_s(time_s: float) -> float:
        return sum(by_s for at_s, by_s in settings if time_s >= at_s)

    sent = list(messages_of(sim.mission))
    late_s = lag.link_s + lag.jitter_s * rng.random(len(sent))
    come_s = [
        one.time_s + (0.0 if isinstance(one, ImuSample) else float(s))
        for one, s in zip(sent, late_s, strict=True)
    ]
    order = np.argsort(come_s, kind="stable").tolist()
    truth = {replace(one, time_s=0.0): one.time_s for one in sent}
    smoother = FixedLagSmoother(_vehicle(sim), replace(ONLINE, lag_s=5.0))
    at = [0.0]
    clock = RunClock(lambda: EPOCH_S + at[0] + set_by_s(at[0]), lambda: STEADY_S + at[0])
    stamps = StampClocks(clock)
    answers, misread_s, n_passed, n_refused = list[Answer](), 0.0, 0, 0
    for at[0] in lag.looks(sent[-1].time_s + 10.0, rng):
        now, _ = clock.read()
        passed, refused = list[Message](), 0
        for source in SOURCES:
            settled, untold = stamps.settle(source, now)
            passed, refused = passed + settled, refused + len(untold)
        while order and come_s[order[0]] <= at[0]:
            one = sent[order.pop(0)]
            own_s = set_by_s(one.time_s) if gnss_follows or not isinstance(one, Fix) else 0.0
            stamped = replace(one, time_s=EPOCH_S + one.time_s + own_s)
            sifted = stamps.of(type(one).__name__, one).sift(stamped, now)
            passed += sifted.passed
            refused += len(sifted.refused) + len(sifted.untold)
        for message in passed:
            off_s = message.time_s - EPOCH_S - truth[replace(message, time_s=0.0)]
            misread_s = max(misread_s, abs(off_s))
            smoother.push(message)
        n_passed, n_refused = n_passed + len(passed), n_refused + refused
        if passed and (answer := _answer(sim, smoother)) is not None:
            answers.append(answer)
    return Sailed(answers, misread_s, len(sent), n_passed, n_refused)


def _vehicle(sim: SimulatedMission) -> Vehicle:
    vehicle = vehicle_of(sim.mission)
    assert vehicle.initial is not None
    return replace(vehicle, initial=replace(vehicle.initial, time_s=EPOCH_S))


def _answer(sim: SimulatedMission, smoother: FixedLagSmoother) -> Answer | None:
    newest = smoother.newest()
    if newest is None:
        return None
    time_s = newest.time_s - EPOCH_S
    truth = sim.truth_at(np.array([time_s]))
    metres = 6.371e6 * np.array([
        (newest.lon - truth.lon[0]) * math.cos(truth.lat[0]),
        newest.lat - truth.lat[0],
    ])  # fmt: skip
    speed = (newest.velocity_enu - truth.velocity_enu[0])[:2]
    sigmas = (newest.position_sigma_enu[:2], newest.velocity_sigma_enu[:2])
    off = [np.hypot(*e) / np.hypot(*s) for e, s in zip((metres, speed), sigmas, strict=True)]
    return Answer(time_s, newest.health is Health.GOOD, float(max(off)))
