"""The serial protocol of a Water Linked DVL: the maker's lines, order, damage, recordings."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.protocols.waterlinked_serial import crc8
from ssm_graph.live.recorded.log import read_recorded
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.messages import Message
from tests.water_linked_fixture import serial_line, serial_ping, velocity_report

BEGIN_S = 1_700_000_000.0
ALONG, DOWN = math.sin(math.pi / 8.0) / math.sqrt(2.0), math.cos(math.pi / 8.0)
BEAMS = np.array([[-1, 1], [-1, -1], [1, -1], [1, 1]]) * ALONG
"""(4, 2): x and y of the beams, z is DOWN."""


def pings(n: int) -> tuple[list[bytes], Array]:
    """Return the lines of pings of a vehicle that turns and accelerates, and their speeds (n, 4).

    Of the seventh the second beam has no lock.
    """
    rng = np.random.default_rng(5)
    velocity = np.cumsum(rng.normal(0.0, 0.05, (n, 3)), axis=0)
    speed = velocity[:, :2] @ BEAMS.T + DOWN * velocity[:, 2:]
    speed[6:7, 1] = math.nan
    times_s = BEGIN_S + 0.1 * np.arange(n)
    return [serial_ping(*one) for one in zip(times_s, speed, velocity, strict=True)], speed


def fed(data: bytes, *, size: int = 1000) -> tuple[list[Message], list[str]]:
    """Return what a decoder makes of bytes that come in pieces, and what it refused."""
    decoder, found = WaterLinkedDecoder(heading=True, max_clock_error_s=1e3), list[Message]()
    for at in range(0, len(data), size):
        found += decoder.feed(data[at : at + size], arrival_s=BEGIN_S + 1.0)
    return found, decoder.take_refusals()


def speeds(messages: list[Message]) -> Array:
    """Return (n, 4) speeds along beams, m/s."""
    return np.array([one.speed for one in messages if isinstance(one, Ping)])


def test_lines_of_the_maker() -> None:
    """Out of its manual, with their checksums."""
    lines = (
        "wrz,0.120,-0.400,2.000,y,1.30,1.855,1e-07;0;1.4;0;1.2;0;0.2;0;1e+09,7,14,123.00,1*50",
        "wru,0,0.070,1.10,-40,-95*9c",
        "wru,1,-0.500,1.25,-62,-104*f0",
        "wru,2,2.200,1.40,-56,-98*18",
        "wru,3,1.800,1.35,-58,-96*a3",
        "wrp,49056.809,0.41,0.15,1.23,0.4,53.9,13.0,19.3,0*de",
        "wrx,112.83,0.007,0.017,0.006,0.000,0.93,y,0*d2",
        "wrt,15.00,15.20,14.90,14.20*b1",
    )
    for line in lines:
        body, _, given = line.partition("*")
        assert f"{crc8(body.encode()):02x}" == given
    found, refused = fed("\n".join(lines).encode() + b"\n")
    assert isinstance(found[0], Ping)
    assert found[0].speed == (0.07, -0.5, 2.2, 1.8)
    assert isinstance(found[1], HeadingReading)
    assert math.degrees(found[1].heading) == pytest.approx(19.3)
    assert all("stamps" in text for text in refused)


@pytest.mark.parametrize("size", [1, 7, 4096])
def test_speeds_and_times_are_those_of_the_lines(size: int) -> None:
    """However the bytes are cut; a transducer that heard nothing is no beam."""
    lines, speed = pings(12)
    found, refused = fed(b"".join(lines), size=size)
    np.testing.assert_allclose(speeds(found), speed, atol=6e-4)
    expected = BEGIN_S + 0.1 * np.arange(12)
    np.testing.assert_allclose([one.time_s for one in found], expected, atol=1e-6)
    assert not refused


def test_transducers_before_their_velocity() -> None:
    """After some pings each goes with the velocity that it agrees with; none comes twice."""
    lines, speed = pings(40)
    before = []
    for one in lines:
        head, *beams = one.splitlines(keepends=True)
        before += [*beams, head]
    found, _ = fed(b"".join(before))
    of_time = {round((one.time_s - BEGIN_S) / 0.1): one for one in found if isinstance(one, Ping)}
    assert len(of_time) == len(found) >= 38
    for k in range(10, 40):
        np.testing.assert_allclose(of_time[k].speed, speed[k], atol=6e-4)


def test_a_velocity_that_is_a_little_off_its_beams_turns_no_order() -> None:
    """By 2 mm/s of noise and 2 % of scale, of a vehicle that speeds up and slows down."""
    rng, n = np.random.default_rng(1), 240
    velocity = np.cumsum(np.repeat(rng.normal(0.0, 0.03, (n // 20, 3)), 20, axis=0), axis=0)
    speed = np.round(velocity[:, :2] @ BEAMS.T + DOWN * velocity[:, 2:], 3)
    said = 1.02 * velocity + rng.normal(0.0, 0.002, (n, 3))
    times_s = BEGIN_S + 0.1 * np.arange(n)
    found, _ = fed(b"".join(map(serial_ping, times_s, speed, said)))
    np.testing.assert_allclose(speeds(found), speed, atol=6e-4)


def test_damage_costs_its_ping() -> None:
    """Whether a transducer's line is damaged or the velocity's."""
    lines, speed = pings(6)
    lines[1] = lines[1].replace(b"wru,2,", b"wru,2,9")
    lines[3] = lines[3].replace(b"wrz,", b"wrz,9")
    found, refused = fed(b"".join(lines))
    assert len(refused) == 2
    assert "expected checksum" in refused[0]
    np.testing.assert_allclose(speeds(found), np.delete(speed, [1, 3], axis=0), atol=6e-4)


def test_no_ping_is_made_of_two() -> None:
    """Bytes that are lost from amid one ping to amid the next leave no mixture of both."""
    lines, speed = pings(8)
    data = b"".join(lines)
    for begin in range(len(lines[0]), 2 * len(lines[0]), 7):
        found, _ = fed(data[:begin] + data[begin + len(lines[0]) :])
        for one in speeds(found):
            assert np.nanmax(np.abs(speed - one), axis=1).min() < 6e-4


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("wru,0,0.1", "3 fields or more, got 2"),
        ("wru", "3 fields or more, got 0"),
        ("wru,4,0.1,1.0,-40,-95", "numbers 0 to 3, got 4"),
        ("wru,0,nan,1.0,-40,-95", "velocity: expected a number"),
        ("wrz,0.1,0.1,0.1,y,1.0", "expected 11 fields, got 5"),
        ("wrz,0.1,0.1,0.1,x,1.0,0.1,0;0,7,14,100.0,0", "y or n"),
        ("wrz,0.1,0.1,0.1,y,1.0,0.1,0;0,-7,14,100.0,0", "whole microseconds"),
        ("wrp,1.0,2.0", "expected 9 fields, got 2"),
        ("wrq,1", "expected wrz, wrs, wru or wrp"),
    ],
)
def test_lines_that_are_no_sound_ones(body: str, said: str) -> None:
    """Their checksum is right; one sentence each, and the next ping is read."""
    lines, speed = pings(2)
    found, refused = fed(lines[0] + serial_line(body) + lines[1])
    np.testing.assert_allclose(speeds(found), speed, atol=6e-4)
    (text,) = refused
    assert said in text


def test_the_first_version_alone_is_told(tmp_path: Path) -> None:
    """Once, and what to set; beside the second it is passed over."""
    old = serial_line("wrx,112.83,0.007,0.017,0.006,0.000,0.93,y,0")
    old += serial_line("wrt,15.00,15.20,14.90,14.20")
    log = tmp_path / "old.log"
    log.write_bytes(30 * old)
    with pytest.raises(DataError, match="WL - Serial V2"):
        read_recorded(log)
    assert "WL - Serial V2" in fed(30 * (old + serial_line("wrp,1.5,0,0,0,0,0,0,0,0")))[1][0]
    lines, _ = pings(9)
    found, refused = fed(b"".join(old + one for one in lines))
    assert len(found) == 9
    assert not refused


def test_no_lock_and_water_track() -> None:
    """A velocity that is not valid and no altitude: no beam counts; wrs is off the water."""
    (ping,), _ = pings(1)
    lost = ping.splitlines()[0].partition(b"*")[0].replace(b",y,4.00", b",n,-1.00").decode()
    beams = b"\n".join(ping.splitlines()[1:]) + b"\n"
    (found,), _ = fed(serial_line(lost) + beams)
    assert isinstance(found, Ping)
    assert np.isnan(found.speed).all()
    water = ping.splitlines()[0].partition(b"*")[0].replace(b"wrz", b"wrs").replace(b",4.00", b"")
    (found,), refused = fed(serial_line("wrs,1776409079,0,,") + serial_line(water.decode()) + beams)
    assert isinstance(found, Ping)
    assert found.is_water
    assert not refused


@pytest.mark.parametrize("order", ["sj", "js", "sjs", "jsj"])
@pytest.mark.parametrize("join", [b"", b"\r\n"], ids=["back to back", "lines"])
def test_either_protocol_at_one_port(order: str, join: bytes) -> None:
    """The instrument is switched from one to the other; no ping is lost, however bytes are cut."""
    lines, speed = pings(len(order))
    lead = b'{"type":"response","result":"' + 700 * b"x" + b'"}'
    data = [
        lines[k]
        if one == "s"
        else lead + join + velocity_report(BEGIN_S + 0.1 * k, speed[k]).encode() + b"\r\n"
        for k, one in enumerate(order)
    ]
    for size in (1, 100, 333, 10_000):
        found, refused = fed(b"".join(data), size=size)
        np.testing.assert_allclose(speeds(found), speed, atol=6e-4)
        assert len(refused) <= order.count("js")


def test_a_recording(tmp_path: Path) -> None:
    """As a terminal writes it, begun amid a line, with stamps of its own before each."""
    lines, speed = pings(12)
    stamped = [
        f"[2023-11-14 22:13:2{k % 10}] ".encode() + line
        for k, one in enumerate(lines)
        for line in one.splitlines(keepends=True)
    ]
    log = tmp_path / "minicom.cap"
    for lead in (b"", b"INFO node_of_the_velocity_log: received "):
        log.write_bytes(b"00,0.002*5f\r\n" + b"".join(lead + one for one in stamped))
        found = read_recorded(log)
        assert found is not None
        assert found.about == "Water Linked, serial protocol, 12 pings"
        np.testing.assert_allclose(speeds(list(found.messages)), speed, atol=6e-4)


def test_json_is_read_as_before() -> None:
    """Whatever stands before the first report."""
    report = velocity_report(BEGIN_S, np.zeros(4))
    for lead in (b"", b"\n", b"x", b"abc wr\n", b"["):
        found, _ = fed(lead + report.encode() + json.dumps({"type": "response"}).encode(), size=3)
        assert len(found) == 1
