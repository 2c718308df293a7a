"""Cutting of byte streams: the chunks do not matter, what is held is bounded, garbage is told."""

from __future__ import annotations

import json
import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssm_graph.base.errors import ConfigError
from ssm_graph.live.protocols.decoder import (
    MAX_REFUSALS,
    Clock,
    Refusals,
    RefusedError,
    Stamper,
    parse_object,
    shown,
)
from ssm_graph.live.protocols.framing import LineFramer, ObjectFramer, SentenceFramer, TokenBucket
from tests.helpers import STEADY

SOUP = st.lists(
    st.sampled_from(
        [
            b"{",
            b"}",
            b'"',
            b"\\",
            b"\n",
            b"\r",
            b"$",
            b"\xff",
            b"[",
            b"]",
            b",",
            b"a",
            b"\xff",
            b'{"a":1}',
            b'{"b":{"c":2}}',
        ]
    ),
    max_size=30,
).map(b"".join)
CUTS = st.lists(st.integers(0, 60), max_size=4)


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    """Return ``data`` cut at these places."""
    places = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    return [data[a:b] for a, b in pairwise(places)]


@pytest.mark.parametrize("framer", [LineFramer, ObjectFramer, SentenceFramer])
@settings(STEADY, max_examples=25)
@given(data=SOUP, cuts=CUTS)
def test_chunks_do_not_matter(
    framer: type[LineFramer] | type[ObjectFramer] | type[SentenceFramer],
    data: bytes,
    cuts: list[int],
) -> None:
    """Whole, in pieces and byte by byte: the same comes out and the same is refused."""
    found = []
    for chunks in ([data], pieces(data, cuts), [bytes([byte]) for byte in data]):
        refused: list[str] = []
        cutter = framer(refused.append, max_length=20)
        out = []
        for chunk in chunks:
            out += cutter.feed(chunk)
            assert cutter.n_held <= 22
        found.append((out, len(refused), cutter.n_held))
    assert found[0] == found[1] == found[2]


@settings(STEADY, max_examples=25)
@given(
    objects=st.lists(
        st.dictionaries(
            st.text(max_size=4),
            st.text(max_size=5) | st.lists(st.integers(0, 9), max_size=2),
            max_size=3,
        ),
        max_size=5,
    ),
    indent=st.sampled_from([None, 4]),
    between=st.sampled_from(["", "\n", ",\n", "\r\n", " "]),
)
def test_objects_come_in_any_layout(
    objects: list[dict[str, object]], indent: int | None, between: str
) -> None:
    """Back to back, a line each, over lines, in a list: no layout loses an object."""
    text = "[" + between.join(json.dumps(x, indent=indent) for x in objects) + "]"
    refused: list[str] = []
    found = ObjectFramer(refused.append).feed(text.encode())
    assert [json.loads(x) for x in found] == objects
    assert not refused


def test_long_and_foreign_lines_are_dropped_and_told() -> None:
    """Decoding goes on with the next line."""
    refused: list[str] = []
    framer = LineFramer(refused.append, max_length=8)
    assert framer.feed(b"12345678\n123456789\nok\r\n\n\xff\xfe\n  next \nrest") == [
        "12345678",
        "ok",
        "next",
    ]
    assert len(refused) == 2
    assert "at most 8 bytes" in refused[0]
    assert "byte 0xff" in refused[1]
    assert framer.feed(b"\n") == ["rest"]


@pytest.mark.parametrize(
    ("broken", "told"),
    [
        (b'{"a": 1, "b": ', "begin of the next"),
        (b'{"a": "x\n"', "line break within quotes"),
        (b"{" * 33, "levels of nesting"),
        (b"hello", "other bytes"),
        (b'{"a": "' + b"x" * 200 + b'"}', "at most 100 bytes"),
        (b'{"a": "\xff"}', "byte 0xff"),
    ],
)
def test_a_broken_object_costs_no_other(broken: bytes, told: str) -> None:
    """What is wrong is said once, and the object on the next line is there."""
    refused: list[str] = []
    framer = ObjectFramer(refused.append, max_length=100)
    assert framer.feed(b'{"n": 1}\n' + broken + b'\n{"n": 2}\n') == ['{"n": 1}', '{"n": 2}']
    assert len(refused) == 1
    assert told in refused[0]


def test_rate_limit_admits_the_burst_and_then_the_rate() -> None:
    """Exactly what the bucket's law says, and a clock set back neither fills nor blocks it."""
    bucket = TokenBucket(rate_per_s=10.0, burst=5)
    assert sum(bucket.admit(100.0) for _ in range(20)) == 5
    assert bucket.n_refused == 15
    assert sum(bucket.admit(101.0 + 0.01 * k) for k in range(100)) == 5 + 9
    assert not bucket.admit(0.0)
    assert not bucket.admit(math.nan)
    assert bucket.admit(0.1)
    bucket.grant(1.0)
    bucket.catch_up()
    assert sum(bucket.admit(0.1) for _ in range(20)) == 5
    with pytest.raises(ConfigError, match="rate above 0"):
        TokenBucket(rate_per_s=math.inf, burst=5)


def test_refusals_are_kept_then_counted() -> None:
    """However much is refused, memory is bounded and nothing is forgotten in the count."""
    refusals = Refusals()
    for k in range(50):
        refusals.add(str(k))
    taken = refusals.take()
    assert len(taken) == MAX_REFUSALS + 1
    assert taken[-1] == "30 more were refused"
    assert refusals.take() == []
    assert refusals.n_total == 50


def test_a_clock_that_is_off_is_said_once() -> None:
    """The arrival steps in; when the clocks agree again the instrument's stamp counts."""
    refusals = Refusals()
    stamper = Stamper(Clock.INSTRUMENT, max_clock_error_s=5.0, refusals=refusals, place="x")
    assert [stamper.stamp(t, 100.0) for t in (99.8, 50.0, 51.0, None, 99.9)] == [
        99.8,
        100.0,
        100.0,
        100.0,
        99.9,
    ]
    assert len(refusals.take()) == 1
    with pytest.raises(RefusedError, match="time of arrival"):
        stamper.stamp(99.8, math.nan)
    arrival = Stamper(Clock.ARRIVAL, max_clock_error_s=5.0, refusals=refusals, place="x")
    assert arrival.stamp(99.8, 100.0) == 100.0


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('{"a": NaN}', "finite numbers, got NaN"),
        ('{"a": -Infinity}', "finite numbers"),
        ('{"a": 1e999}', "finite numbers"),
        ('{"a": ' + "9" * 5000 + "}", "at most 20 digits"),
        ('{"a": 1, "a": 2}', "comes twice"),
        ('{"a": ' + "[" * 5000 + "]" * 5000 + "}", "brackets"),
        ("[1]", "expected a JSON object"),
        ('{"a": 1} x', "Extra data"),
        ("", "expected a JSON object"),
        ("__import__('os')", "expected a JSON object"),
    ],
)
def test_json_cannot_hurt(text: str, told: str) -> None:
    """All that Python's parser takes or falls over, and we do not want."""
    with pytest.raises(RefusedError, match=told):
        parse_object(text)


def test_messages_show_no_control_characters() -> None:
    """A refusal may be printed on a terminal, whatever came."""
    text = shown("\x1b[2J\ud800" + "x" * 10_000)
    assert text.isprintable()
    assert len(text) < 80
