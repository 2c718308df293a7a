"""From sockets of instruments to answers and files, with the real estimator and real signals."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import ExitCode
from ssm_graph.cli.online_run import engine_of
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.io.results.tables import read_results
from ssm_graph.live.estimator import ONLINE
from ssm_graph.live.protocols.json_messages import JsonDecoder, encode_message
from ssm_graph.live.protocols.nmea import NmeaDecoder
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.run.run_folder import RunFolder
from ssm_graph.live.run.runner import Connections, Runner
from ssm_graph.live.sockets.endpoints import LOOPBACK, Endpoint, Transport
from ssm_graph.live.sockets.feed import Limits
from ssm_graph.live.sockets.inputs import UdpInput
from ssm_graph.live.sockets.outputs import OutputFormat, TcpServerOutput
from ssm_graph.live.sockets.sockets import InputConfig, OutputConfig, SocketHub
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from tests.instrument_fixture import A50, UdpSender, free_port, gga, pips
from tests.mission_fixture import make_mission

TURN_S = 0.02
"""What the vehicle's clock goes on by while an instrument waits to be called."""
ROOT = Path(__file__).parents[2]
PATIENCE_S = 60.0

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a straight run of a minute."""
    folder = tmp_path_factory.mktemp("online") / "mission"
    write_mission(folder, make_mission())
    return folder


def start(*words: str | Path) -> subprocess.Popen[str]:
    """Start ``ssm-graph online`` as a process of its own."""
    command = [sys.executable, "-m", "ssm_graph.cli.main", "online", *map(str, words)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


def finish(*words: str | Path) -> tuple[int, str]:
    """Run it to its end."""
    process = start(*words)
    out, err = process.communicate(timeout=PATIENCE_S)
    return process.returncode, out + err


def wait_for(is_so: Callable[[], object], what: str) -> None:
    """Wait for it; fail where it does not come."""
    end_s = time.monotonic() + PATIENCE_S
    while not is_so():
        assert time.monotonic() < end_s, f"{what} did not come about"
        time.sleep(0.01)


@contextlib.contextmanager
def killed_at_last(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    """Leave no process behind where a test fails."""
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def size_of(path: Path) -> int:
    """Return the size of a file that may not be there yet."""
    return path.stat().st_size if path.exists() else 0


def is_larger(path: Path, size: float) -> bool:
    """Return whether a file has grown beyond a size."""
    return size_of(path) > size


def test_killed_twice_and_started_again(mission: Path, tmp_path: Path) -> None:
    """``kill -9`` in mid-run: the answer in the end is that of a run that nothing interrupted."""
    words: tuple[str | Path, ...] = ("--replay", mission, "--speed", "full", "--lag", "10")
    words = (*words, "--checkpoint-every", "5", "--out")
    code, said = finish(*words, tmp_path / "whole")
    assert code == ExitCode.GOOD, said
    log = tmp_path / "killed" / "log" / "imu.csv"
    whole_size = size_of(tmp_path / "whole" / "log" / "imu.csv")
    for share in (0.3, 0.7):
        with killed_at_last(start(*words, tmp_path / "killed")) as process:
            wait_for(partial(is_larger, log, share * whole_size), "the log")
            os.kill(process.pid, signal.SIGKILL)
            process.wait(PATIENCE_S)
            assert process.returncode == -signal.SIGKILL
    code, said = finish(*words, tmp_path / "killed")
    assert code == ExitCode.GOOD, said
    whole, killed = (read_results(tmp_path / name) for name in ("whole", "killed"))
    assert killed.summary["n_messages"] == whole.summary["n_messages"]
    for name in ("imu", "dvl", "depth", "gnss"):
        tables = [(tmp_path / run / "log" / f"{name}.csv") for run in ("whole", "killed")]
        rows = [
            [row for row in table.read_text().splitlines() if "torn" not in row] for table in tables
        ]
        assert rows[0] == rows[1], name
    assert_alike(killed.trajectory, whole.trajectory)
    assert_alike(killed.beams, whole.beams)
    newest = (run.summary["newest"] for run in (killed, whole))
    assert_alike(*({k: np.array(v) for k, v in x.items() if is_number(v)} for x in newest))


def is_number(value: Any) -> bool:
    """Return whether a value of an answer can be compared; the computing time cannot."""
    return isinstance(value, float)


def assert_alike(found: Any, expected: Any) -> None:
    """Compare all but the last digits, which depend on when a window was put together again."""
    assert list(found) == list(expected)
    for name in expected:
        if name != "latency_s":
            np.testing.assert_allclose(
                found[name], expected[name], rtol=1e-5, atol=1e-6, err_msg=name
            )


def test_sigterm_ends_in_order_and_the_run_goes_on_later(mission: Path, tmp_path: Path) -> None:
    """Answers reach a client; the end is written; the next process finishes the mission."""
    port, run = free_port(), tmp_path / "run"
    words = ("--replay", mission, "--out", run)
    with (
        killed_at_last(
            start(*words, "--speed", "6", "--publish", f"tcp-listen://:{port}")
        ) as process,
        connected(port) as client,
        client.makefile("rb") as lines,
    ):
        answers = [json.loads(lines.readline()) for _ in range(5)]
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode in (ExitCode.GOOD, ExitCode.NOT_GOOD), err
    assert "Traceback" not in err
    assert "asked to stop" in out
    assert all(answer["type"] == "navigation" for answer in answers)
    assert np.all(np.diff([answer["time_s"] for answer in answers]) > 0.0)
    summary = read_results(run).summary
    assert summary["ended"] == "it was asked to stop"
    n_messages = len(list(messages_of(make_mission())))
    assert 0 < summary["n_messages"] < n_messages
    code, said = finish(*words, "--speed", "full")
    assert code == ExitCode.GOOD, said
    assert read_results(run).summary["n_messages"] == n_messages


def test_what_is_asked_for_and_cannot_be(mission: Path, tmp_path: Path) -> None:
    """A port in use, a run that another process writes."""
    run = tmp_path / "run"
    with killed_at_last(start("--replay", mission, "--out", run)) as process:
        wait_for(lambda: size_of(run / "log" / "imu.csv") > 200, "the log")
        code, said = finish("--replay", mission, "--out", run)
        assert code == ExitCode.USAGE
        assert "another process" in said
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)
    with socket.create_server((LOOPBACK, 0)) as taken:
        address = f"tcp-listen://:{taken.getsockname()[1]}"
        code, said = finish("--replay", mission, "--out", tmp_path / "b", "--publish", address)
    assert code == ExitCode.USAGE
    assert "cannot listen" in said


@contextlib.contextmanager
def connected(port: int) -> Iterator[socket.socket]:
    """Return a client, once somebody listens."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            client = socket.create_connection((LOOPBACK, port), timeout=PATIENCE_S)
            break
        except ConnectionRefusedError:
            assert time.monotonic() < end_s
            time.sleep(0.02)
    with client:
        yield client


class Ship:
    """Instruments that play a mission on their own sockets, in a thread, with mishaps.

    The vehicle's clock goes with what is played, 0.1 s after it, and no further than what has been
    taken: however busy the computer is, everything comes at the same times.
    """

    def __init__(self, hub: SocketHub, a50: A50, time_s: list[float]) -> None:
        self._hub, self.a50, self._time_s = hub, a50, time_s
        ports = {s.feed.name: s.port for s in hub.inputs if isinstance(s, UdpInput)}
        self._senders = {name: UdpSender(port) for name, port in ports.items()}
        self._n_sent = Counter[str]()
        self.failure: BaseException | None = None
        self.on_end: Callable[[], object] = lambda: None
        self.thread = threading.Thread(target=self._play, name="ship")

    def wait(self) -> None:
        """Have time go on, where nothing is played."""
        self._time_s[0] += TURN_S
        time.sleep(0.001)

    def _play(self) -> None:
        try:
            self.a50.accept()
            for message in messages_of(make_mission()):
                self._time_s[0] = max(self._time_s[0], message.time_s + 0.1)
                self._mishap(message)
                self._send(message)
                wait_for(self._is_taken, f"all up to {message}")
            self._time_s[0] += 1.0  # for a fix that waits for its GST
        except BaseException as error:
            self.failure = error
        finally:
            for sender in self._senders.values():
                sender.close()
            self.on_end()

    def _is_taken(self) -> bool:
        taken = {status.name: status.n_messages for status in self._hub.source_status()}
        return all(taken[name] >= n for name, n in self._n_sent.items())

    def _mishap(self, message: Message) -> None:
        """Break the connection amid a report, send garbage and repeat what was sent."""
        if not isinstance(message, Ping):
            return
        if message.time_s == 20.0:
            self.a50.send_bytes(b'{"type": "velocity", "transducers": [{"id": 0, "vel')
            self.a50.vanish()
            self.a50.come_back()
            self.a50.accept()
        if message.time_s == 30.0:
            self.a50.send_bytes(b"\x00\xff\xfe garbage }{ \r\n" * 20)
            self._senders["gnss"].send(b"$GPGGA,nonsense*00\r\n")
            self._senders["imu"].send(b'{"type": "imu"}\n{"type": "im')

    def _send(self, message: Message) -> None:
        match message:
            case Ping():
                name = "dvl"
                self.a50.send(message)
            case ImuSample():
                name = "imu"
                self._senders[name].send(encode_message(message))
            case Fix():
                name = "gnss"
                self._senders[name].send(gga(message))
            case DepthReading():
                name = "depth"
                self._senders[name].send(pips(message))
        self._n_sent[name] += 1


class Reader:
    """A client that reads all answers as they come."""

    def __init__(self, port: int) -> None:
        self._client = socket.create_connection((LOOPBACK, port))
        self._lines: list[bytes] = []
        self._thread = threading.Thread(target=self._read, name="reader")
        self._thread.start()

    def everything(self) -> list[bytes]:
        """Return all lines, once the server has hung up."""
        self._thread.join(PATIENCE_S)
        self._client.close()
        return self._lines

    def _read(self) -> None:
        with self._client.makefile("rb") as stream:
            self._lines = stream.readlines()


def test_instruments_on_sockets(tmp_path: Path) -> None:
    """A50 over TCP, GNSS and depth as NMEA, IMU as JSON: the answer is where the vehicle is."""
    mission, time_s = make_mission(), [0.0]
    a50 = A50(on_idle=lambda: ship.wait())
    vehicle = vehicle_of(mission)

    def wall_s() -> float:
        return time_s[0]

    limits = Limits(retry_s=(0.02, 0.1))
    nothing = Endpoint(Transport.UDP, LOOPBACK, 0)
    inputs = [
        InputConfig(
            "dvl", Endpoint(Transport.TCP_CLIENT, LOOPBACK, a50.port), WaterLinkedDecoder, limits
        ),
        InputConfig("gnss", nothing, NmeaDecoder, limits),
        InputConfig("depth", nothing, NmeaDecoder, limits),
        InputConfig("imu", nothing, JsonDecoder, limits),
    ]
    serving = Endpoint(Transport.TCP_SERVER, LOOPBACK, 0)
    outputs = [OutputConfig(form, serving) for form in OutputFormat]
    with SocketHub(inputs, outputs, wall_s=wall_s, steady_s=wall_s) as hub:
        ship = Ship(hub, a50, time_s)
        readers = [
            Reader(output.port) for output in hub.outputs if isinstance(output, TcpServerOutput)
        ]
        runner = Runner(
            RunFolder(tmp_path, vehicle, {}),
            engine_of(vehicle, ONLINE),
            lambda _: Connections(hub, hub),
        )
        ship.on_end = runner.stop
        ship.thread.start()
        end = runner.run()
        ship.thread.join()
        a50.vanish()
        statuses = {status.name: status for status in hub.source_status()}
    assert ship.failure is None, ship.failure
    assert end.n_errors == 0
    assert end.navigation is not None
    assert error_m(end.navigation.lat, end.navigation.lon, end.navigation.time_s) < 1.5
    assert statuses["imu"].n_messages == len(mission.imu.time_s)
    assert statuses["imu"].n_refused == 2
    assert statuses["dvl"].n_reconnects == 1
    assert statuses["dvl"].n_messages >= len(mission.dvl.time_s) - 1
    assert mission.gnss is not None
    assert statuses["gnss"].n_messages == len(mission.gnss.time_s)
    lines = (tmp_path / "events.jsonl").read_text().splitlines()
    events = [json.loads(line)["kind"] for line in lines]
    assert {"connected", "connection_lost", "message_refused", "ended"} <= set(events)
    json_lines, nmea_lines = (reader.everything() for reader in readers)
    answers = [json.loads(line) for line in json_lines]
    times = np.array([answer["time_s"] for answer in answers])
    assert len(answers) > 200
    assert np.all(np.diff(times) >= 0.0)
    assert nmea_lines[0].startswith(b"$INGGA")
    assert 3 * 40 <= len(nmea_lines) <= 3 * 70
    track = read_results(tmp_path).trajectory
    late = track["time_s"] > 5.0
    errors = [
        error_m(np.radians(lat), np.radians(lon), t)
        for lat, lon, t in zip(
            track["lat_deg"][late], track["lon_deg"][late], track["time_s"][late], strict=True
        )
    ]
    assert max(errors) < 1.5


def error_m(lat: float, lon: float, time_s: float) -> float:
    """Return the horizontal distance from the truth."""
    reference = make_mission().reference
    assert reference is not None
    at = [float(np.interp(time_s, reference.time_s, column)) for column in _columns(reference)]
    north, east = (lat - at[0]) * 6.37e6, (lon - at[1]) * 6.37e6 * np.cos(lat)
    return float(np.hypot(north, east))


def _columns(reference: Any) -> tuple[Array, Array]:
    return reference.lat, reference.lon
