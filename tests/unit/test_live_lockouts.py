"""Who keeps whom out: alive means sound messages, a clock is remembered, a stop costs no sense."""

from __future__ import annotations

import json
import socket
from contextlib import ExitStack

import numpy as np
import pytest

from ssm_graph.live.protocols.json_messages import JsonDecoder, encode_message
from ssm_graph.live.protocols.nmea import NmeaDecoder
from ssm_graph.live.sockets.clocks import STRANGER_S, Now, RunClock, StampClock
from ssm_graph.live.sockets.endpoints import LOOPBACK, Endpoint, Transport
from ssm_graph.live.sockets.feed import Limits
from ssm_graph.live.sockets.inputs import TcpServerInput, UdpInput
from ssm_graph.live.sockets.outputs import MAX_CLIENTS, OutputFormat, Publisher, TcpServerOutput
from ssm_graph.live.sockets.sockets import InputConfig, OutputConfig, SocketHub
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from tests.instrument_fixture import Receiver, UdpSender, gga
from tests.live_fixture import Recorder, a_navigation

WALL_S = 1_700_000_000.0
PERIOD_S = 0.01


def sample(stamp_s: float) -> ImuSample:
    """Return an inertial sample."""
    return ImuSample(stamp_s, (0.01, 0.0, 0.0), (0.0, 0.0, -9.8))


class Steady:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        """Return seconds since some moment."""
        return self.now_s


def hub_with(transport: Transport, clock: Steady, *, nmea: bool = False) -> SocketHub:
    """Return a hub that listens for one source."""
    make = NmeaDecoder if nmea else JsonDecoder
    config = InputConfig("imu", Endpoint(transport, LOOPBACK, 0), make)
    return SocketHub([config], steady_s=clock, wall_s=lambda: WALL_S + clock.now_s)


def port_of(hub: SocketHub) -> int:
    """Return where it listens."""
    (source,) = hub.inputs
    assert isinstance(source, TcpServerInput | UdpInput)
    return source.port


def test_a_byte_now_and_then_keeps_nobody_out() -> None:
    """Four clients with a byte every half second; the inertial data get in within five seconds."""
    clock = Steady()
    with hub_with(Transport.TCP_SERVER, clock) as hub, ExitStack() as stack:
        receiver = Receiver(hub)
        address = (LOOPBACK, port_of(hub))
        slow = [stack.enter_context(socket.create_connection(address)) for _ in range(4)]
        receiver.until(lambda: len(hub.inputs[0]._reading) == 4)
        for _ in range(6):
            clock.now_s += 0.5
            for client in slow:
                client.sendall(b"{")
            receiver.poll()
        imu = stack.enter_context(socket.create_connection(address))
        imu.sendall(encode_message(sample(12.0)))
        receiver.until(lambda: receiver.messages)
        assert "client_refused" not in receiver.kinds
        for k in range(40):  # and it stays, whoever calls
            clock.now_s += 0.5
            imu.sendall(encode_message(sample(12.5 + 0.5 * k)))
            stack.enter_context(socket.create_connection(address))
            receiver.until(lambda n=k: len(receiver.messages) == n + 2)  # type: ignore[misc]


def test_sound_messages_that_hold_nothing_for_us_are_alive() -> None:
    """A receiver without a fix is not called again and again for that."""
    clock = Steady()
    with hub_with(Transport.TCP_SERVER, clock, nmea=True) as hub:
        receiver = Receiver(hub)
        with socket.create_connection((LOOPBACK, port_of(hub))) as client:
            for _ in range(30):
                clock.now_s += 1.0
                n_bytes = hub.source_status()[0].n_bytes
                client.sendall(b"$GPGLL,,,,,,V,N*64\r\n")
                receiver.until(lambda n=n_bytes: hub.source_status()[0].n_bytes > n)  # type: ignore[misc]
        assert "connection_lost" not in receiver.kinds[:-1]


def test_readers_that_do_nothing_block_no_output() -> None:
    """With all places taken the oldest makes room, after two seconds at the earliest."""
    clock = Steady()
    place = Endpoint(Transport.TCP_SERVER, LOOPBACK, 0)
    config = OutputConfig(OutputFormat.JSON, place)
    with SocketHub(outputs=[config], steady_s=clock) as hub, ExitStack() as stack:
        receiver = Receiver(hub)
        (output,) = hub.outputs
        assert isinstance(output, TcpServerOutput)
        address = (LOOPBACK, output.port)
        for _ in range(MAX_CLIENTS):
            stack.enter_context(socket.create_connection(address))
        receiver.until(lambda: output.n_clients == MAX_CLIENTS)
        clock.now_s += 3.0
        reader = stack.enter_context(socket.create_connection(address))
        receiver.until(lambda: "client_lost" in receiver.kinds)
        assert output.n_clients == MAX_CLIENTS
        hub.send(OutputFormat.JSON, b"answer\n")
        reader.settimeout(5.0)
        assert reader.recv(100) == b"answer\n"
        for client in output._since_s:  # as if all had just come
            output._since_s[client] = clock.now_s
        stack.enter_context(socket.create_connection(address))
        receiver.until(lambda: "client_refused" in receiver.kinds)
        assert output.n_clients == MAX_CLIENTS


class Sifted:
    """What a clock lets pass of messages at times of arrival."""

    def __init__(self, *, is_steady: bool = True) -> None:
        self.steady, self.set_by_s = Steady(), 0.0
        self._run = RunClock(lambda: self.steady.now_s + self.set_by_s, self.steady)
        self.clock = StampClock(self._run, is_steady=is_steady)
        self.passed, self.refused = list[float](), list[float]()
        self.untold = list[float]()
        self.set_by = list[float]()

    def give(self, stamps: list[float], steady_s: float) -> None:
        """Have messages arrive together, where nothing had come a moment before."""
        self.steady.now_s = max(self.steady.now_s, steady_s - 0.05)
        self._run.read()
        self.steady.now_s = steady_s
        now, _ = self._run.read()
        for stamp in stamps:
            passed, refused, untold, set_by_s = self.clock.sift(sample(stamp), now)
            self.untold += [message.time_s for message in untold]
            self.passed += [message.time_s for message in passed]
            self.refused += [message.time_s for message in refused]
            self.set_by += [set_by_s] if set_by_s else []

    @property
    def now(self) -> Now:
        """What the time is."""
        return self._run.read()[0]

    def run(self, begin_s: float, end_s: float, *, offset_s: float = 0.0) -> list[float]:
        """Have a clock tick for a while."""
        count = round((end_s - begin_s) / PERIOD_S)
        stamps = [begin_s + offset_s + k * PERIOD_S for k in range(count)]
        for stamp in stamps:
            self.give([stamp], stamp - offset_s)
        return stamps


@pytest.mark.parametrize("off_s", [3600.0, -3600.0, 3.0, 1e9])
@pytest.mark.parametrize("count", [1, 20, 400])
def test_strays_of_another_clock_are_refused(off_s: float, count: int) -> None:
    """Twenty in one datagram ended navigation; now they are refused when the known one goes on."""
    sifted = Sifted()
    before = sifted.run(100.0, 102.0)
    strays = [102.0 + off_s + k * PERIOD_S for k in range(count)]
    sifted.give(strays, 102.0)
    after = sifted.run(102.0, 104.0)
    assert sifted.passed == before + after
    assert sifted.refused == strays


def test_strays_in_a_datagram_are_counted_and_told() -> None:
    """By the source that they came from."""
    clock = Steady()
    with hub_with(Transport.UDP, clock) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        sender = UdpSender(port_of(hub))
        sender.send(encode_message(sample(50.0)))
        receiver.until(lambda: receiver.messages)
        sender.send(b"".join(encode_message(sample(9000.0 + 0.01 * k)) for k in range(20)))
        sender.send(encode_message(sample(50.01)))
        receiver.until(lambda: len(receiver.messages) == 2)
        assert hub.source_status()[0].n_refused == 20
        (said,) = (event.text for event in receiver.events if event.kind == "clock_refused")
        assert "20 inertial samples of another clock, stamped +8949.99 s off" in said
        sender.close()


@pytest.mark.parametrize("off_s", [3600.0, -3600.0, 3.0, 0.5, -0.5])
def test_the_clock_of_an_instrument_that_was_set(off_s: float) -> None:
    """It is believed after a second; not a sample is lost, and time goes on as it did."""
    sifted = Sifted()
    before = sifted.run(100.0, 102.0)
    sifted.run(102.0, 104.0, offset_s=off_s)
    assert not sifted.refused
    after = [102.0 + k * PERIOD_S for k in range(200)]
    np.testing.assert_allclose(sifted.passed, before + after, rtol=0, atol=1e-6)
    assert sifted.set_by == [pytest.approx(off_s, abs=1e-6)]


@pytest.mark.parametrize("off_s", [30.0, -30.0, 3.0, -3.0, 0.5, -0.5, 0.06, -0.06, 1e8])
@pytest.mark.parametrize("is_steady", [True, False])
def test_the_clock_of_the_vehicle_is_set(off_s: float, *, is_steady: bool) -> None:
    """What follows it is known at once, in the time of the run, with samples on their way too."""
    sifted = Sifted(is_steady=is_steady)
    before = sifted.run(100.0, 102.0)
    sifted.give([102.0], 102.03)  # on its way when the clock was set
    sifted.set_by_s = off_s
    sifted.give([102.01], 102.03)
    sifted.run(102.02, 104.0, offset_s=off_s)
    after = [102.0 + k * PERIOD_S for k in range(200)]
    np.testing.assert_allclose(sifted.passed, before + after, rtol=0, atol=1e-6)
    assert not sifted.refused
    assert not sifted.set_by


@pytest.mark.parametrize("off_s", [30.0, -30.0, 3.0, -3.0, 0.5, -0.5])
@pytest.mark.parametrize("is_steady", [True, False])
def test_an_instrument_with_a_clock_of_its_own_does_not_follow(
    off_s: float, *, is_steady: bool
) -> None:
    """A receiver that knows UTC while the vehicle's clock is set, and comes late now and then."""
    sifted = Sifted(is_steady=is_steady)
    before = sifted.run(100.0, 102.0)
    sifted.set_by_s = off_s
    after = [102.0 + k * PERIOD_S for k in range(2000)]
    for stamp in after:
        sifted.give([stamp], max(stamp, 110.2) if 110.0 < stamp < 110.2 else stamp)
    np.testing.assert_allclose(sifted.passed, before + after, rtol=0, atol=1e-6)


@pytest.mark.parametrize("off_s", [0.5, -0.5, 3.0, -3.0])
@pytest.mark.parametrize("follows", [True, False])
def test_a_clock_that_is_set_while_nothing_comes_in_time(off_s: float, *, follows: bool) -> None:
    """Delays of up to a second hide for a while which clock stamps; none passes at a wrong time."""
    sifted = Sifted(is_steady=False)
    rng = np.random.default_rng(0)
    sent = [100.0 + 0.7 * k for k in range(120)]
    arrived = np.maximum.accumulate(np.add(sent, 0.1 + rng.choice([0.0, 0.4, 1.0], len(sent))))
    for k, (time_s, come_s) in enumerate(zip(sent, arrived.tolist(), strict=True)):
        sifted.set_by_s = off_s * (k >= 40)
        sifted.give([time_s + off_s * (follows and k >= 40)], come_s)
    assert not sifted.refused
    assert len(sifted.passed) + len(sifted.untold) == len(sent)
    assert len(sifted.untold) <= 6  # they waited eight seconds
    nearest = np.round((np.array(sifted.passed) - 100.0) / 0.7) * 0.7 + 100.0
    np.testing.assert_allclose(sifted.passed, nearest, atol=1e-6)
    assert len(set(nearest.tolist())) == len(sifted.passed)


def test_a_stamp_from_before_its_clock_is_known_to_be_set() -> None:
    """The clock is set between a look at it and the reading of what is stamped by it."""
    sifted = Sifted()
    before = sifted.run(100.0, 102.0)
    sifted.give([132.0], 102.0)
    sifted.set_by_s = 30.0
    sifted.give([132.01], 102.01)
    np.testing.assert_allclose(sifted.passed, [*before, 102.0, 102.01], rtol=0, atol=1e-6)
    assert not sifted.refused


@pytest.mark.parametrize("off_s", [0.5, 3.0])
def test_pings_of_a_clock_that_was_set_forward(off_s: float) -> None:
    """Nothing comes before it was measured; a stray is refused, a clock that stays is followed."""
    sifted = Sifted(is_steady=False)
    sent = [100.0 + 0.5 * k for k in range(40)]
    for k, time_s in enumerate(sent):
        stray = [time_s + off_s] if k == 10 else []
        late_s = 0.1 if k % 3 else 0.12
        sifted.give([time_s + off_s * (k >= 20), *stray], time_s + late_s)
    assert sifted.refused == [sent[10] + off_s]
    np.testing.assert_allclose(sifted.passed, sent, rtol=0, atol=0.03)
    assert sifted.set_by == [pytest.approx(off_s, abs=0.03)]


def test_both_clocks_are_set_at_once() -> None:
    """The instrument's is followed; whether it follows the vehicle's is no question any more."""
    sifted = Sifted(is_steady=False)
    sent = [100.0 + 0.5 * k for k in range(40)]
    for k, time_s in enumerate(sent):
        sifted.set_by_s = 3.0 * (k >= 20)
        sifted.give([time_s + 50.0 * (k >= 20)], time_s + 0.1)
        if k > 24:
            assert len(sifted.passed) == k + 1  # none waits
    np.testing.assert_allclose(sifted.passed, sent, rtol=0, atol=0.03)
    assert sifted.set_by == [pytest.approx(50.0, abs=0.03)]


def test_what_waits_to_be_read_is_not_lost_at_the_end() -> None:
    """Nothing more will come to tell it: read as is likelier, once."""
    sifted = Sifted(is_steady=False)
    for k in range(44):
        time_s = 100.0 + 0.7 * k
        sifted.set_by_s = 0.5 * (k >= 40)
        sifted.give([time_s], time_s + (1.1 if k % 2 else 0.1))
    n_waiting = 44 - len(sifted.passed)
    assert 0 < n_waiting <= 4
    waiting = sifted.clock.waiting(sifted.now)
    rest, others = ([readings[k] for readings in waiting] for k in range(2))
    np.testing.assert_allclose(
        [message.time_s for message in rest], 100.0 + 0.7 * np.arange(44 - n_waiting, 44), atol=1e-6
    )
    off_s = [one.time_s - other.time_s for one, other in zip(rest, others, strict=True)]
    np.testing.assert_allclose(off_s[1:], 0.5)  # the first was stamped before it was set


@pytest.mark.parametrize(
    ("off_s", "is_steady"),
    [(3600.0, True), (-3600.0, True), (0.5, True), (3600.0, False), (0.5, False)],
)
def test_a_clock_in_judgement_at_the_end(off_s: float, *, is_steady: bool) -> None:
    """Once the known one has missed its turn, it was set; read as if it had been believed."""
    sifted, believed = (Sifted(is_steady=is_steady) for _ in range(2))
    n_before = 200
    for one, end_s in ((sifted, 102.8), (believed, 104.0)):
        one.run(100.0, 102.0)
        one.run(102.0, end_s, offset_s=off_s)
    assert len(sifted.passed) == n_before
    waiting = [readings[0].time_s for readings in sifted.clock.waiting(sifted.now)]
    assert waiting == believed.passed[n_before : n_before + 80]  # bit for bit: it counts once
    passed, refused = sifted.clock.end(sifted.now)
    assert ([message.time_s for message in passed], refused) == (waiting, [])
    assert sifted.clock.end(sifted.now) == ([], [])


@pytest.mark.parametrize("off_s", [3600.0, -3600.0, 3.0])
def test_strays_at_the_end_are_refused_and_told(off_s: float) -> None:
    """The known clock has not missed its turn: nothing says that it was set."""
    clock = Steady()
    with hub_with(Transport.UDP, clock) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        sender = UdpSender(port_of(hub))
        for k in range(20):
            clock.now_s += PERIOD_S
            sender.send(encode_message(sample(50.0 + k * PERIOD_S)))
            receiver.until(lambda n=k: len(receiver.messages) == n + 1)  # type: ignore[misc]
        strays = [encode_message(sample(50.0 + off_s + k * PERIOD_S)) for k in range(20)]
        n_bytes = hub.source_status()[0].n_bytes + sum(map(len, strays))
        sender.send(b"".join(strays))
        receiver.until(lambda: hub.source_status()[0].n_bytes == n_bytes)
        assert not hub.waiting()
        assert not hub.end()
        receiver.poll()
        (said,) = (event.text for event in receiver.events if event.kind == "clock_refused")
        assert said.startswith("imu: 20 inertial samples of another clock, which waited")
        sender.close()


def test_strays_are_refused_while_others_wait_to_be_read() -> None:
    """What waits is no silence of the known clock."""
    sifted = Sifted(is_steady=False)
    rng = np.random.default_rng(0)
    sent = [100.0 + 0.7 * k for k in range(60)]
    late_s = 0.1 + rng.choice([0.0, 0.4, 1.0], len(sent))
    arrived = np.maximum.accumulate(np.add(sent, late_s)).tolist()
    strays = []
    for k, (time_s, come_s) in enumerate(zip(sent, arrived, strict=True)):
        sifted.set_by_s = 0.5 * (k >= 40)
        sifted.give([time_s], come_s)
        if 40 <= k < 48:
            strays.append(time_s + 300.0)
            sifted.give(strays[-1:], come_s + 0.01)
    assert sifted.refused == strays
    np.testing.assert_allclose(sorted(sifted.passed + sifted.untold), sent, rtol=0, atol=1e-6)
    assert not sifted.set_by


def test_a_clock_that_is_right_at_last() -> None:
    """An instrument that began before its clock was set is taken at its word from then on."""
    sifted = Sifted()
    sifted.run(100.0, 102.0, offset_s=-1e9)
    after = sifted.run(102.0, 104.0)
    assert sifted.passed[-len(after) :] == after


def test_two_clocks_at_once_never_take_turns() -> None:
    """The one that was there first goes on, however long the other one talks."""
    sifted, known = Sifted(), []
    for k in range(1000):
        steady_s = 100.0 + k * PERIOD_S
        known.append(steady_s)
        sifted.give([steady_s], steady_s)
        sifted.give([5000.0 + k * PERIOD_S], steady_s)
    assert sifted.passed == known


def test_gaps_and_delays_are_no_other_clock() -> None:
    """An instrument that was off for a minute, a link that held back half a minute."""
    sifted = Sifted()
    before = sifted.run(100.0, 102.0)
    late = [162.0 + k * PERIOD_S for k in range(3000)]
    sifted.give(late[:1], 162.0)
    sifted.give(late[1:], 192.0)
    assert sifted.passed == before + late
    assert STRANGER_S < 30.0


def test_what_came_while_the_process_was_stopped_is_not_stamped_now() -> None:
    """Half a minute old fixes are refused by name; nobody is called silent for the time."""
    clock = Steady()
    fix = Fix(WALL_S + 101.0, 1.1, 0.18, 40.0, (0.5, 0.5, 1.0))
    later = Fix(WALL_S + 132.0, 1.1, 0.18, 40.0, (0.5, 0.5, 1.0))
    with hub_with(Transport.UDP, clock, nmea=True) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        sender = UdpSender(port_of(hub))
        sender.send(gga(fix))
        clock.now_s += 30.0
        receiver.until(lambda: hub.source_status()[0].n_refused)
        assert "stood still" in " ".join(event.text for event in receiver.events)
        assert "source_silent" not in receiver.kinds
        clock.now_s += 1.5
        receiver.poll()
        sender.send(gga(later))
        receiver.until(lambda: receiver.messages)
        assert receiver.messages[0].time_s == pytest.approx(later.time_s, abs=1.0)
        sender.close()


def answered(hub: SocketHub) -> str:
    """Return the health of a good answer as it is sent."""
    recorder = Recorder()
    recorder.is_behind = hub.is_behind
    Publisher().send(recorder, OutputFormat.JSON, a_navigation(0.0))
    return str(json.loads(recorder.sent[0][1])["health"])


def test_what_waited_while_the_process_was_stopped_is_not_too_much() -> None:
    """A hundred samples a second for ten seconds, at once: all of them, from one who is counted."""
    clock = Steady()
    limits = Limits(messages_per_s=110.0, burst=20, bytes_per_s=3e4)
    config = InputConfig("imu", Endpoint(Transport.UDP, LOOPBACK, 0), JsonDecoder, limits)
    with SocketHub([config], steady_s=clock, wall_s=lambda: WALL_S + clock.now_s) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        sender = UdpSender(port_of(hub))
        stamps = [clock.now_s + k * PERIOD_S for k in range(1001)]
        sender.send(encode_message(sample(stamps[0])))
        receiver.until(lambda: receiver.messages)
        for begin in range(1, 1001, 100):
            lines = (encode_message(sample(stamp)) for stamp in stamps[begin : begin + 100])
            sender.send(b"".join(lines))
        clock.now_s += 10.0
        healths = set[tuple[bool, str]]()
        receiver._after_poll = lambda: healths.add((hub.is_behind, answered(hub)))
        receiver.until(lambda: len(receiver.messages) == 1001 and not hub.is_behind)
        receiver._after_poll = lambda: None
        assert healths == {(True, "DEGRADED"), (False, "GOOD")}
        assert [message.time_s for message in receiver.messages] == stamps
        sender.send(b"".join(encode_message(sample(stamps[-1] + k)) for k in range(1, 200)))
        receiver.until(lambda: "rate_limited" in receiver.kinds)  # and then as ever
        sender.close()
