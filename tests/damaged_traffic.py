"""Damaged traffic into the live decoders: nothing may raise, grow, or let a bad number through."""

from __future__ import annotations

import json
import math
import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from ssm_graph.base.errors import printable
from ssm_graph.io.nmea_sentences import checksum
from ssm_graph.live.protocols.decoder import MAX_REFUSALS, Decoder
from ssm_graph.live.protocols.framing import MAX_LENGTH
from ssm_graph.live.protocols.json_messages import JsonDecoder, encode_message
from ssm_graph.live.protocols.nmea import NmeaDecoder
from ssm_graph.live.protocols.waterlinked import BeamRule, WaterLinkedDecoder
from ssm_graph.sensors.acoustic import AcousticRange, UsblFix
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.magnetometer import MagneticReading
from ssm_graph.sensors.messages import Message, bad_number
from ssm_graph.sensors.standstill import RestReading
from tests.water_linked_fixture import serial_line

START_S = 1_700_000_000.0
MAX_HELD = MAX_LENGTH + 16
BLOCK = 8192
"""Bytes of traffic that are damaged and fed together; after each a sound message must come out."""
MAX_CHUNK = 4096
MAX_FAILURES = 20


def json_traffic(rng: random.Random, time_s: float) -> bytes:
    """Return a message of any kind as a line."""

    def normal(n: int, sigma: float = 1.0) -> tuple[float, ...]:
        return tuple(rng.gauss(0.0, sigma) for _ in range(n))

    a, b, c, d = normal(4)
    kind = rng.random()
    message: Message
    if kind < 0.7:
        message = ImuSample(time_s, (a, b, c), (d, a, -9.8))
    elif kind < 0.85:
        sigma = None if kind < 0.8 else (0.01, 0.02, math.nan, 0.01)
        message = Ping(time_s, (a, math.nan if b > 1.0 else b, c, d), sigma, is_water=a > 1.0)
    elif kind < 0.9:
        message = DepthReading(time_s, 30.0 + a)
    else:
        place = (time_s, 1.0 + 1e-3 * a, 0.2 + 1e-3 * b, 40.0 + c, (0.5, 0.5, 1.0))
        message = rng.choice(
            (
                Fix(*place),
                UsblFix(*place, abs(d)),
                AcousticRange(time_s, 7.0, 100.0 + a),
                HeadingReading(time_s, a),
                MagneticReading(time_s, (1e-5 * a, 1e-5 * b, 4e-5)),
                RestReading(time_s),
            )
        )
    return encode_message(message)


def waterlinked_traffic(rng: random.Random, time_s: float) -> bytes:
    """Return a report of a DVL: mostly velocities, a line each or indented, some in a list."""
    if rng.random() < 0.2:
        place = {"ts": time_s, "x": rng.random(), "yaw": 360.0 * rng.random() - 180.0}
        return json.dumps({**place, "status": 0, "type": "position_local"}).encode() + b"\n"
    beams = [
        {
            "id": k,
            "velocity": rng.gauss(0.0, 0.3),
            "distance": 5.0 * rng.random(),
            "rssi": -50.0,
            "beam_valid": rng.random() < 0.9,
        }
        for k in range(4)
    ]
    report = {
        "time": 1e3 * rng.random(),
        "vx": rng.gauss(0.0, 0.3),
        "fom": 1e-3,
        "covariance": [[1e-6, 0.0, 0.0], [0.0, 1e-6, 0.0], [0.0, 0.0, 1e-7]],
        "altitude": rng.choice([4.5, -1]),
        "transducers": beams,
        "velocity_valid": rng.random() < 0.8,
        "status": 0,
        "format": "json_v3.1",
        "type": rng.choice(["velocity", "velocity", "velocity_water"]),
        "time_of_validity": int((time_s - 0.15) * 1e6),
    }
    indent = 4 if rng.random() < 0.3 else None
    return json.dumps(report, indent=indent).encode() + rng.choice([b"\n", b"\r\n", b",\n", b""])


def serial_traffic(rng: random.Random, time_s: float) -> bytes:
    """Return a ping of a DVL at a serial port, and what comes between two."""
    micro_s = int((time_s - 0.15) * 1e6)
    head = f"{rng.gauss(0.0, 0.3):.3f},0.017,0.006,{rng.choice('yyyn')}"
    tail = f"0.001,1e-07;0;0;0;1e-07;0;0;0;1e-08,{micro_s},{micro_s + 150_000},112.83,0"
    bodies = [rng.choice([f"wrz,{head},0.93,{tail}", f"wrs,{head},{tail}"])]
    bodies += [f"wru,{k},{rng.gauss(0.0, 0.3):.3f},1.1,-40,-95" for k in range(4)]
    if rng.random() < 0.3:
        bodies += [f"wrp,{time_s:.3f},0.4,0.2,1.2,0.4,53.9,13.0,19.3,0", "wra", "wrv,2,5,0"]
    return b"".join(map(serial_line, bodies))


def nmea_traffic(rng: random.Random, time_s: float) -> bytes:
    """Return a burst of a receiver and a pressure sensor."""
    seconds = time_s % 86400.0
    utc = f"{int(seconds) // 3600:02d}{int(seconds) // 60 % 60:02d}{seconds % 60.0:05.2f}"
    quality = rng.choice("124506")
    place = f"6326.{rng.randrange(10**4):04d},N,01024.{rng.randrange(10**4):04d},E"
    bodies = [
        f"GPGGA,{utc},{place},{quality},10,0.{rng.randrange(1, 10)},20.5,M,40.2,M,,",
        f"GPGST,{utc},1.1,0.3,0.2,45.0,0.02,0.01,0.05",
        f"PRVAT,00.115,M,{10.0 + 30.0 * rng.random():08.3f},dBar",
        f"PIPS,{30.0 * rng.random():07.2f},M",
        "SDDPT,12.5,0.0",
        f"GPRMC,{utc},A,{place},0.5,54.7,250625,,,A",
        f"GNGLL,{place},{utc},A,A",
        f"HEHDT,{rng.randrange(360)}.5,T",
        f"HCHDG,{rng.randrange(360)}.5,1.0,E,,",
    ]
    kept = [body for body in bodies if rng.random() < 0.7]
    frame = b"\xb5\x62" + rng.randbytes(rng.randrange(100)) if rng.random() < 0.2 else b""
    return frame + b"".join(f"${body}*{checksum(body)}\r\n".encode() for body in kept)


@dataclass
class Target:
    """A decoder under test, its traffic and what became of it."""

    name: str
    decoder: Decoder
    traffic: Callable[[random.Random, float], bytes]
    fed: int = 0
    chunks: int = 0
    messages: int = 0
    refusals: int = 0
    most_held: int = 0
    wall_s: float = 0.0
    slowest_s: float = 0.0
    failures: list[str] = field(default_factory=list)

    def feed(self, chunk: bytes, arrival_s: float) -> list[Message]:
        """Feed one chunk and check all that must hold after it."""
        messages, held = list[Message](), list[Message]()
        start = time.perf_counter()
        try:
            messages = self.decoder.feed(chunk, arrival_s=arrival_s)
            held = self.decoder.waiting()
        except Exception as error:
            self.fail(f"raised {error!r}", chunk)
        spent_s = time.perf_counter() - start
        self.wall_s += spent_s
        self.slowest_s = max(self.slowest_s, spent_s)
        self.fed += len(chunk)
        self.chunks += 1
        self.messages += len(messages)
        self.most_held = max(self.most_held, self.decoder.n_held)
        if self.decoder.n_held > MAX_HELD:
            self.fail(f"holds {self.decoder.n_held} bytes", chunk)
        for message in (*messages, *held):
            if (name := bad_number(message)) is not None:
                self.fail(f"{name} of {message} is not finite", chunk)
        return messages

    def take(self) -> None:
        """Take the refusals as a caller would, and check that they are few and can be shown."""
        texts = self.decoder.take_refusals()
        self.refusals += len(texts)
        if len(texts) > MAX_REFUSALS + 1:
            self.fail(f"kept {len(texts)} refusals", b"")
        for text in texts:
            if len(text) > 400 or "\n" in text or printable(text) != text:
                self.fail(f"refusal {text!r:.200}", b"")

    def fail(self, what: str, chunk: bytes) -> None:
        """Note a failure with the bytes that showed it."""
        if len(self.failures) < MAX_FAILURES:
            self.failures.append(f"{self.name}: {what}; chunk {chunk[:200]!r}")


def targets() -> list[Target]:
    """Return all decoders, each with the traffic that is its own."""
    return [
        Target("json", JsonDecoder(), json_traffic),
        Target("water linked", WaterLinkedDecoder(), waterlinked_traffic),
        Target("water linked, every beam", _each_beam(), waterlinked_traffic),
        Target("water linked, serial", WaterLinkedDecoder(heading=True), serial_traffic),
        Target("nmea", NmeaDecoder(), nmea_traffic),
    ]


def _each_beam() -> Decoder:
    return WaterLinkedDecoder(beam_rule=BeamRule.EACH, heading=True)


def block_of(target: Target, others: Sequence[Target], rng: random.Random, time_s: float) -> bytes:
    """Return sound traffic, one part in twenty of another instrument."""
    parts: list[bytes] = []
    while sum(map(len, parts)) < BLOCK:
        source = rng.choice(others) if rng.random() < 0.05 else target
        parts.append(source.traffic(rng, time_s + 0.01 * len(parts)))
    return b"".join(parts)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return the block with up to a dozen injuries; one in ten stays whole."""
    result = bytearray(data)
    if rng.random() < 0.1:
        return data
    for _ in range(rng.randrange(1, 13)):
        at, length = rng.randrange(len(result) + 1), int(rng.expovariate(1.0 / 40.0))
        kind = rng.randrange(8)
        if kind == 0 and at < len(result):  # bit flip
            result[at] ^= 1 << rng.randrange(8)
        elif kind == 1:  # bytes lost
            del result[at : at + length]
        elif kind == 2:  # spliced: a piece again, elsewhere
            start = rng.randrange(len(result) + 1)
            result[at:at] = result[start : start + 4 * length]
        elif kind == 3:  # noise
            result[at:at] = rng.randbytes(length)
        elif kind == 4:  # what parsers fall over
            result[at:at] = rng.choice(BAIT)
        elif kind == 5:  # a number of the traffic becomes another
            _replace_number(result, at, rng)
        elif kind == 6 and rng.random() < 0.05:  # far too long
            result[at:at] = rng.choice([b"[", b'{"a":', b"9", b"\\", b'"', b"$", b"\xff"]) * 70_000
        elif kind == 7 and rng.random() < 0.3:  # cut off
            del result[at:]
    return bytes(result)


BAIT = (
    *(b"NaN", b"-Infinity", b"1e999", b"1e-999999999999999999999", b"9" * 5000, b"-", b"null"),
    *(b"true", b'"', b"\\", b"\\u", b'"\\ud800"', b"{", b"}", b"[" * 300, b"{" * 40, b"\n", b"\r"),
    *(b"\n{", b"\x00", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"$", b"*", b"*00", b",,,,,,,,,,,,,,,,"),
    *(b"$GPGGA,,,,,,1,,,,M,,M,,*00\r\n", b'{"type":"imu"}\n', b'{"type":"velocity"}', b"1_000"),
)


def _replace_number(result: bytearray, at: int, rng: random.Random) -> None:
    begin = next((k for k in range(at, len(result)) if chr(result[k]).isdigit()), len(result))
    end = next((k for k in range(begin, len(result)) if not chr(result[k]).isdigit()), len(result))
    result[begin:end] = rng.choice(
        [b"0", b"-1", b"1e308", b"1e-320", b"true", b"[]", b'"1"', b"99999"]
    )


def chunks_of(data: bytes, rng: random.Random) -> Iterator[bytes]:
    """Yield the data in chunks of random sizes, single bytes among them."""
    at = 0
    while at < len(data):
        size = min(MAX_CHUNK, int(math.exp(rng.uniform(0.0, math.log(MAX_CHUNK)))))
        yield data[at : at + size]
        at += size


def run(target: Target, others: Sequence[Target], n_bytes: int, rng: random.Random) -> None:
    """Feed so many damaged bytes; after each block the next sound message must be decoded."""
    time_s = START_S
    while target.fed < n_bytes and len(target.failures) < MAX_FAILURES:
        for chunk in chunks_of(damaged(block_of(target, others, rng, time_s), rng), rng):
            arrival_s = rng.choice([math.nan, math.inf, -1e300]) if rng.random() < 1e-3 else time_s
            target.feed(chunk, arrival_s)
            if rng.random() < 0.2:
                target.take()
        time_s += 10.0
        if not target.feed(sound(target, time_s), time_s):
            target.fail("a sound message after damage was not decoded", b"")
        time_s += 10.0


def sound(target: Target, time_s: float) -> bytes:
    """Return a message that must be decoded, on a line of its own."""
    if target.traffic is nmea_traffic:
        return b"\r\n$PIPS,0020.00,M*%s\r\n" % checksum("PIPS,0020.00,M").encode()
    if target.traffic is json_traffic:
        return b"\n" + encode_message(DepthReading(time_s, 1.0))
    beams = [{"id": k, "velocity": 0.1 * k, "beam_valid": True} for k in range(4)]
    report = {"type": "velocity", "velocity_valid": True, "time": time_s, "transducers": beams}
    return b"\n" + json.dumps(report).encode() + b"\n"
