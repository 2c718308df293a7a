"""How a live run goes, as a page for browsers: one file of HTML, and server-sent events.

The run hands over what it knows and goes on; what browsers do is the business of threads of their
own, which send the newest state that there is, or nothing. At most eight browsers are served, each
for as long as it reads what it is sent.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import math
import re
import socket
import threading
from collections import deque
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socketserver import TCPServer
from typing import Any, Final

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError
from ssm_graph.live.protocols.json_messages import navigation_fields
from ssm_graph.live.sockets.endpoints import LOOPBACK
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.mission.run_status import RunStatus

MOST_BROWSERS: Final = 8
MOST_CONNECTIONS: Final = 32
"""Those that ask, too; more are hung up on."""
CLOSES_S: Final = 0.1
"""The end of a run waits for the page no longer."""
PATIENCE_S: Final = 5.0
"""A browser that takes or says nothing for so long is hung up on."""
MOST_POINTS: Final = 4000
"""Of the track; then every second goes."""
ALTITUDE_S: Final = 5.0
"""An altitude of a source that has been silent for longer is not shown."""
SLOWEST: Final = 0.03
"""m/s, below which there is no course."""
MOST_TURNS: Final = 20
"""Of the verdict, beside the events of the run: what a watch looks back on."""
_TURNED: Final = {Health.GOOD: Severity.INFO, Health.BAD: Severity.ERROR}
"""How much a verdict matters that begins; the others warn."""
_ADDRESS: Final = re.compile(r"(?:(?P<host>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9_.-]*):)?(?P<port>\d{1,5})")
_PORT: Final = re.compile(r":\d*$")
"""Of the header ``Host``, which leaves out the usual one."""
_HEADERS: Final = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; connect-src 'self'; base-uri 'none'; frame-ancestors 'none'",
}


def parse_page_address(text: str) -> tuple[str, int]:
    """Return host and port of ``127.0.0.1:8080``, ``[::1]:8080`` or ``:8080``, which is loopback.

    Raises :class:`ConfigError` for any other text.
    """
    found = _ADDRESS.fullmatch(text.strip())
    if found is None or not 1 <= int(found["port"]) <= 65535:
        raise ConfigError(f"--page: expected HOST:PORT, such as {LOOPBACK}:8080, got {text!r}")
    return (found["host"] or LOOPBACK).strip("[]"), int(found["port"])


class LivePage:
    """Serves the page of a run.

    ::

        with LivePage("127.0.0.1", 8080) as page:
            Runner(folder, engine, connect, on_status=page).run()
    """

    def __init__(self, host: str, port: int, *, surface_height_m: float = 0.0) -> None:
        """Listen at an address; port 0 lets the system choose one.

        ``surface_height_m`` is the height of the water above the ellipsoid, from which depths are
        counted. Raises :class:`ConfigError` for an address that cannot be had.
        """
        self._surface_height_m = surface_height_m
        self._changed = threading.Condition()
        self._version, self._is_closed = 0, False
        self._text = b""
        self._points: list[list[Any]] = []
        self._stride, self._n_seen = 1, 0
        self._frame: LocalFrame | None = None
        self._health: Health | None = None
        self._turns: deque[Event] = deque(maxlen=MOST_TURNS)
        try:
            self._server = _Server(host, port, self)
        except (OSError, UnicodeError) as error:  # which the name of a host may be no text for
            why = getattr(error, "strerror", None) or error
            raise ConfigError(
                f"--page: cannot listen at {host}:{port}: {why}; give another address"
            ) from error
        self.port: int = self._server.server_address[1]
        self.address = f"http://{f'[{host}]' if ':' in host else host}:{self.port}/"
        threading.Thread(target=self._server.serve_forever, args=(CLOSES_S,), daemon=True).start()

    def __enter__(self) -> LivePage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __call__(self, status: RunStatus) -> None:
        """Take how it goes now; never waits for a browser."""
        self._note_turn(status.navigation)
        fields = self._fields(status)
        text = json.dumps(fields, allow_nan=False).encode()
        with self._changed:
            self._text = text
            self._keep(fields["point"])
            self._version += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Hang up on all and listen no more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()

    def _note_turn(self, navigation: Navigation | None) -> None:
        """Remember when the verdict became another, and why."""
        if navigation is None or navigation.health is self._health:
            return
        self._health = navigation.health
        severity = _TURNED.get(self._health, Severity.WARNING)
        text = f"{self._health.name}: {navigation.reason}"
        self._turns.append(Event(navigation.time_s, severity, "verdict", text))

    def _keep(self, point: list[Any] | None) -> None:
        self._n_seen += 1
        if point is None or self._n_seen % self._stride:
            return
        self._points.append(point)
        if len(self._points) > MOST_POINTS:
            self._points, self._stride = self._points[::2], 2 * self._stride

    def events(self) -> _Events:
        """Return what one browser is to be sent."""
        return _Events(self)

    def _fields(self, status: RunStatus) -> dict[str, Any]:
        """Return what the page shows, in the units of its words."""
        heard = [source.altitude_m for source in status.sources if source.age_s <= ALTITUDE_S]
        altitude_m = next((x for x in heard if math.isfinite(x)), None)
        own = self._navigation_fields(status.navigation)
        point = None
        if status.navigation is not None:
            of = (own[name] for name in ("depth_m", "sigma_m", "protection_m"))
            doubtful = int(status.navigation.health is not Health.GOOD)
            place = self._place(status.navigation)
            point = [_round(x, 3) for x in (own["time_s"], *place, *of, altitude_m)] + [doubtful]
        return {
            **own,
            "point": point,
            "altitude_m": altitude_m,
            "vehicle": status.vehicle,
            "folder": status.folder,
            "elapsed_s": status.elapsed_s,
            "n_messages": status.n_messages,
            "reason": status.reason,
            "note": status.note,
            "log_problem": status.log_problem,
            "checkpoint_age_s": _finite(status.checkpoint_age_s),
            "events": [
                {"time_s": _finite(e.time_s), "severity": e.severity.name, "text": e.text}
                for e in sorted((*status.events, *self._turns), key=_begun_s)
            ],
            "sources": [
                {
                    "name": s.name,
                    "address": s.address,
                    "state": s.state.value,
                    "rate_hz": _finite(s.rate_hz),
                    "n_refused": s.n_refused + s.n_limited,
                    "age_s": _finite(s.age_s),
                }
                for s in status.sources
            ],
            "outputs": [
                {k: getattr(o, k) for k in ("name", "address", "n_clients", "n_dropped")}
                for o in status.outputs
            ],
        }

    def _navigation_fields(self, navigation: Navigation | None) -> dict[str, Any]:
        names = ["time_s", "lat_deg", "lon_deg", "roll_deg", "pitch_deg", "heading_deg"]
        names += ["sigma_up_m", "sigma_heading_deg", "protection_m", "since_aid_s"]
        own = ("depth_m", "speed_m_per_s", "course_deg", "sigma_m", "bottom_lock")
        if navigation is None:
            nothing: dict[str, Any] = dict.fromkeys((*names, *own))
            return nothing | {"health": Health.ALIGNING.name, "beam_weights": []}
        fields = navigation_fields(navigation)
        east, north, _ = navigation.velocity_enu.tolist()
        speed = math.hypot(east, north)
        sigma = float(np.sqrt(0.5 * np.sum(navigation.position_sigma_enu[:2] ** 2)))
        return {name: fields[name] for name in names} | {
            "depth_m": _finite(self._surface_height_m - navigation.height),
            "speed_m_per_s": _finite(speed),
            "course_deg": math.degrees(math.atan2(east, north)) % 360 if speed > SLOWEST else None,
            "sigma_m": _finite(sigma),
            "bottom_lock": fields["bottom_lock"],
            "health": fields["health"],
            "beam_weights": [_round(x, 3) for x in fields["beam_weights"]],
        }

    def _place(self, navigation: Navigation) -> tuple[float | None, float | None]:
        """Return metres east and north of the first answer."""
        at = navigation.lat, navigation.lon, navigation.height
        if not all(map(math.isfinite, at)):
            return None, None
        if self._frame is None:
            self._frame = LocalFrame(*at)
        east, north, _ = self._frame.p_n_from_geodetic(*map(np.asarray, at)).tolist()
        return east, north


def _begun_s(event: Event) -> float:
    return event.time_s if math.isfinite(event.time_s) else -math.inf


class _Events:
    """What one browser is sent: the track so far, then the newest state again and again."""

    def __init__(self, page: LivePage) -> None:
        self._page, self._version = page, -1

    def next(self) -> bytes | None:
        """Wait for the next thing to send; None at the end of the run."""
        page = self._page
        with page._changed:
            if self._version < 0:
                self._version = 0
                track = list(page._points)
                is_first = True
            else:
                page._changed.wait_for(self._is_new, timeout=PATIENCE_S / 2.0)
                is_first = False
            if page._is_closed:
                return None
            version, text = page._version, page._text
        if is_first:
            return b"retry: 1000\nevent: track\ndata: " + json.dumps(track).encode() + b"\n\n"
        if version == self._version:
            return b": still here\n\n"
        self._version = version
        return b"event: status\ndata: " + text + b"\n\n"

    def _is_new(self) -> bool:
        return self._page._is_closed or self._page._version != self._version


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 8
    allow_reuse_address = True

    def __init__(self, host: str, port: int, page: LivePage) -> None:
        self.page = page
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._room = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self.browsers = threading.BoundedSemaphore(MOST_BROWSERS)
        super().__init__((host, port), _Handler)
        self.is_private = ipaddress.ip_address(str(self.server_address[0])).is_loopback

    def server_bind(self) -> None:
        """Bind without asking for the name of this computer, which takes long where none tells."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # there is no thread to be had
            self._room.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a browser that is gone is no event of the run."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = PATIENCE_S
    server_version, sys_version = "ssm-graph", ""

    def do_GET(self) -> None:
        """Answer the page, or its events."""
        if not self._is_asked_here():
            self._refuse(403, "this page is asked for by its address")
        elif self.path == "/":
            page = (files("ssm_graph.live.page") / "page.html").read_bytes()
            self._begin("text/html; charset=utf-8", length=len(page))
            self.wfile.write(page)
        elif self.path == "/events":
            self._send_events()
        else:
            self._refuse(404, "there is / and /events")

    def _is_asked_here(self) -> bool:
        """Whether a page that only this computer sees is asked for under a name of this computer.

        Another name that leads here is one that a stranger's page made its own.
        """
        if not self.server.is_private:
            return True
        host = _PORT.sub("", self.headers.get("Host") or "").strip("[]")
        if host.lower() == "localhost":
            return True
        with contextlib.suppress(ValueError):
            return ipaddress.ip_address(host).is_loopback
        return False

    def _send_events(self) -> None:
        server = self.server
        if not server.browsers.acquire(blocking=False):
            self._refuse(503, f"there are {MOST_BROWSERS} browsers already")
            return
        events = server.page.events()
        try:
            # What waits for a slow one is little, and old soon.
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2**16)
            self._begin("text/event-stream")
            while (data := events.next()) is not None:
                self.wfile.write(data)
        except OSError:
            self.close_connection = True
        finally:
            server.browsers.release()

    def _begin(self, kind: str, *, length: int | None = None, code: int = 200) -> None:
        self.send_response(code)
        for name, value in {"Content-Type": kind, **_HEADERS}.items():
            self.send_header(name, value)
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.send_header("Connection", "close")
        self.end_headers()

    def _refuse(self, code: int, text: str) -> None:
        self._begin("text/plain; charset=utf-8", length=len(text), code=code)
        self.wfile.write(text.encode())

    def log_message(self, *_: object) -> None:
        """Say nothing: the terminal is the run's."""


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _round(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
