"""Serial ports as sources: read raw, opened again, and refused by their cause."""

from __future__ import annotations

import os
import pty
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.live.protocols.decoder import Decoder
from ssm_graph.live.protocols.nmea import NmeaDecoder
from ssm_graph.live.sockets.endpoints import OUTPUTS, Endpoint, Transport, parse_endpoint
from ssm_graph.live.sockets.feed import Limits
from ssm_graph.live.sockets.serial_port import SerialInput
from ssm_graph.live.sockets.sockets import InputConfig, SocketHub
from ssm_graph.mission.run_status import LinkState
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.messages import Message
from tests.instrument_fixture import pips

DEPTH = pips(DepthReading(0.0, 20.0))
QUICK = Limits(retry_s=(0.02, 0.1), stall_s=60.0)


@pytest.fixture
def line() -> Iterator[tuple[int, int]]:
    """Return the instrument's end of a line and ours, which is kept open as a cable is."""
    ends = pty.openpty()
    yield ends
    for end in ends:
        os.close(end)


def at(path: str, baud: int = 9600) -> InputConfig:
    """Return a pressure sensor at a port."""

    def make() -> Decoder:
        return NmeaDecoder()

    return InputConfig("depth", Endpoint(Transport.SERIAL, path, baud), make, QUICK)


def poll(hub: SocketHub, n_polls: int = 20) -> list[Message]:
    """Return what comes."""
    return [message for _ in range(n_polls) for message in hub.poll(0.005)]


def test_addresses_of_ports() -> None:
    """A path and a speed; for sources only."""
    found = parse_endpoint("serial:///dev/ttyUSB0?baud=115200", where="--dvl")
    assert found == Endpoint(Transport.SERIAL, "/dev/ttyUSB0", 115200)
    assert str(found) == "serial:///dev/ttyUSB0?baud=115200"
    for text in (
        "serial:///dev/ttyUSB0",
        "serial://ttyUSB0?baud=9600",
        "serial:///dev/x?baud=fast",
    ):
        with pytest.raises(ConfigError, match=r"serial:///dev/PORT\?baud=BAUD"):
            parse_endpoint(text, where="--dvl")
    with pytest.raises(ConfigError, match="--nmea: expected tcp-listen"):
        parse_endpoint("serial:///dev/ttyUSB0?baud=9600", where="--nmea", allowed=OUTPUTS)
    with pytest.raises(ConfigError, match=r"expected a baud of 50, .*, 115200.*, got 12345"):
        SocketHub([at("/dev/ttyUSB0", 12345)], [])


def test_bytes_come_as_they_are(line: tuple[int, int]) -> None:
    """Control characters and line ends too, at the speed that was asked for; nothing is echoed."""
    ours, theirs = line
    left = termios.tcgetattr(theirs)
    left[6][termios.VMIN] = 0  # by another program that had the port before
    termios.tcsetattr(theirs, termios.TCSANOW, left)
    with SocketHub([at(os.ttyname(theirs), 4800)], []) as hub:
        assert poll(hub) == []
        assert termios.tcgetattr(theirs)[6][termios.VMIN] in (1, b"\x01")
        os.write(ours, b"\x03\x11\x13\x04" + DEPTH + pips(DepthReading(0.0, 21.0)))
        assert len(poll(hub)) == 2
        assert hub.source_status()[0].state is LinkState.CONNECTED
        assert termios.tcgetattr(theirs)[4] == termios.B4800
        os.set_blocking(ours, False)
        with pytest.raises(BlockingIOError):
            os.read(ours, 100)


def test_a_port_that_comes_later_and_goes_again(tmp_path: Path) -> None:
    """An adapter that is plugged in, pulled out and plugged in again."""
    path = tmp_path / "ttyUSB0"
    with SocketHub([at(str(path))], []) as hub:
        assert poll(hub) == []
        assert hub.source_status()[0].state is LinkState.WAITING
        for _ in range(2):
            ours, theirs = pty.openpty()
            path.symlink_to(os.ttyname(theirs))
            poll(hub, 60)
            os.write(ours, DEPTH)
            assert len(poll(hub)) == 1
            os.close(ours)
            os.close(theirs)
            path.unlink()
            assert poll(hub) == []
            assert hub.source_status()[0].state is LinkState.WAITING
        assert hub.source_status()[0].n_reconnects == 1
        kinds = {event.kind for event in hub.take_events()}
    assert kinds == {"connect_failed", "connected", "connection_lost"}


def test_a_file_is_no_port(tmp_path: Path) -> None:
    """It is told, and tried again: a wrong name may be a device that is not there yet."""
    path = tmp_path / "file"
    path.write_bytes(DEPTH)
    with SocketHub([at(str(path))], []) as hub:
        assert poll(hub) == []
        assert "cannot open" in hub.take_events()[0].text
        assert isinstance(hub.inputs[0], SerialInput)
