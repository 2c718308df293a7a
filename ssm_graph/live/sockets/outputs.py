"""Answers on their way out: each form at its own rate, as datagrams and to clients of a server.

Nobody who is slow holds anything up.
"""

from __future__ import annotations

import selectors
import socket
from abc import ABC, abstractmethod
from dataclasses import replace
from enum import Enum
from typing import Final, Protocol

from ssm_graph.base.errors import ConfigError
from ssm_graph.live.protocols.json_messages import encode_navigation
from ssm_graph.live.protocols.nmea_out import encode_nmea
from ssm_graph.live.sockets.clocks import Now
from ssm_graph.live.sockets.endpoints import Endpoint, Listener, let_go, received, resolve
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.navigation import Health, Navigation, Severity
from ssm_graph.mission.run_status import OutputStatus

MAX_CLIENTS: Final = 8
MAX_WAITING: Final = 64 * 1024
"""Bytes that wait for a client, besides as many in the system; one who is slower is dropped."""
STAY_S: Final = 2.0
"""Nobody makes room for another client before."""
BEHIND: Final = (
    "this process stood still and works through what came meanwhile: the answer is of the time "
    "that it is stamped with"
)
BEHIND_CONFIDENCE: Final = 0.45
_ROUNDING: Final = 1e-6
"""Of a period: sampling times are not exact."""


class OutputFormat(Enum):
    """How answers are written; the value is shown to the user."""

    JSON = "json"
    NMEA = "nmea"


class Output(ABC):
    """One place that answers go to."""

    def __init__(self, form: OutputFormat, address: str, events: EventLog) -> None:
        self.form, self.address, self.name = form, address, address
        self._events = events
        self._n_sent = self._n_dropped = 0

    @property
    @abstractmethod
    def n_clients(self) -> int:
        """How many listen, as far as that can be known."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send whole messages, or drop them; never waits."""

    def tick(self, now: Now) -> None:  # noqa: B027
        """Look after what time brings."""

    @abstractmethod
    def close(self) -> None:
        """Close all sockets."""

    def status(self) -> OutputStatus:
        """Return how it is doing."""
        return OutputStatus(
            self.form.value, self.address, self.n_clients, self._n_sent, self._n_dropped
        )

    def tell(self, kind: str, text: str, severity: Severity) -> None:
        """Note an event about this output."""
        self._events.note(f"{self.form.value} to {self.address}", kind, text, severity)


class UdpOutput(Output):
    """Datagrams to one place, whether or not somebody listens there."""

    n_clients = 1

    def __init__(self, form: OutputFormat, endpoint: Endpoint, events: EventLog) -> None:
        super().__init__(form, str(endpoint), events)
        family, self._target = resolve(endpoint)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, data: bytes) -> None:
        """Send one datagram."""
        try:
            self._socket.sendto(data, self._target)
            self._n_sent += 1
        except OSError as error:
            self._n_dropped += 1
            self.tell("send_failed", error.strerror or str(error), Severity.WARNING)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpServerOutput(Output):
    """Clients that call; what they say is not looked at."""

    def __init__(
        self,
        form: OutputFormat,
        endpoint: Endpoint,
        events: EventLog,
        selector: selectors.BaseSelector,
    ) -> None:
        super().__init__(form, str(endpoint), events)
        self._selector = selector
        self._waiting: dict[socket.socket, bytearray] = {}
        self._since_s: dict[socket.socket, float] = {}
        self._listener = Listener(endpoint, selector, self, most=MAX_CLIENTS, tell=self.tell)
        self.port = self._listener.port

    @property
    def n_clients(self) -> int:
        """How many listen."""
        return len(self._waiting)

    def send(self, data: bytes) -> None:
        """Send to all; drop who has too much before him."""
        for client, waiting in list(self._waiting.items()):
            waiting += data
            self._flush(client, waiting)
            if len(waiting) > MAX_WAITING:
                self._n_dropped += 1
                self._drop(client, f"reads too slowly: {len(waiting)} bytes wait for it, dropped")
            else:
                self._n_sent += 1

    def on_ready(self, ready: socket.socket, mask: int, now: Now) -> None:
        """Take a client, write what waits, see who has gone."""
        if ready is self._listener.socket:
            self._accept(now)
            return
        waiting = self._waiting.get(ready)
        if waiting is not None and mask & selectors.EVENT_WRITE:
            self._flush(ready, waiting)
        if ready in self._waiting and mask & selectors.EVENT_READ:
            why = received(ready)
            if isinstance(why, str):
                self._drop(ready, why, Severity.INFO)

    def tick(self, now: Now) -> None:
        """Listen again after there was no room."""
        self._listener.tick(now.steady_s)

    def abandon(self, sock: socket.socket) -> None:
        """Drop a client."""
        if sock in self._waiting:
            self._drop(sock, "dropped after a defect")
        elif sock in self._selector.get_map():
            self._selector.unregister(sock)

    def close(self) -> None:
        """Send what can be sent at once, and hang up."""
        for client, waiting in list(self._waiting.items()):
            self._flush(client, waiting)
            if client in self._waiting:
                self._drop(client, "the run has ended", Severity.INFO)
        self._listener.close()

    def _accept(self, now: Now) -> None:
        old = [x for x, since_s in self._since_s.items() if now.steady_s - since_s > STAY_S]
        client = self._listener.accept(now.steady_s, len(self._waiting) - bool(old))
        if client is None:
            return
        if len(self._waiting) >= MAX_CLIENTS:
            # Who reads and who does not cannot be told apart before answers wait for him.
            oldest = min(old, key=lambda x: (not self._waiting[x], self._since_s[x]))
            self._drop(oldest, f"made room: there are {MAX_CLIENTS} already, it was the oldest")
        self._since_s[client] = now.steady_s
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_WAITING)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._waiting[client] = bytearray()
        self._selector.register(client, selectors.EVENT_READ, self)

    def _flush(self, client: socket.socket, waiting: bytearray) -> None:
        try:
            while waiting:
                del waiting[: client.send(waiting)]
        except (BlockingIOError, InterruptedError):
            pass
        except OSError as error:
            self._drop(client, error.strerror or str(error), Severity.INFO)
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if waiting else 0)
        self._selector.modify(client, wanted, self)

    def _drop(self, client: socket.socket, why: str, severity: Severity = Severity.WARNING) -> None:
        self._waiting.pop(client, None)
        self._since_s.pop(client, None)
        let_go(client, self._selector)
        self.tell("client_lost", f"a client: {why}", severity)


class Outlet(Protocol):
    """Takes answers as bytes, in the forms that somebody wants, and says how they are doing."""

    @property
    def set_by_s(self) -> float: ...  # noqa: D102
    @property
    def is_behind(self) -> bool: ...  # noqa: D102
    def wants(self, form: OutputFormat) -> bool: ...  # noqa: D102
    def send(self, form: OutputFormat, data: bytes) -> None: ...  # noqa: D102
    def output_status(self) -> tuple[OutputStatus, ...]: ...  # noqa: D102


class Every:
    """Says when something is due again; a clock that was set begins anew."""

    def __init__(self, period_s: float, *, at_once: bool = False) -> None:
        self._period_s, self._at_once = period_s, at_once
        self._last_s: float | None = None

    def is_due(self, now_s: float) -> bool:
        """Return whether it is due now, and take it as done."""
        if self._last_s is None:
            self._last_s = now_s
            return self._at_once
        if abs(now_s - self._last_s) < self._period_s * (1.0 - _ROUNDING):
            return False
        self._last_s = now_s
        return True


class Publisher:
    """Sends the newest answer, in every form that somebody listens to.

    JSON lines and NMEA sentences go at most so often, in the time of the run.
    """

    def __init__(
        self, *, rate_hz: float = 50.0, nmea_rate_hz: float = 1.0, geoid_separation_m: float = 0.0
    ) -> None:
        for name, rate in (("output rate", rate_hz), ("NMEA rate", nmea_rate_hz)):
            if not 0.0 < rate < float("inf"):
                raise ConfigError(f"{name}: expected a number above 0 Hz, got {rate}")
        self._geoid_separation_m = geoid_separation_m
        self._dues = {
            OutputFormat.JSON: Every(1.0 / rate_hz, at_once=True),
            OutputFormat.NMEA: Every(1.0 / nmea_rate_hz, at_once=True),
        }

    def due(self, outlet: Outlet, now_s: float) -> list[OutputFormat]:
        """Return the forms in which an answer is due and wanted."""
        return [
            form for form, every in self._dues.items() if outlet.wants(form) and every.is_due(now_s)
        ]

    def send(self, outlet: Outlet, form: OutputFormat, navigation: Navigation) -> None:
        """Send one answer in one form, stamped by the vehicle's clock; it is not good if old."""
        if outlet.is_behind and navigation.health is Health.GOOD:
            navigation = replace(
                navigation, health=Health.DEGRADED, reason=BEHIND, confidence=BEHIND_CONFIDENCE
            )
        set_by_s = outlet.set_by_s
        if form is OutputFormat.JSON:
            outlet.send(form, encode_navigation(navigation, set_by_s=set_by_s))
        else:
            navigation = replace(navigation, time_s=navigation.time_s + set_by_s)
            separation_m = self._geoid_separation_m
            outlet.send(form, encode_nmea(navigation, geoid_separation_m=separation_m))
