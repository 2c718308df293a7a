"""Ranges to anchors as a value: sorted, checked, and with every reading that was dropped told."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ShortRepr, read_only

Indices = NDArray[np.intp]

LONGEST_M: Final = 500.0
"""Beyond it a radio's range is taken for an error of the record."""
SIGMA_M: Final = 0.10
"""Of a radio whose record does not say: Decawave's data sheet."""


@dataclass(frozen=True, slots=True, eq=False)
class Ranges(ShortRepr):
    """Ranges from an antenna at the camera to anchors, in order of time."""

    time_s: Array
    """(M,) s, on the clock of the images but for an offset; never falling."""
    anchor: Indices
    """(M,) index into `names`"""
    range_m: Array
    """(M,) m, above zero"""
    sigma_m: Array
    """(M,) standard deviation in line of sight, m"""
    names: tuple[str, ...]
    """(J,) of the anchors"""
    known_position: Array
    """(J, 3) m, places of anchors that are known, NaN for all others; in axes of the user's own"""
    notes: tuple[str, ...] = ()
    """What was dropped or put right, a sentence each."""

    def __post_init__(self) -> None:
        time_s = read_only("Ranges.time_s", self.time_s, (None,))
        n, n_anchors = len(time_s), len(self.names)
        anchor = np.array(self.anchor, dtype=np.intp)
        if anchor.shape != (n,):
            raise DataError(f"Ranges.anchor: expected an array of shape ({n},), got {anchor.shape}")
        if n and not (anchor.min() >= 0 and anchor.max() < n_anchors):
            raise DataError(
                f"Ranges.anchor: expected indices from 0 to {n_anchors - 1}, got "
                f"{anchor.min()} to {anchor.max()}; try `screened_ranges`, which makes them"
            )
        anchor.setflags(write=False)
        for name, value, shape in (
            ("range_m", self.range_m, (n,)),
            ("sigma_m", self.sigma_m, (n,)),
            ("known_position", self.known_position, (n_anchors, 3)),
        ):
            object.__setattr__(self, name, read_only(f"Ranges.{name}", value, shape))
        object.__setattr__(self, "time_s", time_s)
        object.__setattr__(self, "anchor", anchor)
        usable = np.isfinite(time_s) & (self.range_m > 0.0) & (self.sigma_m > 0.0)
        if not usable.all() or np.any(np.diff(time_s) < 0.0):
            raise DataError(
                "Ranges: expected finite times that never fall, ranges and sigmas above zero, got "
                f"{int((~usable).sum())} others of {n}; try `screened_ranges`, which drops them"
            )

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def n_anchors(self) -> int:
        """Anchors, known or not."""
        return len(self.names)

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """(J,) whether an anchor's place is known."""
        return np.asarray(np.isfinite(self.known_position).all(axis=1))

    def rows(self, kept: NDArray[np.bool_] | slice | Indices) -> Ranges:
        """Return some of the ranges, of the same anchors."""
        return replace(
            self,
            time_s=self.time_s[kept],
            anchor=self.anchor[kept],
            range_m=self.range_m[kept],
            sigma_m=self.sigma_m[kept],
        )

    def of(self, name: str) -> Ranges:
        """Return the ranges of one anchor, as the only one."""
        if name not in self.names:
            raise DataError(f"Ranges.of: no anchor {name!r}; there are {', '.join(self.names)}")
        j = self.names.index(name)
        own = self.rows(self.anchor == j)
        return replace(
            own,
            anchor=np.zeros(len(own), dtype=np.intp),
            names=(name,),
            known_position=self.known_position[j : j + 1],
        )

    def between(self, begin_s: float, end_s: float) -> slice:
        """Return the slice of those from ``begin_s`` up to, but without, ``end_s``."""
        first, last = np.searchsorted(self.time_s, (begin_s, end_s))
        return slice(int(first), int(last))


def at_the_anchor(ranges: Ranges, sound_speed_m_per_s: float) -> tuple[Ranges, Indices]:
    """Return two-way acoustic ranges at the times at which the sound was at the anchor.

    They are stamped when the reply came. Half of both legs is the range of the time between them,
    but for ``(v / c)^2 / 2`` of it at a speed ``v`` across: a thousandth of a millimetre in 10 m.
    Also returned is the order (M,) of the new rows among the old.
    """
    if not sound_speed_m_per_s > 0.0:
        raise DataError(f"sound speed: expected above 0 m/s, got {sound_speed_m_per_s}; try 1500")
    time_s = ranges.time_s - ranges.range_m / sound_speed_m_per_s
    order = np.argsort(time_s, kind="stable")
    return replace(ranges.rows(order), time_s=time_s[order]), order


def screened_ranges(
    time_s: ArrayLike,
    name: Sequence[str],
    range_m: ArrayLike,
    sigma_m: ArrayLike | None = None,
    *,
    known: Mapping[str, Iterable[float]] | None = None,
    lines: Sequence[int] | None = None,
    source: str = "ranges",
    longest_m: float = LONGEST_M,
) -> Ranges:
    """Return the ranges of a record that can be used; `Ranges.notes` tells of the others.

    Dropped are readings without a time, at or below zero, beyond ``longest_m``, and repeats (same
    anchor, same time). What is out of order is sorted. A missing sigma is `SIGMA_M`.

    Parameters
    ----------
    time_s, range_m : (M,) s and m.
    name : (M,) of the anchors.
    sigma_m : (M,) m; NaN or none where the record does not say.
    known : places (3,) of known anchors, m.
    lines : (M,) of the record, for the notes.
    source : its name, for the notes.
    """
    time, measured = (np.asarray(x, dtype=np.float64) for x in (time_s, range_m))
    stated = np.full(time.shape, np.nan) if sigma_m is None else np.asarray(sigma_m, np.float64)
    if not len(time) == len(name) == len(measured) == len(stated):
        raise DataError(
            f"{source}: expected columns of one length, got {len(time)} times, {len(name)} names, "
            f"{len(measured)} ranges, {len(stated)} sigmas"
        )
    places = {} if known is None else {key: np.asarray([*x], float) for key, x in known.items()}
    names = (*dict.fromkeys([*places, *name]),)
    index = {key: j for j, key in enumerate(names)}
    anchor = np.array([index[key] for key in name], dtype=np.intp)
    notes: list[str] = []
    kept = np.ones(len(time), dtype=bool)

    def drop(bad: NDArray[np.bool_], what: str) -> None:
        now = bad & kept
        if now.any():
            first = int(np.flatnonzero(now)[0])
            where = f"line {lines[first]}" if lines is not None else f"reading {first + 1}"
            notes.append(f"{source}: {int(now.sum())} {what}, dropped (first: {where})")
            kept[now] = False

    drop(~np.isfinite(time), "readings without a time")
    drop(~np.isfinite(measured), "readings without a range")
    drop(measured <= 0.0, "ranges at or below zero")
    drop(measured > longest_m, f"ranges beyond {longest_m:g} m")
    order = np.lexsort((anchor, np.where(kept, time, np.inf)))
    same = np.zeros(len(time), dtype=bool)
    same[order[1:]] = (np.diff(time[order]) == 0.0) & (np.diff(anchor[order]) == 0)
    drop(same, "repeats of an anchor's range at the same time")
    late = int((np.diff(time[kept]) < 0.0).sum())
    if late:
        notes.append(f"{source}: {late} readings out of order of time, sorted")
    used = order[kept[order]]
    sigma = np.where(np.isfinite(stated) & (stated > 0.0), stated, SIGMA_M)[used]
    known_position = np.array([places.get(key, np.full(3, np.nan)) for key in names])
    return Ranges(
        time[used],
        anchor[used],
        measured[used],
        sigma,
        names,
        known_position.reshape(len(names), 3),
        (*notes,),
    )
