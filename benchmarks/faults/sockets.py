"""The faults of connections: a real runner behind real sockets, on a clock that runs with the data.

One thread plays the instruments and the vehicle's computer in turn, so that minutes of a mission
take as long as their computing.
"""

from __future__ import annotations

import contextlib
import json
import math
import random
import socket
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks.faults.case import (
    LAG_S,
    Case,
    Look,
    Rule,
    Run,
    Sent,
    Stage,
    simulated_stage,
    stage_config,
    undisturbed_stream,
)
from benchmarks.faults.transforms import untouched
from ssm_graph.cli.online_run import engine_of
from ssm_graph.io.raw_log.log import replay
from ssm_graph.live.estimator import ONLINE
from ssm_graph.live.protocols.json_messages import JsonDecoder, encode_message
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.run.run_folder import LOG_NAME, RunFolder
from ssm_graph.live.run.runner import Connections, Runner, RunnerConfig
from ssm_graph.live.sockets.endpoints import LOOPBACK, Endpoint, Transport
from ssm_graph.live.sockets.inputs import TcpServerInput
from ssm_graph.live.sockets.outputs import OutputFormat, TcpServerOutput
from ssm_graph.live.sockets.sockets import InputConfig, OutputConfig, SocketHub
from ssm_graph.mission.navigation import Event, Health, Severity
from ssm_graph.mission.run_status import RunStatus
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.depth import DepthLog, DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message, Readings
from ssm_graph.simulation import DepthSettings, simulate

BEGIN_S: Final = 25.0
END_S: Final = 35.0
EPOCH_S: Final = 1_700_000_000.0
"""Unix time of the mission's begin: instruments stamp by UTC."""


class Dvl:
    """A Water Linked DVL: a server that takes one caller."""

    def __init__(self) -> None:
        self._client: socket.socket | None = None
        self._listener: socket.socket | None = None
        self.port = 0
        self.listen()

    @property
    def is_there(self) -> bool:
        """Whether it can be called."""
        return self._listener is not None

    def listen(self) -> None:
        """Take callers, at the same port as ever."""
        self._listener = socket.create_server((LOOPBACK, self.port))
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])

    def send(self, data: bytes) -> bool:
        """Send to the caller; return whether there is one."""
        if self._listener is not None and self._client is None:
            with contextlib.suppress(BlockingIOError):
                self._client, _ = self._listener.accept()
        if self._client is None:
            return False
        try:
            self._client.sendall(data)
        except OSError:
            self.hang_up()
            return False
        return True

    def hang_up(self) -> None:
        """End the call."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def vanish(self) -> None:
        """Hang up, and listen no more."""
        self.hang_up()
        if self._listener is not None:
            self._listener.close()
            self._listener = None


def report(ping: Ping) -> bytes:
    """Return a velocity report."""
    beams = [
        {"id": k, "velocity": v, "distance": 10.0, "rssi": -30.0, "nsd": -90.0, "beam_valid": True}
        for k, v in enumerate(ping.speed)
    ]
    fields = {
        "time": 106.0, "vx": 0.1, "vy": 0.0, "vz": 0.0, "fom": 0.002, "altitude": 9.2,
        "transducers": beams, "velocity_valid": True, "status": 0, "format": "json_v3.1",
        "type": "velocity", "time_of_validity": round(ping.time_s * 1e6),
    }  # fmt: skip
    return json.dumps(fields).encode() + b"\r\n"


@dataclass(slots=True)
class Vessel:
    """Everything around the runner."""

    hub: SocketHub
    dvl: Dvl
    others: socket.socket
    """Inertial data, depth and GNSS as JSON lines"""
    clients: list[socket.socket] = field(default_factory=list)
    rng: random.Random = field(default_factory=lambda: random.Random(0))
    n_lost: int = 0
    """Messages that nobody could receive"""
    n_extra: int = 0
    """Sound messages sent beyond the mission's"""

    def call(self, number: int = 0) -> socket.socket:
        """Call an output."""
        output = self.hub.outputs[number]
        assert isinstance(output, TcpServerOutput)
        client = socket.create_connection((LOOPBACK, output.port))
        self.clients.append(client)
        return client


Disturb = Callable[[Vessel, Sent], bool]
"""Does what it does before a message is sent, and returns whether that is sent still."""


def during(act: Disturb) -> Disturb:
    """Disturb between begin and end only."""
    return lambda vessel, sent: act(vessel, sent) if BEGIN_S <= sent.true_s < END_S else True


def vanishing(vessel: Vessel, sent: Sent) -> bool:
    """Let the DVL vanish, and return."""
    dvl = vessel.dvl
    if BEGIN_S <= sent.true_s < END_S:
        dvl.vanish()
    elif not dvl.is_there:
        dvl.listen()
    return True


def garbage(vessel: Vessel, sent: Sent) -> bool:
    """Send random bytes before each report."""
    if isinstance(sent.message, Ping):
        vessel.dvl.send(vessel.rng.randbytes(5000) + b"\r\n")
    return True


def halves(vessel: Vessel, sent: Sent) -> bool:
    """Cut a report off, hang up, and be called again; every other one."""
    message = sent.message
    if isinstance(message, Ping) and round(2.0 * sent.true_s) % 2:
        data = report(replace(message, time_s=message.time_s + EPOCH_S))
        vessel.dvl.send(data[: len(data) // 2])
        vessel.dvl.hang_up()
        vessel.n_lost += 1
        return False
    return True


def reports_flood(vessel: Vessel, sent: Sent) -> bool:
    """Send each report 100 times."""
    if isinstance(sent.message, Ping):
        data = report(replace(sent.message, time_s=sent.message.time_s + EPOCH_S))
        vessel.dvl.send(99 * data)
    return True


def messages_flood(eager: Callable[[], DepthLog]) -> Disturb:
    """Send the readings of a far too eager depth sensor with the inertial samples."""

    def flood(vessel: Vessel, sent: Sent) -> bool:
        if isinstance(sent.message, ImuSample):
            depths = eager()
            end = int(np.searchsorted(depths.time_s, sent.true_s))
            begin = int(np.searchsorted(depths.time_s, sent.true_s - 0.01))
            lines = [
                encode_message(DepthReading(EPOCH_S + depths.time_s[k], depths.depth[k]))
                for k in range(begin, end)
            ]
            vessel.others.sendall(b"".join(lines))
            vessel.n_extra += len(lines)
        return True

    return flood


def strange_depths(vessel: Vessel, sent: Sent) -> bool:
    """Have a client of the same port send false depths with the inertial samples."""
    if isinstance(sent.message, ImuSample):
        if not vessel.clients:
            vessel.clients.append(socket.create_connection(vessel.others.getpeername()))
        time_s = EPOCH_S + sent.true_s
        lines = (encode_message(DepthReading(time_s - 1e-4 * k, 20.0)) for k in range(100))
        vessel.clients[0].sendall(b"".join(lines))
    return True


def deaf_client(vessel: Vessel, sent: Sent) -> bool:
    """Call both outputs once, and never read."""
    if not vessel.clients and sent.true_s >= BEGIN_S:
        for number in (0, 1):
            vessel.call(number).setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    return True


def leaving_clients(vessel: Vessel, sent: Sent) -> bool:
    """Call and hang up, with each ping."""
    if isinstance(sent.message, Ping):
        vessel.call().close()
    return True


def nothing(vessel: Vessel, sent: Sent) -> bool:
    """Do nothing: the fault is elsewhere."""
    del vessel, sent
    return True


STAGE: Final = Stage(duration_s=60.0, gnss=((0.0, 20.0),))


@cache
def eager_depths() -> DepthLog:
    """Return what the mission's depth sensor would read 10 000 times a second."""
    config = replace(stage_config(STAGE), depth=DepthSettings(rate_hz=1e4))
    depths = simulate(config).mission.depth
    assert depths is not None
    return depths


class SocketFault(NamedTuple):
    """A row."""

    injected: str
    disturb: Disturb
    rule: Rule = Rule()
    end_s: float = END_S


_SPAN: Final = f"{BEGIN_S:.0f} to {END_S:.0f} s"
FAULTS: Final = {
    "DVL server vanishes": SocketFault(
        f"{_SPAN}, over TCP", vanishing, Rule(Health.DEGRADED, 5.0, told="connection_lost"),
    ),
    "garbage on the DVL's socket": SocketFault(
        f"5000 random bytes before each report, {_SPAN}", during(garbage),
        Rule(told="message_refused", good_after_s=5.0),
    ),
    "half reports": SocketFault(
        f"every other report is cut off and the connection lost, {_SPAN}", during(halves),
        Rule(good_after_s=15.0),
    ),
    "reports 100 times": SocketFault(
        f"each, over TCP, {_SPAN}", during(reports_flood), Rule(good_after_s=5.0),
    ),
    "messages at 100 times the rate": SocketFault(
        f"10 000 depths/s more on the socket of the inertial data, {_SPAN}",
        during(messages_flood(eager_depths)), Rule(told="rate_limited", good_after_s=25.0),
    ),
    "depths of a stranger": SocketFault(
        f"10 000 false depths/s from another client at the port of the inertial data, {_SPAN}",
        during(strange_depths), Rule(told="second_source", good_after_s=5.0),
    ),
    "a client that never reads": SocketFault(
        f"one at each output, from {BEGIN_S:.0f} s on", deaf_client, Rule(good_after_s=5.0),
    ),
    "clients that leave": SocketFault(
        f"one calls and leaves twice a second, {_SPAN}", during(leaving_clients)
    ),
    "an output that is gone": SocketFault(
        "answers by UDP to a port where nobody listens, all the time", nothing,
        Rule(good_after_s=5.0),
    ),
}  # fmt: skip
SOCKET_CASES: Final = tuple(FAULTS)


class Voyage:
    """The mission's messages over sockets: the source that the runner polls."""

    def __init__(self, disturb: Disturb) -> None:
        self._stream = iter(undisturbed_stream(STAGE))
        self._next: Sent | None = next(self._stream)
        self._disturb = disturb
        self.elapsed_s = 0.0
        self.n_sent = 0
        dvl = Dvl()
        dvl_at = Endpoint(Transport.TCP_CLIENT, LOOPBACK, dvl.port)
        others_at = Endpoint(Transport.TCP_SERVER, LOOPBACK, 0)
        outputs = [
            OutputConfig(OutputFormat.JSON, others_at),
            OutputConfig(OutputFormat.NMEA, others_at),
            OutputConfig(OutputFormat.JSON, Endpoint(Transport.UDP, LOOPBACK, 9)),
        ]
        inputs = [
            InputConfig("dvl", dvl_at, WaterLinkedDecoder),
            InputConfig("messages", others_at, JsonDecoder),
        ]
        hub = SocketHub(
            inputs,
            outputs,
            wall_s=lambda: EPOCH_S + self.elapsed_s,
            steady_s=lambda: self.elapsed_s,
        )
        self.take_events, self.source_status = hub.take_events, hub.source_status
        messages_in = hub.inputs[1]
        assert isinstance(messages_in, TcpServerInput)
        others = socket.create_connection((LOOPBACK, messages_in.port))
        self.vessel = Vessel(hub, dvl, others)
        for _ in range(10):
            hub.poll(0.002)

    @property
    def is_finished(self) -> bool:
        """Whether the mission is over."""
        return self._next is None

    @property
    def time_s(self) -> float:
        """The vehicle's clock, s."""
        return EPOCH_S + self.elapsed_s

    def waiting(self) -> list[Readings]:
        """Return what has come and waits."""
        return self.vessel.hub.waiting()

    def end(self) -> list[Message]:
        """Return what waits when the run ends."""
        return self.vessel.hub.end()

    def poll(self, timeout_s: float) -> list[Message]:
        """Send all messages up to the next inertial sample and receive what comes of it."""
        del timeout_s
        n_expected = 0
        while self._next is not None:
            sent, self._next = self._next, next(self._stream, None)
            self.elapsed_s = sent.true_s
            n_expected += self._send(sent)
            if self._next is not None and isinstance(self._next.message, ImuSample):
                break
        received: list[Message] = []
        for _ in range(20):
            received += self.vessel.hub.poll(0.002 if len(received) < n_expected else 0.0)
            if len(received) >= n_expected:
                break
        return received

    def _send(self, sent: Sent) -> bool:
        if not self._disturb(self.vessel, sent):
            return False
        message = replace(sent.message, time_s=sent.message.time_s + EPOCH_S)
        if isinstance(message, Ping):
            is_received = self.vessel.dvl.send(report(message))
        else:
            self.vessel.others.sendall(encode_message(message))
            is_received = True
        self.n_sent += is_received
        self.vessel.n_lost += not is_received
        return is_received

    def close(self) -> None:
        """Close everything."""
        self.vessel.hub.close()
        self.vessel.dvl.vanish()
        for sock in (self.vessel.others, *self.vessel.clients):
            sock.close()


def run_socket_case(name: str) -> tuple[Case, Run]:
    """Run a fault; return it as a case of the table, with its times as in the mission."""
    fault = FAULTS[name]
    case = Case(
        name, fault.injected, untouched, fault.rule, BEGIN_S, fault.end_s,
        stage=STAGE,
    )  # fmt: skip
    voyage = Voyage(fault.disturb)
    with tempfile.TemporaryDirectory() as folder:
        try:
            return case, _run(voyage, Path(folder) / "run", _vehicle())
        finally:
            voyage.close()


def _vehicle() -> Vehicle:
    vehicle = simulated_stage(STAGE)[1]
    assert vehicle.initial is not None
    return replace(vehicle, initial=replace(vehicle.initial, time_s=EPOCH_S))


def _run(voyage: Voyage, folder: Path, vehicle: Vehicle) -> Run:
    looks: list[Look] = []

    def look(status: RunStatus) -> None:
        navigation = status.navigation
        if navigation is None:
            looks.append(Look(voyage.elapsed_s, Health.ALIGNING, status.reason, None))
        else:
            navigation = replace(navigation, time_s=navigation.time_s - EPOCH_S)
            looks.append(Look(voyage.elapsed_s, navigation.health, navigation.reason, navigation))

    runner = Runner(
        RunFolder(folder, vehicle, {}),
        engine_of(vehicle, replace(ONLINE, lag_s=LAG_S)),
        lambda n: Connections(voyage, voyage.vessel.hub),  # noqa: ARG005
        config=RunnerConfig(),
        on_status=look,
        steady_s=lambda: voyage.elapsed_s,
    )
    end = runner.run()
    events = tuple(_events(folder))
    failures = [f"{x.kind}: {x.text}" for x in events if x.kind in DEFECTS]
    failures += [] if end.reason.name == "SOURCE_ENDED" else [end.reason.value]
    n_logged = sum(1 for _ in replay(folder / LOG_NAME, vehicle, {}))
    return Run(
        looks,
        events,
        _counts(voyage, runner),
        max(_n_received(voyage) - n_logged, 0),
        "; ".join(failures) or None,
    )


_PARTS = "socket decoder log estimator publish results status checkpoint"
DEFECTS: Final = {f"{part}_failed" for part in _PARTS.split()}


def _n_received(voyage: Voyage) -> int:
    """Return how many sound messages were received and not told as left out."""
    sources = voyage.source_status()
    return voyage.n_sent + voyage.vessel.n_extra - sum(s.n_limited for s in sources)


def _counts(voyage: Voyage, runner: Runner) -> dict[str, int]:
    """Return what was lost where."""
    found = {"never received": voyage.vessel.n_lost}
    for source in voyage.source_status():
        found[f"{source.name} refused"] = source.n_refused
        found[f"{source.name} over the limit"] = source.n_limited
    for output in voyage.vessel.hub.output_status():
        found[f"{output.name} answers dropped"] = output.n_dropped
    estimator: Any = runner._estimator
    return {name: n for name, n in {**found, **estimator.counts}.items() if n}


def _events(folder: Path) -> list[Event]:
    lines = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
    found = [json.loads(line) for line in lines]
    return [
        Event(float(x["time_s"] or math.nan), Severity(x["severity"]), x["kind"], x["text"])
        for x in found
    ]
