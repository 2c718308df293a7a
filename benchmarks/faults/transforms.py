"""What can be done to a stream of messages."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.faults.case import Sent, Stream, Transform
from ssm_graph.base.frozen import Array
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.messages import Message

N_BEAMS = 4
"""Of the vehicles whose messages are damaged here."""
Edit = Callable[[Any], Message | None]
"""Returns a message changed, or None to take it away."""


def edited(kind: type, edit: Edit, begin_s: float, end_s: float = math.inf) -> Transform:
    """Change, or take away, the messages of a kind in ``[begin_s, end_s)``."""

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        del rng
        changed: Stream = []
        for sent in stream:
            message: Message | None = sent.message
            if isinstance(message, kind) and begin_s <= sent.true_s < end_s:
                message = edit(message)
            if message is not None:
                changed.append(Sent(sent.true_s, message))
        return changed

    return transform


def silent(kind: type, begin_s: float, end_s: float = math.inf) -> Transform:
    """Take all messages of a kind away."""
    return edited(kind, lambda message: None, begin_s, end_s)  # noqa: ARG005


def untouched(stream: Stream, rng: np.random.Generator) -> Stream:
    """Do nothing: the fault is elsewhere."""
    del rng
    return stream


def chained(*transforms: Transform) -> Transform:
    """Do one after the other."""

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        for one in transforms:
            stream = one(stream, rng)
        return stream

    return transform


def same(message: Any, **changes: Any) -> Message:
    """Return a message with fields changed."""
    changed: Message = replace(message, **changes)
    return changed


def spoiled(field: str, values: list[float]) -> Edit:
    """Put bad values, each in turn and at a random place, into a field; two of three messages."""
    numbers, rng = itertools.count(), np.random.default_rng(0)

    def edit(message: Any) -> Message:
        number = next(numbers)
        if number % 3 == 0:
            return same(message)
        bad, old = values[number % len(values)], getattr(message, field)
        if isinstance(old, tuple):
            at = int(rng.integers(len(old)))
            return same(message, **{field: (*old[:at], bad, *old[at + 1 :])})
        return same(message, **{field: bad})

    return edit


def scaled(*fields: str, factor: float) -> Edit:
    """Multiply fields."""

    def times(old: Any) -> Any:
        return tuple(factor * x for x in old) if isinstance(old, tuple) else factor * old

    return lambda message: same(message, **{x: times(getattr(message, x)) for x in fields})


def moved(field: str, by: float) -> Edit:
    """Add to a field."""
    return lambda message: same(message, **{field: getattr(message, field) + by})


def beams(change: Callable[[Array], Any]) -> Edit:
    """Change the beam speeds of a ping."""
    return lambda ping: with_speeds(ping, change(np.array(ping.speed)))


def with_speeds(ping: Any, speeds: Any) -> Message:
    """Return a ping of other speeds."""
    return same(ping, speed=tuple(np.broadcast_to(speeds, N_BEAMS).tolist()))


def outliers(share: float, size: tuple[float, float]) -> Edit:
    """Offset each beam with a probability."""
    rng = np.random.default_rng(0)

    def change(speed: Array) -> Array:
        offset = rng.uniform(*size, N_BEAMS) * rng.choice([-1.0, 1.0], N_BEAMS)
        return speed + np.where(rng.random(N_BEAMS) < share, offset, 0.0)

    return beams(change)


def permuted(order: tuple[int, int, int, int]) -> Edit:
    """Swap beams."""
    return beams(lambda speed: speed[list(order)])


def offset(*by: float) -> Edit:
    """Add to the four beams."""
    return beams(lambda speed: speed + np.array(by))


def frozen(kind: type, begin_s: float, end_s: float = math.inf) -> Transform:
    """Repeat the first message of the span, with new stamps."""
    first: list[Any] = []

    def edit(message: Any) -> Message:
        first[:] = first or [message]
        return same(first[0], time_s=message.time_s)

    return edited(kind, edit, begin_s, end_s)


def repeated(share: float, *, times: int = 1, kind: type = object, later: int = 0) -> Transform:
    """Send messages again, ``later`` places further on."""

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        order = [(float(at), sent) for at, sent in enumerate(stream)]
        for at, sent in enumerate(stream):
            if isinstance(sent.message, kind) and rng.random() < share:
                again = Sent(stream[min(at + later, len(stream) - 1)].true_s, sent.message)
                order += times * [(at + later + 0.5, again)]
        return [sent for _, sent in sorted(order, key=lambda pair: pair[0])]

    return transform


def late(kind: type, share: float, low_s: float, high_s: float) -> Transform:
    """Let a share of the messages arrive late, each by a random time between two."""

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        end_s = stream[-1].true_s
        moved = [
            Sent(min(sent.true_s + rng.uniform(low_s, high_s), end_s), sent.message)
            if isinstance(sent.message, kind) and rng.random() < share
            else sent
            for sent in stream
        ]
        return sorted(moved, key=lambda sent: sent.true_s)

    return transform


def clock_moved(by_s: float, begin_s: float, kind: type = object) -> Transform:
    """Set the clock of all messages or of a kind."""
    return edited(kind, moved("time_s", by_s), begin_s)


def one_more(make: Callable[[Any], Message], kind: type, at_s: float) -> Transform:
    """Put one more message after the first of a kind from a time on."""

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        del rng
        found = (x.true_s >= at_s and isinstance(x.message, kind) for x in stream)
        end = list(found).index(True) + 1
        extra = Sent(stream[end - 1].true_s, make(stream[end - 1].message))
        return [*stream[:end], extra, *stream[end:]]

    return transform


def turned_start(vehicle: Vehicle) -> Vehicle:
    """Return a vehicle whose initial heading is wrong by 180 degrees."""
    assert vehicle.initial is not None
    turned = replace(vehicle.initial, heading=vehicle.initial.heading + math.pi)
    return replace(vehicle, initial=turned)
