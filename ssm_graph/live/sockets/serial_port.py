"""Sources at serial ports, ``serial:///dev/ttyUSB0?baud=115200``, opened again if need be.

Eight data bits, no parity, one stop bit, no flow control: what instruments are set to.
"""

from __future__ import annotations

import os
import re
import selectors
import socket
from importlib import import_module
from typing import Any, Final, cast

from ssm_graph.base.errors import ConfigError
from ssm_graph.live.sockets.clocks import Now
from ssm_graph.live.sockets.endpoints import Endpoint
from ssm_graph.live.sockets.feed import Channel, Feed
from ssm_graph.live.sockets.inputs import Input, Patience
from ssm_graph.mission.navigation import Severity
from ssm_graph.mission.run_status import LinkState, SourceStatus
from ssm_graph.sensors.messages import Message

_INPUT_MODES: Final = "IGNBRK BRKINT PARMRK INPCK ISTRIP INLCR IGNCR ICRNL IXON IXOFF"
_LOCAL_MODES: Final = "ECHO ECHONL ICANON ISIG IEXTEN"


class SerialPort:
    """An open port, which is read as a socket is.

    Raises :class:`ConfigError` for a speed that this computer does not know. Raises
    :class:`OSError` where the port cannot be opened.
    """

    def __init__(self, path: str, baud: int) -> None:
        termios = _termios()
        speed = _speed(termios, baud)
        self._handle = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            termios.tcsetattr(self._handle, termios.TCSANOW, self._raw(termios, speed))
            termios.tcflush(self._handle, termios.TCIFLUSH)
        except termios.error as error:  # it is no terminal
            self.close()
            raise OSError(*error.args) from error

    def _raw(self, termios: Any, speed: int) -> list[Any]:
        """Return the settings of a port whose bytes come as they are."""
        inputs, _, control, local, _, _, special = termios.tcgetattr(self._handle)
        inputs &= ~_bits(termios, _INPUT_MODES)
        local &= ~_bits(termios, _LOCAL_MODES)
        control &= ~(termios.CSIZE | termios.PARENB | termios.CSTOPB)
        control &= ~getattr(termios, "CRTSCTS", 0)
        control |= termios.CS8 | termios.CREAD | termios.CLOCAL
        special[termios.VMIN], special[termios.VTIME] = 1, 0  # reading nothing is its end
        return [inputs, 0, control, local, speed, speed, special]

    def fileno(self) -> int:
        """Return the number of the open file; -1 once it is closed."""
        return self._handle

    def recv(self, count: int) -> bytes:
        """Return what has come, so much of it; nothing where the port has gone."""
        return os.read(self._handle, count)

    def close(self) -> None:
        """Close the port."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


class SerialInput(Input):
    """A serial port; one that is unplugged or silent is opened again."""

    def __init__(self, feed: Feed, selector: selectors.BaseSelector, endpoint: Endpoint) -> None:
        super().__init__(feed, selector)
        self._endpoint = endpoint
        _speed(_termios(), endpoint.port)  # which is refused before anything runs
        self._patience = Patience(feed.limits.retry_s)
        self._channel: Channel | None = None

    def on_ready(self, ready: socket.socket, now: Now) -> list[Message]:
        """Read; a port that can be read is well again."""
        messages = super().on_ready(ready, now)
        if ready in self._reading:
            self._patience.renew()
        return messages

    def tick(self, now: Now) -> list[Message]:
        """Open the port where it is not."""
        messages = super().tick(now)
        if not self._reading and self._patience.is_over(now):
            self._open(now)
        return messages

    def status(self, now: Now) -> SourceStatus:
        """Return how it is doing."""
        state = LinkState.CONNECTED if self._reading else LinkState.WAITING
        return self.feed.status(state, now)

    def _open(self, now: Now) -> None:
        try:
            port = SerialPort(self._endpoint.host, self._endpoint.port)
        except OSError as error:
            self._patience.wait(now)
            text = f"cannot open {self.feed.address}: {error.strerror}; it is tried again and again"
            self.feed.tell("connect_failed", text, Severity.WARNING)
            return
        if self._channel is None:
            self._channel = self.feed.channel(now)
        else:
            self.feed.n_reconnects += 1
        self._channel.heard_s = now.steady_s
        self._read_from(cast(socket.socket, port), self._channel)
        self.feed.tell("connected", f"{self.feed.address} is open", Severity.INFO)

    def _lose(self, sock: socket.socket, now: Now, why: str) -> list[Message]:
        messages = self._end(sock, now)
        self._patience.wait(now)
        text = f"{self.feed.address}: {why}; it is opened again"
        self.feed.tell("connection_lost", text, Severity.WARNING)
        return messages


def _speed(termios: Any, baud: int) -> int:
    found = getattr(termios, f"B{baud}", None) if baud > 0 else None
    if found is None:
        known = sorted(int(name[1:]) for name in dir(termios) if re.fullmatch(r"B[1-9]\d*", name))
        raise ConfigError(f"expected a baud of {', '.join(map(str, known))}, got {baud}")
    return int(found)


def _termios() -> Any:
    try:
        return import_module("termios")
    except ImportError as error:
        raise ConfigError("serial ports are read on Linux and macOS only") from error


def _bits(termios: Any, names: str) -> int:
    return sum(getattr(termios, name, 0) for name in names.split())
