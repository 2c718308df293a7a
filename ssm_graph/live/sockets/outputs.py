"""Where answers go: datagrams, and clients of a server; nobody who is slow holds anything up."""

from __future__ import annotations

import selectors
import socket
from abc import ABC, abstractmethod
from enum import Enum
from typing import Final

from ssm_graph.live.run.feed import CHUNK, Now
from ssm_graph.live.run.notices import Notices
from ssm_graph.live.sockets.endpoints import Endpoint, resolve
from ssm_graph.live.sockets.listeners import bound
from ssm_graph.mission.navigation import Severity
from ssm_graph.mission.run_status import OutputStatus

MAX_CLIENTS: Final = 8
MAX_WAITING: Final = 64 * 1024
"""Bytes that wait for a client, besides as many in the system; one who is slower is dropped."""
_ACCEPT_PAUSE_S: Final = 1.0


class OutputFormat(Enum):
    """How answers are written; the value is shown to the user."""

    JSON = "json"
    NMEA = "nmea"


class Output(ABC):
    """One place that answers go to."""

    def __init__(self, form: OutputFormat, address: str, notices: Notices) -> None:
        self.form, self.address = form, address
        self._notices = notices
        self._n_sent = self._n_dropped = 0

    @property
    @abstractmethod
    def n_clients(self) -> int:
        """How many listen, as far as that can be known."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send whole messages, or drop them; never waits."""

    @abstractmethod
    def on_ready(self, ready: socket.socket, mask: int, now: Now) -> None:
        """Look after a socket that can be read or written."""

    @abstractmethod
    def tick(self, now: Now) -> None:
        """Look after what time brings."""

    @abstractmethod
    def abandon(self, sock: socket.socket) -> None:
        """Let go of a socket that made something fail."""

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
        self._notices.tell(f"{self.form.value} to {self.address}", kind, text, severity)


class UdpOutput(Output):
    """Datagrams to one place, whether or not somebody listens there."""

    n_clients = 1

    def __init__(self, form: OutputFormat, endpoint: Endpoint, notices: Notices) -> None:
        super().__init__(form, str(endpoint), notices)
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

    def on_ready(self, ready: socket.socket, mask: int, now: Now) -> None:
        """Do nothing: nothing is read here."""

    def tick(self, now: Now) -> None:
        """Do nothing."""

    def abandon(self, sock: socket.socket) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpServerOutput(Output):
    """Clients that call; what they say is not looked at."""

    def __init__(
        self,
        form: OutputFormat,
        endpoint: Endpoint,
        notices: Notices,
        selector: selectors.BaseSelector,
    ) -> None:
        super().__init__(form, str(endpoint), notices)
        self._selector = selector
        self._waiting: dict[socket.socket, bytearray] = {}
        self._listener = bound(endpoint)
        self.port = int(self._listener.getsockname()[1])
        self._selector.register(self._listener, selectors.EVENT_READ, self)
        self._next_accept_s = float("-inf")

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
        if ready is self._listener:
            self._accept(now)
            return
        waiting = self._waiting.get(ready)
        if waiting is None:
            return
        if mask & selectors.EVENT_WRITE:
            self._flush(ready, waiting)
        if mask & selectors.EVENT_READ and ready in self._waiting:
            try:
                if not ready.recv(CHUNK):
                    self._drop(ready, "it has hung up", Severity.INFO)
            except (BlockingIOError, InterruptedError):
                pass
            except OSError as error:
                self._drop(ready, error.strerror or str(error), Severity.INFO)

    def tick(self, now: Now) -> None:
        """Listen again after there was no room."""
        if self._listener not in self._selector.get_map() and now.steady_s >= self._next_accept_s:
            self._selector.register(self._listener, selectors.EVENT_READ, self)

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
        if self._listener.fileno() >= 0:
            if self._listener in self._selector.get_map():
                self._selector.unregister(self._listener)
            self._listener.close()

    def _accept(self, now: Now) -> None:
        try:
            client, address = self._listener.accept()
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._selector.unregister(self._listener)
            self._next_accept_s = now.steady_s + _ACCEPT_PAUSE_S
            self.tell("accept_failed", error.strerror or str(error), Severity.WARNING)
            return
        client.setblocking(False)
        place = f"client {address[0]}:{address[1]}"
        if len(self._waiting) >= MAX_CLIENTS:
            client.close()
            text = f"{place} refused: there are {MAX_CLIENTS} already"
            self.tell("client_refused", text, Severity.WARNING)
            return
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_WAITING)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._waiting[client] = bytearray()
        self._selector.register(client, selectors.EVENT_READ, self)
        self.tell("connected", f"{place} has called", Severity.INFO)

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
        if client in self._selector.get_map():
            self._selector.unregister(client)
        client.close()
        self.tell("client_lost", f"a client: {why}", severity)
