"""What all decoders are: bytes of one connection in, messages out, and JSON that cannot hurt.

Streams are cut into lines or JSON objects. What comes out does not depend on how the stream was
cut into chunks, and what is held is bounded.
"""

from __future__ import annotations

import json
import math
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable
from decimal import Decimal
from enum import Enum
from typing import Any, Final

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.sensors.messages import Message

MAX_LENGTH: Final = 64 * 1024
"""Bytes of a line or an object."""
MAX_DEPTH: Final = 32
_TOKEN = re.compile(rb'\\[^\n]|\n\{|["{}\n]')
_BETWEEN = b"[], \t\r\n"


class LineFramer:
    """Lines of UTF-8 text; one that is too long or not UTF-8 is dropped and told to ``refuse``."""

    def __init__(self, refuse: Callable[[str], None], *, max_length: int = MAX_LENGTH) -> None:
        self._refuse, self._max_length = refuse, max_length
        self._rest, self._is_skipping = bytearray(), False

    @property
    def n_held(self) -> int:
        """Bytes of the unfinished line, at most ``max_length``."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[str]:
        """Return the lines that end in ``data``, without line ends and space around, not empty."""
        *ended, rest = data.split(b"\n")
        lines = []
        for part in ended:
            self._extend(part)
            lines.append("" if self._is_skipping else _text(bytes(self._rest), self._refuse))
            self._rest.clear()
            self._is_skipping = False
        self._extend(rest)
        return [line for line in lines if line]

    def _extend(self, part: bytes) -> None:
        if self._is_skipping:
            return
        if len(self._rest) + len(part) > self._max_length:
            self._refuse(
                f"expected lines of at most {self._max_length} bytes, got a longer one; "
                "is the port another instrument's?"
            )
            self._rest.clear()
            self._is_skipping = True
        else:
            self._rest += part


class ObjectFramer:
    """JSON objects back to back, one a line, spread over lines, or as the items of a list.

    Brackets, commas and space between objects are skipped. An object that will never end does not
    swallow the next: a brace at the very begin of a line begins anew, and so does what follows a
    line break within quotes, which JSON does not allow.
    """

    def __init__(self, refuse: Callable[[str], None], *, max_length: int = MAX_LENGTH) -> None:
        self._refuse, self._max_length = refuse, max_length
        self._rest, self._start, self._scanned, self._depth = b"", 0, 0, 0
        self._is_quoted = self._is_skipping = False
        self._objects: list[str] = []

    @property
    def n_held(self) -> int:
        """Bytes of the unfinished object, at most ``max_length`` and the token at its end."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[str]:
        """Return the objects that end in ``data``."""
        text = self._rest + data
        limit = _complete_tokens(text, self._scanned)
        for token in _TOKEN.finditer(text, self._scanned, limit):
            self._step(text, token.group(), token.start(), token.end())
        if self._depth and limit - self._start > self._max_length:
            self._drop_long(limit)
        if not self._depth:
            self._leave_out(text[self._start : limit])
            self._start = limit
        self._rest = text[self._start :]
        self._scanned = limit - self._start
        self._start = 0
        objects, self._objects = self._objects, []
        return objects

    def _step(self, text: bytes, token: bytes, begin: int, end: int) -> None:
        """Take one token into account; an escaped character changes nothing."""
        if self._depth and begin - self._start >= self._max_length:
            self._drop_long(begin)
        if not self._depth or token == b"\n{":
            if token[-1:] == b"{" and token[:1] != b"\\":
                self._begin(text, end - 1)
        elif token == b'"':
            self._is_quoted = not self._is_quoted
        elif token == b"\n" and self._is_quoted:
            self._drop("expected a JSON object, got a line break within quotes", end)
        elif token == b"{" and not self._is_quoted:
            self._depth += 1
            if self._depth > MAX_DEPTH:
                self._drop(f"expected at most {MAX_DEPTH} levels of nesting, got more", end)
        elif token == b"}" and not self._is_quoted:
            self._depth -= 1
            if not self._depth:
                self._objects += filter(None, [_text(text[self._start : end], self._refuse)])
                self._start = end

    def _begin(self, text: bytes, start: int) -> None:
        if self._depth:
            self._refuse("expected the end of a JSON object, got the begin of the next")
        else:
            self._leave_out(text[self._start : start])
        self._start, self._depth = start, 1
        self._is_quoted = self._is_skipping = False

    def _drop(self, why: str, start: int) -> None:
        """Forget the object; what is left of it is skipped without a word."""
        self._refuse(why)
        self._start, self._depth, self._is_skipping = start, 0, True

    def _drop_long(self, start: int) -> None:
        text = f"expected JSON objects of at most {self._max_length} bytes, got a longer one"
        self._drop(text, start)

    def _leave_out(self, between: bytes) -> None:
        if not self._is_skipping and between.strip(_BETWEEN):
            self._refuse(
                "expected JSON objects, got other bytes; is the port another instrument's?"
            )
            self._is_skipping = True


class TokenBucket:
    """Admits ``rate_per_s`` messages a second in the mean and ``burst`` at once."""

    def __init__(self, *, rate_per_s: float, burst: int) -> None:
        if not (math.isfinite(rate_per_s) and rate_per_s > 0.0 and burst >= 1):
            raise ConfigError(
                f"rate limit: expected a rate above 0 per second and a burst of 1 or more, "
                f"got {rate_per_s} and {burst}"
            )
        self.n_refused = 0
        """How many were refused so far."""
        self._rate_per_s, self._burst, self._tokens = rate_per_s, float(burst), float(burst)
        self._last_s: float | None = None

    def admit(self, now_s: float) -> bool:
        """Return whether one more message may pass at ``now_s``; a clock set back fills nothing."""
        if math.isfinite(now_s):
            elapsed_s = max(0.0, now_s - (now_s if self._last_s is None else self._last_s))
            self._tokens = min(self._burst, self._tokens + elapsed_s * self._rate_per_s)
            self._last_s = now_s
        if self._tokens < 1.0:
            self.n_refused += 1
            return False
        self._tokens -= 1.0
        return True


def _text(data: bytes, refuse: Callable[[str], None]) -> str:
    """Return the text of a line or object; empty where it is not UTF-8."""
    try:
        return data.decode("utf-8").strip()
    except UnicodeDecodeError as error:
        refuse(f"expected UTF-8 text, got byte 0x{data[error.start]:02x}; check the baud rate")
        return ""


def _complete_tokens(text: bytes, scanned: int) -> int:
    """Return where tokens may still change with the next bytes: an escape or a line break."""
    end = len(text)
    if text.endswith(b"\n"):
        return max(scanned, end - 1)
    run = end
    while run > scanned and text[run - 1] == 0x5C:
        run -= 1
    return end - (end - run) % 2


MAX_REFUSALS: Final = 20
LARGEST_NUMBER: Final = 1e12
"""Whatever the unit, a larger number is damage."""
_SHOWN: Final = 60
_MAX_DIGITS: Final = 20
_MAX_BRACKETS: Final = 200


class Clock(Enum):
    """The clock that stamps a message; the text is shown to the user."""

    INSTRUMENT = "the instrument's own UTC where it agrees with the arrival, else the arrival"
    ARRIVAL = "the arrival of the bytes"


class RefusedError(ValueError):
    """A message cannot be used; the text says what was expected and what came."""


class Refusals:
    """The first sentences since they were last taken; the rest is counted."""

    def __init__(self) -> None:
        self.n_total = 0
        self._texts: list[str] = []
        self._n_more = 0

    def add(self, text: str) -> None:
        """Keep or count one sentence."""
        self.n_total += 1
        if len(self._texts) < MAX_REFUSALS:
            self._texts.append(text)
        else:
            self._n_more += 1

    def take(self) -> list[str]:
        """Return the sentences, the last one with the count of those not kept; start anew."""
        texts = self._texts
        if self._n_more:
            texts = [*texts, f"{self._n_more} more were refused"]
        self._texts, self._n_more = [], 0
        return texts


class Stamper:
    """Joins the instrument's clock and the arrival.

    A stamp that differs from the arrival by more than ``max_clock_error_s`` is not believed: the
    instrument's clock or the vehicle's is not set, and stamps of two clocks do not go together. It
    is said once, when it begins.
    """

    def __init__(
        self, clock: Clock, *, max_clock_error_s: float, refusals: Refusals, place: str
    ) -> None:
        self._clock, self._max_error_s = clock, max_clock_error_s
        self._refusals, self._place, self._is_off = refusals, place, False

    def stamp(self, instrument_s: float | None, arrival_s: float) -> float:
        """Return the time of a message, s; raise :class:`RefusedError` where there is none."""
        if not math.isfinite(arrival_s):
            raise RefusedError(
                "expected a finite time of arrival, got none; check the vehicle's clock"
            )
        if self._clock is Clock.ARRIVAL or instrument_s is None:
            return arrival_s
        off = instrument_s - arrival_s
        is_off = not abs(off) <= self._max_error_s
        if is_off and not self._is_off:
            self._refusals.add(
                f"{self._place}: expected stamps within {self._max_error_s:g} s of the arrival, "
                f"got {off:+.6g} s; the arrival is used: set both clocks to UTC, or choose "
                f"Clock.ARRIVAL"
            )
        self._is_off = is_off
        return arrival_s if is_off else instrument_s


class Decoder(ABC):
    """Texts that a framer cuts out of a stream to messages; the rest is refused."""

    _framer: LineFramer | ObjectFramer

    def __init__(self, place: str) -> None:
        """``place`` is how refusals call the source."""
        self._place = place
        self._refusals = Refusals()

    @property
    def n_held(self) -> int:
        """Bytes held of an unfinished text."""
        return self._framer.n_held

    @property
    def n_refused(self) -> int:
        """How much was refused so far."""
        return self._refusals.n_total

    def feed(self, data: bytes, *, arrival_s: float) -> list[Message]:
        """Return the messages that the next bytes complete, and those that waited long enough.

        Never raises, whatever the bytes are and wherever the stream was cut; they came at
        ``arrival_s``, s on the vehicle's clock.
        """
        messages: list[Message] = []
        for text in self._framer.feed(data):
            try:
                messages += self._decode(text, arrival_s)
            except RefusedError as error:
                self._refuse(str(error))
        return messages + self._overdue(arrival_s)

    def take_refusals(self) -> list[str]:
        """Return what was refused since the last call, a sentence each, and forget it."""
        return self._refusals.take()

    @abstractmethod
    def _decode(self, text: str, arrival_s: float) -> list[Message]:
        """Return the messages of one text; raise :class:`RefusedError` for what is none."""

    def _overdue(self, arrival_s: float) -> list[Message]:  # noqa: ARG002
        """Return messages that waited for others long enough; most protocols have none."""
        return []

    def _refuse(self, text: str) -> None:
        self._refusals.add(f"{self._place}: {text}")


def shown(value: object) -> str:
    """Return a value as it came, cut to a length for people and free of control characters."""
    text = repr(value[: _SHOWN + 1]) if isinstance(value, str) else repr(value)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def parse_object(
    text: str, *, parse_float: Callable[[str], float | Decimal] | None = None
) -> dict[str, Any]:
    """Return a JSON object; raise :class:`RefusedError` for all that is no sound one.

    Refused beyond the grammar: NaN and Infinity, numbers that overflow, integers of more than 20
    digits, keys that come twice, more than 200 brackets (and with them deep nesting).

    ``parse_float`` reads a number with a point or exponent; the nearest float unless given.
    """
    if text.count("[") + text.count("{") > _MAX_BRACKETS:
        raise RefusedError(f"expected a flat JSON object, got more than {_MAX_BRACKETS} brackets")
    try:
        found = json.loads(
            text,
            object_pairs_hook=_unique,
            parse_constant=_no_constant,
            parse_int=_short_int,
            parse_float=parse_float or _finite_float,
        )
    except RefusedError:
        raise
    except RecursionError:
        raise RefusedError("expected a flat JSON object, got deep nesting") from None
    except (ValueError, ArithmeticError) as error:
        reason = getattr(error, "msg", type(error).__name__)
        raise RefusedError(f"expected a JSON object, got {shown(text)} ({reason})") from None
    if not isinstance(found, dict):
        raise RefusedError(f"expected a JSON object, got {shown(text)}")
    return found


def require(fields: dict[str, Any], key: str) -> Any:
    """Return the value of a key that must be there."""
    if key not in fields:
        near = nearest_hint(key, [name[:_SHOWN] for name in fields]) if len(fields) < 40 else ""
        raise RefusedError(f"key {key!r} is missing; {near}".rstrip("; "))
    return fields[key]


def reject_unknown(fields: Iterable[str], known: Iterable[str]) -> None:
    """Refuse a key that nothing reads, with the nearest one that is read."""
    names = list(known)
    for key in fields:
        if key not in names:
            raise RefusedError(f"unknown key {shown(key)}; {nearest_hint(key[:_SHOWN], names)}")


def number(value: object, *, key: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a JSON number as float; refuse other types, damage and what is out of range."""
    if type(value) is float:  # nearly all of them
        result = value
    elif isinstance(value, bool) or not isinstance(value, (int, float, Decimal)):
        raise RefusedError(f"{key}: expected a number, got {shown(value)}")
    else:
        result = float(value)
    if not abs(result) <= LARGEST_NUMBER:
        raise RefusedError(
            f"{key}: expected a number below {LARGEST_NUMBER:g}, got {shown(result)}"
        )
    if not low <= result <= high:
        raise RefusedError(f"{key}: expected {low:g} to {high:g}, got {result:g}; check the unit")
    return result


def flag(fields: dict[str, Any], key: str) -> bool:
    """Return the truth value of a key that must be there."""
    value = require(fields, key)
    if not isinstance(value, bool):
        raise RefusedError(f"{key}: expected true or false, got {shown(value)}")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        twice = counts.most_common(1)[0][0]
        raise RefusedError(f"key {shown(twice)} comes twice; expected it once")
    return result


def _no_constant(text: str) -> float:
    raise RefusedError(f"expected finite numbers, got {text}; write null for what is missing")


def _short_int(text: str) -> int:
    if len(text) > _MAX_DIGITS:
        raise RefusedError(f"expected at most {_MAX_DIGITS} digits, got {len(text)}")
    return int(text)


def _finite_float(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise RefusedError(f"expected finite numbers, got {shown(text)}")
    return value
