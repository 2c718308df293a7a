"""A small measurement with correlated noise, six runs side by side, to try update rules on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.update import Runs, Update, UpdateRule
from tests.linear_filter import LinearModel, LinearSystem

N_STATES, N_ROWS, N_RUNS = 5, 4, 6
EACH_ROW, ALL_ROWS = np.arange(N_ROWS), np.zeros(N_ROWS, dtype=np.intp)


def a_system(rng: np.random.Generator) -> LinearSystem:
    """Return a system with correlated noise."""
    H, root = rng.normal(size=(N_ROWS, N_STATES)), rng.normal(size=(N_ROWS, N_ROWS))
    Q = F = np.eye(N_STATES)
    return LinearSystem(F, Q, H, np.diag([0.5, 1.0, 2.0, 3.0]) + 0.05 * root @ root.T)


def predicted(rng: np.random.Generator) -> Array:
    """Return covariances (N_RUNS, n, n) of predictions."""
    root = rng.normal(size=(N_RUNS, N_STATES, N_STATES))
    P = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(N_STATES)
    P.setflags(write=False)
    return P


def measured(rng: np.random.Generator) -> Array:
    """Return measurements (N_RUNS, m) of a state that is predicted as zero, one run far off."""
    z = 2.0 * rng.normal(size=(N_RUNS, N_ROWS))
    z[0, 1] += 60.0
    return z


def corrected(
    rule: UpdateRule, P: Array, system: LinearSystem, z: Array, group: Runs = EACH_ROW
) -> Update:
    """Correct predictions of zero."""
    return rule(P, LinearModel(system, np.zeros(P.shape[:2]), z, group=group))


def assert_same(found: Update, expected: Iterable[NDArray[Any]], *, atol: float = 1e-9) -> None:
    """Compare all that two updates have to say, in the order of the runs."""
    for column, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(column, other, rtol=1e-9, atol=atol)
