"""Sources behind sockets that listen: clients that call us, datagrams."""

from __future__ import annotations

import selectors
import socket
from typing import Final

from ssm_graph.base.errors import ConfigError
from ssm_graph.live.run.feed import CHUNK, Channel, Feed, Now
from ssm_graph.live.sockets.endpoints import Endpoint, Transport, resolve
from ssm_graph.live.sockets.inputs import Input
from ssm_graph.mission.navigation import Severity
from ssm_graph.mission.run_status import LinkState, SourceStatus
from ssm_graph.sensors.messages import Message

MAX_DATAGRAMS: Final = 64
"""Read of one source before the others have their turn."""
_ACCEPT_PAUSE_S: Final = 1.0


class TcpServerInput(Input):
    """A few clients that call us; more are refused, silent ones make room."""

    def __init__(self, feed: Feed, selector: selectors.BaseSelector, endpoint: Endpoint) -> None:
        super().__init__(feed, selector)
        self._listener = bound(endpoint)
        self.port = int(self._listener.getsockname()[1])
        self._selector.register(self._listener, selectors.EVENT_READ, self)
        self._next_accept_s = float("-inf")

    def on_ready(self, ready: socket.socket, now: Now) -> list[Message]:
        """Read a client, or take a new one."""
        if ready is self._listener:
            self._accept(now)
            return []
        channel = self._reading.get(ready)
        if channel is None:
            return []
        try:
            data = ready.recv(CHUNK)
        except (BlockingIOError, InterruptedError):
            return []
        except OSError as error:
            return self._drop(ready, channel, now, error.strerror or str(error))
        if not data:
            return self._drop(ready, channel, now, "it has hung up")
        messages = self.feed.take(channel, data, now)
        self._pause_if_over(now)
        return messages

    def tick(self, now: Now) -> list[Message]:
        """Drop who is silent."""
        messages = super().tick(now)
        for sock, channel in list(self._reading.items()):
            if not self._is_paused and self.feed.is_silent(channel, now):
                why = f"silent for {self.feed.limits.stall_s:g} s, dropped"
                messages += self._drop(sock, channel, now, why)
        is_deaf = self._listener not in self._selector.get_map()
        if is_deaf and now.steady_s >= self._next_accept_s:
            self._selector.register(self._listener, selectors.EVENT_READ, self)
        return messages

    def status(self, now: Now) -> SourceStatus:
        """Return how it is doing."""
        state = LinkState.CONNECTED if self._reading else LinkState.LISTENING
        return self.feed.status(state, now)

    def close(self) -> None:
        """Hang up, and listen no more."""
        super().close()
        self._forget(self._listener)

    def _accept(self, now: Now) -> None:
        try:
            client, address = self._listener.accept()
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:  # no more files, for example: the client stays in the queue
            self._selector.unregister(self._listener)
            self._next_accept_s = now.steady_s + _ACCEPT_PAUSE_S
            self.feed.tell("accept_failed", error.strerror or str(error), Severity.WARNING)
            return
        client.setblocking(False)
        place = f"client {address[0]}:{address[1]}"
        if len(self._reading) >= self.feed.limits.max_clients:
            client.close()
            text = f"{place} refused: there are {len(self._reading)} already"
            self.feed.tell("client_refused", text, Severity.WARNING)
            return
        self._read_from(client, self.feed.channel(now))
        self.feed.tell("connected", f"{place} has called", Severity.INFO)

    def _drop(self, sock: socket.socket, channel: Channel, now: Now, why: str) -> list[Message]:
        self._forget(sock)
        self.feed.tell("connection_lost", f"a client: {why}", Severity.WARNING)
        return self.feed.take(channel, b"\n", now)


class UdpInput(Input):
    """Datagrams; each ends what it holds, so that one that was cut off spoils no other."""

    def __init__(self, feed: Feed, selector: selectors.BaseSelector, endpoint: Endpoint) -> None:
        super().__init__(feed, selector)
        self._socket = bound(endpoint)
        self.port = int(self._socket.getsockname()[1])
        self._channel: Channel | None = None
        self._is_silent = False

    def on_ready(self, ready: socket.socket, now: Now) -> list[Message]:
        """Read what waits, so much of it."""
        assert self._channel is not None
        data = bytearray()
        for _ in range(MAX_DATAGRAMS):
            try:
                datagram = ready.recv(CHUNK)
            except (BlockingIOError, InterruptedError):
                break
            except OSError as error:  # an ICMP message about something else
                self.feed.tell("receive_failed", error.strerror or str(error), Severity.WARNING)
                break
            data += datagram if datagram.endswith(b"\n") else datagram + b"\n"
            if len(data) >= CHUNK:
                break
        self._is_silent = False
        messages = self.feed.take(self._channel, bytes(data), now)
        self._pause_if_over(now)
        return messages

    def tick(self, now: Now) -> list[Message]:
        """Say it where nothing comes any more."""
        if self._channel is None:
            self._channel = self.feed.channel(now)
            self._read_from(self._socket, self._channel)
        messages = super().tick(now)
        if not self._is_silent and self.feed.is_silent(self._channel, now):
            self._is_silent = True
            text = f"{self.feed.address}: silent for {self.feed.limits.stall_s:g} s"
            self.feed.tell("source_silent", text, Severity.WARNING)
        return messages

    def status(self, now: Now) -> SourceStatus:
        """Return how it is doing."""
        return self.feed.status(LinkState.SILENT if self._is_silent else LinkState.LISTENING, now)

    def close(self) -> None:
        """Listen no more."""
        super().close()
        self._socket.close()


def bound(endpoint: Endpoint) -> socket.socket:
    """Return a socket that listens at an address.

    Raises
    ------
    ConfigError
        Where the address is not one of this computer, or in use.
    """
    found = resolve(endpoint)[0]
    is_udp = endpoint.transport is Transport.UDP
    sock = socket.socket(found.family, socket.SOCK_DGRAM if is_udp else socket.SOCK_STREAM)
    try:
        if found.family == socket.AF_INET6:  # [::] is not to be IPv4 as well
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        if not is_udp:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setblocking(False)
        sock.bind(found.address)
        if not is_udp:
            sock.listen(8)
    except OSError as error:
        sock.close()
        raise ConfigError(
            f"{endpoint}: cannot listen there ({error.strerror or error}); "
            "is another process at this port, or the address another computer's?"
        ) from error
    return sock
