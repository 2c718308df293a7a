"""Addresses, ``tcp://HOST:PORT``, ``tcp-listen://:PORT``, ``udp://:PORT``, and who listens there.

What is bound is bound to this computer only, 127.0.0.1, unless another interface is named.
"""

from __future__ import annotations

import errno
import ipaddress
import re
import selectors
import socket
from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, NamedTuple

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.mission.navigation import Severity

LOOPBACK: Final = "127.0.0.1"
WAITING: Final = 4 * 2**20
"""Bytes of datagrams that may wait while this process stands still, as far as the system allows."""
CHUNK: Final = 65536
"""Bytes that are read of one socket before the others have their turn."""
_ACCEPT_PAUSE_S: Final = 1.0
_ADDRESS = re.compile(
    r"(?P<scheme>[A-Za-z-]+)://(?P<host>\[[^\[\]]*\]|[^:/\[\]@]*):(?P<port>\d{1,5})/?", re.ASCII
)
_SERIAL = re.compile(r"serial://(?P<path>/[!-<>@-~]+)\?baud=(?P<baud>\d{1,7})", re.ASCII)
_HOST_NAME = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_.-]{0,252}[A-Za-z0-9_])?", re.ASCII)


class Transport(Enum):
    """How bytes come and go; the value is the scheme of an address."""

    TCP_CLIENT = "tcp"
    TCP_SERVER = "tcp-listen"
    UDP = "udp"
    SERIAL = "serial"


INPUTS: Final = frozenset(Transport)
OUTPUTS: Final = frozenset({Transport.TCP_SERVER, Transport.UDP})
FORMS: Final = {
    Transport.TCP_CLIENT: "tcp://HOST:PORT",
    Transport.TCP_SERVER: "tcp-listen://[HOST]:PORT",
    Transport.UDP: "udp://[HOST]:PORT",
    Transport.SERIAL: "serial:///dev/PORT?baud=BAUD",
}
"""How an address is written; a host in square brackets may be left out, or is IPv6."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where bytes come from or go to."""

    transport: Transport
    host: str
    """Of a serial port, its path."""
    port: int
    """0 lets the system choose one, where something is bound. Of a serial port, its baud."""

    def __str__(self) -> str:
        if self.transport is Transport.SERIAL:
            return f"serial://{self.host}?baud={self.port}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.transport.value}://{host}:{self.port}"


class Resolved(NamedTuple):
    """A numeric address that a socket takes."""

    family: socket.AddressFamily
    address: Any


def parse_endpoint(text: str, *, where: str, allowed: Collection[Transport] = INPUTS) -> Endpoint:
    """Return the endpoint of an address as it is written.

    Raises :class:`ConfigError` for any other text.

    For example ``tcp://192.168.194.95:16171``, ``udp://:9000``, ``tcp-listen://[::1]:7000``;
    ``where`` is the option it belongs to, ``allowed`` what may be used there.
    """
    wanted = " or ".join(FORMS[kind] for kind in Transport if kind in allowed)
    serial = _SERIAL.fullmatch(text.strip())
    if serial and Transport.SERIAL in allowed:
        return Endpoint(Transport.SERIAL, serial["path"], int(serial["baud"]))
    found = _ADDRESS.fullmatch(text.strip())
    if not found:
        raise ConfigError(f"{where}: expected {wanted}, got {text!r}")
    scheme, port = found["scheme"].lower(), int(found["port"])
    names = {kind.value: kind for kind in Transport if kind in allowed and kind != Transport.SERIAL}
    if scheme not in names:
        raise ConfigError(
            f"{where}: expected {wanted}, got {scheme!r}; {nearest_hint(scheme, names)}"
        )
    if not 1 <= port <= 65535:
        raise ConfigError(f"{where}: expected a port from 1 to 65535, got {port}")
    return Endpoint(names[scheme], _host(found["host"], names[scheme], where, text), port)


def resolve(endpoint: Endpoint) -> list[Resolved]:
    """Return the numeric addresses of an endpoint; may ask a name server, so not within a loop.

    Raises :class:`ConfigError` for a name that is not known.
    """
    kind = socket.SOCK_DGRAM if endpoint.transport is Transport.UDP else socket.SOCK_STREAM
    try:
        found = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)
    except (OSError, UnicodeError) as error:
        raise ConfigError(
            f"{endpoint}: the host is not known ({error}); give its number instead"
        ) from error
    return [Resolved(family, address) for family, _, _, _, address in found]


def bound(endpoint: Endpoint) -> socket.socket:
    """Return a socket that listens at an address.

    Raises :class:`ConfigError` where the address is not one of this computer, or in use.
    """
    found = resolve(endpoint)[0]
    is_udp = endpoint.transport is Transport.UDP
    sock = socket.socket(found.family, socket.SOCK_DGRAM if is_udp else socket.SOCK_STREAM)
    try:
        if found.family == socket.AF_INET6:  # [::] is not to be IPv4 as well
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        if is_udp:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WAITING)
        else:
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


class Listener:
    """A server's socket: takes clients as long as there is room.

    More than ``most`` clients at once are refused. ``tell`` notes an event, of this kind, text and
    severity; the selector names ``owner`` when somebody calls.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        selector: selectors.BaseSelector,
        owner: object,
        *,
        most: int,
        tell: Callable[[str, str, Severity], None],
    ) -> None:
        self.socket = bound(endpoint)
        self.port = int(self.socket.getsockname()[1])
        self._selector, self._owner, self._most, self._tell = selector, owner, most, tell
        self._again_s = float("-inf")
        selector.register(self.socket, selectors.EVENT_READ, owner)

    def accept(self, steady_s: float, n_clients: int) -> socket.socket | None:
        """Return the client that has called; None for one too many, or already gone."""
        try:
            client, address = self.socket.accept()
        except (BlockingIOError, InterruptedError):
            return None
        except OSError as error:  # no more files, for example: the client stays in the queue
            self._selector.unregister(self.socket)
            self._again_s = steady_s + _ACCEPT_PAUSE_S
            self._tell("accept_failed", error.strerror or str(error), Severity.WARNING)
            return None
        client.setblocking(False)
        place = f"client {address[0]}:{address[1]}"
        if n_clients >= self._most:
            client.close()
            text = f"{place} refused: there are {n_clients} already"
            self._tell("client_refused", text, Severity.WARNING)
            return None
        self._tell("connected", f"{place} has called", Severity.INFO)
        return client

    def tick(self, steady_s: float) -> None:
        """Listen again after there was no room."""
        if self.socket not in self._selector.get_map() and steady_s >= self._again_s:
            self._selector.register(self.socket, selectors.EVENT_READ, self._owner)

    def close(self) -> None:
        """Listen no more."""
        let_go(self.socket, self._selector)


def received(sock: socket.socket) -> bytes | str | None:
    """Return what has come: bytes, None for nothing yet, or in words why nothing will any more."""
    try:
        return sock.recv(CHUNK) or "closed by the other side"
    except (BlockingIOError, InterruptedError):
        return None
    except OSError as error:
        return error.strerror or str(error)


def let_go(sock: socket.socket, selector: selectors.BaseSelector) -> None:
    """Close a socket, and have the selector forget it."""
    if sock.fileno() >= 0 and sock in selector.get_map():
        selector.unregister(sock)
    sock.close()


def _host(written: str, transport: Transport, where: str, text: str) -> str:
    if written.startswith("["):
        host = written[1:-1]
        try:
            ipaddress.IPv6Address(host)
        except ValueError as error:
            raise ConfigError(
                f"{where}: expected an IPv6 address in brackets, got {text!r} ({error})"
            ) from error
        return host
    if not written:
        if transport is Transport.TCP_CLIENT:
            raise ConfigError(f"{where}: expected {FORMS[transport]} with a host, got {text!r}")
        return LOOPBACK
    looks_numeric = re.fullmatch(r"[0-9.]+", written) is not None
    if not _HOST_NAME.fullmatch(written) or (looks_numeric and not _is_ipv4(written)):
        raise ConfigError(f"{where}: expected a host name, an IPv4 address or [IPv6], got {text!r}")
    return written


def _is_ipv4(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True


def caller(client: socket.socket) -> tuple[str, str]:
    """Return who has called, for people, and the host; one that is gone already has none."""
    try:
        host, port = client.getpeername()[:2]
    except OSError:
        return "a client that is gone", ""
    return f"client {host}:{port}", host


def fault_of(sock: socket.socket) -> int:
    """Return an error of a socket that says it is connected: lost again, or a port to itself."""
    try:
        is_itself = sock.getpeername() == sock.getsockname()
    except OSError as error:
        return error.errno or errno.ENOTCONN
    return errno.ECONNREFUSED if is_itself else 0
