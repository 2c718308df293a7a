"""An hour at real sockets with storms, slow clients and jumps of the clock: who is locked out.

``python -m benchmarks.soak.sockets --keep`` (in real time: it takes the hour); a quick look is
``--minutes 10``, each storm once.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from benchmarks.faults.case import INSIDE, WORSE, Stage, stage_config
from benchmarks.faults.sockets import EPOCH_S, Dvl, report
from benchmarks.report import Option, Report, note, table
from benchmarks.soak.storms import STORMS, TICK_S, Place, Shore
from ssm_graph.cli.online_run import engine_of, pass_over_imports
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE
from ssm_graph.live.protocols.json_messages import JsonDecoder, encode_message
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.run.run_folder import RunFolder
from ssm_graph.live.run.runner import Connections, Runner, RunnerConfig
from ssm_graph.live.sockets.endpoints import LOOPBACK, Endpoint, Transport
from ssm_graph.live.sockets.outputs import OutputFormat
from ssm_graph.live.sockets.sockets import InputConfig, OutputConfig, SocketHub
from ssm_graph.mission.navigation import Health
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message, Readings
from ssm_graph.simulation import SimulatedMission, simulate

CYCLE_S: Final = 600.0
"""Each storm blows once in it."""
JUMPS: Final = (0.5, -0.5, 3.0, -3.0, 30.0, -30.0)
"""By how much the clock of vehicle and instruments is set, s, one after the other in each cycle."""
JUMP_AT_S: Final = 520.0
"""The first one within the cycle."""
JUMP_EVERY_S: Final = 13.0
BEGINS_S: Final = 10.0
"""So long from the start of the processes to the first sample."""
AFTER_S: Final = 10.0
"""What comes so long after a storm is told with it."""
LOCKED_OUT_S: Final = 5.0
FLAT_MB_PER_H: Final = 1.0
LEGEND: Final = f"""\
A live run in a process of its own, as `ssm-graph online` makes it: the IMU (100 Hz) calls a TCP
port, depth and GNSS come as datagrams, a Water Linked DVL (2 Hz) is called, answers go to TCP
clients. Every {CYCLE_S / 60:g} minutes each storm blows once. Silences: the longest time in which
nothing of an instrument reached the estimator, or no answer the sound client, in seconds, from the
begin of the storm to {AFTER_S:g} s after it. Inside: share of the answers of good health whose
horizontal error is within three of their sigmas, and the largest of these errors.
"""
WARM_S: Final = 600.0
"""Memory counts from then on: each storm has filled its buffers once."""


@dataclass(frozen=True, slots=True)
class Clock:
    """The vehicle's clock, which both processes read; ``begin_s`` is on the monotonic one."""

    begin_s: float

    def elapsed_s(self) -> float:
        """Return the time since the begin, s."""
        return time.monotonic() - self.begin_s

    def set_by_s(self, elapsed_s: float) -> float:
        """Return by how much it has been set so far, s."""
        within_s = elapsed_s % CYCLE_S - JUMP_AT_S
        return sum(by for k, by in enumerate(JUMPS) if within_s >= k * JUMP_EVERY_S)

    def wall_s(self) -> float:
        """Return Unix time, s."""
        elapsed_s = self.elapsed_s()
        return EPOCH_S + elapsed_s + self.set_by_s(elapsed_s)


class Ear:
    """The hub as the runner's source; notes how long nothing came of each instrument."""

    def __init__(self, hub: SocketHub, clock: Clock, line: Connection) -> None:
        self._hub, self._clock, self._line = hub, clock, line
        self.take_events, self.source_status = hub.take_events, hub.source_status
        self._heard_s: dict[str, float] = {}
        self._longest_s: dict[str, float] = {}
        self._told_s = 0.0

    @property
    def is_finished(self) -> bool:
        """Whether the other process says that it is over."""
        return self._line.poll()

    @property
    def time_s(self) -> float:
        """The vehicle's clock, s."""
        return self._hub.time_s

    @property
    def elapsed_s(self) -> float:
        """Since the begin, s."""
        return self._clock.elapsed_s()

    def waiting(self) -> list[Readings]:
        """Return what has come and waits."""
        return self._hub.waiting()

    def end(self) -> list[Message]:
        """Return what waits when the run ends."""
        return self._hub.end()

    def poll(self, timeout_s: float) -> list[Message]:
        """Return what has come; tell of it once a second."""
        messages = self._hub.poll(timeout_s)
        now_s = self._clock.elapsed_s()
        for name in {type(message).__name__ for message in messages}:
            silent_s = now_s - self._heard_s.get(name, now_s)
            self._longest_s[name] = max(self._longest_s.get(name, 0.0), silent_s)
            self._heard_s[name] = now_s
        if now_s - self._told_s >= 1.0:
            self._told_s = now_s
            self._line.send((now_s, self._longest_s))
            self._longest_s = {}
        return messages


def navigate(line: Connection, folder: Path, vehicle: Vehicle, dvl_port: int, clock: Clock) -> None:
    """Run the live estimator behind sockets, in a process of its own.

    It tells its ports, and what it hears once a second.
    """
    server, datagrams = (
        Endpoint(kind, LOOPBACK, 0) for kind in (Transport.TCP_SERVER, Transport.UDP)
    )
    inputs = [
        InputConfig("dvl", Endpoint(Transport.TCP_CLIENT, LOOPBACK, dvl_port), WaterLinkedDecoder),
        InputConfig("imu", server, JsonDecoder),
        InputConfig("messages", datagrams, JsonDecoder),
    ]
    outputs = [OutputConfig(form, server) for form in OutputFormat]
    with SocketHub(inputs, outputs, wall_s=clock.wall_s) as hub:
        links = (*hub.inputs[1:], *hub.outputs)
        line.send([link.port for link in links])  # type: ignore[attr-defined]
        connections = Connections(Ear(hub, clock, line), hub)
        pass_over_imports()
        end = Runner(
            RunFolder(folder, vehicle, {}),
            engine_of(vehicle, replace(ONLINE, lag_s=5.0)),
            lambda n: connections,  # noqa: ARG005
            config=RunnerConfig(),
        ).run()
        line.send((end.n_messages, end.n_errors))


@dataclass(slots=True)
class Heard:
    """What was seen of the run."""

    silences: list[tuple[float, str, float]] = field(default_factory=list)
    """When, of what, how long, s: the longest of each second."""
    rss: list[tuple[float, float]] = field(default_factory=list)
    """s, MB"""
    answers: list[tuple[float, Health, float]] = field(default_factory=list)
    """s, health, horizontal error in its sigmas; one a second."""
    late_s: float = 0.0
    """The longest that the instruments themselves were late."""


class Hour:
    """The instruments and the clients of one run, and what disturbs them."""

    def __init__(self, sim: SimulatedMission, clock: Clock, shore: Shore, line: Connection) -> None:
        self._sim, self._clock, self._shore, self._line = sim, clock, shore, line
        self._messages = messages_of(sim.mission)
        self._next = next(self._messages, None)
        self._answered_s = self._ticked_s = self._looked_s = 0.0
        self._blowing: dict[str, Iterator[None]] = {}
        self.heard = Heard()

    def run(self, pid: int, duration_s: float) -> Heard:
        """Send everything at its time; return what came of it."""
        while (now_s := self._clock.elapsed_s()) < duration_s:
            self.heard.late_s = max(self.heard.late_s, now_s - self._ticked_s - TICK_S)
            self._ticked_s = now_s
            self._send(now_s)
            self._blow(now_s % CYCLE_S)
            self._listen(now_s)
            while self._line.poll():
                at_s, longest_s = self._line.recv()
                self.heard.silences += [
                    (at_s, name, s - muted_s(name, at_s, s)) for name, s in longest_s.items()
                ]
            if now_s - self._looked_s >= 1.0:
                self._looked_s = now_s
                self.heard.rss.append((now_s, resident_mb(pid)))
            time.sleep(max(0.0, now_s + TICK_S - self._clock.elapsed_s()))
        return self.heard

    def _blow(self, in_cycle_s: float) -> None:
        """Give each storm that is on its turn; end those that are over."""
        for name, storm in STORMS.items():
            if storm.begin_s <= in_cycle_s < storm.begin_s + storm.length_s:
                next(self._blowing.setdefault(name, storm.blow(self._shore)))
            elif name in self._blowing:
                del self._blowing[name]  # which closes its sockets

    def _send(self, now_s: float) -> None:
        """Send what has become due, stamped by the vehicle's clock."""
        shore = self._shore
        while self._next is not None and self._next.time_s <= now_s:
            stamp_s = EPOCH_S + self._next.time_s + self._clock.set_by_s(self._next.time_s)
            message = replace(self._next, time_s=stamp_s)
            if isinstance(message, Ping):
                shore.last_ping = message
                shore.dvl.send(report(message))
            elif isinstance(message, ImuSample):
                shore.last_imu = message
                shore.imu.send(encode_message(message))
            else:
                shore.send_to(shore.datagrams, encode_message(message))
            self._next = next(self._messages, None)
        shore.imu.send(b"")

    def _listen(self, now_s: float) -> None:
        """Read the answers; keep one of each second."""
        lines = [x for x in self._shore.reader.lines() if x.startswith(b'{"type": "navigation"')]
        if not lines:
            return
        self.heard.silences.append((now_s, "answers", now_s - (self._answered_s or now_s)))
        is_new = int(now_s) > int(self._answered_s)
        self._answered_s = now_s
        if is_new:
            fields = json.loads(lines[-1])
            off = self._off(fields)
            self.heard.answers.append((now_s, Health[fields["health"]], off))

    def _off(self, fields: dict[str, float]) -> float:
        """Return how far an answer is off the truth of its time, horizontally, in its sigmas."""
        true_s = fields["time_s"] - EPOCH_S - fields["clock_set_by_s"]
        truth = self._sim.truth_at(np.array([true_s]))
        east = math.radians(fields["lon_deg"]) - float(truth.lon[0])
        north = math.radians(fields["lat_deg"]) - float(truth.lat[0])
        metres = 6.371e6 * math.hypot(east * math.cos(float(truth.lat[0])), north)
        return metres / math.hypot(fields["sigma_east_m"], fields["sigma_north_m"])


def muted_s(name: str, at_s: float, silent_s: float) -> float:
    """Return how much of a silence that ended within the last second is the instrument's own, s."""
    if name != Ping.__name__:
        return 0.0
    begin_s = at_s - at_s % CYCLE_S + STORMS[MUTE].begin_s
    end_s = begin_s + STORMS[MUTE].length_s
    return max(0.0, min(end_s, at_s) - max(begin_s, at_s - 1.0 - silent_s))


def resident_mb(pid: int) -> float:
    """Return the resident size of a process, MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Outcome(NamedTuple):
    """What an hour came to."""

    heard: Heard
    events: Counter[str]
    n_messages: int
    n_errors: int


def soak(minutes: float) -> Outcome:
    """Run it."""
    duration_s = 60.0 * minutes
    sim = simulate(stage_config(Stage(duration_s, ((0.0, duration_s),))))
    vehicle = vehicle_of(sim.mission)
    assert vehicle.initial is not None
    vehicle = replace(vehicle, initial=replace(vehicle.initial, time_s=EPOCH_S))
    context = multiprocessing.get_context("spawn")
    line, far_end = context.Pipe()
    dvl, clock = Dvl(), Clock(time.monotonic() + BEGINS_S)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        child = context.Process(target=navigate, args=(far_end, folder, vehicle, dvl.port, clock))
        child.start()
        assert child.pid is not None
        shore = Shore(dvl, dict(zip(Place, line.recv(), strict=True)))
        try:
            heard = Hour(sim, clock, shore, line).run(child.pid, duration_s)
            line.send("over")
            while len(told := line.recv()) != 2 or isinstance(told[1], dict):
                pass
            child.join()
        finally:
            child.kill()
            shore.close()
        lines = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
        return Outcome(heard, Counter(json.loads(x)["kind"] for x in lines), *told)


MUTE: Final = "hang-ups"
"""The DVL itself sends nothing while it blows."""
KINDS: Final = ("ImuSample", "Ping", "DepthReading", "Fix", "answers")
HEADER: Final = (
    "while",
    "what",
    "IMU",
    "DVL",
    "depth",
    "GNSS",
    "answers",
    "worst health",
    "inside",
)
QUIET: Final = "the rest of the time"
JUMP: Final = "the clock is set"


def spans() -> dict[str, tuple[float, float]]:
    """Return begin and end of each storm within the cycle, with what comes of it later."""
    found = {name: (x.begin_s, x.begin_s + x.length_s + AFTER_S) for name, x in STORMS.items()}
    last_s = JUMP_AT_S + JUMP_EVERY_S * (len(JUMPS) - 1)
    return {**found, JUMP: (JUMP_AT_S, last_s + AFTER_S)}


def rows(heard: Heard) -> list[list[str]]:
    """Return the table: of each storm the longest silences, s, and what the answers were worth."""
    about = {name: storm.about for name, storm in STORMS.items()}
    about[JUMP] = (
        f"of vehicle and instruments, by {', '.join(f'{x:+g}' for x in JUMPS)} s, one "
        f"{JUMP_EVERY_S:g} s after the other"
    )
    found = []
    for name, span in [*spans().items(), (QUIET, None)]:

        def is_in(at_s: float, span: tuple[float, float] | None = span) -> bool:
            within = at_s % CYCLE_S
            if span is None:
                return not any(low <= within < high for low, high in spans().values())
            return span[0] <= within < span[1]

        longest = [
            max(
                (s for at_s, kind, s in heard.silences if kind == wanted and is_in(at_s)), default=0
            )
            for wanted in KINDS
        ]
        answers = [(health, off) for at_s, health, off in heard.answers if is_in(at_s)]
        worst = max((x for x, _ in answers), key=list(WORSE).index, default=None)
        good = [off for health, off in answers if health is Health.GOOD]
        inside = f"{100 * np.mean(np.less(good, INSIDE)):.1f} %, {max(good):.1f} σ" if good else "–"
        found.append([
            name, about.get(name, ""), *(f"{s:.1f}" for s in longest),
            worst.name if worst else "–", inside,
        ])  # fmt: skip
    return found


def main() -> None:
    """Run the soak; write the page."""
    page = Report(__file__, "Soak at sockets", __doc__, Option("--minutes", 60.0, "of real time"))
    heard, events, n_messages, n_errors = soak(page.args.minutes)
    longest_s = max((s for _, _, s in heard.silences), default=math.inf)
    late = np.array([(at_s / 3600.0, mb) for at_s, mb in heard.rss if at_s >= WARM_S])
    growth = float(np.polyfit(late[:, 0], late[:, 1], 1)[0]) if len(late) > 10 else math.nan
    sizes = [mb for at_s, mb in heard.rss if at_s >= WARM_S] or [mb for _, mb in heard.rss]
    is_met = longest_s <= LOCKED_OUT_S and not abs(growth) > FLAT_MB_PER_H and not n_errors
    told = ", ".join(f"{kind} {n}" for kind, n in sorted(events.items()))
    page.write([
        f"{page.args.minutes:g} minutes in real time, {n_messages} messages. {LEGEND}",
        *table(HEADER, rows(heard)), "",
        f"Longest silence {longest_s:.1f} s (goal {LOCKED_OUT_S:g} s; the instruments themselves "
        f"were late by {heard.late_s:.2f} s at most). Resident size {sizes[0]:.0f} MB at first, "
        f"{max(sizes):.0f} at most, {sizes[-1]:.0f} at the end, {growth:+.2f} MB/h (goal "
        f"{FLAT_MB_PER_H:g}). Exceptions survived: {n_errors}.", "",
        f"Events told: {told}.", "", f"Goals {'met' if is_met else '**missed**'}.",
    ])  # fmt: skip
    note("all goals met" if is_met else "goals missed")


if __name__ == "__main__":
    main()
