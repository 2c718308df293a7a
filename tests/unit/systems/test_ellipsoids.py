"""Set operations: nothing is lost, nothing is larger than it has to be, bad input is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.ellipsoids import (
    Ellipsoids,
    around_box,
    checked_shape,
    cut_by_strip,
    intersected,
    segments,
    sum_shape,
)
from ssm_graph.filters.rules.set_membership import Sets, led_on, measured, saturated, shared
from ssm_graph.systems.sensor_network.motion import (
    cosine_range,
    lagrange_remainder,
    planar_image,
    planar_step,
    sine_line,
)

N = 1500
IN = 1.0 + 1e-9
FLOOR = np.array([1e-4, 1e-4, 1e-5])


def drawn(rng: np.random.Generator, count: int = N) -> Ellipsoids:
    """Return ellipsoids of condition numbers up to some hundreds."""
    A = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0]
    size = np.exp(rng.uniform(-1.5, 1.5, (count, 3)))
    return Ellipsoids(rng.standard_normal((count, 3)), (A * size[:, None]) @ np.swapaxes(A, 1, 2))


def on(sets: Ellipsoids, rng: np.random.Generator) -> Array:
    """Return a point of the surface of each."""
    return np.asarray(sets.sampled(rng, 1, on_surface=True)[0])


@pytest.fixture
def rng() -> np.random.Generator:
    """Return the numbers of a test."""
    return np.random.default_rng(7)


def test_a_strip_keeps_every_point_and_touches_it(rng: np.random.Generator) -> None:
    """Points on the surface and on the border of the strip: the hardest to keep."""
    E = drawn(rng)
    x, h = on(E, rng), rng.standard_normal((N, 3))
    r = E.extent(h) * rng.random(N)
    at = np.einsum("ni,ni->n", h, x) + r * rng.choice([-1.0, 1.0], N)
    cut, missed = cut_by_strip(E, h, at - r, at + r)
    assert not missed.any()
    assert 0.99 < cut.excess(x).max() <= IN
    assert np.all(cut.log_volume <= E.log_volume + 1e-9)


def test_a_strip_through_the_middle_has_the_least_volume() -> None:
    """Of the unit ball and ``|x| <= r``: shapes ``n r^2`` along and ``n (1-r^2)/(n-1)`` across."""
    r = 0.3
    ball = Ellipsoids(np.zeros(3), np.eye(3))
    cut, _ = cut_by_strip(ball, [1.0, 0.0, 0.0], -r, r)
    expected = np.diag([3.0 * r**2, 1.5 * (1.0 - r**2), 1.5 * (1.0 - r**2)])
    np.testing.assert_allclose(cut.shape, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("low", "high", "misses"), [(1.1, 2.0, True), (0.9, 2.0, False)])
def test_a_strip_that_misses_is_told(low: float, high: float, misses: bool) -> None:
    """And leaves the set as it was."""
    ball = Ellipsoids(np.zeros(3), np.eye(3))
    cut, missed = cut_by_strip(ball, [0.0, 0.0, 1.0], low, high)
    assert bool(missed) is misses
    assert np.array_equal(cut.shape, ball.shape) is misses


def test_an_intersection_keeps_every_point(rng: np.random.Generator) -> None:
    """Of points on both surfaces; it is no larger than the first."""
    E, F = drawn(rng), drawn(rng)
    x = on(E, rng)
    F = Ellipsoids(F.center + x - on(F, rng), F.shape)
    both, apart = intersected(E, F)
    assert not apart.any()
    assert 0.99 < both.excess(x).max() <= 1.0 + 1e-8
    assert np.all(both.log_volume <= E.log_volume + 1e-9)


def test_apart_is_told_exactly_for_balls() -> None:
    """Two unit balls meet up to a distance of two."""
    E = Ellipsoids(np.zeros((2, 3)), np.broadcast_to(np.eye(3), (2, 3, 3)).copy())
    F = Ellipsoids(np.array([[2.001, 0.0, 0.0], [1.999, 0.0, 0.0]]), E.shape)
    assert intersected(E, F)[1].tolist() == [True, False]


def test_a_sum_keeps_every_sum(rng: np.random.Generator) -> None:
    """Of two ellipsoids and a segment, in the directions where it is tightest, too."""
    E, F, d = drawn(rng), drawn(rng), rng.standard_normal((N, 1, 3))
    P = sum_shape(np.concatenate([E.shape[:, None], F.shape[:, None], segments(d)], axis=1))
    u = rng.standard_normal((N, 3))
    # The farthest point along u of each part: sums of these reach farthest.
    reach = sum(np.einsum("nij,nj->ni", Q.shape, u) / Q.extent(u)[:, None] for Q in (E, F))
    reach = reach + d[:, 0] * np.sign(np.einsum("ni,ni->n", d[:, 0], u))[:, None]
    excess = Ellipsoids(np.zeros((N, 3)), P).excess(reach)
    assert 0.9 < excess.max() <= IN


def test_a_sum_of_one_is_itself() -> None:
    """And of two of a shape the sum of the half-widths."""
    P = np.diag([1.0, 4.0, 9.0])
    np.testing.assert_allclose(sum_shape(np.array([P, 4.0 * P])), 9.0 * P, rtol=1e-9)


def test_box_shadow_and_samples(rng: np.random.Generator) -> None:
    """Corners are inside; a shadow holds the shadows of points; samples are inside."""
    box = around_box(np.zeros(3), [1.0, 2.0, 3.0])
    corners = np.array(np.meshgrid([-1, 1], [-2, 2], [-3, 3])).reshape(3, -1).T
    assert all(box.excess(corner) <= 1.0 for corner in corners)
    E = drawn(rng, 50)
    x = E.sampled(rng, 20)
    assert E.contains(x).all()
    assert E.projected([0, 2]).contains(x[..., [0, 2]]).all()


def test_the_sine_stays_by_its_line() -> None:
    """The bound holds, is reached, and is a quarter of Lagrange's cubic term for small angles."""
    a = np.linspace(0.01, 5.0, 60)
    s, bound = sine_line(a)
    e = np.linspace(-1.0, 1.0, 2001)[:, None] * a
    rest = np.abs(np.sin(e) - s * e).max(axis=0)
    assert np.all(rest <= bound + 1e-12)
    np.testing.assert_allclose(rest[a < np.pi], bound[a < np.pi], rtol=1e-3)
    assert bound[0] < 0.27 * a[0] ** 3 / 6.0


def test_ranges_of_the_cosine() -> None:
    """Against a dense scan."""
    rng = np.random.default_rng(1)
    low = rng.uniform(-8.0, 8.0, 200)
    high = low + rng.uniform(0.0, 7.0, 200)
    scan = np.cos(low + np.linspace(0.0, 1.0, 2001)[:, None] * (high - low))
    least, most = cosine_range(low, high)
    assert np.all(least <= scan.min(axis=0) + 1e-12)
    assert np.all(most >= scan.max(axis=0) - 1e-12)
    np.testing.assert_allclose(least, scan.min(axis=0), atol=1e-4)
    np.testing.assert_allclose(most, scan.max(axis=0), atol=1e-4)


def test_lagrange_bounds_a_square() -> None:
    """Of ``f = x y`` over a box the rest is ``b1 b2`` at its corners, and not more."""
    hessian = np.array([[[0.0, 1.0], [1.0, 0.0]]])
    assert lagrange_remainder([2.0, 3.0], hessian) == pytest.approx([6.0])


@pytest.mark.parametrize("half_rad", [0.05, 0.7, 2.0, 4.0])
def test_a_motion_keeps_every_state(half_rad: float, rng: np.random.Generator) -> None:
    """With noise and errors of the advance at their corners, headings known or not; then walls."""
    shape = np.broadcast_to(np.diag([0.3, 0.3, half_rad**2]), (N, 3, 3)).copy()
    sets = Sets.of(Ellipsoids(np.zeros((N, 3)), shape), FLOOR)
    sets, _ = measured(sets, rng.standard_normal((N, 3)), np.zeros(N), 0.4)
    x = sets.nearest(on(sets.ellipsoid, rng))
    d, w, b = rng.standard_normal((N, 2)), np.array([0.1, 0.2, 0.05]), np.array([0.1, 0.03])
    moved = led_on(sets, planar_image(sets, d, np.full(N, 0.2), w, advance_bound=b))
    y = planar_step(x, d + b * rng.choice([-1.0, 1.0], (N, 2)), 0.2)
    y = y + w * rng.choice([-1.0, 1.0], (N, 3))
    assert 0.8 < moved.excess(y).max() <= IN
    levels = np.array([0.5, 0.8, 1.0])
    walled = saturated(moved, levels)
    assert walled.excess(np.clip(y, -levels, levels)).max() <= IN
    assert np.all(walled.high <= levels + FLOOR)


def test_walls_that_are_far_change_nothing(rng: np.random.Generator) -> None:
    """The exact test: the very same set."""
    sets = Sets.of(drawn(rng, 5), FLOOR)
    assert saturated(sets, [1e3, 1e3, 1e3]) is sets


def test_sharing_keeps_the_truth_and_never_enlarges(rng: np.random.Generator) -> None:
    """Whatever the two sets have in common: their correlation is not asked for."""
    E = Sets.of(drawn(rng), FLOOR)
    x = E.ellipsoid.sampled(rng, 1)[0]
    F = drawn(rng)
    other = Sets.of(Ellipsoids(F.center + x - F.sampled(rng, 1)[0], F.shape), FLOOR)
    both, apart = shared(E, other)
    assert not apart.any()
    assert both.excess(x).max() <= IN
    assert np.all(both.ellipsoid.log_volume <= E.ellipsoid.log_volume + 1e-9)
    assert np.all(both.half_widths <= E.half_widths + 1e-12)


def test_points_next_to_a_set_are_in_it_and_no_further(rng: np.random.Generator) -> None:
    """The truth is inside, so that moving a guess into the set never takes it away from it."""
    sets = Sets.of(drawn(rng), FLOOR)
    sets, _ = measured(sets, rng.standard_normal(3), sets.ellipsoid.center[:, 0], 0.3)
    truth = sets.nearest(sets.ellipsoid.sampled(rng, 1)[0])
    guess = truth + 2.0 * rng.standard_normal(truth.shape)
    near = sets.nearest(guess)
    scale = sets.ellipsoid.half_widths
    assert sets.contains(near).all()
    before = np.linalg.norm((guess - truth) / scale, axis=1)
    after = np.linalg.norm((near - truth) / scale, axis=1)
    assert np.mean(after <= before + 1e-6) > 0.999
    np.testing.assert_allclose(sets.nearest(truth), truth, atol=1e-9)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        (np.diag([1.0, 0.0]), "positive definite"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), "finite"),
        (np.ones(3), "square"),
    ],
)
def test_bad_shapes_are_refused(shape: Array, expected: str) -> None:
    """With the name of what they are."""
    with pytest.raises(DataError, match=f"P_0.*{expected}"):
        checked_shape("P_0", shape)


def test_every_inequality_of_the_page_has_its_tests() -> None:
    """What docs/network.md names is there."""
    here = Path(__file__).parent
    rows = [
        line
        for line in (here.parents[2] / "docs" / "network.md").read_text("utf-8").splitlines()
        if line.startswith("| **")
    ]
    tests = "".join(path.read_text("utf-8") for path in here.glob("test_*.py"))
    named = [re.findall(r"`(?:\.\.\.)?(\w*_\w+)`", row.split(" | ")[-1]) for row in rows]
    assert len(rows) >= 20
    for row, names in zip(rows, named, strict=True):
        assert names, row
        assert not [name for name in names if f"{name}(" not in tests], row


def test_one_component_is_no_ellipsoid() -> None:
    """The law of least volume has none for it."""
    with pytest.raises(DataError, match="two components"):
        cut_by_strip(Ellipsoids(np.zeros(1), np.eye(1)), [1.0], -1.0, 1.0)
