"""What goes wrong with DVL beams: random outliers of six kinds, offsets, what is missing.

An outlier or a fault is an offset added to a beam's speed; a dropout or a loss takes the beam away.
Outliers are placed at random from the generator handed in, faults exactly where they are asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.simulation import checked
from ssm_graph.simulation.faults import Fault

Mask = NDArray[np.bool_]

_SILT_RISE_S = 60.0


class OutlierKind(Enum):
    """How random outliers come; ``rate`` is always the fraction of pings that they touch."""

    NONE = "no outliers"
    SPARSE = "one random beam of random pings"
    BURST = "one random beam for 5 to 20 s at a constant offset"
    ONE_BEAM = "the same beam in random pings"
    TWO_BEAMS = "two random beams of random pings, independent offsets"
    SILT = "one random beam drifts off within a minute, stays for tens of seconds, snaps back"
    BLOCKED = "one random beam reads zero for 5 to 20 s"


DEFAULT_SIZE: Final[Mapping[OutlierKind, tuple[float, float]]] = MappingProxyType(
    {kind: (0.15, 0.3) if kind is OutlierKind.SILT else (0.5, 3.0) for kind in OutlierKind}
)
"""Smallest and largest absolute offset, m/s, drawn uniformly; the sign is drawn as well."""

_EVENT_S: Final[Mapping[OutlierKind, tuple[float, float]]] = MappingProxyType(
    {
        OutlierKind.BURST: (5.0, 20.0),
        OutlierKind.BLOCKED: (5.0, 20.0),
        OutlierKind.SILT: (80.0, 140.0),
    }
)


@dataclass(frozen=True, slots=True)
class Outliers(checked.Settings):
    """Random outliers of one kind."""

    kind: OutlierKind = OutlierKind.NONE
    rate: float = checked.fraction(0.1)
    """Fraction of pings with an outlier; of the time, for kinds that come as events."""
    size: tuple[float, float] | None = checked.sizes(None)
    """Smallest and largest absolute offset, m/s; None for that of the kind."""
    beam: int | None = None
    """The beam that suffers, from 0; None draws it. Not for TWO_BEAMS."""

    @property
    def beams(self) -> tuple[int, ...]:
        """The beams that are named."""
        return () if self.beam is None else (self.beam,)

    @property
    def low_high(self) -> tuple[float, float]:
        """The size, m/s, by default that of the kind."""
        return DEFAULT_SIZE[self.kind] if self.size is None else self.size


@dataclass(frozen=True, slots=True)
class Loss(checked.Settings):
    """No bottom lock of some beams in ``[start_s, end_s)``."""

    start_s: float
    end_s: float
    beams: tuple[int, ...] | None = checked.beams(None)
    """Beams from 0; None for all."""

    def __post_init__(self) -> None:
        super(Loss, self).__post_init__()
        checked.require_rule("Loss", checked.WINDOW, (self.start_s, self.end_s))


class BeamFaults(NamedTuple):
    """What was done to the beams of every ping."""

    offset: Array
    """(N, B) m/s added to the speed."""
    is_outlier: Mask
    """(N, B) True where an outlier or fault acts, even where its offset happens to be tiny."""


def draw_outliers(
    outliers: Outliers, time_s: Array, speed: Array, *, rng: np.random.Generator
) -> BeamFaults:
    """Draw random outliers for pings at ``time_s`` (N,) whose clean speeds are ``speed`` (N, B)."""
    offset, mask = np.zeros(speed.shape), np.zeros(speed.shape, dtype=bool)
    if outliers.kind is OutlierKind.NONE or len(time_s) == 0:
        return BeamFaults(offset, mask)
    if outliers.kind in _EVENT_S:
        _add_events(outliers, time_s, offset, mask, rng=rng)
        if outliers.kind is OutlierKind.BLOCKED:
            offset[mask] = -speed[mask]
        return BeamFaults(offset, mask)
    chosen = rng.choice(len(time_s), size=round(outliers.rate * len(time_s)), replace=False)
    beams = _pick_beams(outliers.kind, (len(chosen), speed.shape[1]), rng=rng)
    if outliers.beam is not None and outliers.kind is not OutlierKind.TWO_BEAMS:
        beams = np.full_like(beams, outliers.beam)
    mask[chosen[:, None], beams] = True
    offset[chosen[:, None], beams] = _draw_offsets(outliers, beams.shape, rng=rng)
    return BeamFaults(offset, mask)


def _pick_beams(
    kind: OutlierKind, shape: tuple[int, int], *, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return the beams (P, 1 or 2) that suffer in pings chosen before, (P, B) being the shape."""
    n_pings, n_beams = shape
    if kind is OutlierKind.SPARSE:
        return rng.integers(n_beams, size=(n_pings, 1))
    if kind is OutlierKind.ONE_BEAM:
        return np.full((n_pings, 1), rng.integers(n_beams))
    return rng.permuted(np.tile(np.arange(n_beams), (n_pings, 1)), axis=1)[:, :2]


def _draw_offsets(outliers: Outliers, shape: tuple[int, ...], *, rng: np.random.Generator) -> Array:
    """Return offsets of either sign, m/s, uniform in absolute value."""
    low, high = outliers.low_high
    return rng.choice([-1.0, 1.0], size=shape) * rng.uniform(low, high, size=shape)


def _add_events(
    outliers: Outliers, time_s: Array, offset: Array, mask: Mask, *, rng: np.random.Generator
) -> None:
    """Fill offsets and mask, both our own, with events of one beam each."""
    for start_s, end_s in _place_events(outliers, time_s, rng=rng):
        beam = int(rng.integers(offset.shape[1])) if outliers.beam is None else outliers.beam
        size = float(_draw_offsets(outliers, (1,), rng=rng)[0])
        inside = (start_s <= time_s) & (time_s < end_s)
        mask[inside, beam] = True
        if outliers.kind is OutlierKind.SILT:
            age = np.clip((time_s[inside] - start_s) / _SILT_RISE_S, 0.0, 1.0)
            offset[inside, beam] = size * age
        else:
            offset[inside, beam] = size


def _place_events(
    outliers: Outliers, time_s: Array, *, rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Return disjoint windows that fill the fraction ``rate`` of the time between the pings.

    Lengths are drawn until they suffice, the last one is cut; what is left of the time is shared
    out at random between them.
    """
    step = (time_s[-1] - time_s[0]) / max(len(time_s) - 1, 1)
    total = len(time_s) * step
    wanted = outliers.rate * total
    lengths: list[float] = []
    while sum(lengths) < wanted:
        length = rng.uniform(*_EVENT_S[outliers.kind])
        lengths.append(min(length, wanted - sum(lengths)))
        if lengths[-1] < step:  # a rest too short for a ping
            lengths.pop()
            break
    gaps = np.sort(rng.uniform(0.0, max(total - sum(lengths), 0.0), size=len(lengths)))
    starts = time_s[0] + gaps + np.concatenate([[0.0], np.cumsum(lengths)[:-1]])[: len(lengths)]
    return [(start, start + length) for start, length in zip(starts, lengths, strict=True)]


def draw_dropouts(shape: tuple[int, ...], *, dropout_rate: float, rng: np.random.Generator) -> Mask:
    """Return which beams of that shape, (N, B), are missing, each at ``dropout_rate``."""
    return np.asarray(rng.random(shape) < dropout_rate)


def lost_beams(time_s: Array, n_beams: int, losses: Sequence[Loss]) -> Mask:
    """Return which beams (N, B) have no bottom lock."""
    lost = np.zeros((len(time_s), n_beams), dtype=bool)
    for loss in losses:
        inside = (loss.start_s <= time_s) & (time_s < loss.end_s)
        beams = np.arange(n_beams) if loss.beams is None else np.array(loss.beams)
        lost[np.ix_(inside, beams)] = True
    return lost


def add_faults(
    drawn: BeamFaults, faults: Sequence[Fault], time_s: Array, speed: Array
) -> BeamFaults:
    """Return ``drawn`` with programmed faults added to pings of clean ``speed`` (N, B)."""
    offset, mask = drawn.offset.copy(), drawn.is_outlier.copy()
    for fault in faults:
        inside = fault.inside(time_s)
        where = np.ix_(inside, fault.beams_of(speed.shape[1]))
        offset[where] += fault.offset(time_s[inside], speed[where])
        mask[where] = True
    return BeamFaults(offset, mask)
