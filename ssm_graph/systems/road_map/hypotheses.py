"""All lanes that a stretch of a drive could have been driven in, each with its evidence.

The particles may have lost the right lane before they knew better. So the stretch as a whole is
laid on the map from everywhere about the fix, coarsely, and the best places finely: what the map
itself says is possible does not depend on which particles are left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEGREE, wrapped
from ssm_graph.filters.rules.hypotheses import Hypothesis, apart_from_each_other, told
from ssm_graph.filters.rules.particles import normalised
from ssm_graph.systems.road_map.locator import (
    INDEPENDENT_M,
    LocatorSettings,
    laid,
    likelihood_of_points,
)
from ssm_graph.systems.road_map.maps.index import LineIndex
from ssm_graph.systems.road_map.maps.road_map import LineKind
from ssm_graph.systems.road_map.window import Window

LATERAL_M: Final = 1.2
"""Places closer to each other across the road are one lane ..."""
TURN: Final = 20.0 * DEGREE
"""... if they face the same way."""
ALONG_M: Final = 8.0
"""Places of one lane farther apart along the road are told apart all the same."""
_ALONG_LEAST_M: Final = 1.0
"""No place along a lane is held to be better known than so, when places are compared."""
_COARSE_M: Final = 2.0
_COARSE_TURN: Final = 2.5 * DEGREE
_COARSE_SIGMA_M: Final = 1.2
_KEPT: Final = 40
SLIDE_M: Final = 24.0
"""How far along the lane a place is looked for anew."""
_ROUNDS: Final = 5
_HELD_ROUNDS: Final = 3
"""Along a lane: each place begins where the one before it was fitted."""
ALONG_STEP_M: Final = 2.0
"""Between the places along a lane that are compared with each other."""
_HELD: Final = 1e6
"""1/m^2, along the course of a place that stays where it is along its lane."""


def is_same_lane(hypothesis: Hypothesis, pose: Array) -> bool:
    """Whether a pose is within the lane of a hypothesis, wherever along it."""
    here = np.array(hypothesis.pose)
    return abs(aside(here, pose)) < LATERAL_M and abs(apart(here, pose)[2]) < TURN


def aside(pose: Array, other: Array) -> float:
    """Return how far ``other`` is beside the lane of a pose (3,), an arc between courses, m."""
    across, along, turn = apart(pose, other)
    return across - along * float(np.tan(0.5 * turn))


def lane_share(found: list[Hypothesis], pose: Array) -> float:
    """Return which share of the evidence is for the lane of a pose (3,)."""
    return sum(h.share for h in found if is_same_lane(h, pose))


def known_along(found: list[Hypothesis], pose: Array, along_m: float) -> list[Hypothesis]:
    """Return places by evidence where those in the lane of a pose (3,) are known along it as well.

    A stretch of straight road allows them all alike; ``along_m`` is the sigma of what was known
    of the place along it before.
    """
    mine = np.array([is_same_lane(h, pose) for h in found])
    along = np.array([apart(pose, np.array(h.pose))[1] for h in found])
    loss = np.where(mine, 0.5 * np.square(along / max(along_m, _ALONG_LEAST_M)), 0.0)
    value = np.array([h.log_evidence for h in found]) - loss
    if mine.any():
        value[mine] += loss[mine].min()
    share = normalised(value)
    order = np.argsort(-value, kind="stable")
    return [replace(found[i], log_evidence=float(value[i]), share=float(share[i])) for i in order]


def apart(pose: Array, other: Array) -> tuple[float, float, float]:
    """Return how far ``other`` is across and along a pose (3,), m, and turned, rad."""
    dx, dy = other[0] - pose[0], other[1] - pose[1]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return float(c * dy - s * dx), float(c * dx + s * dy), float(wrapped(other[2] - pose[2]))


def search(
    window: Window,
    x_y: Array,
    half_m: float,
    yaws: Array,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
    own: Array,
) -> tuple[list[Hypothesis], Hypothesis]:
    """Return the places of the last picture that the stretch allows, best first, and the own one.

    Parameters
    ----------
    x_y, half_m : middle and half side of the square that is searched, m.
    yaws : (n,) courses that are tried, rad.
    own : (3,) pose that is tried as well, the mean of the particles.
    """
    side = np.arange(-half_m, half_m + 0.5 * _COARSE_M, _COARSE_M)
    places = np.stack(np.meshgrid(*(x_y[:, None] + side), indexing="ij"), axis=-1).reshape(-1, 2)
    near = np.zeros(len(places), dtype=bool)
    for index in indices.values():
        distance, _ = index.nearest(places[:, 0], places[:, 1])
        near |= distance < index.reach_m
    places = places[near] if near.any() else places
    grid = np.column_stack([np.repeat(places, len(yaws), axis=0), np.tile(yaws, len(places))])
    thin = _thinned(window)
    coarse = _log_likelihood(_thinned(window, 6, 3), grid, indices, settings, _COARSE_SIGMA_M)
    starts = np.concatenate([grid[_apart_from_each_other(grid, coarse, _KEPT)], own[None]])
    fine = _fitted(thin, starts, indices, settings, _COARSE_SIGMA_M)
    inside = np.abs(fine[:, :2] - x_y).max(axis=1) < half_m + 2.0 * _COARSE_M
    if inside.any() and not inside[-1]:  # the fix says that it is not there
        found, last = _ranked(window, fine[inside], indices, settings)
        return found, replace(last, log_evidence=-np.inf)
    inside[-1] = True
    return _ranked(window, fine[inside], indices, settings)


def slide(
    window: Window,
    pose: Array,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
) -> tuple[list[Hypothesis], Hypothesis]:
    """Return the places along the lane of a pose (3,) that the stretch allows, and the own one."""
    at = np.arange(-SLIDE_M, SLIDE_M + 1.0, 2.0 * _COARSE_M)
    starts = pose + at[:, None] * [np.cos(pose[2]), np.sin(pose[2]), 0.0]
    thin = _thinned(window)
    fine = _fitted(thin, np.concatenate([starts, pose[None]]), indices, settings, 0.5)
    return _ranked(window, fine, indices, settings)


def along_lane(
    window: Window,
    pose: Array,
    x_y: Array,
    half_m: float,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
) -> tuple[Array, Array]:
    """Return places (n, 3) all along the lane of a pose (3,), and the log evidence (n,) of each.

    They are ``ALONG_STEP_M`` apart, as far as the square about a point (2,) reaches; each is moved
    across and turned to where the stretch fits best there.
    """
    thin = _thinned(window)
    ends, found = np.stack([pose, pose]), [pose]
    goes_on = np.ones(2, dtype=bool)
    step = ALONG_STEP_M * np.array([1.0, -1.0])
    for _ in range(int(np.ceil(2.0 * half_m / ALONG_STEP_M))):
        moved = ends + step[:, None] * np.column_stack(
            [np.cos(ends[:, 2]), np.sin(ends[:, 2]), np.zeros(2)]
        )
        fitted = _fitted(thin, moved, indices, settings, 0.5, is_held=True)
        across = np.hypot(*(fitted - moved)[:, :2].T)
        goes_on &= (across < LATERAL_M) & (np.abs(fitted[:, :2] - x_y).max(axis=1) < half_m)
        if not goes_on.any():
            break
        ends = fitted
        found += list(ends[goes_on])
    poses = np.array(found)
    return poses, evidence_of(window, poses, indices, settings)


def evidence_of(
    window: Window,
    poses: Array,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
) -> Array:
    """Return the log evidence (n,) of poses (n, 3) of the last picture, up to a constant.

    Pictures close to each other see the same errors of the map again: so much less they count.
    """
    return _independent(window) * _log_likelihood(window, poses, indices, settings, 0.0)


def _independent(window: Window) -> float:
    """Return which share of its pictures a window is worth: close ones see the same errors."""
    length = float(np.hypot(*np.diff(window.motion[:, :2], axis=0).T).sum())
    return min(1.0, (length + INDEPENDENT_M) / (INDEPENDENT_M * len(window.time_s)))


def _ranked(
    window: Window,
    poses: Array,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
) -> tuple[list[Hypothesis], Hypothesis]:
    """Return poses (n, 3) by evidence, without those in the place of a better one; and the last.

    Pictures close to each other see the same errors of the map again: so much less they count.
    """
    new = _independent(window)
    whole = _log_likelihood(window, poses, indices, settings, 0.0)
    found, misfit = new * whole, -whole / len(window.picture)
    kept = _apart_from_each_other(poses, found, _KEPT)
    every = told(poses, found, misfit, kept)
    return [every[row] for row in kept], every[-1]


def _thinned(window: Window, n_pictures: int = 8, n_points: int = 4) -> Window:
    """Return the window with fewer pictures, the last among them, and fewer points a curve."""
    n = len(window.time_s)
    kept = np.unique(np.linspace(n - 1, 0, min(n, n_pictures)).astype(int))
    mine = np.isin(window.picture, kept)
    points = np.linspace(0, window.points.shape[1] - 1, n_points).astype(int)
    return Window(
        window.time_s[kept],
        window.motion[kept],
        np.searchsorted(kept, window.picture[mine]).astype(float),
        window.points[mine][:, points],
        window.kind[mine],
        window.mark[mine],
        window.sigma_m[mine],
    )


def _log_likelihood(
    window: Window,
    last: Array,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
    wider_m: float,
) -> Array:
    """Return the log likelihood (n,) of the window that ends at the poses (n, 3)."""
    return likelihood_of_points(
        *(last, window.stiff, window.kind, window.mark, indices, settings),
        dict.fromkeys(indices, wider_m),
    )


def _apart_from_each_other(poses: Array, value: Array, most: int) -> list[int]:
    """Return rows of the best poses (n, 3), none in the place of a better one."""

    def is_same(best: int, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        d = poses[rows, :2] - poses[best, :2]
        c, s = np.cos(poses[best, 2]), np.sin(poses[best, 2])
        across, along = np.abs(c * d[:, 1] - s * d[:, 0]), np.abs(c * d[:, 0] + s * d[:, 1])
        turn = np.abs(wrapped(poses[rows, 2] - poses[best, 2]))
        return np.asarray((across < LATERAL_M) & (along < ALONG_M) & (turn < TURN))

    return apart_from_each_other(value, is_same, most)


def _fitted(
    window: Window,
    last: Array,
    indices: Mapping[LineKind, LineIndex],
    settings: LocatorSettings,
    first_m: float,
    *,
    is_held: bool = False,
) -> Array:
    """Return poses (n, 3) moved to where the window fits best nearby: damped Gauss-Newton.

    The widths fall from round to round, beginning with ``first_m`` more than the sigmas. Those that
    are held move across their course only, and turn.
    """
    at: Array = last.copy()
    points = window.stiff
    for number in range(_HELD_ROUNDS if is_held else _ROUNDS):
        wider_m = first_m * 0.4**number
        hessian = np.zeros((len(at), 3, 3)) + np.diag([0.05, 0.05, 30.0])
        if is_held:
            ahead = np.column_stack([np.cos(at[:, 2]), np.sin(at[:, 2])])
            hessian[:, :2, :2] += _HELD * ahead[:, :, None] * ahead[:, None]
        slope = np.zeros((len(at), 3))
        for kind, index in indices.items():
            mine = window.kind == kind
            if not mine.any():
                continue
            how = settings.line if kind is LineKind.LANE_LINE else settings.boundary
            x, y = laid(at, points[mine])
            dx, dy, segment = index.off(x, y)
            normal = index.normal.take(segment, axis=0)
            nx, ny = normal[..., 0], normal[..., 1]
            sigma = how.sigma_m + wider_m
            counted = (dx * dx + dy * dy < how.cap_sq * sigma**2) / sigma**2
            # In world axes, and turned about the last picture's position.
            block = np.stack([nx, ny, ny * (x - at[:, 0]) - nx * (y - at[:, 1])])
            hessian += np.einsum("apn,pn,bpn->nab", block, counted, block)
            slope += np.einsum("apn,pn->na", block, counted * (nx * dx + ny * dy))
        step = np.linalg.solve(hessian, slope[..., None])[..., 0]
        at = at - step
    return at


def course_trials(yaw: float, sigma: float) -> Array:
    """Return the courses that a search tries: within two and a half sigma of one, rad."""
    n = max(1, int(np.ceil(2.5 * sigma / _COARSE_TURN)))
    return np.asarray(yaw + _COARSE_TURN * np.arange(-n, n + 1), dtype=np.float64)
