"""Sockets of a live run: lost, silent, flooding, damaged, slow; none of them harms others."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.live.protocols.decoder import Clock, Decoder
from ssm_graph.live.protocols.json_messages import JsonDecoder, encode_message
from ssm_graph.live.protocols.nmea import NmeaDecoder
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.sockets.endpoints import (
    CHUNK,
    LOOPBACK,
    OUTPUTS,
    Endpoint,
    Transport,
    parse_endpoint,
)
from ssm_graph.live.sockets.feed import Limits
from ssm_graph.live.sockets.inputs import TcpServerInput, UdpInput
from ssm_graph.live.sockets.outputs import MAX_CLIENTS, MAX_WAITING, OutputFormat, TcpServerOutput
from ssm_graph.live.sockets.sockets import InputConfig, OutputConfig, SocketHub
from ssm_graph.mission.navigation import Event, Severity
from ssm_graph.mission.run_status import LinkState
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from tests.instrument_fixture import A50, DEADLINE_S, Receiver, UdpSender, gga, pips, report

WALL_S = 1_700_000_000.0
IMU = ImuSample(12.0, (0.01, 0.0, 0.0), (0.0, 0.0, -9.8))
QUICK = Limits(retry_s=(0.02, 0.1), stall_s=60.0)


def a_ping(k: int = 0) -> Ping:
    """Return a ping just taken; each has speeds of its own."""
    return Ping(WALL_S - 0.125 + k / 64.0, (0.1 + k / 64.0, -0.2, math.nan, 0.25))


class FakeTime:
    """Clocks that a test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def steady_s(self) -> float:
        """Return seconds since some moment."""
        return self.now_s

    def wall_s(self) -> float:
        """Return Unix time."""
        return WALL_S + self.now_s - 100.0


def clock_from(begin_s: float = WALL_S) -> Callable[[], float]:
    """Return the clock of a computer that nobody sets, s."""
    ahead_s = begin_s - time.monotonic()
    return lambda: time.monotonic() + ahead_s


def pass_time(clock: FakeTime, receiver: Receiver, span_s: float) -> None:
    """Let time pass, as long as the hub is looked after as it is in a run."""
    for _ in range(round(span_s)):
        clock.now_s += span_s / round(span_s)
        receiver.poll()


def tcp(port: int) -> Endpoint:
    """Return a server on this computer."""
    return Endpoint(Transport.TCP_CLIENT, LOOPBACK, port)


def dvl_at(port: int, limits: Limits = QUICK) -> InputConfig:
    """Return a DVL that is called."""
    return InputConfig("dvl", tcp(port), WaterLinkedDecoder, limits)


def listening(
    transport: Transport,
    name: str = "imu",
    limits: Limits = QUICK,
    make: Callable[[], Decoder] = JsonDecoder,
) -> InputConfig:
    """Return a source that we listen for, at any free port."""
    return InputConfig(name, Endpoint(transport, LOOPBACK, 0), make, limits)


def port_of(hub: SocketHub, index: int = 0) -> int:
    """Return where a hub listens."""
    source = hub.inputs[index]
    assert isinstance(source, TcpServerInput | UdpInput)
    return source.port


@pytest.fixture
def dvl() -> Iterator[tuple[A50, Receiver]]:
    """Return a DVL and a hub that is connected with it."""
    a50 = A50()
    with SocketHub([dvl_at(a50.port)], wall_s=clock_from()) as hub:
        receiver = Receiver(hub)
        a50._on_idle = receiver.poll
        a50.accept()
        yield a50, receiver
    a50.vanish()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tcp://192.168.194.95:16171", Endpoint(Transport.TCP_CLIENT, "192.168.194.95", 16171)),
        ("tcp://dvl-a50.local:16171", Endpoint(Transport.TCP_CLIENT, "dvl-a50.local", 16171)),
        (" TCP://[fe80::1]:1 ", Endpoint(Transport.TCP_CLIENT, "fe80::1", 1)),
        ("tcp-listen://:7000", Endpoint(Transport.TCP_SERVER, "127.0.0.1", 7000)),
        ("tcp-listen://0.0.0.0:7000", Endpoint(Transport.TCP_SERVER, "0.0.0.0", 7000)),
        ("udp://[::1]:9000", Endpoint(Transport.UDP, "::1", 9000)),
        ("udp://:65535", Endpoint(Transport.UDP, "127.0.0.1", 65535)),
    ],
)
def test_addresses(text: str, expected: Endpoint) -> None:
    """What is left out is this computer; what is printed can be read again."""
    found = parse_endpoint(text, where="--dvl")
    assert found == expected
    assert parse_endpoint(str(found), where="--dvl") == expected


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "tcp://HOST:PORT"),
        ("192.168.1.5:16171", "tcp://HOST:PORT"),
        ("tcp://:16171", "with a host"),
        ("tpc://a:1", "did you mean 'tcp'"),
        ("serial://a:1", "known are"),
        ("tcp://a:0", "1 to 65535"),
        ("tcp://a:65536", "1 to 65535"),
        ("tcp://a:port", "tcp://HOST:PORT"),
        ("tcp://::1:80", "tcp://HOST:PORT"),
        ("tcp://[1::2::3]:80", "IPv6"),
        ("tcp://[]:80", "IPv6"),
        ("tcp://1.2.3:80", "IPv4"),
        ("tcp://a b:80", "host name"),
        ("tcp://user@host:80", "tcp://HOST:PORT"),
        ("udp://-x:80", "host name"),
        ("tcp://a:٣", "tcp://HOST:PORT"),
    ],
)
def test_nonsense_is_no_address(text: str, said: str) -> None:
    """The message names the option and says how it is written."""
    with pytest.raises(ConfigError, match="--dvl: ") as refusal:
        parse_endpoint(text, where="--dvl")
    assert said in str(refusal.value)
    with pytest.raises(ConfigError, match="tcp-listen"):
        parse_endpoint("tcp://a:1", where="--publish", allowed=OUTPUTS)


def test_what_cannot_be_opened_is_a_setting() -> None:
    """A port in use, a host that nobody knows, an address of another computer."""
    with socket.create_server((LOOPBACK, 0)) as taken:
        port = taken.getsockname()[1]
        config = InputConfig("imu", Endpoint(Transport.TCP_SERVER, LOOPBACK, port), JsonDecoder)
        with pytest.raises(ConfigError, match="cannot listen"):
            SocketHub([config])
    elsewhere = InputConfig("imu", Endpoint(Transport.UDP, "192.0.2.1", 9000), JsonDecoder)
    with pytest.raises(ConfigError, match="cannot listen"):
        SocketHub([elsewhere])
    unknown = InputConfig("imu", Endpoint(Transport.TCP_CLIENT, "x..y", 9000), JsonDecoder)
    with pytest.raises(ConfigError, match="not known"):
        SocketHub([unknown])
    with pytest.raises(ConfigError, match="stall_s"):
        Limits(stall_s=0.0)


def test_reports_of_a_dvl_become_pings(dvl: tuple[A50, Receiver]) -> None:
    """One report after the other, by the instrument's own time, a half one when it is whole."""
    a50, receiver = dvl
    a50.send(a_ping(0))
    half = report(a_ping(1))
    a50.send_bytes(half[:100])
    receiver.until(lambda: len(receiver.messages) == 1)
    a50.send_bytes(half[100:] + report(a_ping(2)))
    receiver.until(lambda: len(receiver.messages) == 3)
    assert [m.time_s for m in receiver.messages] == [a_ping(k).time_s for k in range(3)]
    first = receiver.messages[0]
    assert isinstance(first, Ping)
    assert first.speed[:2] == a_ping(0).speed[:2]
    assert math.isnan(first.speed[2])
    (status,) = receiver.hub.source_status()
    assert (status.n_messages, status.n_refused, status.n_reconnects) == (3, 0, 0)
    assert status.state is LinkState.CONNECTED
    assert status.n_bytes > 1000


def test_half_a_report_does_not_spoil_the_next_connection(dvl: tuple[A50, Receiver]) -> None:
    """The connection breaks amid a report: it is gone and said, all after it counts."""
    a50, receiver = dvl
    a50.send_bytes(report(a_ping(0))[:150])
    a50.drop()
    a50.accept()
    a50.send(a_ping(1))
    receiver.until(lambda: receiver.messages)
    assert [m.time_s for m in receiver.messages] == [a_ping(1).time_s]
    assert receiver.kinds.count("connection_lost") == 1
    assert receiver.hub.source_status()[0].n_reconnects == 1


def test_garbage_is_refused_and_what_follows_counts(dvl: tuple[A50, Receiver]) -> None:
    """Random bytes, another instrument's sentences, and reports that lie about their type."""
    a50, receiver = dvl
    a50.send_bytes(bytes(range(256)) * 20 + b"\n")
    a50.send_bytes(b'{"type": "velocity", "transducers": 5}\n' * 50)
    a50.send(a_ping())
    receiver.until(lambda: receiver.messages)
    assert len(receiver.messages) == 1
    refused = [event for event in receiver.events if event.kind == "message_refused"]
    assert 0 < len(refused) <= 5
    assert all(event.text.startswith("dvl: water linked: ") for event in refused)
    assert receiver.hub.source_status()[0].n_refused > 50


def test_a_dvl_that_vanishes_is_called_until_it_is_back(dvl: tuple[A50, Receiver]) -> None:
    """Nobody listens for a while; then the same port answers again."""
    a50, receiver = dvl
    a50.vanish()
    receiver.until(lambda: "connect_failed" in receiver.kinds)
    assert receiver.hub.source_status()[0].state in (LinkState.WAITING, LinkState.CONNECTING)
    a50.come_back()
    a50.accept()
    a50.send(a_ping())
    receiver.until(lambda: receiver.messages)
    assert receiver.hub.source_status()[0].n_reconnects == 1


def test_patience_grows_and_starts_again_after_data() -> None:
    """0.5 s after the first failure, twice as long after each further one, never above 3 s."""
    a50, clock = A50(), FakeTime()
    a50.vanish()
    times: list[float] = []
    with SocketHub(
        [dvl_at(a50.port, Limits())], steady_s=clock.steady_s, wall_s=clock.wall_s
    ) as hub:
        state = LinkState.WAITING
        while len(times) < 8:
            hub.poll(0.0)
            before, state = state, hub.source_status()[0].state
            if before is LinkState.WAITING and state is LinkState.CONNECTING:
                times.append(clock.now_s)
            if state is LinkState.WAITING:
                clock.now_s += 0.125
        waits = [b - a for a, b in pairwise(times)]
        assert waits == [0.5, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0]
        a50.come_back()
        receiver = Receiver(hub, after_poll=lambda: setattr(clock, "now_s", clock.now_s + 0.5))
        a50._on_idle = receiver.poll
        a50.accept()
        a50.send(a_ping())
        receiver.until(lambda: hub.source_status()[0].n_bytes > 0)
        receiver._after_poll = lambda: None
        a50.vanish()
        receiver.until(lambda: hub.source_status()[0].state is LinkState.WAITING)
        clock.now_s += 0.5
        receiver.until(lambda: hub.source_status()[0].state is LinkState.CONNECTING)


def test_a_silent_dvl_is_called_again() -> None:
    """Connected and silent is worse than disconnected: it is given up after a while."""
    a50, clock = A50(), FakeTime()
    with SocketHub([dvl_at(a50.port)], steady_s=clock.steady_s, wall_s=clock.wall_s) as hub:
        receiver = Receiver(hub)
        a50._on_idle = receiver.poll
        a50.accept()
        a50.send(a_ping())
        receiver.until(lambda: receiver.messages)
        pass_time(clock, receiver, 59.0)
        assert "source_silent" not in receiver.kinds
        clock.now_s += 2.0
        receiver.until(lambda: "source_silent" in receiver.kinds)
        receiver._after_poll = lambda: setattr(clock, "now_s", clock.now_s + 0.1)
        a50.accept()
        assert hub.source_status()[0].n_reconnects <= 1
    a50.vanish()


def test_a_call_that_nobody_answers_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packets that are lost on the way, which loopback never does: a socket that never connects."""
    clock = FakeTime()
    monkeypatch.setattr(socket.socket, "connect_ex", lambda *_: 115)
    monkeypatch.setattr(
        "ssm_graph.live.sockets.inputs.selectors.EVENT_WRITE", 1
    )  # a new socket can always be written
    with SocketHub([dvl_at(9)], steady_s=clock.steady_s, wall_s=clock.wall_s) as hub:
        receiver = Receiver(hub)
        hub.inputs[0].on_ready = lambda *_: []  # type: ignore[method-assign]
        receiver.poll()
        assert hub.source_status()[0].state is LinkState.CONNECTING
        clock.now_s += 5.1
        receiver.until(lambda: "connect_failed" in receiver.kinds)
        assert "no answer within 5 s" in receiver.events[-1].text


def test_a_server_takes_a_few_clients_and_drops_silent_ones() -> None:
    """Half open connections of a rebooted sender must not lock it out."""
    clock = FakeTime()
    config = listening(Transport.TCP_SERVER, limits=Limits(max_clients=2, stall_s=10.0))
    with SocketHub([config], steady_s=clock.steady_s, wall_s=clock.wall_s) as hub:
        receiver = Receiver(hub)
        address = (LOOPBACK, port_of(hub))
        with socket.create_connection(address) as one, socket.create_connection(address) as two:
            one.sendall(encode_message(IMU))
            receiver.until(lambda: receiver.messages and receiver.kinds.count("connected") >= 1)
            with socket.create_connection(address) as three:
                receiver.until(lambda: "client_refused" in receiver.kinds)
                three.settimeout(5.0)
                assert three.recv(1) == b""
            pass_time(clock, receiver, 9.0)
            two.sendall(encode_message(IMU) + encode_message(IMU)[:20])
            receiver.until(lambda: hub.inputs[0].n_held)
            clock.now_s += 2.0
            receiver.until(lambda: "connection_lost" in receiver.kinds)
            two.sendall(encode_message(IMU)[20:])
            receiver.until(lambda: len(receiver.messages) == 3)
        with socket.create_connection(address) as again:
            again.sendall(encode_message(IMU) + b"half")
            receiver.until(lambda: len(receiver.messages) == 4)
        receiver.until(lambda: hub.source_status()[0].state is LinkState.LISTENING)
    assert not hub.inputs[0].n_held


def test_datagrams_end_what_they_hold() -> None:
    """One that was cut off, or has no line end, spoils no other."""
    with SocketHub([listening(Transport.UDP)]) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        sender = UdpSender(port_of(hub))
        whole = encode_message(IMU)
        for data in (whole[:-1], whole[:40], whole, b"", b"\xff\x00", whole + whole):
            sender.send(data)
        receiver.until(lambda: len(receiver.messages) == 4)
        assert hub.source_status()[0].n_refused == 2
        sender.close()


def test_a_fix_that_waits_is_released_by_silence() -> None:
    """Decoders are asked about once a second whether something has waited long enough."""
    clock = FakeTime()
    config = listening(Transport.UDP, "gnss", make=NmeaDecoder)
    fix = Fix(WALL_S, 1.1, 0.18, 40.0, (0.5, 0.5, 1.0))
    both = gga(fix)
    only_gga = gga(Fix(WALL_S + 1.0, 1.1, 0.18, 40.0, (0.5, 0.5, 1.0))).split(b"\r\n")[0] + b"\r\n"
    with SocketHub([config], steady_s=clock.steady_s, wall_s=clock.wall_s) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        sender = UdpSender(port_of(hub))
        sender.send(both)
        receiver.until(lambda: receiver.messages)
        sender.send(only_gga)
        receiver.until(lambda: hub.source_status()[0].n_bytes == len(both) + len(only_gga))
        assert len(receiver.messages) == 1
        clock.now_s += 1.1
        receiver.until(lambda: len(receiver.messages) == 2)
        first = receiver.messages[0]
        assert isinstance(first, Fix)
        assert first.lat == pytest.approx(1.1, abs=1e-11)
        assert first.height == pytest.approx(40.0)
        sender.close()


def test_a_flood_harms_nobody_else_and_is_said() -> None:
    """A source at a hundred times its rate: bounded in messages, bytes, memory and words."""
    clock = FakeTime()
    limits = Limits(messages_per_s=200.0, burst=400)
    configs = [
        listening(Transport.TCP_SERVER, "imu", limits),
        listening(Transport.UDP, "messages"),
    ]
    flood = encode_message(IMU) * 500
    n_sent, duration_s, step_s = 0, 3.0, 0.01
    with SocketHub(configs, steady_s=clock.steady_s, wall_s=clock.wall_s) as hub:
        hub.poll(0.0)
        attacker = socket.create_connection((LOOPBACK, port_of(hub)))
        attacker.setblocking(False)
        sender = UdpSender(port_of(hub, 1))
        messages: list[Message] = []
        events: list[Event] = []
        for k in range(round(duration_s / step_s)):
            for _ in range(10):
                try:
                    n_sent += attacker.send(flood)
                except BlockingIOError:
                    break
            sender.send(encode_message(DepthReading(float(k), 5.0)))
            messages += hub.poll(0.0)
            events += hub.take_events()
            clock.now_s += step_s
        for _ in range(10):
            messages += hub.poll(0.005)
        depths = [m for m in messages if isinstance(m, DepthReading)]
        assert [m.time_s for m in depths] == [float(k) for k in range(round(duration_s / step_s))]
        status, _ = hub.source_status()
        assert status.n_messages <= 400 + 200.0 * duration_s + 1
        assert status.n_messages >= 200.0 * duration_s
        assert status.n_bytes <= 6e5 * (duration_s + 0.1) + 2 * CHUNK
        assert n_sent > status.n_bytes  # TCP holds the rest back
        assert status.n_limited > 5_000
        assert hub.inputs[0].n_held < CHUNK
        assert len(events) < 10
        assert {"rate_limited", "byte_limited"} <= {event.kind for event in events}
        attacker.close()
        sender.close()


def test_a_storm_of_datagrams_takes_nothing_of_another_sender() -> None:
    """Noise at five times what a sender may: it is read and dropped, and told."""
    clock, n = FakeTime(), 40
    limits = Limits(bytes_per_s=1e4)
    with (
        SocketHub(
            [listening(Transport.UDP, limits=limits)], steady_s=clock.steady_s, wall_s=clock.wall_s
        ) as hub,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as storm,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sound,
    ):
        to, messages, events = (LOOPBACK, port_of(hub)), list[Message](), list[Event]()
        hub.poll(0.0)
        for k in range(n):
            for _ in range(50):
                storm.sendto(b"x" * 500, to)
            sound.sendto(encode_message(DepthReading(float(k), 5.0)), to)
            for _ in range(3):
                messages += hub.poll(0.005)
            events += hub.take_events()
            clock.now_s += 0.5
        assert [message.time_s for message in messages] == [float(k) for k in range(n)]
        (status,) = hub.source_status()
        assert status.n_bytes < 1e4 * (0.5 * n + 0.2) + 100 * n
        assert any("the rest is dropped" in event.text for event in events)


def test_a_decoder_that_fails_is_replaced_and_said() -> None:
    """No defect of one source may end the run."""
    made: list[JsonDecoder] = []

    class Fragile(JsonDecoder):
        def __init__(self) -> None:
            super().__init__()
            made.append(self)

        def feed(self, data: bytes, *, arrival_s: float) -> list[Message]:
            if b"boom" in data:
                raise ZeroDivisionError("a defect")
            return super().feed(data, arrival_s=arrival_s)

    with SocketHub([listening(Transport.UDP, make=Fragile)]) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        sender = UdpSender(port_of(hub))
        sender.send(b"boom")
        receiver.until(lambda: receiver.events)
        sender.send(encode_message(IMU))
        receiver.until(lambda: receiver.messages)
        (event,) = receiver.events
        assert event.severity is Severity.ERROR
        assert event.text.startswith("imu: ZeroDivisionError: a defect (")
        assert len(made) == 3  # for all senders, this one, and again for this one
        sender.close()


def test_a_defect_at_a_socket_drops_that_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever fails there must not be called again and again."""
    with SocketHub([listening(Transport.TCP_SERVER), listening(Transport.UDP, "depth")]) as hub:
        receiver = Receiver(hub)
        receiver.poll()

        def fail(*_: object) -> None:
            raise RuntimeError("a defect")

        with socket.create_connection((LOOPBACK, port_of(hub))) as client:
            receiver.until(lambda: "connected" in receiver.kinds)
            monkeypatch.setattr(hub.inputs[0].feed, "take", fail)
            client.sendall(b"x")
            receiver.until(lambda: "socket_failed" in receiver.kinds)
            client.settimeout(5.0)
            assert client.recv(1) == b""
        sender = UdpSender(port_of(hub, 1))
        sender.send(encode_message(IMU))
        receiver.until(lambda: receiver.messages)
        sender.close()


@pytest.mark.parametrize("is_nmea", [True, False])
def test_depth_by_arrival(*, is_nmea: bool) -> None:
    """A sensor without a clock is stamped when it comes."""
    make: Callable[[], Decoder] = NmeaDecoder if is_nmea else JsonDecoder
    reading = DepthReading(WALL_S, 12.5)
    with SocketHub([listening(Transport.UDP, "depth", make=make)], wall_s=clock_from()) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        sender = UdpSender(port_of(hub))
        sender.send(pips(reading) if is_nmea else encode_message(reading))
        receiver.until(lambda: receiver.messages)
        assert isinstance(found := receiver.messages[0], DepthReading)
        assert found.time_s == pytest.approx(WALL_S, abs=DEADLINE_S)
        assert found.depth == reading.depth
        sender.close()


def test_a_dvl_by_arrival() -> None:
    """Where clocks are not set, the arrival stamps."""
    a50 = A50()
    config = InputConfig(
        "dvl", tcp(a50.port), lambda: WaterLinkedDecoder(clock=Clock.ARRIVAL), QUICK
    )
    with SocketHub([config], wall_s=clock_from(50.0)) as hub:
        receiver = Receiver(hub)
        a50._on_idle = receiver.poll
        a50.accept()
        a50.send(a_ping())
        receiver.until(lambda: receiver.messages)
        assert receiver.messages[0].time_s == pytest.approx(50.0, abs=DEADLINE_S)
    a50.vanish()


def serving(hub: SocketHub) -> TcpServerOutput:
    """Return the server of a hub."""
    (output,) = hub.outputs
    assert isinstance(output, TcpServerOutput)
    return output


def test_a_client_that_never_reads_is_dropped() -> None:
    """Nothing waits for it, and who reads gets every answer."""
    answer = b"x" * 999 + b"\n"
    config = OutputConfig(OutputFormat.JSON, Endpoint(Transport.TCP_SERVER, LOOPBACK, 0))
    with SocketHub(outputs=[config]) as hub:
        receiver, output = Receiver(hub), serving(hub)
        slow = socket.socket()
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect((LOOPBACK, output.port))
        good = socket.create_connection((LOOPBACK, output.port))
        good.setblocking(False)
        assert not hub.wants(OutputFormat.JSON)
        receiver.until(lambda: output.n_clients == 2)
        assert hub.wants(OutputFormat.JSON)
        assert not hub.wants(OutputFormat.NMEA)
        assert not any(client.getblocking() for client in output._waiting)
        n_sent, got = 0, bytearray()
        while output.n_clients == 2:
            hub.send(OutputFormat.JSON, answer)
            n_sent += 1
            receiver.poll(0.0)
            _read_all(good, got)
            assert sum(map(len, output._waiting.values())) <= 2 * (MAX_WAITING + len(answer))
            assert n_sent < 5000, "never dropped"
        receiver._after_poll = lambda: _read_all(good, got)
        receiver.until(lambda: len(got) == n_sent * len(answer))
        assert bytes(got) == answer * n_sent
        receiver.poll()
        assert "client_lost" in receiver.kinds
        assert hub.output_status()[0].n_dropped == 1
        receiver._after_poll = good.close
        receiver.until(lambda: output.n_clients == 0)
        slow.close()


def _read_all(sock: socket.socket, into: bytearray) -> None:
    try:
        while chunk := sock.recv(65536):
            into += chunk
    except BlockingIOError:
        pass


def test_an_output_server_takes_so_many_and_says_who_is_too_many() -> None:
    """What clients say is not looked at; one too many is refused."""
    config = OutputConfig(OutputFormat.NMEA, Endpoint(Transport.TCP_SERVER, LOOPBACK, 0))
    with SocketHub(outputs=[config]) as hub:
        receiver, output = Receiver(hub), serving(hub)
        address = (LOOPBACK, output.port)
        clients = [socket.create_connection(address) for _ in range(MAX_CLIENTS + 1)]
        receiver.until(lambda: "client_refused" in receiver.kinds)
        assert output.n_clients == MAX_CLIENTS
        clients[0].sendall(b"GET / HTTP/1.0\r\n\r\n")
        for client in clients:
            client.close()
        receiver.until(lambda: output.n_clients == 0)


def test_answers_as_datagrams() -> None:
    """They go out whether or not somebody listens."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind((LOOPBACK, 0))
    listener.settimeout(5.0)
    port = listener.getsockname()[1]
    config = OutputConfig(OutputFormat.JSON, Endpoint(Transport.UDP, LOOPBACK, port))
    with SocketHub(outputs=[config]) as hub:
        assert hub.wants(OutputFormat.JSON)
        hub.send(OutputFormat.JSON, b"one\n")
        assert listener.recv(100) == b"one\n"
        listener.close()
        for _ in range(3):
            hub.send(OutputFormat.JSON, b"two\n")
        hub.send(OutputFormat.JSON, b"x" * 70_000)
        assert hub.take_events()[-1].kind == "send_failed"
        hub.wait(0.01)


def test_ipv6_works_where_there_is_any() -> None:
    """In brackets, as everywhere."""
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 here")
    config = InputConfig("imu", Endpoint(Transport.TCP_SERVER, "::1", 0), JsonDecoder)
    with SocketHub([config]) as hub:
        receiver = Receiver(hub)
        with socket.create_connection(("::1", port_of(hub))) as client:
            client.sendall(encode_message(IMU))
            receiver.until(lambda: receiver.messages)
        assert receiver.messages == [IMU]


def test_a_flood_of_one_kind_leaves_the_others_of_its_socket_alone() -> None:
    """Of a hundred depths with each inertial sample the most are left out, of those none."""
    clock = FakeTime()
    with SocketHub(
        [listening(Transport.UDP, "messages")], steady_s=clock.steady_s, wall_s=clock.wall_s
    ) as hub:
        hub.poll(0.0)
        sender = UdpSender(port_of(hub))
        messages: list[Message] = []
        for k in range(200):
            depths = [
                encode_message(DepthReading(WALL_S + 0.01 * k + 1e-5 * n, 5.0)) for n in range(100)
            ]
            sender.send(encode_message(replace(IMU, time_s=WALL_S + 0.01 * k)))
            for begin in range(0, 100, 20):
                sender.send(b"".join(depths[begin : begin + 20]))
            messages += hub.poll(0.0)
            clock.now_s += 0.01
        for _ in range(10):
            messages += hub.poll(0.005)
        sender.close()
    samples = [m.time_s for m in messages if isinstance(m, ImuSample)]
    assert samples == [WALL_S + 0.01 * k for k in range(200)]
    n_depths = len(messages) - len(samples)
    assert 200.0 * 2.0 <= n_depths <= 200.0 * 2.0 + 400 + 1
