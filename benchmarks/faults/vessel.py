"""What is around a live run in the table of faults: a DVL, clients, and what they do wrong."""

from __future__ import annotations

import contextlib
import json
import random
import socket
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from benchmarks.faults.case import Sent
from ssm_graph.live.protocols.json_messages import encode_message
from ssm_graph.live.sockets.endpoints import LOOPBACK
from ssm_graph.live.sockets.outputs import TcpServerOutput
from ssm_graph.live.sockets.sockets import SocketHub
from ssm_graph.sensors.depth import DepthLog, DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import ImuSample

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
