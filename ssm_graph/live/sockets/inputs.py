"""Sources behind sockets: what they share, and a server that is called."""

from __future__ import annotations

import errno
import os
import selectors
import socket
from abc import ABC, abstractmethod

from ssm_graph.live.run.feed import CHUNK, Channel, Feed, Now
from ssm_graph.live.sockets.endpoints import Endpoint, resolve
from ssm_graph.mission.navigation import Severity
from ssm_graph.mission.run_status import LinkState, SourceStatus
from ssm_graph.sensors.messages import Message


class Input(ABC):
    """One source. The hub calls :meth:`on_ready` for its sockets and :meth:`tick` all the time."""

    def __init__(self, feed: Feed, selector: selectors.BaseSelector) -> None:
        self.feed, self._selector = feed, selector
        self._reading: dict[socket.socket, Channel] = {}
        self._is_paused = False

    @abstractmethod
    def on_ready(self, ready: socket.socket, now: Now) -> list[Message]:
        """Return the messages of a socket that can be read or has connected."""

    def tick(self, now: Now) -> list[Message]:
        """Return messages that a decoder releases; look after patience and connections."""
        if self._is_paused and not self.feed.is_over(now):
            self._is_paused = False
            for sock in self._reading:
                self._selector.register(sock, selectors.EVENT_READ, self)
        released: list[Message] = []
        for channel in list(self._reading.values()):
            released += self.feed.idle(channel, now)
        return released

    @abstractmethod
    def status(self, now: Now) -> SourceStatus:
        """Return how it is doing."""

    @property
    def n_held(self) -> int:
        """Bytes held of messages that are not complete."""
        return sum(channel.decoder.n_held for channel in self._reading.values())

    def abandon(self, sock: socket.socket) -> None:
        """Let go of a socket that made something fail."""
        if sock in self._reading:
            self._forget(sock)
        elif sock in self._selector.get_map():
            self._selector.unregister(sock)

    def close(self) -> None:
        """Close all sockets."""
        for sock in list(self._reading):
            self._forget(sock)

    def _read_from(self, sock: socket.socket, channel: Channel) -> None:
        self._reading[sock] = channel
        if not self._is_paused:
            self._selector.register(sock, selectors.EVENT_READ, self)

    def _forget(self, sock: socket.socket) -> None:
        self._reading.pop(sock, None)
        if sock in self._selector.get_map():
            self._selector.unregister(sock)
        sock.close()

    def _pause_if_over(self, now: Now) -> None:
        """Stop reading a source that sends too much: TCP holds it back, of UDP the rest is lost."""
        if not self._is_paused and self.feed.is_over(now):
            self._is_paused = True
            self.feed.tell(
                "byte_limited",
                f"expected at most {self.feed.limits.bytes_per_s:g} bytes/s, got more; it is read "
                "no faster",
                Severity.WARNING,
            )
            for sock in self._reading:
                self._selector.unregister(sock)


class TcpClientInput(Input):
    """A server that is called, again and again if need be, ever more patiently."""

    def __init__(self, feed: Feed, selector: selectors.BaseSelector, endpoint: Endpoint) -> None:
        super().__init__(feed, selector)
        self._addresses = resolve(endpoint)
        self._n_tries = 0
        self._wait_s = feed.limits.retry_s[0]
        self._next_try_s = float("-inf")
        self._was_connected = False
        self._calling: socket.socket | None = None
        self._channel: Channel | None = None

    def on_ready(self, ready: socket.socket, now: Now) -> list[Message]:
        """Read, or see whether the call was answered."""
        if ready is self._calling:
            self._answered(ready, now)
            return []
        channel = self._reading.get(ready)
        if channel is None:
            return []
        try:
            data = ready.recv(CHUNK)
        except (BlockingIOError, InterruptedError):
            return []
        except OSError as error:
            return self._lose(now, error.strerror or str(error))
        if not data:
            return self._lose(now, "closed by the other side")
        self._wait_s = self.feed.limits.retry_s[0]
        messages = self.feed.take(channel, data, now)
        self._pause_if_over(now)
        return messages

    def tick(self, now: Now) -> list[Message]:
        """Call where nobody is called; give up who does not answer or has become silent."""
        messages = super().tick(now)
        if self._calling is not None and now.steady_s > self._next_try_s:
            self._failed(f"no answer within {self.feed.limits.connect_s:g} s", now)
        elif self._calling is None and not self._reading and now.steady_s >= self._next_try_s:
            self._call(now)
        elif self._reading and not self._is_paused and self._is_silent(now):
            messages += self._lose(now, f"silent for {self.feed.limits.stall_s:g} s")
        return messages

    def status(self, now: Now) -> SourceStatus:
        """Return how it is doing."""
        state = LinkState.CONNECTED if self._reading else LinkState.WAITING
        return self.feed.status(LinkState.CONNECTING if self._calling else state, now)

    def close(self) -> None:
        """Hang up."""
        super().close()
        if self._calling is not None:
            self._forget(self._calling)
            self._calling = None

    def _is_silent(self, now: Now) -> bool:
        return self._channel is not None and self.feed.is_silent(self._channel, now)

    def _call(self, now: Now) -> None:
        family, address = self._addresses[self._n_tries % len(self._addresses)]
        self._n_tries += 1
        self._next_try_s = now.steady_s + self.feed.limits.connect_s
        self._calling = socket.socket(family, socket.SOCK_STREAM)
        self._calling.setblocking(False)
        code = self._calling.connect_ex(address)
        if code in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
            self._selector.register(self._calling, selectors.EVENT_WRITE, self)
        else:
            self._failed(os.strerror(code), now)

    def _answered(self, sock: socket.socket, now: Now) -> None:
        code = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) or _fault_of(sock)
        if code:
            self._failed(os.strerror(code), now)
            return
        self._calling = None
        self._selector.unregister(sock)
        if self._channel is None:
            self._channel = self.feed.channel(now)
        self._channel.heard_s = now.steady_s
        self._read_from(sock, self._channel)
        self.feed.n_reconnects += self._was_connected
        again = " again" if self._was_connected else ""
        self._was_connected = True
        self.feed.tell("connected", f"connected{again} to {self.feed.address}", Severity.INFO)

    def _failed(self, why: str, now: Now) -> None:
        assert self._calling is not None
        self._forget(self._calling)
        self._calling = None
        self._wait(now)
        self.feed.tell(
            "connect_failed",
            f"cannot connect to {self.feed.address}: {why}; it is tried again and again",
            Severity.WARNING,
        )

    def _lose(self, now: Now, why: str) -> list[Message]:
        """Hang up; a message that was cut off ends here and does not meet the next one's begin."""
        messages = []
        for sock, channel in list(self._reading.items()):
            self._forget(sock)
            messages += self.feed.take(channel, b"\n", now)
        self._wait(now)
        kind = "source_silent" if why.startswith("silent") else "connection_lost"
        self.feed.tell(kind, f"{self.feed.address}: {why}; it is called again", Severity.WARNING)
        return messages

    def _wait(self, now: Now) -> None:
        self._next_try_s = now.steady_s + self._wait_s
        self._wait_s = min(2.0 * self._wait_s, self.feed.limits.retry_s[1])


def _fault_of(sock: socket.socket) -> int:
    """Return an error of a socket that says it is connected: lost again, or a port to itself."""
    try:
        is_itself = sock.getpeername() == sock.getsockname()
    except OSError as error:
        return error.errno or errno.ENOTCONN
    return errno.ECONNREFUSED if is_itself else 0
