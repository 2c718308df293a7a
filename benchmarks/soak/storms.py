"""What disturbs the sockets of a live run: floods, slow and silent clients, callers without end."""

from __future__ import annotations

import contextlib
import random
import socket
from collections.abc import Callable, Iterator
from dataclasses import replace
from enum import Enum
from itertools import count
from typing import Final, NamedTuple

from benchmarks.faults.sockets import Dvl, report
from ssm_graph.live.protocols.json_messages import encode_message
from ssm_graph.live.sockets.endpoints import CHUNK, LOOPBACK
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import ImuSample

TICK_S: Final = 0.01
"""From one turn of a storm to the next, s."""
N_CLIENTS: Final = 8
"""As many as an output takes, and more than an input does."""


class Place(Enum):
    """A port of the run."""

    IMU = "inertial data, TCP"
    MESSAGES = "depth and GNSS, UDP"
    JSON = "answers as JSON, TCP"
    NMEA = "answers as NMEA, TCP"


class Caller:
    """A sound client that calls again at once where it was hung up on; never waits."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._socket: socket.socket | None = None
        self._waiting, self._rest = bytearray(), b""

    def send(self, data: bytes) -> None:
        """Send, or have it wait."""
        self._waiting += data
        with self._answering():
            while self._waiting:
                del self._waiting[: self._called().send(self._waiting)]

    def lines(self) -> list[bytes]:
        """Return the lines that have come."""
        with self._answering():
            while data := self._called().recv(CHUNK):
                self._rest += data
            self.hang_up()
        *lines, self._rest = self._rest.split(b"\n")
        return lines

    def hang_up(self) -> None:
        """End the call; what waits is lost, as its socket is."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._rest = None, b""
        self._waiting.clear()

    def _called(self) -> socket.socket:
        """Return the connection, made anew where there is none."""
        if self._socket is None:
            self._socket = calling(self._port)
        return self._socket

    @contextlib.contextmanager
    def _answering(self) -> Iterator[None]:
        """Go on after what is done here where nobody answers; who hung up is called anew."""
        try:
            yield
        except BlockingIOError:
            pass
        except OSError:
            self.hang_up()


class Shore:
    """Everything around the run that a storm may touch."""

    def __init__(self, dvl: Dvl, ports: dict[Place, int]) -> None:
        self.dvl, self.ports, self.rng = dvl, ports, random.Random(0)
        self.imu, self.reader = Caller(ports[Place.IMU]), Caller(ports[Place.JSON])
        self.datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.stray = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.last_imu: ImuSample | None = None
        self.last_ping: Ping | None = None

    def send_to(self, sock: socket.socket, data: bytes) -> None:
        """Send a datagram to the port of depth and GNSS."""
        with contextlib.suppress(OSError):
            sock.sendto(data, (LOOPBACK, self.ports[Place.MESSAGES]))

    def close(self) -> None:
        """Close all sockets."""
        self.imu.hang_up()
        self.reader.hang_up()
        self.dvl.vanish()
        self.datagrams.close()
        self.stray.close()


def calling(port: int) -> socket.socket:
    """Return a connection that nobody waits for."""
    sock = socket.create_connection((LOOPBACK, port), timeout=1.0)
    sock.setblocking(False)
    return sock


class Crowd:
    """Clients of one port that send what they are told, and are replaced where they are dropped."""

    def __init__(self, port: int, n_clients: int = 1) -> None:
        self._port = port
        self._clients: list[socket.socket | None] = [None] * n_clients

    def send(self, data: bytes) -> None:
        """Send from each, as much as can be sent at once; who was dropped calls again."""
        for k, client in enumerate(self._clients):
            try:
                if client is None:
                    client = self._clients[k] = calling(self._port)
                if data:
                    client.send(data)
            except BlockingIOError:
                pass
            except OSError:
                self._clients[k] = None
                if client is not None:
                    client.close()

    def hang_up(self) -> None:
        """All end their calls."""
        for client in self._clients:
            if client is not None:
                client.close()


def every(period_s: float) -> Iterator[bool]:
    """Return at each tick whether so long has passed, the first time after half of it."""
    ticks = max(1, round(period_s / TICK_S))
    return (k % ticks == ticks // 2 for k in count())


def crowding(
    place: Place, n_clients: int, period_s: float, data: Callable[[Shore], bytes], again_s: float
) -> Callable[[Shore], Iterator[None]]:
    """Return a storm of clients that send data once in a period.

    The sound client of the place hangs up and calls anew once in ``again_s``.
    """

    def blow(shore: Shore) -> Iterator[None]:
        crowd = Crowd(shore.ports[place], n_clients)
        try:
            for is_due, is_again in zip(every(period_s), every(again_s), strict=False):
                if is_due:
                    crowd.send(data(shore))
                if is_again:
                    (shore.imu if place is Place.IMU else shore.reader).hang_up()
                yield
        finally:
            crowd.hang_up()

    return blow


def depth_flood(shore: Shore) -> bytes:
    """Return 100 sound messages of the present."""
    last = shore.last_imu
    time_s = 0.0 if last is None else last.time_s
    return b"".join(encode_message(DepthReading(time_s + 1e-5 * k, 20.0)) for k in range(100))


def bomb(shore: Shore) -> bytes:
    """Return what costs a careless reader most: nesting, digits, an endless line."""
    return shore.rng.choice((b'{"a":' * 8000, b"[" * 60_000 + b"\n", b'{"t": ' + b"9" * 50_000))


def calls(shore: Shore) -> Iterator[None]:
    """Call and leave all TCP ports, 25 times a second."""
    for is_due in every(0.04):
        if is_due:
            for place in (Place.IMU, Place.JSON, Place.NMEA):
                with contextlib.suppress(OSError):
                    calling(shore.ports[place]).close()
        yield


def hang_ups(shore: Shore) -> Iterator[None]:
    """Let the DVL hang up as soon as it is called."""
    for _ in count():
        shore.dvl.send(b"")
        shore.dvl.hang_up()
        yield


def datagrams(shore: Shore) -> Iterator[None]:
    """Send random datagrams of 500 bytes, 2000 a second, to the port of depth and GNSS."""
    for _ in count():
        for _ in range(20):
            shore.send_to(shore.stray, shore.rng.randbytes(500))
        yield


def strays(shore: Shore) -> Iterator[None]:
    """Send twenty samples of another clock in one datagram, once a second."""
    for is_due in every(1.0):
        last = shore.last_imu
        if is_due and last is not None:
            lines = [replace(last, time_s=last.time_s - 1000.0 + 0.01 * k) for k in range(20)]
            shore.send_to(shore.stray, b"".join(map(encode_message, lines)))
        yield


def repeats(shore: Shore) -> Iterator[None]:
    """Repeat the last report of the DVL 500 times a second."""
    for _ in count():
        if shore.last_ping is not None:
            shore.dvl.send(5 * report(shore.last_ping))
        yield


class Storm(NamedTuple):
    """When in the cycle what blows."""

    begin_s: float
    length_s: float
    blow: Callable[[Shore], Iterator[None]]
    about: str


_BYTE: Final = lambda shore: b"{"  # noqa: E731, ARG005
_NOTHING: Final = lambda shore: b""  # noqa: E731, ARG005
_NOISE: Final = lambda shore: shore.rng.randbytes(10_000)  # noqa: E731
STORMS: Final = {
    "byte dribblers": Storm(
        30.0, 50.0, crowding(Place.IMU, 4, 0.5, _BYTE, 15.0),
        "four clients at the IMU's port send a byte every half second; the IMU calls anew",
    ),
    "idle senders": Storm(
        90.0, 30.0, crowding(Place.IMU, N_CLIENTS, 0.1, _NOTHING, 10.0),
        "eight clients at the IMU's port say nothing and call again; the IMU calls anew",
    ),
    "idle readers": Storm(
        140.0, 50.0, crowding(Place.JSON, N_CLIENTS, 0.1, _NOTHING, 15.0),
        "eight clients of the answers never read and call again; the sound one calls anew",
    ),
    "noise": Storm(
        200.0, 30.0, crowding(Place.IMU, 1, 0.01, _NOISE, 10.0),
        "random bytes at the IMU's port, 1 MB/s; the IMU calls anew",
    ),
    "messages": Storm(
        240.0, 30.0, crowding(Place.IMU, 1, 0.01, depth_flood, 1e9),
        "10 000 sound depths a second at the IMU's port, from another client",
    ),
    "bombs": Storm(
        280.0, 30.0, crowding(Place.IMU, 3, 0.1, bomb, 10.0),
        "nesting, digits and endless lines from three clients at the IMU's port; it calls anew",
    ),
    "datagrams": Storm(
        320.0, 30.0, datagrams, "2000 random datagrams a second, 1 MB/s, where depth and GNSS come"
    ),
    "strays": Storm(
        360.0, 30.0, strays, "twenty samples of another clock in one datagram, once a second"
    ),
    "calls": Storm(400.0, 30.0, calls, "all TCP ports are called and left 25 times a second"),
    "hang-ups": Storm(
        440.0, 20.0, hang_ups, "the DVL hangs up as soon as it is called; counted from the end on"
    ),
    "repeats": Storm(480.0, 30.0, repeats, "the last report of the DVL again, 500 times a second"),
}  # fmt: skip
