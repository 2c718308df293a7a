"""The vehicle's clock is set under a run: its own time goes on, in one process and in the next."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from ssm_graph.live.protocols.json_messages import JsonDecoder, encode_message
from ssm_graph.live.run.clock_file import CLOCK_NAME, ClockFile
from ssm_graph.live.sockets.clocks import RunClock
from ssm_graph.live.sockets.endpoints import LOOPBACK, Endpoint, Transport
from ssm_graph.live.sockets.inputs import UdpInput
from ssm_graph.live.sockets.outputs import OutputFormat, Publisher
from ssm_graph.live.sockets.sockets import InputConfig, SocketHub
from ssm_graph.sensors.imu import ImuSample
from tests.instrument_fixture import Receiver, UdpSender
from tests.live_fixture import Recorder, a_navigation

WALL_S = 1_700_000_000.0


class Clocks:
    """A computer's two clocks, one of which is set."""

    def __init__(self) -> None:
        self.steady, self.set_by_s = 5000.0, 0.0

    def wall_s(self) -> float:
        """Return Unix time."""
        return WALL_S + self.steady + self.set_by_s

    def steady_s(self) -> float:
        """Return seconds since the computer was started."""
        return self.steady


@pytest.mark.parametrize("by_s", [30.0, -30.0, 0.5, -1e9])
def test_the_time_of_a_run_goes_on(by_s: float) -> None:
    """However far the vehicle's clock is set; slower than a step it may go as it likes."""
    clocks = Clocks()
    run = RunClock(clocks.wall_s, clocks.steady_s)
    clocks.steady += 10.0
    clocks.set_by_s = 7.0
    assert run.read()[1] == pytest.approx(7.0)
    assert run.time_s == clocks.wall_s()  # nothing has come: it may be right now
    run.begin()
    clocks.set_by_s = 7.0 + by_s
    _, step_s = run.read()
    assert step_s == pytest.approx(by_s)
    assert run.time_s == pytest.approx(WALL_S + 5017.0)
    clocks.steady += 10.0
    clocks.set_by_s += 0.01
    assert run.read()[1] == 0.0
    assert run.time_s == pytest.approx(WALL_S + 5027.01)


def test_clocks_that_are_read_apart_are_not_compared() -> None:
    """A process that is preempted between the two readings has seen no clock that was set."""
    clocks = Clocks()

    def wall_s() -> float:
        clocks.steady += 1.0  # between the two
        return WALL_S

    run = RunClock(wall_s, clocks.steady_s)
    assert run.read()[1] == run.set_by_s == 0.0


def test_the_next_process_knows_the_time_of_the_run(tmp_path: Path) -> None:
    """Set while it ran, and between two processes; another start of the computer is another run."""
    clocks, file = Clocks(), ClockFile(tmp_path, boot="a")
    assert file.set_by_s(clocks.wall_s(), clocks.steady_s()) == 0.0
    assert file.note(clocks.wall_s(), 0.0, clocks.steady_s()) is None
    clocks.set_by_s = 30.0
    assert file.note(clocks.wall_s() - 30.0, 30.0, clocks.steady_s()) is None
    clocks.steady += 100.0
    clocks.set_by_s = -7.0
    again = ClockFile(tmp_path, boot="a")
    assert again.set_by_s(clocks.wall_s(), clocks.steady_s()) == pytest.approx(-7.0)
    assert ClockFile(tmp_path, boot="b").set_by_s(clocks.wall_s(), clocks.steady_s()) == 0.0
    assert ClockFile(tmp_path, boot="").set_by_s(clocks.wall_s(), clocks.steady_s()) == 0.0


@pytest.mark.parametrize(
    "damage", [b"", b"\0" * 100, b"\xff\n", b"time_s\n1,2,3\nx,y,z,a\n", b"inf,0,1,a\nnan,0,1,a\n"]
)
def test_a_damaged_clock_file_says_nothing(tmp_path: Path, damage: bytes) -> None:
    """The run then begins with the vehicle's clock, as where there is no file; rows go on."""
    (tmp_path / CLOCK_NAME).write_bytes(damage)
    file = ClockFile(tmp_path, boot="a")
    assert file.set_by_s(WALL_S, 5000.0) == 0.0
    assert file.note(WALL_S - 30.0, 30.0, 5000.0) is None
    assert file.set_by_s(WALL_S, 5000.0) == pytest.approx(30.0)


def test_a_clock_file_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    """A full disk, or a folder in its place, ends nothing."""
    (tmp_path / CLOCK_NAME).mkdir()
    file = ClockFile(tmp_path, boot="a")
    said = file.note(WALL_S, 0.0, 0.0)
    assert said is not None
    assert CLOCK_NAME in said
    assert file.set_by_s(WALL_S, 0.0) == 0.0


def test_the_clock_is_set_under_a_hub() -> None:
    """It is told and remembered, samples go on, and answers are stamped by the clock as set."""
    clocks, noted = Clocks(), list[tuple[float, float, float]]()
    config = InputConfig("imu", Endpoint(Transport.UDP, LOOPBACK, 0), JsonDecoder)
    with SocketHub(
        [config],
        wall_s=clocks.wall_s,
        steady_s=clocks.steady_s,
        note_clock=lambda *row: noted.append(row),
    ) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        (source,) = hub.inputs
        assert isinstance(source, UdpInput)
        sender = UdpSender(source.port)
        for by_s in (0.0, 30.0, -30.0):
            clocks.steady += 0.01
            clocks.set_by_s += by_s
            n_messages = len(receiver.messages)
            sender.send(encode_message(ImuSample(clocks.wall_s(), (0.0,) * 3, (0.0, 0.0, -9.8))))
            receiver.until(lambda n=n_messages: len(receiver.messages) > n)  # type: ignore[misc]
            recorder = Recorder()
            recorder.set_by_s = hub.set_by_s
            Publisher().send(recorder, OutputFormat.JSON, a_navigation(hub.time_s, 1.0))
            fields = json.loads(recorder.sent[0][1])
            assert fields["time_s"] == pytest.approx(clocks.wall_s(), abs=1e-6)
            own_s = fields["time_s"] - fields["clock_set_by_s"]
            assert own_s == pytest.approx(WALL_S + clocks.steady, abs=1e-6)
        sender.close()
    begin_s = WALL_S + 5000.0
    times = [message.time_s - begin_s for message in receiver.messages]
    assert times == pytest.approx([0.01, 0.02, 0.03], abs=1e-6)
    assert receiver.kinds.count("clock_set") == 2
    assert [round(set_by_s, 6) for _, set_by_s, _ in noted] == [0.0, 30.0, 0.0]
    assert all(math.isclose(time_s - steady, WALL_S) for time_s, _, steady in noted)
