"""Landmarks that are one, by their joint covariance: where two parts of a map are the same place.

After a stretch in which nothing was seen, what is met again stands in the map a second time, off by
what the odometry has lost since. One pair alone tells little then, for it may lie anywhere; several
pairs that one turn and shift brings together tell much. The odds that the landmarks of a set of
pairs are the same, over their being others, are the joint density of their differences at zero over
the density of landmarks (the ratio of Savage and Dickey)::

    log odds = log N(d; 0, S) - n log rho

with the differences ``d = m_i - m_j`` of all n pairs, and ``S`` of them from the joint covariance.
A set grows pair by pair, each judged with those before it taken as the same.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array

FITS: Final = 0.99
"""Share of true sets whose joint square passes, and of true pairs by their own."""
MOST_SEEDS: Final = 100
"""Pairs from which a set is grown, those of the greatest odds of their own."""
FEW_SEEDS: Final = 10
"""The same where all sets are looked for, one after the other."""
MOST_PAIRS: Final = 12
"""In a set; what is left comes after it."""
TOGETHER: Final = 0.1
"""Share of a landmark's scans in which another may be seen beside it and yet be the same: errors of
association."""


class Map(NamedTuple):
    """Landmarks as they are believed, some of them one already."""

    places: Array
    """(L, 2) m"""
    cov: Array
    """(2 L, 2 L) m^2, joint"""
    together: NDArray[np.intp]
    """(L, L) scans with both; the diagonal: scans with the one"""
    one: NDArray[np.intp]
    """(L,) which landmark each is: its own number, or that of another"""


class Merger(NamedTuple):
    """A set of landmarks taken as the same."""

    odds: float
    """Logarithm."""
    map: Map


def mergers(now: Map, per_m2: float, most: int = MOST_SEEDS) -> list[Merger]:
    """Return sets of pairs that are likelier the same than not, the likeliest first.

    ``per_m2`` are the landmarks per square metre, ``most`` the pairs from which sets grow. Sets
    that begin with different pairs and end as the same set are one.
    """
    i, j, odds, _ = _pairs(now, per_m2)
    found: dict[bytes, Merger] = {}
    for seed in np.argsort(-odds)[:most].tolist():
        grown = _grown(now, (int(i[seed]), int(j[seed])), per_m2)
        if grown.odds > 0.0:
            found.setdefault(grown.map.one.tobytes(), grown)
    return sorted(found.values(), key=lambda one: -one.odds)


def all_merged(now: Map, per_m2: float, tells: float) -> Map:
    """Return the map after all mergers whose odds exceed ``tells``, the likeliest first."""
    while True:
        found = mergers(now, per_m2, FEW_SEEDS)
        if not found or found[0].odds < tells:
            return now
        now = found[0].map


def _grown(now: Map, seed: tuple[int, int], per_m2: float) -> Merger:
    """Return the map with a pair taken as one, and all that follow from it."""
    total = squares = 0.0
    best = Merger(-np.inf, now)
    for n in range(1, MOST_PAIRS + 1):
        i, j, odds, square = _pairs(now, per_m2)
        if n == 1:
            at = int(np.flatnonzero((i == seed[0]) & (j == seed[1]))[0])
        elif len(odds) and odds.max() > 0.0:
            at = int(np.argmax(odds))
        else:
            break
        total, squares = total + float(odds[at]), squares + float(square[at])
        if squares > chi2.ppf(FITS, 2 * n):
            break
        now = _as_one(now, int(i[at]), int(j[at]))
        if total > best.odds:
            best = Merger(total, now)
    return best


def _pairs(now: Map, per_m2: float) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
    """Return pairs (P,), (P,) that may be one, the logarithms of their odds and squares (P,)."""
    seen, L = np.diagonal(now.together), len(now.one)
    alone = np.flatnonzero(now.one == np.arange(L))
    i, j = (alone[side] for side in np.triu_indices(len(alone), 1))
    may = now.together[i, j] <= TOGETHER * np.minimum(seen[i], seen[j])
    i, j = i[may], j[may]
    d = now.places[i] - now.places[j]
    P = now.cov.reshape(L, 2, L, 2)
    S = P[i, :, i] + P[j, :, j] - P[i, :, j] - P[j, :, i]
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
    square = S[:, 1, 1] * d[:, 0] ** 2 - 2.0 * S[:, 0, 1] * d[:, 0] * d[:, 1]
    square = (square + S[:, 0, 0] * d[:, 1] ** 2) / det
    near = square < chi2.ppf(FITS, 2)
    odds = -0.5 * (square + np.log((2.0 * np.pi) ** 2 * det)) - np.log(per_m2)
    return i[near], j[near], odds[near], square[near]


def _as_one(now: Map, i: int, j: int) -> Map:
    """Return the map in which landmark j is i."""
    a, b = slice(2 * i, 2 * i + 2), slice(2 * j, 2 * j + 2)
    cross = now.cov[:, a] - now.cov[:, b]
    gain = cross @ np.linalg.inv(cross[a] - cross[b])
    places = now.places - (gain @ (now.places[i] - now.places[j])).reshape(-1, 2)
    together = now.together.copy()
    together[i] += together[j]
    together[:, i] += together[:, j]
    return Map(places, now.cov - gain @ cross.T, together, np.where(now.one == j, i, now.one))
