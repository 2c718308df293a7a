"""What a person on watch reads, as text."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from ssm_graph.mission.estimate import CalibratedValue, Calibration, CurrentTrack, Found
from ssm_graph.mission.navigation import Event, Health, Severity
from ssm_graph.mission.run_status import Latency, LinkState, OutputStatus, RunStatus, SourceStatus
from ssm_graph.report.terminal.status_page import (
    StatusPage,
    plain_line,
    render,
    weight_bar,
)
from tests.live_fixture import a_navigation

STATUS = RunStatus(
    vehicle="otter [2]",
    folder="runs/1",
    elapsed_s=3723.4,
    n_messages=12409,
    navigation=a_navigation(100.0, 0.7),
    reason="all is well",
    latency=Latency(0.001, 0.012, 0.0345),
    sources=(
        SourceStatus(
            "dvl",
            "tcp://192.168.194.95:16171",
            LinkState.WAITING,
            n_bytes=5,
            n_messages=7,
            n_refused=2,
            n_limited=3,
            n_reconnects=4,
            rate_hz=7.96,
            age_s=12.3,
        ),
    ),
    outputs=(OutputStatus("json", "udp://127.0.0.1:9000", 1, 77, 0),),
    events=(Event(99.0, Severity.ERROR, "bottom_lost", "no beam [counts]"),),
    log_problem=None,
    checkpoint_age_s=4.0,
)


def text_of(status: RunStatus, *, width: int = 80) -> str:
    """Return the page as plain text."""
    stream = io.StringIO()
    Console(file=stream, width=width).print(render(status))
    return stream.getvalue()


def test_the_page_has_everything() -> None:
    """Health and reason, all states with sigmas and units, beams, sources, events, disk."""
    text = text_of(STATUS, width=100)
    for expected in (
        "otter [2]",
        "1:02:03",
        "GOOD",
        "all is well",
        "confidence 0.90",
        f"lat {math.degrees(0.7):.7f}° ±0.40 m",
        f"lon {math.degrees(-0.7):.7f}° ±0.30 m",
        "height -20.00 ±0.05 m",
        "east +1.000 ±0.010 m/s",
        "north -0.500 ±0.010 m/s",
        "roll 1.00 ±0.02°",
        "heading 350.00 ±0.5°",
        "1█ 1.00",
        "2▅ 0.60",
        "3▁ 0.02",
        "4· –",
        "bottom lock",
        "last aid 0.2 s ago",
        "median 1.0 ms, 99 % 12.0 ms, max 34.5 ms",
        "waiting",
        "tcp://192.168.194.95:16171",
        "8.0",
        "12.3 s",
        "→ json",
        "1 listening",
        "99.0 s  no beam [counts]",
        "checkpoint 4.0 s ago",
        "runs/1",
    ):
        assert expected in text, f"{expected!r} is missing in\n{text}"
    narrow = text_of(STATUS)
    assert "heading 350.00 ±0.5°" in narrow
    assert "last aid 0.2 s ago" in narrow
    row = next(line for line in text.splitlines() if "16171" in line)
    assert row.split()[1:-2] == ["dvl", "waiting", "8.0", "7", "5", "4", "12.3", "s"]


def test_the_page_before_the_first_answer() -> None:
    """What is waited for stands where the answer will be."""
    view = RunStatus(
        "otter",
        "runs/1",
        0.0,
        0,
        None,
        "waiting for a fix",
        log_problem="raw log: no space left",
        note="going through the log",
    )
    text = text_of(view)
    assert "ALIGNING  waiting for a fix" in text
    assert "nothing has come yet" in text
    assert "raw log: no space left" in text
    assert "going through the log" in text
    line = plain_line(view)
    assert line == (
        "0:00:00; ALIGNING; waiting for a fix; raw log: no space left; going through the log"
    )


def test_a_plain_line_says_the_most_important() -> None:
    """One line without markup; the reason where all is not well."""
    line = plain_line(STATUS)
    assert line.startswith("1:02:03; GOOD; lat 40.1070457 lon -40.1070457 deg; height -20.00 m; ")
    assert "sigma 0.50 m; protected within 2.5 m; heading 350.0 deg; bottom lock" in line
    assert "dvl waiting 8/s" in line
    assert "all is well" not in line
    navigation = a_navigation(1.0, health=Health.BAD, bottom_lock=False, since_aid_s=math.inf)
    bad = RunStatus("otter", "", 0.0, 1, navigation, "it has run away")
    assert "BAD" in plain_line(bad)
    assert "no bottom lock" in plain_line(bad)
    assert "last aid not yet" in text_of(bad)


def test_without_a_terminal_a_line_every_ten_seconds() -> None:
    """As a service's journal wants it."""
    stream, now = io.StringIO(), [0.0]
    with StatusPage(Console(file=stream, width=80), steady_s=lambda: now[0]) as show:
        for _ in range(41):
            show(STATUS)
            now[0] += 0.5
    lines = stream.getvalue().splitlines()
    assert len(lines) == 3
    assert all("GOOD" in line and "\x1b" not in line for line in lines)


def test_on_a_terminal_the_page_is_drawn_again() -> None:
    """Colours say the health."""
    stream = io.StringIO()
    console = Console(file=stream, width=120, force_terminal=True, color_system="standard")
    with StatusPage(console) as show:
        show(STATUS)
        show(STATUS)
    assert "\x1b[1;32m GOOD" in stream.getvalue()


@pytest.mark.parametrize(
    ("weight", "bar"),
    [(0.0, "▁"), (0.124, "▁"), (0.126, "▂"), (0.99, "█"), (1.0, "█"), (1.4, "█"), (np.nan, "·")],
)
def test_weights_as_bars(weight: float, bar: str) -> None:
    """Eight steps; weights above 1 are full, beams that are missing have none."""
    assert weight_bar(weight) == bar


def test_the_page_has_what_was_found_besides() -> None:
    """Current and calibration, each with its sigma and its unit; neither where there is none."""
    found = Found(
        Calibration(
            (CalibratedValue("dvl_mounting", "dvl_mounting_z_deg", 0.5, 1.0, 0.1, 2.0),),
            np.eye(1),
            np.zeros((1, 0)),
        ),
        CurrentTrack(np.zeros(1), np.array([[0.3, -0.4, 0.0]]), np.diag([0.01, 0.04, 0.0])[None]),
    )
    text = text_of(replace(STATUS, found=found), width=100)
    assert "dvl_mounting_z_deg +2 ±0.2" in text
    assert "current  east +0.30 ±0.10  north -0.40 ±0.20" in text
    plain = text_of(STATUS)
    assert "off what is stated" not in plain
    assert "current" not in plain


@pytest.mark.parametrize("n_beams", [1, 3, 8])
def test_the_page_has_every_beam(n_beams: int) -> None:
    """However many the instrument has; what does not fit goes on in the next line."""
    weights = np.linspace(1.0, 0.0, n_beams)
    navigation = a_navigation(100.0, 0.7, beam_weights=weights)
    page = text_of(replace(STATUS, navigation=navigation))
    shown = " ".join(page.replace("│", "").split())
    for number, weight in enumerate(weights, start=1):
        assert f" {number}{weight_bar(weight)} {weight:.2f}" in shown
    assert f" {n_beams + 1}{weight_bar(0.0)}" not in shown
