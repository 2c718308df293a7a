"""The law of a particle filter: weights, resampling, how many are needed, moments.

Nothing here knows what a particle is a state of, but that one column may be an angle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

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


@dataclass(slots=True)
class Particles:
    """Particles (n, d) with the logarithms of their weights (n,)."""

    states: Array
    log_weight: Array

    @property
    def weight(self) -> Array:
        """Weights (n,), sum 1."""
        return normalised(self.log_weight)


def drawn_anew(
    particles: Particles,
    *,
    cell: Array,
    roughening: ArrayLike,
    least: int,
    rng: np.random.Generator,
) -> Particles:
    """Return particles drawn by their weights where fewer than half of them count, else the same.

    Parameters
    ----------
    particles : (n, d)
    cell : (c,) size of the cells, in the first columns, that tell how many are needed.
    roughening : (r,) sigma of what is added to the first columns of those that are drawn.
    least : so many at least.
    """
    weight, states = particles.weight, particles.states
    if effective_number(weight) >= 0.5 * len(weight):
        return particles
    cells = np.floor(states[:, : len(cell)] / cell).astype(np.int64)
    n_cells = len(np.unique(cells[weight > 0.01 * weight.max()], axis=0))
    n = min(max(kld_number(n_cells), least), len(states))
    drawn = states[systematic(weight, n, rng)]
    sigma = np.asarray(roughening)
    drawn[:, : len(sigma)] += rng.standard_normal((n, len(sigma))) * sigma
    return Particles(drawn, np.zeros(n))


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
    z = float(ndtri(confidence))
    return int(np.ceil(k / (2.0 * error) * (1.0 - a + np.sqrt(a) * z) ** 3))


def moments(states: Array, weight: Array, angle: int) -> tuple[Array, Array]:
    """Return weighted mean (d,) and covariance (d, d) of states (N, d), circular in one column."""
    w = weight / weight.sum() if weight.sum() > 0.0 else np.full(len(weight), 1.0 / len(weight))
    yaw = states[:, angle]
    mean = w @ states
    mean[angle] = np.arctan2(w @ np.sin(yaw), w @ np.cos(yaw))
    off = states - mean
    off[:, angle] = wrapped(off[:, angle])
    return mean, np.asarray((off * w[:, None]).T @ off)
