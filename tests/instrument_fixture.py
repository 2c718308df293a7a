"""Simulated instruments on loopback: a Water Linked A50, NMEA and JSON over UDP."""

from __future__ import annotations

import json
import math
import socket
import time
from collections.abc import Callable
from typing import Any

from ssm_graph.io.nmea_sentences import checksum
from ssm_graph.live.sockets.sockets import SocketHub
from ssm_graph.mission.navigation import Event
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.messages import Message

DEADLINE_S = 5.0
"""So long a test waits for what should come at once."""


class A50:
    """A DVL that serves its reports over TCP, and everything that it may do wrong.

    ``on_idle`` is called while it waits for a caller, so that one thread can be both sides.
    """

    def __init__(self, port: int = 0, *, on_idle: Callable[[], object] = lambda: None) -> None:
        self._on_idle = on_idle
        self._client: socket.socket | None = None
        self._listener: socket.socket | None = None
        self.port = port
        self.come_back()

    def come_back(self) -> None:
        """Listen, at the same port as ever."""
        self._listener = socket.create_server(("127.0.0.1", self.port))
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])

    def accept(self) -> None:
        """Wait for a caller."""
        assert self._listener is not None
        end_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < end_s:
            self._on_idle()
            try:
                client, _ = self._listener.accept()
            except BlockingIOError:
                continue
            client.setblocking(True)
            client.settimeout(DEADLINE_S)
            self.drop()
            self._client = client
            return
        raise AssertionError("nobody has called")

    def send(self, ping: Ping) -> None:
        """Send a report as it should be."""
        self.send_bytes(report(ping))

    def send_bytes(self, data: bytes) -> None:
        """Send whatever it is: half a report, garbage."""
        assert self._client is not None
        self._client.sendall(data)

    def drop(self) -> None:
        """Hang up."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def vanish(self) -> None:
        """Hang up, and listen no more."""
        self.drop()
        if self._listener is not None:
            self._listener.close()
            self._listener = None


def report(ping: Ping, **changes: Any) -> bytes:
    """Return a velocity report of format ``json_v3``, one line."""
    beams = [
        {
            "id": k,
            "velocity": 0.0 if math.isnan(speed) else speed,
            "distance": 10.0,
            "rssi": -30.0,
            "nsd": -90.0,
            "beam_valid": not math.isnan(speed),
        }
        for k, speed in enumerate(ping.speed)
    ]
    is_valid = sum(not math.isnan(speed) for speed in ping.speed) >= 3
    fields = {
        "time": 106.0,
        "vx": 0.1,
        "vy": 0.0,
        "vz": 0.0,
        "fom": 0.002,
        "altitude": 9.2 if is_valid else -1.0,
        "transducers": beams,
        "velocity_valid": is_valid,
        "status": 0,
        "format": "json_v3.1",
        "type": "velocity",
        "time_of_validity": round(ping.time_s * 1e6),
    }
    return json.dumps({**fields, **changes}).encode() + b"\r\n"


def gga(fix: Fix) -> bytes:
    """Return a fix as GGA and GST of the same time of day."""
    day_s = fix.time_s % 86400.0
    utc = f"{int(day_s // 3600):02d}{int(day_s // 60 % 60):02d}{day_s % 60:09.6f}"
    lat, lon = (_angle(angle, width) for angle, width in ((fix.lat, 2), (fix.lon, 3)))
    ns, ew = "N" if fix.lat >= 0.0 else "S", "E" if fix.lon >= 0.0 else "W"
    east, north, up = fix.sigma_enu
    return _sentence(
        f"GPGGA,{utc},{lat},{ns},{lon},{ew},4,12,0.6,{fix.height - 40.0:.4f},M,40.0,M,,"
    ) + _sentence(f"GPGST,{utc},,,,,{north:.4f},{east:.4f},{up:.4f}")


def pips(reading: DepthReading) -> bytes:
    """Return a depth below the ellipsoid, as if that were the surface."""
    return _sentence(f"PIPS,{reading.depth:.5f},M")


class UdpSender:
    """Sends datagrams to a port of this computer."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))

    def send(self, data: bytes) -> None:
        """Send one datagram."""
        self._socket.send(data)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Receiver:
    """What a hub has received while it was polled until something was there."""

    def __init__(self, hub: SocketHub, *, after_poll: Callable[[], object] = lambda: None) -> None:
        self.hub = hub
        self.messages: list[Message] = []
        self.events: list[Event] = []
        self._after_poll = after_poll

    def poll(self, timeout_s: float = 0.005) -> None:
        """Poll once."""
        self.messages += self.hub.poll(timeout_s)
        self.events += self.hub.take_events()
        self._after_poll()

    def until(self, is_there: Callable[[], object], what: str = "") -> None:
        """Poll until something is the case; fail where it does not come to that."""
        end_s = time.monotonic() + DEADLINE_S
        while not is_there():
            assert time.monotonic() < end_s, f"{what or 'it'} did not come about: {self.events}"
            self.poll()

    @property
    def kinds(self) -> list[str]:
        """The kinds of the events, in order."""
        return [event.kind for event in self.events]


def free_port() -> int:
    """Return a TCP port that was free a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def _sentence(body: str) -> bytes:
    return f"${body}*{checksum(body)}\r\n".encode("ascii")


def _angle(angle: float, width: int) -> str:
    minutes = abs(math.degrees(angle)) * 60.0
    return f"{int(minutes // 60):0{width}d}{minutes % 60.0:011.8f}"
