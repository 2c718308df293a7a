"""Sources behind sockets: servers that are called, clients that call us, datagrams."""

from __future__ import annotations

import errno
import math
import os
import selectors
import socket
from abc import ABC, abstractmethod
from typing import Final

from ssm_graph.live.sockets.clocks import Now
from ssm_graph.live.sockets.endpoints import (
    CHUNK,
    Endpoint,
    Listener,
    bound,
    caller,
    fault_of,
    let_go,
    received,
    resolve,
)
from ssm_graph.live.sockets.feed import AHEAD_S, Channel, Feed
from ssm_graph.live.sockets.places import Place
from ssm_graph.mission.navigation import Severity
from ssm_graph.mission.run_status import LinkState, SourceStatus
from ssm_graph.sensors.messages import Message, Readings

YOUNG_S: Final = 2.0
"""A client that has sent no sound message for so long makes room for another one."""
MAX_SENDERS: Final = 64
"""Of datagrams, that are told apart, and that are remembered of those that spoke once."""
MAX_DATAGRAMS: Final = 512
"""Read of one source before the others have their turn."""


class Input(ABC):
    """One source. The hub calls :meth:`on_ready` for its sockets and :meth:`tick` all the time."""

    def __init__(self, feed: Feed, selector: selectors.BaseSelector) -> None:
        self.feed, self.name, self._selector = feed, feed.name, selector
        self._reading: dict[socket.socket, Channel] = {}
        self._is_paused = False

    def on_ready(self, ready: socket.socket, now: Now) -> list[Message]:
        """Return the messages of a socket that can be read or has connected."""
        channel = self._reading.get(ready)
        if channel is None or (data := received(ready)) is None:
            return []
        if isinstance(data, str):
            return self._lose(ready, now, data)
        messages = self.feed.take(channel, data, now)
        if len(data) < CHUNK:  # else more waits
            channel.catch_up()
        self._pause_if_over(now)
        return messages

    def stood_still(self, span_s: float) -> None:
        """Have nobody pay for the time in which this process did not listen."""
        self.feed.stood_still(span_s)
        for channel in self._channels:
            channel.stand_still(span_s)

    def tick(self, now: Now) -> list[Message]:
        """Return messages that a decoder releases; look after patience and connections."""
        if self._is_paused and not self.feed.is_over(now):
            self._is_paused = False
            for sock in self._reading:
                self._selector.register(sock, selectors.EVENT_READ, self)
        messages: list[Message] = []
        for sock, channel in list(self._reading.items()):
            if not self._is_paused and channel.fed_s < now.steady_s:  # nothing waited for it
                channel.catch_up()
            messages += self.feed.idle(channel, now)
            if not self._is_paused and self.feed.is_silent(channel, now):
                messages += self._lose(sock, now, self.feed.silence)
        if not self.is_behind:
            self.feed.catch_up()
        return messages

    @abstractmethod
    def _lose(self, sock: socket.socket, now: Now, why: str) -> list[Message]:
        """Give a connection up; return the messages of what it still held."""

    @abstractmethod
    def status(self, now: Now) -> SourceStatus:
        """Return how it is doing."""

    @property
    def _channels(self) -> tuple[Channel, ...]:
        """All that is read of."""
        return tuple(self._reading.values())

    @property
    def is_behind(self) -> bool:
        """Whether what came while this process stood still is not read to its end."""
        return any(channel.is_stale for channel in self._channels)

    @property
    def n_held(self) -> int:
        """Bytes held of messages that are not complete."""
        return sum(channel.decoder.n_held for channel in self._channels)

    def waiting(self, now: Now) -> list[Readings]:
        """Return complete messages that decoders hold, as they would be read now."""
        return [one for held in self._channels for one in self.feed.held(held, now)]

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
        let_go(sock, self._selector)

    def _end(self, sock: socket.socket, now: Now) -> list[Message]:
        """Hang up; a message that was cut off ends here and does not meet the next one's begin."""
        channel = self._reading[sock]
        self._forget(sock)
        return self.feed.end(channel, now)

    def _pause_if_over(self, now: Now) -> None:
        """Stop reading a source that sends too much: TCP holds it back, of UDP the rest is lost."""
        if not self._is_paused and self.feed.is_over(now):
            self._is_paused = True
            most = f"expected at most {self.feed.limits.bytes_per_s:g} bytes/s, got more"
            self.feed.tell("byte_limited", f"{most}; it is read no faster", Severity.WARNING)
            for sock in self._reading:
                self._selector.unregister(sock)


class Patience:
    """When to try again: at once at first, then after ever longer waits, up to a limit."""

    def __init__(self, retry_s: tuple[float, float]) -> None:
        """Take the first wait and the longest one, s."""
        self._retry_s = retry_s
        self._wait_s = retry_s[0]
        self._until_s = float("-inf")

    def is_over(self, now: Now) -> bool:
        """Return whether it is time to try."""
        return now.steady_s >= self._until_s

    def has_passed(self, now: Now) -> bool:
        """Return whether the time to try is past."""
        return now.steady_s > self._until_s

    def wait_for(self, seconds: float, now: Now) -> None:
        """Wait for so long, the next time as before."""
        self._until_s = now.steady_s + seconds

    def wait(self, now: Now) -> None:
        """Wait from now on, and twice as long the next time."""
        self.wait_for(self._wait_s, now)
        self._wait_s = min(2.0 * self._wait_s, self._retry_s[1])

    def renew(self) -> None:
        """Begin with the first wait again: what was tried is well."""
        self._wait_s = self._retry_s[0]


class TcpClientInput(Input):
    """A server that is called, again and again if need be, ever more patiently."""

    def __init__(self, feed: Feed, selector: selectors.BaseSelector, endpoint: Endpoint) -> None:
        super().__init__(feed, selector)
        self._addresses = resolve(endpoint)
        self._n_tries = 0
        self._patience = Patience(feed.limits.retry_s)
        self._was_connected = False
        self._calling: socket.socket | None = None
        self._channel: Channel | None = None

    def on_ready(self, ready: socket.socket, now: Now) -> list[Message]:
        """Read, or see whether the call was answered."""
        if ready is self._calling:
            self._answered(ready, now)
            return []
        messages = super().on_ready(ready, now)
        if ready in self._reading:
            self._patience.renew()
        return messages

    def tick(self, now: Now) -> list[Message]:
        """Call where nobody is called; give up who does not answer."""
        messages = super().tick(now)
        if self._calling is not None and self._patience.has_passed(now):
            self._failed(f"no answer within {self.feed.limits.connect_s:g} s", now)
        elif self._calling is None and not self._reading and self._patience.is_over(now):
            self._call(now)
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

    def _call(self, now: Now) -> None:
        family, address = self._addresses[self._n_tries % len(self._addresses)]
        self._n_tries += 1
        self._patience.wait_for(self.feed.limits.connect_s, now)
        self._calling = socket.socket(family, socket.SOCK_STREAM)
        self._calling.setblocking(False)
        code = self._calling.connect_ex(address)
        if code in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
            self._selector.register(self._calling, selectors.EVENT_WRITE, self)
        else:
            self._failed(os.strerror(code), now)

    def _answered(self, sock: socket.socket, now: Now) -> None:
        code = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) or fault_of(sock)
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
        self._patience.wait(now)
        text = f"cannot connect to {self.feed.address}: {why}; it is tried again and again"
        self.feed.tell("connect_failed", text, Severity.WARNING)

    def _lose(self, sock: socket.socket, now: Now, why: str) -> list[Message]:
        messages = self._end(sock, now)
        self._patience.wait(now)
        kind = "source_silent" if why == self.feed.silence else "connection_lost"
        self.feed.tell(kind, f"{self.feed.address}: {why}; it is called again", Severity.WARNING)
        return messages


class TcpServerInput(Input):
    """A few clients that call us; more are refused, silent ones make room."""

    def __init__(self, feed: Feed, selector: selectors.BaseSelector, endpoint: Endpoint) -> None:
        super().__init__(feed, selector)
        most = feed.limits.max_clients
        self._listener = Listener(endpoint, selector, self, most=most, tell=feed.tell)
        self.port = self._listener.port

    def on_ready(self, ready: socket.socket, now: Now) -> list[Message]:
        """Read a client, or take a new one."""
        if ready is not self._listener.socket:
            return super().on_ready(ready, now)
        messages: list[Message] = []
        silent = min(self._reading, key=lambda sock: self._reading[sock].heard_s, default=None)
        has_one = silent and now.steady_s - self._reading[silent].heard_s > YOUNG_S
        client = self._listener.accept(now.steady_s, len(self._reading) - bool(has_one))
        if client is not None:
            if silent and len(self._reading) >= self.feed.limits.max_clients:
                messages = self._lose(silent, now, "it sent nothing sound and made room")
            self._read_from(client, self.feed.channel(now, self.feed.place(*caller(client))))
        return messages

    def tick(self, now: Now) -> list[Message]:
        """Drop who is silent."""
        messages = super().tick(now)
        self._listener.tick(now.steady_s)
        return messages

    def status(self, now: Now) -> SourceStatus:
        """Return how it is doing."""
        state = LinkState.CONNECTED if self._reading else LinkState.LISTENING
        return self.feed.status(state, now)

    def close(self) -> None:
        """Hang up, and listen no more."""
        super().close()
        self._listener.close()

    def _lose(self, sock: socket.socket, now: Now, why: str) -> list[Message]:
        self.feed.tell("connection_lost", f"a client is gone: {why}", Severity.WARNING)
        self._reading[sock].place.leave()
        return self._end(sock, now)


class UdpInput(Input):
    """Datagrams; each ends what it holds, so that one that was cut off spoils no other.

    Of a sender that sends too much the rest is read and dropped: left unread it would fill the room
    of the others.
    """

    def __init__(self, feed: Feed, selector: selectors.BaseSelector, endpoint: Endpoint) -> None:
        super().__init__(feed, selector)
        self._socket = bound(endpoint)
        self.port = int(self._socket.getsockname()[1])
        self._all: Channel | None = None
        """Stands for all senders, and is that of those that spoke once"""
        self._once: dict[str, Place] = {}
        self._senders: dict[str, Channel] = {}
        """Each of the others has a channel of its own"""
        self._is_silent = False
        self._free_s: dict[str, float] = {}
        self._behind_s = 0.0

    @property
    def _channels(self) -> tuple[Channel, ...]:
        return (*self._reading.values(), *self._senders.values())

    def on_ready(self, ready: socket.socket, now: Now) -> list[Message]:
        """Read what waits, so much of it."""
        assert self._all is not None
        data: dict[str, bytearray] = {}
        n_bytes, is_all = 0, False
        for _ in range(MAX_DATAGRAMS):
            try:
                datagram, sender = ready.recvfrom(CHUNK)
            except (BlockingIOError, InterruptedError):
                is_all = True
                break
            except OSError as error:  # an ICMP message about something else
                self.feed.tell("receive_failed", error.strerror or str(error), Severity.WARNING)
                break
            name = f"{sender[0]}:{sender[1]}"
            if self._is_too_much(name, len(datagram), now):
                continue
            whole = datagram if datagram.endswith(b"\n") else datagram + b"\n"
            data.setdefault(name, bytearray()).extend(whole)
            n_bytes += len(whole)
            if n_bytes >= CHUNK:
                break
        messages: list[Message] = []
        for name, own in data.items():
            channel = self._channel_of(name, now)
            messages += self.feed.take(channel, bytes(own), now)
            self._all.stand_for(channel)
        self._is_silent = self._is_silent and self.feed.is_silent(self._all, now)
        if is_all:
            for channel in self._channels:
                channel.catch_up()
            self._behind_s = 0.0
        return messages

    def _channel_of(self, sender: str, now: Now) -> Channel:
        """Return the channel of a sender; of too many the newest gives way.

        Those that speak for the first time share one: a program that opens a socket for every
        datagram is one instrument, and its decoder has to know what came before.
        """
        assert self._all is not None
        if sender in self._senders:
            return self._senders[sender]
        place = self._once.pop(sender, None)
        if place is None:
            if len(self._once) >= MAX_SENDERS:
                self._once.pop(next(iter(self._once)))
            place = self.feed.place(f"sender {sender}", sender)
            self._once[sender] = place
            self._all.speak_for(place)
            return self._all
        if len(self._senders) >= MAX_SENDERS:
            _, last = self._senders.popitem()
            last.place.leave()
        channel = self._senders[sender] = self.feed.channel(now, place)
        channel.heard_s, channel.is_stale = -math.inf, self._all.is_stale
        if self._all.place is place:  # nobody else has spoken since
            self._all.swap_decoders(channel)
        return channel

    def stood_still(self, span_s: float) -> None:
        """Have nobody pay for the time in which this process did not listen."""
        super().stood_still(span_s)
        self._behind_s += span_s

    def _is_too_much(self, sender: str, n_bytes: int, now: Now) -> bool:
        """Return whether a datagram of a sender is beyond what he may send, which is told."""
        limit = self.feed.limits.bytes_per_s
        heard_s = now.steady_s - self._behind_s
        free_s = max(self._free_s.get(sender, heard_s), heard_s) + n_bytes / limit
        if free_s - now.steady_s > AHEAD_S + n_bytes / limit:
            most = f"{sender}: expected at most {limit:g} bytes/s, got more; the rest is dropped"
            self.feed.tell("byte_limited", most, Severity.WARNING)
            return True
        if len(self._free_s) >= MAX_SENDERS:
            self._free_s = {who: s for who, s in self._free_s.items() if s > now.steady_s}
        self._free_s[sender] = free_s
        return False

    def tick(self, now: Now) -> list[Message]:
        """Say it where nothing comes any more."""
        if self._all is None:
            self._all = self.feed.channel(now)
            self._read_from(self._socket, self._all)
        messages = super().tick(now)
        for channel in self._senders.values():
            if not self._all.is_stale:
                channel.catch_up()
            messages += self.feed.idle(channel, now)
        return messages

    def status(self, now: Now) -> SourceStatus:
        """Return how it is doing."""
        return self.feed.status(LinkState.SILENT if self._is_silent else LinkState.LISTENING, now)

    def close(self) -> None:
        """Listen no more."""
        super().close()
        self._socket.close()

    def _lose(self, sock: socket.socket, now: Now, why: str) -> list[Message]:  # noqa: ARG002
        if not self._is_silent:
            self._is_silent = True
            self.feed.tell("source_silent", f"{self.feed.address}: {why}", Severity.WARNING)
        return []
