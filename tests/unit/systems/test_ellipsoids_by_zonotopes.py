"""Operations on sets against exact ones: constrained zonotopes, whose reach a linear program tells.

What is made of a box inside an ellipsoid is known exactly, and has to stay inside what ours make of
the ellipsoid. Where zonoopt (PyPI) is there, its operations have to reach as far as those here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.linalg import block_diag
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

N = 3
CASES = range(12)
NEAR = 1e-7
"""What a linear program may be off by."""


class Exact(NamedTuple):
    """All ``c + G z`` with ``|z| <= 1``, ``A z = a`` and ``B z <= b``."""

    G: Array
    c: Array
    A: Array
    a: Array
    B: Array
    b: Array

    def in_strip(self, h: Array, low: float, high: float) -> Exact:
        """Return the part in a strip."""
        row, at = h @ self.G, float(h @ self.c)
        b = np.append(self.b, [high - at, at - low])
        return self._replace(B=np.vstack([self.B, row, -row]), b=b)

    def plus(self, spans: Array) -> Exact:
        """Return the Minkowski sum with segments ``[-d, d]``, rows of (S, n)."""
        free = [np.hstack([one, np.zeros((len(one), len(spans)))]) for one in (self.A, self.B)]
        return self._replace(G=np.hstack([self.G, spans.T]), A=free[0], B=free[1])

    def meeting(self, other: Exact) -> Exact:
        """Return what is in both."""
        A = np.vstack([block_diag(self.A, other.A), np.hstack([self.G, -other.G])])
        a = np.concatenate([self.a, other.a, other.c - self.c])
        G = np.hstack([self.G, np.zeros_like(other.G)])
        B, b = block_diag(self.B, other.B), np.concatenate([self.b, other.b])
        return Exact(G, self.c, A, a, B, b)

    def reach(self, direction: Array) -> float | None:
        """Return the largest ``d.x``, None where nothing is in the set."""
        found = linprog(
            -direction @ self.G,
            A_ub=self.B,
            b_ub=self.b,
            A_eq=self.A,
            b_eq=self.a,
            bounds=(-1.0, 1.0),
            method="highs",
        )
        return float(direction @ self.c - found.fun) if found.status == 0 else None


def inscribed(sets: Ellipsoids, rng: np.random.Generator) -> Exact:
    """Return a turned cube of the unit ball, mapped into an ellipsoid."""
    turn = special_ortho_group.rvs(N, random_state=rng)
    nothing = np.zeros((0, N)), np.zeros(0)
    return Exact(
        np.linalg.cholesky(sets.shape) @ turn / np.sqrt(N), sets.center, *nothing, *nothing
    )


def drawn(rng: np.random.Generator) -> Ellipsoids:
    """Draw an ellipsoid of a shape that is far from a ball."""
    root = rng.standard_normal((N, N)) * np.exp(rng.uniform(-2.0, 2.0, N))
    return Ellipsoids(rng.standard_normal(N), root @ root.T + 1e-3 * np.eye(N))


def inside(exact: Exact, ours: Ellipsoids, rng: np.random.Generator) -> float | None:
    """Return how far an exact set reaches at most, ours 1, in some directions; None if empty."""
    shares: list[float] = []
    for direction in rng.standard_normal((5, N)):
        most = exact.reach(direction)
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
        left = exact.in_strip(h, low, high)
        if bool(misses):
            assert inside(left, ours, rng) is None, step
            return
        spans = rng.standard_normal((2, N)) * 0.3
        shape = sum_shape(np.concatenate([cut.shape[None], segments(spans)]))
        ours, exact = Ellipsoids(cut.center, shape), left.plus(spans)
        share = inside(exact, ours, rng)
        if share is None:
            return
        assert share <= 1.0 + NEAR, step
    other = Ellipsoids(ours.center + rng.standard_normal(N), drawn(rng).shape)
    both, apart = intersected(ours, other)
    share = inside(exact.meeting(inscribed(other, rng)), both, rng)
    assert share is None or (share <= 1.0 + NEAR and not bool(apart))


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
        share = inside(inscribed(ours, rng).in_strip(h, at - 0.5 * width, at), small, rng)
        lost += share is not None and share > 1.0
    assert lost > 0


def test_another_library_reaches_as_far() -> None:
    """A strip of a box, summed up and intersected with another box, by zonoopt and here."""
    zonoopt = pytest.importorskip("zonoopt", reason="another library: pip install zonoopt")
    n_met = 0
    for case in CASES:
        rng = np.random.default_rng([case, *b"other"])
        one = inscribed(drawn(rng), rng)
        two = inscribed(Ellipsoids(one.c + 0.1, drawn(rng).shape), rng)
        h, spans = rng.standard_normal(N), 0.3 * rng.standard_normal((2, N))
        low, high = float(h @ one.c) - 0.1, float(h @ one.c) + 0.4
        ours = one.in_strip(h, low, high).plus(spans).meeting(two)
        theirs = zonoopt.halfspace_intersection(
            zonoopt.Zono(csc_matrix(one.G), one.c),
            csc_matrix(np.stack([h, -h])),
            np.array([high, -low]),
        )
        theirs = zonoopt.minkowski_sum(theirs, zonoopt.Zono(csc_matrix(spans.T), np.zeros(N)))
        theirs = zonoopt.intersection(theirs, zonoopt.Zono(csc_matrix(two.G), two.c))
        for direction in rng.standard_normal((3, N)):
            a, b = (reach(direction) for reach in (ours.reach, reach_of(theirs)))
            assert a == b if a is None or b is None else abs(a - b) < NEAR * (1.0 + abs(b))
            n_met += a is not None
    assert n_met > len(CASES)


def reach_of(theirs: Any) -> Callable[[Array], float | None]:
    """Return how far a constrained zonotope of zonoopt reaches."""
    if theirs.is_0_1_form():
        theirs.convert_form()
    nothing = np.zeros((0, theirs.get_G().shape[1])), np.zeros(0)
    equal = theirs.get_A().toarray(), np.ravel(theirs.get_b())
    exact = Exact(theirs.get_G().toarray(), np.ravel(theirs.get_c()), *equal, *nothing)
    return exact.reach
