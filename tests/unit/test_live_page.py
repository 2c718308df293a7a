"""The live page: what it says, whom it serves, and that nobody who looks on holds the run up."""

from __future__ import annotations

import json
import math
import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.live.page.server import (
    MOST_BROWSERS,
    MOST_POINTS,
    LivePage,
    parse_page_address,
)
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.mission.run_status import LinkState, RunStatus, SourceStatus
from tests.browser import BROWSER, Browser


def status(
    k: int = 0, *, health: Health = Health.GOOD, age_s: float = 0.1, **more: Any
) -> RunStatus:
    """Return how a run goes after ``k`` s eastwards at 1.5 m/s; ``age_s`` is that of its DVL."""
    navigation = Navigation(
        time_s=float(k),
        lat=0.8,
        lon=0.2 + 1.5 * k / 6.38e6 / math.cos(0.8),
        height=-12.5,
        health=health,
        reason="fixes are off" if health is Health.BAD else "all agree",
        confidence=0.9,
        bottom_lock=True,
        since_aid_s=0.2,
        latency_s=0.01,
        velocity_enu=np.array([1.5, 0.0, 0.1]),
        roll_pitch_heading=np.radians([1.0, -2.0, 80.0]),
        position_sigma_enu=np.array([0.3, 0.4, 0.05]),
        velocity_sigma_enu=np.full(3, 0.01),
        attitude_sigma=np.full(3, 0.001),
        gyro_bias=np.zeros(3),
        accel_bias=np.zeros(3),
        beam_weights=np.array([1.0, 0.02, np.nan, 0.6]),
        protection_m=math.inf if health is Health.BAD else 4.0,
    )
    source = SourceStatus("dvl", "tcp://a:1", LinkState.CONNECTED, age_s=age_s, altitude_m=7.5)
    event = Event(1.0, Severity.WARNING, "bottom_lost", "no bottom <b>lock</b>")
    return RunStatus(
        "rov",
        "run",
        1.0,
        5,
        navigation,
        navigation.reason,
        sources=(source,),
        events=(event,),
        **more,
    )


@pytest.fixture
def page() -> Iterator[LivePage]:
    """Return a page that listens at a port of its own."""
    with LivePage("127.0.0.1", 0, surface_height_m=1.0) as served:
        yield served


def events_of(page: LivePage) -> Iterator[tuple[str, Any]]:
    """Yield name and content of what a browser is sent."""
    with urllib.request.urlopen(page.address + "events", timeout=10) as answer:
        name = ""
        for line in answer:
            if line.startswith(b"event: "):
                name = line[7:].decode().strip()
            elif line.startswith(b"data: "):
                yield name, json.loads(line[6:])


def test_what_a_browser_is_told(page: LivePage) -> None:
    """The track so far, then the newest state, in the words of people on watch."""
    for k in range(3):
        page(status(k))
    told = events_of(page)
    name, track = next(told)
    assert name == "track"
    np.testing.assert_allclose([p[1] for p in track], [0.0, 1.5, 3.0], atol=0.01)
    name, now = next(told)
    assert name == "status"
    assert now["depth_m"] == 13.5
    assert now["altitude_m"] == 7.5
    assert (now["speed_m_per_s"], now["course_deg"]) == (1.5, 90.0)
    assert now["sigma_m"] == pytest.approx(math.sqrt((0.09 + 0.16) / 2.0))
    assert now["protection_m"] == 4.0
    assert now["beam_weights"] == [1.0, 0.02, None, 0.6]
    page(status(3, health=Health.BAD, age_s=60.0))
    name, now = next(told)
    assert (now["health"], now["protection_m"], now["point"][7]) == ("BAD", None, 1)
    assert now["altitude_m"] is None  # of a minute ago
    turns = [(e["time_s"], e["severity"], e["text"]) for e in now["events"]]
    assert turns[0] == (0.0, "INFO", "GOOD: all agree")
    assert turns[1:] == [
        (1.0, "WARNING", "no bottom <b>lock</b>"),
        (3.0, "ERROR", "BAD: fixes are off"),
    ]


def test_before_the_first_answer(page: LivePage) -> None:
    """What is not known is null, never a number."""
    page(RunStatus("rov", "run", 0.0, 0, None, "waiting for inertial data"))
    told = events_of(page)
    assert next(told) == ("track", [])
    _, now = next(told)
    assert (now["health"], now["depth_m"], now["point"]) == ("ALIGNING", None, None)


def test_a_long_track_is_thinned(page: LivePage) -> None:
    """From the first point to the last, at most so many."""
    first = status()
    for _ in range(2 * MOST_POINTS + 10):
        page._keep([float(page._n_seen), 0.0])
    page(first)
    _, track = next(events_of(page))
    assert MOST_POINTS / 2 < len(track) <= MOST_POINTS
    assert track[0][0] < 5.0
    assert np.all(np.diff([p[0] for p in track[:-1]]) > 0.0)


def test_who_does_not_read_holds_nobody_up(page: LivePage) -> None:
    """Connections that say nothing and one that never reads: the others are told all the same."""
    quiet = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(3)]
    hung = socket.socket()
    hung.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
    hung.connect(("127.0.0.1", page.port))
    hung.sendall(b"GET /events HTTP/1.1\r\nHost: localhost:1\r\n\r\n")
    told = events_of(page)
    next(told)
    for k in range(400):
        page(status(k))
    page(status(400, note="last"))
    assert any(now["note"] == "last" for _, now in told)
    for one in (*quiet, hung):
        one.close()


def test_it_serves_so_many(page: LivePage) -> None:
    """One browser more is told so, and the page is there all the same."""
    open_ = []
    for _ in range(MOST_BROWSERS):
        open_.append(events_of(page))
        next(open_[-1])
    with pytest.raises(urllib.error.HTTPError, match="503"):
        urllib.request.urlopen(page.address + "events", timeout=10)
    with urllib.request.urlopen(page.address, timeout=10) as answer:
        assert b"<!DOCTYPE html>" in answer.read()


@pytest.mark.parametrize(
    ("host", "path", "code"),
    [
        ("evil.example:80", "/", 403),
        ("", "/", 403),
        ("localhost:80", "/etc", 404),
        ("Localhost", "/etc", 404),
        ("127.0.0.1", "/etc", 404),
        ("[::1]", "/etc", 404),
    ],
)
def test_others_are_refused(page: LivePage, host: str, path: str, code: int) -> None:
    """A stranger's name for this computer, and what is not there; port 80 goes without saying."""
    request = urllib.request.Request(page.address.rstrip("/") + path, headers={"Host": host})
    with pytest.raises(urllib.error.HTTPError, match=str(code)):
        urllib.request.urlopen(request, timeout=10)


def test_addresses() -> None:
    """Loopback unless another host is named; one that is taken is said."""
    assert parse_page_address(":8080") == ("127.0.0.1", 8080)
    assert parse_page_address("[::1]:81") == ("::1", 81)
    with pytest.raises(ConfigError, match="expected HOST:PORT"):
        parse_page_address("localhost:http")
    with pytest.raises(ConfigError, match="give another"):
        LivePage("a..b", 8080)
    with LivePage("127.0.0.1", 0) as page, pytest.raises(ConfigError, match="give another"):
        LivePage("127.0.0.1", page.port)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no chromium or chrome on this machine")
def test_in_a_browser(page: LivePage, tmp_path: Path) -> None:
    """Words of health without colour, texts as texts, an alarm once the run is silent or gone."""
    word = "document.getElementById('word').textContent"
    with Browser(tmp_path) as browser:
        browser.open(page.address)
        page(status(0))
        page(status(1))
        browser.wait_for(f"document.readyState == 'complete' && {word} == '✓ GOOD'")
        page(status(2, health=Health.BAD))
        browser.wait_for(f"{word}.includes('ALARM: DO NOT USE')")
        assert "fixes are off" in browser.value("document.getElementById('why').textContent")
        shown = browser.value("document.body.innerText")
        for text in ("13.50 m", "90.0°", "0.02 OUT", "missing", "7.50 m", "no bottom <b>lock</b>"):
            assert text in shown, text
        browser.resize(390, 800)
        assert browser.value("document.documentElement.scrollWidth") <= 390
        browser.wait_for(f"{word}.includes('ALARM: NOTHING NEW')")
        page.close()
        browser.wait_for(f"{word}.includes('ALARM: NO CONNECTION')")
        browser.screenshot(tmp_path / "page.png")
        assert (tmp_path / "page.png").stat().st_size > 20_000
        assert not [e for e in browser.errors if "ERR_CONNECTION" not in e and "network" not in e]
