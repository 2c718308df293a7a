"""A linear filter over any update rule, for problems that are vectors and matrices.

Shapes: B runs side by side, n states, m rows.
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.update import Iterate, Runs, Update, UpdateRule


class LinearSystem(NamedTuple):
    """``x' = F x + w``, ``z = H x + v`` with ``w ~ N(0, Q)``, ``v ~ N(0, R)``."""

    F: Array
    """(n, n)"""
    Q: Array
    """(n, n)"""
    H: Array
    """(m, n)"""
    R: Array
    """(m, m)"""


@final
class LinearModel:
    """A measurement ``z`` (B, m) of vectors, about their predicted means (B, n)."""

    def __init__(self, system: LinearSystem, mean: Array, z: Array, *, group: Runs) -> None:
        self.present = np.isfinite(z)
        self.group = group
        # Missing components drop out before whitening: the others keep their own noise.
        whitened, self._H = _whitened(system, z, self.present)
        self._missed = whitened - (self._H @ mean[..., None])[..., 0]

    def at(self, xi: Array) -> Iterate:
        """Return all runs at their predicted means plus ``xi``."""
        return Iterate(xi, self._missed - (self._H @ xi[..., None])[..., 0], self._H)

    def move(self, iterate: Iterate, step: Array, runs: Runs) -> Iterate:  # noqa: ARG002
        """Return the sums."""
        return iterate.linear_move(step)


def _whitened(system: LinearSystem, z: Array, present: NDArray[np.bool_]) -> tuple[Array, Array]:
    n_runs, n_rows = z.shape
    whitened, H = np.zeros((n_runs, n_rows)), np.zeros((n_runs, *system.H.shape))
    for pattern in np.unique(present, axis=0):
        runs = np.all(present == pattern, axis=1)
        root = np.linalg.cholesky(system.R[np.ix_(pattern, pattern)])
        whitened[np.ix_(runs, pattern)] = np.linalg.solve(root, z[np.ix_(runs, pattern)].T).T
        H[np.ix_(runs, pattern)] = np.linalg.solve(root, system.H[pattern])
    return whitened, H


class LinearHistory(NamedTuple):
    """Result of a linear filter: K steps of B runs."""

    x: Array
    """(K, B, n) posterior means"""
    P: Array
    """(K, B, n, n) posterior covariances"""
    x_prior: Array
    """(K, B, n)"""
    P_prior: Array
    """(K, B, n, n)"""
    updates: tuple[Update, ...]
    """Everything else of every step."""


def run_linear_filter(
    system: LinearSystem,
    z: Array,
    *,
    x0: Array,
    P0: Array,
    rule: UpdateRule,
    group: Runs | None = None,
) -> LinearHistory:
    """Filter measurements (K, B, m) of B runs; NaN marks a missing component.

    Each step predicts first, then makes one update: ``x0`` and ``P0`` are those before the first
    prediction.

    Parameters
    ----------
    system : the model.
    z : (K, B, m) measurements.
    x0 : (B, n) means.
    P0 : (B, n, n) covariances.
    rule : how a measurement corrects the prediction.
    group : (m,) rows that share an auxiliary parameter; one group of all when left out.
    """
    group = np.zeros(z.shape[2], dtype=np.intp) if group is None else group
    x, P = x0, P0
    steps: list[tuple[Array, Array, Array, Array]] = []
    updates: list[Update] = []
    for measured in z:
        x_prior, P_prior = x @ system.F.T, system.F @ P @ system.F.T + system.Q
        model = LinearModel(system, x_prior, measured, group=group)
        update = rule(P_prior, model, mean=x_prior)
        x, P = x_prior + update.xi, update.covariance
        steps.append((x, P, x_prior, P_prior))
        updates.append(update)
    x_all, P_all, x_prior_all, P_prior_all = (np.array(c) for c in zip(*steps, strict=True))
    return LinearHistory(x_all, P_all, x_prior_all, P_prior_all, tuple(updates))
