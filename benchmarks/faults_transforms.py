"""What can be done to a stream of messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.faults_case import Sent, Stream, Transform
from ssm_graph.base.frozen import Array
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.dvl import N_BEAMS, Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.messages import Message

Edit = Callable[[Any, np.random.Generator], Message | None]


def edited(kind: type, edit: Edit, begin_s: float, end_s: float = math.inf) -> Transform:
    """Change, or take away, the messages of a kind in ``[begin_s, end_s)``."""

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        changed: Stream = []
        for sent in stream:
            message: Message | None = sent.message
            if isinstance(message, kind) and begin_s <= sent.true_s < end_s:
                message = edit(message, rng)
            if message is not None:
                changed.append(Sent(sent.true_s, message))
        return changed

    return transform


def silent(kind: type, begin_s: float, end_s: float = math.inf) -> Transform:
    """Take all messages of a kind away."""
    return edited(kind, _gone, begin_s, end_s)


def _gone(message: Any, rng: np.random.Generator) -> None:
    del message, rng


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


def spoiled(field: str, values: list[float]) -> Edit:
    """Put bad values, each in turn and at a random place, into a field; two of three messages."""
    count = iter(range(10**9))

    def edit(message: Any, rng: np.random.Generator) -> Message:
        number = next(count)
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

    def edit(message: Any, rng: np.random.Generator) -> Message:
        del rng
        new = {}
        for name in fields:
            old = getattr(message, name)
            new[name] = tuple(factor * x for x in old) if isinstance(old, tuple) else factor * old
        return same(message, **new)

    return edit


def beams(change: Callable[[Array], Any]) -> Edit:
    """Change the beam speeds of a ping."""

    def edit(ping: Any, rng: np.random.Generator) -> Message:
        del rng
        return with_speeds(ping, change(np.array(ping.speed)))

    return edit


def with_speeds(ping: Any, speeds: Any) -> Message:
    """Return a ping of other speeds."""
    assert isinstance(ping, Ping)
    v1, v2, v3, v4 = np.broadcast_to(speeds, N_BEAMS).tolist()
    return replace(ping, speed=(v1, v2, v3, v4))


def same(message: Any, **changes: Any) -> Message:
    """Return a message with fields changed."""
    changed: Message = replace(message, **changes)
    return changed


def frozen(kind: type, begin_s: float, end_s: float = math.inf) -> Transform:
    """Repeat the first message of the span, with new stamps."""
    first: list[Any] = []

    def edit(message: Any, rng: np.random.Generator) -> Message:
        del rng
        first[:] = first or [message]
        return same(first[0], time_s=message.time_s)

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        first.clear()
        return edited(kind, edit, begin_s, end_s)(stream, rng)

    return transform


def repeated(share: float, *, times: int = 1, kind: type = object, later: int = 0) -> Transform:
    """Send messages again, ``later`` places further on."""

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        order = [(float(at), sent) for at, sent in enumerate(stream)]
        again = [
            (
                at + later + 0.5,
                Sent(stream[min(int(at) + later, len(stream) - 1)].true_s, x.message),
            )
            for at, x in order
            if isinstance(x.message, kind) and rng.random() < share
            for _ in range(times)
        ]
        return [sent for _, sent in sorted(order + again, key=lambda pair: pair[0])]

    return transform


def late(kind: type, share: float, delay_s: float | tuple[float, float]) -> Transform:
    """Let a share of the messages arrive late."""

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        low, high = delay_s if isinstance(delay_s, tuple) else (delay_s, delay_s)
        end_s = stream[-1].true_s
        moved = [
            Sent(min(sent.true_s + rng.uniform(low, high), end_s), sent.message)
            if isinstance(sent.message, kind) and rng.random() < share
            else sent
            for sent in stream
        ]
        return sorted(moved, key=lambda sent: sent.true_s)

    return transform


def clock_moved(by_s: float, begin_s: float, *kinds: type) -> Transform:
    """Set the clock of some or all kinds."""

    def edit(message: Any, rng: np.random.Generator) -> Message:
        del rng
        return same(message, time_s=message.time_s + by_s)

    return chained(*(edited(kind, edit, begin_s) for kind in kinds or (object,)))


def one_more(make: Callable[[Any], Message], kind: type, at_s: float) -> Transform:
    """Put one more message after the first of a kind from a time on."""

    def transform(stream: Stream, rng: np.random.Generator) -> Stream:
        del rng
        at = next(
            k for k, x in enumerate(stream) if x.true_s >= at_s and isinstance(x.message, kind)
        )
        return [
            *stream[: at + 1],
            Sent(stream[at].true_s, make(stream[at].message)),
            *stream[at + 1 :],
        ]

    return transform


def outliers(share: float, size: tuple[float, float]) -> Edit:
    """Offset each beam with a probability."""

    def edit(ping: Any, rng: np.random.Generator) -> Message:
        offset = rng.uniform(*size, N_BEAMS) * rng.choice([-1.0, 1.0], N_BEAMS)
        return with_speeds(ping, ping.speed + np.where(rng.random(N_BEAMS) < share, offset, 0.0))

    return edit


def moved_fix(north_m: float) -> Edit:
    """Move a fix."""

    def edit(fix: Any, rng: np.random.Generator) -> Message:
        del rng
        assert isinstance(fix, Fix)
        return same(fix, lat=fix.lat + north_m / 6.371e6)

    return edit


def degrees(fix: Any, rng: np.random.Generator) -> Message:
    """Write latitude and longitude in degrees."""
    del rng
    return same(fix, lat=math.degrees(fix.lat), lon=math.degrees(fix.lon))


def permuted(order: tuple[int, int, int, int]) -> Edit:
    """Swap beams."""
    return beams(lambda speed: speed[list(order)])


def offset(*by: float) -> Edit:
    """Add to the four beams."""
    return beams(lambda speed: speed + np.array(by))


def turned_start(vehicle: Vehicle) -> Vehicle:
    """Return a vehicle whose initial heading is wrong by 180 degrees."""
    assert vehicle.initial is not None
    return replace(
        vehicle, initial=replace(vehicle.initial, heading=vehicle.initial.heading + math.pi)
    )


def deeper(by_m: float) -> Edit:
    """Move depths."""

    def edit(message: Any, rng: np.random.Generator) -> Message:
        del rng
        return same(message, depth=message.depth + by_m)

    return edit
