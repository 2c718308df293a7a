"""One instrument, several that claim to be it: who is heard, and when another one is."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.io.nmea_sentences import checksum
from ssm_graph.live.protocols.decoder import Decoder
from ssm_graph.live.protocols.json_messages import JsonDecoder, encode_message
from ssm_graph.live.protocols.nmea import PREFERRED_S, NmeaDecoder
from ssm_graph.live.run.place_file import PLACES_NAME, PlaceFile
from ssm_graph.live.sockets.endpoints import LOOPBACK, Endpoint, Transport
from ssm_graph.live.sockets.inputs import MAX_SENDERS, TcpServerInput, UdpInput
from ssm_graph.live.sockets.places import (
    LONGEST_INTERVAL_S,
    MOST_PLACES,
    SETTLED,
    SILENT_S,
    SILENT_TIMES,
    Known,
    Place,
    Places,
)
from ssm_graph.live.sockets.sockets import REMEMBER_S, InputConfig, SocketHub
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.gnss import Fix
from tests.instrument_fixture import Receiver, UdpSender

WALL_S = 1_700_000_000.0
FIX = Fix(1.0, 0.0, 0.0, 0.0, (1.0, 1.0, 1.0))


class Turns:
    """Places that speak of the depth, at times that a test sets."""

    def __init__(self) -> None:
        self.places, self.now_s = Places(), 0.0

    def hears(self, place: Place, after_s: float = 0.1) -> bool:
        """Return whether a place is heard, so long after the last one that spoke."""
        return bool(self.passed(place, after_s))

    def passed(self, place: Place, after_s: float = 0.1) -> int:
        """Return how many messages of a place pass."""
        self.now_s += after_s
        return len(self.places.hear(place, DepthReading(self.now_s, 1.0), self.now_s).passed)


def test_the_first_that_is_heard_counts() -> None:
    """Whoever else speaks, however much; of another instrument he may be the first."""
    turns, own, other = Turns(), Place("own"), Place("other")
    assert all(turns.hears(own) for _ in range(SETTLED))
    assert not any(turns.hears(other, 0.001) for _ in range(90))
    assert turns.hears(own)
    assert turns.places.hear(other, FIX, turns.now_s).passed == [FIX]
    assert turns.places.is_heard(own, DepthReading)
    assert not turns.places.is_heard(other, DepthReading)


def test_another_one_is_heard_where_the_first_is_silent_until_it_is_back() -> None:
    """After a second and three intervals, which the other one has to have waited."""
    turns, own, other = Turns(), Place("own"), Place("other")
    assert all(turns.hears(own, 0.5) for _ in range(4))
    assert not turns.hears(other, 60.0)  # nobody had looked: the first may have spoken as well
    assert not turns.hears(other, 1.4)
    assert turns.hears(other, 0.2)
    assert turns.places.is_heard(other, DepthReading)
    assert turns.hears(own)
    assert not turns.hears(other)


def test_whoever_speaks_is_heard_once_the_first_has_been_missed_for_long() -> None:
    """Each from a port of its own: those before have waited for it."""
    turns, own = Turns(), Place("own")
    assert all(turns.hears(own) for _ in range(SETTLED))
    heard = [turns.hears(Place(str(k))) for k in range(30)]
    assert not any(heard[:10])
    assert all(heard[12:])


def test_two_that_speak_by_turns_from_the_start_are_told_apart() -> None:
    """The first of them counts, though neither spoke alone."""
    turns, own, other = Turns(), Place("own"), Place("other")
    heard = [(turns.hears(own), turns.hears(other)) for _ in range(8)]
    assert all(first for first, _ in heard)
    assert not any(second for _, second in heard[SETTLED - 1 :])


def test_a_client_that_calls_again_is_the_same() -> None:
    """From its host; one that came in between does not take its turn."""
    turns = Turns()
    own, other = Place("own", "10.0.0.1"), Place("other", "10.0.0.2")
    assert all(turns.hears(own) for _ in range(SETTLED))
    assert not turns.hears(other)
    own.leave()
    assert not turns.hears(other)
    again = Place("own again", "10.0.0.1")
    assert turns.hears(again)
    assert not turns.hears(other, 0.9 * SILENT_S)
    again.leave()
    assert turns.hears(other, 1.1 * SILENT_S)


def test_a_client_that_has_called_again_waits_for_the_end_of_its_last_call() -> None:
    """What it sent before is read together with what it sends now, and nothing of it is lost."""
    turns = Turns()
    own, again = Place("own", "10.0.0.1"), Place("own again", "10.0.0.1")
    assert all(turns.hears(own) for _ in range(SETTLED))
    for _ in range(8):
        assert turns.hears(own, 0.05)
        assert not turns.hears(again, 0.05)
    assert len(turns.places.waiting(again)) == 8
    own.leave()
    assert turns.passed(again) == 9
    assert not turns.places.waiting(again)


def test_who_spoke_beside_another_one_for_long_does_not_take_its_place() -> None:
    """It leaves, and calls again: its turn is kept for a second, and what waited is refused."""
    turns = Turns()
    own, other = Place("own", "10.0.0.1"), Place("other", "10.0.0.1")
    assert all(turns.hears(own) for _ in range(SETTLED))
    refused = 0
    for _ in range(15):
        assert turns.hears(own, 0.05)
        turns.now_s += 0.05
        heard = turns.places.hear(other, DepthReading(turns.now_s, 2.0), turns.now_s)
        assert not heard.passed
        refused += heard.n_refused
    assert refused == 15
    assert heard.instead is own
    own.leave()
    assert not turns.hears(other)
    assert turns.hears(Place("own again", "10.0.0.1"))


def test_a_socket_for_every_datagram_keeps_nobody_out() -> None:
    """Nor where a port comes again by chance; so many are remembered and no more."""
    turns, rng = Turns(), np.random.default_rng(0)
    ports = [Place(str(k)) for k in range(1000)]
    assert all(turns.hears(ports[k], 0.1) for k in rng.integers(0, len(ports), 3000))
    assert len(turns.places._voices[DepthReading]) == MOST_PLACES


def test_a_process_that_follows_knows_who_was_heard() -> None:
    """A stranger that speaks first is refused at once, and gives way where nobody else came."""
    before, own, other = Turns(), Place("own", "10.0.0.1"), Place("other", "10.0.0.2")
    assert all(before.hears(own) for _ in range(SETTLED))
    turns = Turns()
    turns.places = Places(before.places.known(), turns.now_s)
    assert not any(turns.hears(other, 0.5) for _ in range(3))
    assert turns.hears(Place("own, called again", "10.0.0.1"))
    assert not turns.hears(other)
    turns = Turns()
    turns.places = Places(before.places.known(), turns.now_s)
    assert not turns.hears(other, SILENT_TIMES * LONGEST_INTERVAL_S - 0.1)
    assert turns.hears(other, 0.2)
    assert turns.hears(Place("own, called late", "10.0.0.1"))
    assert not turns.hears(other)


@pytest.mark.parametrize("content", [b"", b"[[", b"{}", b'[["Fix", 1, ""], 7]', 3000 * b"["])
def test_places_that_cannot_be_read_are_none(tmp_path: Path, content: bytes) -> None:
    """The run goes on as a new one does."""
    (tmp_path / PLACES_NAME).write_bytes(content)
    assert PlaceFile(tmp_path).known() == []
    assert PlaceFile(tmp_path / "nowhere").known() == []
    assert "cannot be written" in str(PlaceFile(tmp_path / "nowhere").note(()))


class Steady:
    """A clock that a test sets."""

    now_s = 100.0

    def __call__(self) -> float:
        """Return seconds since some moment."""
        return self.now_s


def depth(clock: Steady, metres: float) -> bytes:
    """Return a depth of now."""
    return encode_message(DepthReading(WALL_S + clock.now_s, metres))


def depths(receiver: Receiver) -> list[float]:
    """Return the depths that came."""
    return [message.depth for message in receiver.messages if isinstance(message, DepthReading)]


def test_a_stranger_at_another_port_feeds_no_depths() -> None:
    """Nor at the same one; what is refused is counted and told, with both places."""
    clock = Steady()
    kinds = (Transport.UDP, Transport.TCP_SERVER)
    inputs = [InputConfig(kind.value, Endpoint(kind, LOOPBACK, 0), JsonDecoder) for kind in kinds]
    wall_s = lambda: WALL_S + clock.now_s  # noqa: E731
    with SocketHub(inputs, steady_s=clock, wall_s=wall_s) as hub, ExitStack() as stack:
        receiver = Receiver(hub)
        receiver.poll()
        udp, tcp = hub.inputs
        assert isinstance(udp, UdpInput)
        assert isinstance(tcp, TcpServerInput)
        own, stray = UdpSender(udp.port), UdpSender(udp.port)
        stranger = stack.enter_context(socket.create_connection((LOOPBACK, tcp.port)))
        for k in range(20):
            clock.now_s += 0.1
            own.send(depth(clock, 5.0))
            receiver.until(lambda n=k: len(depths(receiver)) == n + 1)  # type: ignore[misc]
            if k >= SETTLED - 1:
                stray.send(depth(clock, 20.0))
                stranger.sendall(50 * depth(clock, 20.0))
            n_strange = max(k + 2 - SETTLED, 0)
            refused = [n_strange, 50 * n_strange]
            receiver.until(lambda n=refused: [s.n_refused for s in hub.source_status()] == n)  # type: ignore[misc]
        assert set(depths(receiver)) == {5.0}
        said = [event.text for event in receiver.events if event.kind == "second_source"]
        assert len(said) == 2
        assert all("depth messages from" in text and "was heard first" in text for text in said)
        for k in range(12):
            clock.now_s += 0.1
            stranger.sendall(depth(clock, 20.0))
            receiver.until(lambda n=k: hub.source_status()[1].n_bytes > 900 * 50 + n)  # type: ignore[misc]
        receiver.until(lambda: depths(receiver)[-1] == 20.0)
        own.close()
        stray.close()


def test_after_a_kill_the_instrument_is_known_by_its_socket(tmp_path: Path) -> None:
    """A stranger's depths come first, at each of the first three moments, and none is used."""
    clock, places = Steady(), PlaceFile(tmp_path)
    own: UdpSender | None = None
    port = 0
    for is_again in (False, True):
        inputs = [InputConfig("depth", Endpoint(Transport.UDP, LOOPBACK, port), JsonDecoder)]
        with SocketHub(
            inputs,
            steady_s=clock,
            wall_s=lambda: WALL_S + clock.now_s,
            known=places.known(),
            note_places=places.note,
        ) as hub:
            receiver = Receiver(hub)
            receiver.poll()
            (source,) = hub.inputs
            assert isinstance(source, UdpInput)
            port = source.port
            own = own or UdpSender(port)
            stray = UdpSender(port)
            for k in range(SETTLED):
                clock.now_s += 0.1
                if is_again:
                    stray.send(depth(clock, 20.0))
                    receiver.until(lambda n=k: hub.source_status()[0].n_refused == n + 1)  # type: ignore[misc]
                own.send(depth(clock, 5.0))
                receiver.until(lambda n=k, r=receiver: len(depths(r)) == n + 1)  # type: ignore[misc]
            assert set(depths(receiver)) == {5.0}
            clock.now_s += REMEMBER_S
            receiver.poll()
            stray.close()
    assert [one.kind for one in places.known()] == [DepthReading]
    assert own is not None
    own.close()


def test_places_that_a_full_disk_did_not_take_are_written_later() -> None:
    """Once it takes them, and no more often than they change."""
    clock, noted = Steady(), list[tuple[Known, ...]]()
    inputs = [InputConfig("depth", Endpoint(Transport.UDP, LOOPBACK, 0), JsonDecoder)]

    def note(known: Iterable[Known]) -> str | None:
        noted.append(tuple(known))
        return "no space" if len(noted) < 3 else None

    with SocketHub(
        inputs, steady_s=clock, wall_s=lambda: WALL_S + clock.now_s, note_places=note
    ) as hub:
        receiver = Receiver(hub)
        (source,) = hub.inputs
        assert isinstance(source, UdpInput)
        own = UdpSender(source.port)
        for k in range(SETTLED):
            clock.now_s += 0.1
            own.send(depth(clock, 5.0))
            receiver.until(lambda n=k: len(depths(receiver)) == n + 1)  # type: ignore[misc]
        for _ in range(5):
            clock.now_s += REMEMBER_S
            receiver.poll()
        own.close()
    assert [[one.kind for one in known] for known in noted] == 3 * [[DepthReading]]


def test_a_place_that_is_called_no_more_keeps_nobody_out() -> None:
    """A run that is gone on with may call an instrument at another address."""
    clock = Steady()
    known = [
        Known(DepthReading, "dvl, tcp://10.0.0.1:1", f"dvl tcp://10.0.0.1:{k}") for k in (1, 2)
    ]
    for port, n_known in ((1, 1), (3, 0)):
        endpoint = Endpoint(Transport.TCP_CLIENT, "10.0.0.1", port)
        inputs = [InputConfig("dvl", endpoint, JsonDecoder)]
        with SocketHub(inputs, steady_s=clock, known=known) as hub:
            assert len(hub._places.known()) == n_known
    udp_input = InputConfig("dvl", Endpoint(Transport.UDP, LOOPBACK, 0), JsonDecoder)
    with SocketHub([udp_input], steady_s=clock, known=known) as hub:
        assert len(hub._places.known()) == 2
    assert len(Places(50 * known).known()) == MOST_PLACES


@contextmanager
def udp(
    make_decoder: Callable[[], Decoder], clock: Steady
) -> Iterator[tuple[SocketHub, UdpInput, Receiver]]:
    """Yield a hub that hears datagrams, its one source, and who reads it."""
    config = InputConfig("any", Endpoint(Transport.UDP, LOOPBACK, 0), make_decoder)
    with SocketHub([config], steady_s=clock, wall_s=lambda: WALL_S + clock.now_s) as hub:
        receiver = Receiver(hub)
        receiver.poll()
        (source,) = hub.inputs
        assert isinstance(source, UdpInput)
        yield hub, source, receiver


def test_datagrams_of_many_senders_are_told_apart_up_to_a_number() -> None:
    """Halves of two senders do not meet, and the first of them stays."""
    clock = Steady()
    with udp(JsonDecoder, clock) as (hub, source, receiver):
        own = UdpSender(source.port)
        for k in range(MAX_SENDERS + 20):
            clock.now_s += 0.01
            own.send(depth(clock, 5.0))
            receiver.until(lambda n=k: len(depths(receiver)) == n + 1)  # type: ignore[misc]
            other = UdpSender(source.port)
            for n in (1, 2):
                other.send(b"{")
                receiver.until(lambda n=2 * k + n: hub.source_status()[0].n_refused == n)  # type: ignore[misc]
            other.close()
        assert len(source._senders) == MAX_SENDERS
        assert not source._once
        assert len(source._channels) == MAX_SENDERS + 1
        own.close()


def test_a_socket_for_every_sentence_is_one_instrument() -> None:
    """A compass with no more than HDG: read once nothing better has come for a while."""
    clock = Steady()
    with udp(NmeaDecoder, clock) as (hub, source, receiver):
        body = "HCHDG,90.0,,,0.0,E"
        line = f"${body}*{checksum(body)}\r\n".encode()
        senders = []  # kept open, so that no port comes twice
        for k in range(MAX_SENDERS + 20):
            clock.now_s += 0.2
            senders.append(UdpSender(source.port))
            senders[-1].send(line)
            n_bytes = (k + 1) * len(line)
            receiver.until(lambda n=n_bytes: hub.source_status()[0].n_bytes == n)  # type: ignore[misc]
        n_heard = sum(isinstance(message, HeadingReading) for message in receiver.messages)
        assert n_heard == MAX_SENDERS + 20 - round(PREFERRED_S / 0.2)
        assert len(source._once) == MAX_SENDERS
        for sender in senders:
            sender.close()
