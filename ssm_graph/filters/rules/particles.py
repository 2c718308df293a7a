"""The law of a particle filter: weights, resampling, how many are needed, modes and their evidence.

Nothing here knows what a particle is a state of, but that one column may be an angle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.stats import norm

from ssm_graph.base.frozen import Array
from ssm_graph.base.units import wrapped

_Rows = NDArray[np.int64]
KLD_ERROR: Final = 0.05
"""Kullback-Leibler distance between the particles and what they stand for ..."""
KLD_CONFIDENCE: Final = 0.99
"""... that is kept with this probability."""


def normalised(log_weight: Array) -> Array:
    """Return weights (N,) that sum to 1 from their logarithms, whatever is added to all of them."""
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


def effective_number(weight: Array) -> float:
    """Return by how many equal ones particles with weights (N,), sum 1, could be replaced."""
    return float(1.0 / np.square(weight).sum())


def systematic(weight: Array, n: int, rng: np.random.Generator) -> _Rows:
    """Draw ``n`` rows by weights (N,), sum 1, with one number: each within 1 of its share."""
    at = (rng.random() + np.arange(n)) / n
    return np.minimum(np.searchsorted(np.cumsum(weight), at), len(weight) - 1).astype(np.int64)


def kld_number(n_cells: int, error: float = KLD_ERROR, confidence: float = KLD_CONFIDENCE) -> int:
    """Return how many particles represent a density that fills so many cells.

    D. Fox, "Adapting the sample size in particle filters through KLD-sampling", IJRR 22, 2003,
    eq. (12), by the Wilson-Hilferty approximation of chi-square.
    """
    if n_cells < 2:
        return 1
    k = n_cells - 1
    a = 2.0 / (9.0 * k)
    z = float(norm.ppf(confidence))
    return int(np.ceil(k / (2.0 * error) * (1.0 - a + np.sqrt(a) * z) ** 3))


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """A heap of particles that hang together."""

    rows: _Rows
    """Which particles."""
    share: float
    """Of the evidence, 0 to 1."""
    mean: Array
    """(d,) weighted; of the angle the circular mean."""
    cov: Array
    """(d, d) about the mean."""


def modes(states: Array, weight: Array, *, reach: Array, angle: int) -> list[Mode]:
    """Return the heaps of particles (N, d), the one with most evidence first.

    Particles are put into cells of the sizes ``reach`` (d,), infinite for columns that do not tell
    heaps apart; cells that touch, also at a corner and across half a turn of column ``angle``, are
    one heap.
    """
    told = np.flatnonzero(np.isfinite(reach))
    size = reach[told]
    turn = np.flatnonzero(told == angle)
    cells_of_turn = np.zeros(len(told))
    values = states[:, told].copy()
    if turn.size:
        n_turn = max(3, int(np.floor(2.0 * np.pi / size[turn[0]])))
        size = size.copy()
        size[turn[0]] = 2.0 * np.pi / n_turn
        values[:, turn[0]] = np.mod(values[:, turn[0]], 2.0 * np.pi)
        cells_of_turn[turn[0]] = n_turn
    cells, cell_of = np.unique(
        np.floor(values / size).astype(np.int64), axis=0, return_inverse=True
    )
    low = cells.min(axis=0)
    # A tree wraps around the angle; along other columns its box is larger than all cells.
    span = np.where(cells_of_turn > 0, cells_of_turn, np.ptp(cells, axis=0) + 3.0)
    shifted = np.where(cells_of_turn > 0, np.mod(cells, np.maximum(cells_of_turn, 1)), cells - low)
    tree = cKDTree(shifted.astype(float), boxsize=span)
    pairs = tree.query_pairs(1.5, p=np.inf, output_type="ndarray")
    n = len(cells)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1][np.ravel(cell_of)]
    found = [_mode(states, weight, np.flatnonzero(label == k), angle) for k in np.unique(label)]
    return sorted(found, key=lambda mode: -mode.share)


def _mode(states: Array, weight: Array, rows: _Rows, angle: int) -> Mode:
    mean, cov = moments(states[rows], weight[rows], angle)
    return Mode(rows, float(weight[rows].sum()), mean, cov)


def moments(states: Array, weight: Array, angle: int) -> tuple[Array, Array]:
    """Return weighted mean (d,) and covariance (d, d) of states (N, d), circular in one column."""
    w = weight / weight.sum() if weight.sum() > 0.0 else np.full(len(weight), 1.0 / len(weight))
    yaw = states[:, angle]
    mean = w @ states
    mean[angle] = np.arctan2(w @ np.sin(yaw), w @ np.cos(yaw))
    off = states - mean
    off[:, angle] = wrapped(off[:, angle])
    return mean, np.asarray((off * w[:, None]).T @ off)
