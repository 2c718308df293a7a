"""What all decoders are: bytes of one connection in, messages out, and JSON that cannot hurt."""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable
from decimal import Decimal
from enum import Enum
from typing import Any, Final, Protocol

from ssm_graph.base.errors import nearest_hint, printable
from ssm_graph.sensors.messages import Message

MAX_REFUSALS: Final = 20
LARGEST_NUMBER: Final = 1e12
"""Whatever the unit, a larger number is damage."""
_LONGEST_STANDSTILL_S: Final = 3600.0
"""So much later than the last one that agreed may a stamp be whose arrival is not known."""
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
            self._texts.append(printable(text))
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
    is said once, when it begins. One whose arrival is not known is believed where those before it
    were.
    """

    def __init__(
        self, clock: Clock, *, max_clock_error_s: float, refusals: Refusals, place: str
    ) -> None:
        self._clock, self._max_error_s = clock, max_clock_error_s
        self._refusals, self._place, self._is_off = refusals, place, False
        self._agreed_s = math.nan

    def stamp(self, instrument_s: float | None, arrival_s: float) -> float:
        """Return the time of a message, s; raise :class:`RefusedError` where there is none."""
        if not math.isfinite(arrival_s):
            is_believed = self._clock is Clock.INSTRUMENT and not self._is_off
            if is_believed and instrument_s is not None and self._is_soon(instrument_s):
                return instrument_s
            raise RefusedError(
                "the time of arrival is not known: it came while this process stood still, or the "
                "vehicle's clock is broken"
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
        if not is_off:
            self._agreed_s = instrument_s
        return arrival_s if is_off else instrument_s

    def _is_soon(self, stamp_s: float) -> bool:
        """Return whether a stamp follows on the last one that agreed with its arrival."""
        return 0.0 < stamp_s - self._agreed_s < _LONGEST_STANDSTILL_S


class Framer(Protocol):
    """What cuts the bytes of a connection into texts."""

    @property
    def n_held(self) -> int:
        """Bytes of what is not complete."""

    def feed(self, data: bytes) -> list[str]:
        """Return the texts that end in ``data``."""


class Decoder(ABC):
    """Texts that a framer cuts out of a stream to messages; the rest is refused."""

    _framer: Framer

    def __init__(self, place: str) -> None:
        """``place`` is how refusals call the source."""
        self._place = place
        self._refusals = Refusals()
        self.n_sound = 0
        """Texts so far that were what this protocol says, whether or not of use here."""
        self.altitude_m = math.nan
        """Of the instrument above the ground by its last word, m; NaN where it does not say."""

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
            n_before = self.n_refused
            try:
                messages += self._decode(text, arrival_s)
            except RefusedError as error:
                self._refuse(str(error))
            self.n_sound += self.n_refused == n_before
        return messages + self._overdue(arrival_s)

    def waiting(self) -> list[Message]:
        """Return complete messages that wait for others; most protocols have none."""
        return []

    def take_waiting(self) -> list[Message]:
        """Return them for good: nothing more will come."""
        return []

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
