"""Operations on sets against those of another library: constrained zonotopes of zonoopt (PyPI).

Its operations are exact. What they make of a box inside an ellipsoid has to stay inside what ours
make of the ellipsoid; how far it reaches, a linear program of SciPy says.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.sparse import csc_matrix
from scipy.stats import special_ortho_group

from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.ellipsoids import (
    Ellipsoids,
    cut_by_strip,
    intersected,
    segments,
    sum_shape,
)

zonoopt = pytest.importorskip("zonoopt", reason="an independent check: pip install zonoopt")
N = 3
CASES = range(25)


def inscribed(sets: Ellipsoids, rng: np.random.Generator) -> Any:
    """Return a turned cube of the unit ball, mapped into an ellipsoid."""
    turn = special_ortho_group.rvs(N, random_state=rng)
    generators = np.linalg.cholesky(sets.shape) @ turn / np.sqrt(N)
    return zonoopt.Zono(csc_matrix(generators), sets.center)


def reach(exact: Any, direction: Array) -> float | None:
    """Return the largest ``d.x`` of an exact set, None of an empty one."""
    if exact.is_0_1_form():
        exact.convert_form()
    G, c = exact.get_G().toarray(), np.ravel(exact.get_c())
    has = exact.is_conzono()
    A = exact.get_A().toarray() if has else None
    b = np.ravel(exact.get_b()) if has else None
    found = linprog(-direction @ G, A_eq=A, b_eq=b, bounds=(-1.0, 1.0), method="highs")
    return float(direction @ c - found.fun) if found.status == 0 else None


def strip_of(exact: Any, h: Array, low: float, high: float) -> Any:
    """Return the part of an exact set that is in a strip."""
    H = csc_matrix(np.stack([h, -h]))
    return zonoopt.halfspace_intersection(exact, H, np.array([high, -low]))


def drawn(rng: np.random.Generator) -> Ellipsoids:
    """Draw an ellipsoid of a shape that is far from a ball."""
    root = rng.standard_normal((N, N)) * np.exp(rng.uniform(-2.0, 2.0, N))
    return Ellipsoids(rng.standard_normal(N), root @ root.T + 1e-3 * np.eye(N))


def inside(exact: Any, ours: Ellipsoids, rng: np.random.Generator) -> float | None:
    """Return how far an exact set reaches at most, ours 1, in some directions; None if empty."""
    shares: list[float] = []
    for direction in rng.standard_normal((5, N)):
        most = reach(exact, direction)
        if most is None:
            return None
        shares.append(float((most - direction @ ours.center) / ours.extent(direction)))
    return max(shares)


@pytest.mark.parametrize("case", CASES)
def test_what_is_left_of_a_box_stays_inside(case: int) -> None:
    """Cut by a strip, summed up with noise, cut by another, intersected with an ellipsoid."""
    rng = np.random.default_rng([case, *b"zono"])
    ours = drawn(rng)
    exact = inscribed(ours, rng)
    for step in range(3):
        h = rng.standard_normal(N)
        at, width = float(h @ ours.center), float(ours.extent(h))
        low = at + width * rng.uniform(-1.2, 0.6)
        high = low + width * rng.uniform(0.1, 1.0)
        cut, misses = cut_by_strip(ours, h, low, high)
        left = strip_of(exact, h, low, high)
        if bool(misses):
            assert inside(left, ours, rng) is None, step
            return
        ours, exact = cut, left
        spans = rng.standard_normal((2, N)) * 0.3
        ours = Ellipsoids(
            ours.center, sum_shape(np.concatenate([ours.shape[None], segments(spans)]))
        )
        exact = zonoopt.minkowski_sum(exact, zonoopt.Zono(csc_matrix(spans.T), np.zeros(N)))
        share = inside(exact, ours, rng)
        if share is None:
            return
        assert share <= 1.0 + 1e-7, step
    other = Ellipsoids(ours.center + rng.standard_normal(N), drawn(rng).shape)
    both, apart = intersected(ours, other)
    left = zonoopt.intersection(exact, inscribed(other, rng))
    share = inside(left, both, rng)
    assert share is None or (share <= 1.0 + 1e-7 and not bool(apart))


def test_the_check_would_notice() -> None:
    """A strip's cut that is 10 % too small loses corners in some of the cases."""
    lost = 0
    for case in CASES:
        rng = np.random.default_rng([case, *b"small"])
        ours = drawn(rng)
        h = rng.standard_normal(N)
        at, width = float(h @ ours.center), float(ours.extent(h))
        cut, _ = cut_by_strip(ours, h, at - 0.5 * width, at)
        small = Ellipsoids(cut.center, 0.81 * cut.shape)
        share = inside(strip_of(inscribed(ours, rng), h, at - 0.5 * width, at), small, rng)
        lost += share is not None and share > 1.0
    assert lost > 0
