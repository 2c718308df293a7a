"""Which landmark was seen, where nobody says: gates, joint compatibility, provisional landmarks.

A filter goes along; what it expects of the landmarks near, with their covariances, is held against
each scan. A pair has to tell more than chance: the density of the observation where the landmark is
expected, over that of landmarks that were not met yet. After a stretch in which nothing was seen,
heading and place are so uncertain that any landmark fits, and then none is believed. What fits none
and is far from all, or near those alone that could tell nothing, begins a provisional landmark,
which joins the map once it was seen often enough; what is near one but does not fit is left out.

References
----------
.. [1] J. Neira, J. D. Tardós, "Data Association in Stochastic Mapping Using the Joint Compatibility
   Test", IEEE Transactions on Robotics and Automation 17, 2001.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from factors.bearing_range import half_turn
from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.filtered import filter_along
from ssm_graph.systems.landmark_slam.filters import MapFilter
from ssm_graph.systems.landmark_slam.problem import UNKNOWN, SlamNoise, SlamProblem

MOST_LANDMARKS: Final = 400
"""That a log may give rise to."""
FEWEST_DENSE: Final = 3
MARGIN_M: Final = 1.0
SMALLEST_M2: Final = 20.0
"""Landmarks, m and m^2 from which a density is taken seriously: a first one alone tells none."""
MOST_IN_SCAN: Final = 12
"""Observations whose combinations are tried; of more, the nearest are taken."""


class Association(Enum):
    """How observations find their landmarks."""

    KNOWN = "the log names them"
    NEAREST = "nearest in a gate, each landmark once"
    JOINT = "the largest set of pairs that fit together (JCBB)"


@dataclass(frozen=True, slots=True)
class AssociationSettings:
    """Gates and patience."""

    kind: Association = Association.JOINT
    fits: float = 0.99
    """Share of true pairs that pass."""
    is_new: float = 1.0 - 1e-9
    """What no landmark can have been at this confidence may be a new one."""
    tells: float = 1.0
    """Logarithm of the odds for a perfect fit, below which a landmark cannot be told from one that
    was not met yet."""
    sightings: int = 3
    """After which a provisional landmark joins the map."""
    provisional_m: float = 0.2
    """Sightings of a provisional landmark lie so near each other ..."""
    provisional_share: float = 0.05
    """... or nearer than this share of the range."""
    provisional_s: float = 5.0
    """After which one that was not seen again is forgotten."""
    memory_s: float = np.inf
    """Landmarks that were not seen for longer are no candidates: whether they are met again is for
    who knows the whole log."""
    near_m: float = 20.0
    """Landmarks farther from where an observation would put its own are no candidates."""


@dataclass(frozen=True, eq=False)
class _Provisional:
    """A landmark that may be none."""

    place: Array
    """(2,) where it was seen last; its error goes with that of the pose."""
    rows: tuple[int, ...]
    last: int
    """Pose that saw it last."""


class Associated(NamedTuple):
    """A log whose observations have landmarks."""

    problem: SlamProblem
    landmark: NDArray[np.intp]
    """(M,) of the log that came, `UNKNOWN` of observations left out."""
    pose: Array
    """(K, 3) of the filter on its way."""
    places: Array
    """(L, 2) of its landmarks."""


def associate(
    problem: SlamProblem, noise: SlamNoise, settings: AssociationSettings | None = None
) -> Associated:
    """Return a log with landmarks found by what was seen alone; names it had are not looked at."""
    how = settings or AssociationSettings()
    slam, move = filter_along(problem, noise, "ekf-weighted", capacity=MOST_LANDMARKS)
    assert isinstance(slam, MapFilter)
    found = np.full(len(problem.keyframe), UNKNOWN, dtype=np.intp)
    pose = np.empty((len(problem.time_s), 3))
    waiting: list[_Provisional] = []
    first = problem.first_of.tolist()
    last_s: list[float] = []
    for k in range(len(pose)):
        if k > 0:
            move(k)
        rows = np.arange(first[k], first[k + 1])
        rows = rows[np.isfinite(problem.measured[rows]).all(axis=1)]
        if len(rows):
            is_near = problem.time_s[k] - np.array(last_s) < how.memory_s
            pairs, fresh = _paired(slam, problem, rows, is_near, how)
            for row, name in pairs:
                found[row] = name
            joined = _sighted(waiting, slam, problem, fresh, found, k, how)
            _update(slam, problem, [*pairs, *joined])
            last_s += [0.0] * len(joined)
            for _, name in (*pairs, *joined):
                last_s[name] = problem.time_s[k]
        pose[k] = slam.pose[0]
    names = tuple(str(i) for i in slam.ids)
    return Associated(problem.associated(found, names), found, pose, slam.landmarks()[0])


def _update(slam: MapFilter, problem: SlamProblem, pairs: list[tuple[int, int]]) -> None:
    if pairs:
        rows, names = [row for row, _ in pairs], [name for _, name in pairs]
        slam.update(names, problem.measured[rows][None], problem.scales[rows])


def _places(slam: MapFilter, measured: Array) -> Array:
    """Return where observations (m, 2) would put their landmarks."""
    x, y, heading = slam.pose[0]
    angle = heading + measured[:, 1]
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(np.array([x, y]) + measured[:, :1] * ray)


def _paired(
    slam: MapFilter,
    problem: SlamProblem,
    rows: NDArray[np.intp],
    may: NDArray[np.bool_],
    how: AssociationSettings,
) -> tuple[list[tuple[int, int]], list[int]]:
    """Return pairs of rows and landmarks that ``may`` (L,) be met, and rows of a new one."""
    z = problem.measured[rows]
    if not slam.ids:
        return [], rows.tolist()
    away = np.linalg.norm(_places(slam, z)[:, None] - slam.landmarks()[0], axis=2)
    near = np.flatnonzero(may & (away.min(axis=0) < how.near_m))
    if len(near) == 0:
        return [], rows.tolist()
    names = [slam.ids[i] for i in near]
    expected, inner = slam.predicted(names)
    nu = z[:, None] - expected[0]
    nu[..., 1] = half_turn(nu[..., 1])
    R = slam.noise.observation[0] * (
        problem.scales[rows][:, :, None] * problem.scales[rows][:, None]
    )
    own = np.stack([inner[0, 2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(len(near))])
    S = own[None] + R[:, None]
    nis = np.einsum("mli,mli->ml", nu, np.linalg.solve(S, nu[..., None])[..., 0])
    per_m2 = density(slam.landmarks()[0])
    best_odds = -0.5 * np.log(np.linalg.det(2.0 * np.pi * S)) - np.log(per_m2 * z[:, :1])
    near_it = nis < chi2.ppf(how.is_new, 2)
    is_new = ~np.any(near_it & (best_odds > how.tells), axis=1)
    limit = float(chi2.ppf(how.fits, 2))
    nis = np.where(best_odds - 0.5 * nis > 0.0, nis, np.inf)
    if how.kind is Association.NEAREST:
        chosen = _nearest(nis, limit)
    else:
        chosen = _joint(nu, nis, inner[0], R, limit, how.fits)
    is_new[[i for i, _ in chosen]] = False
    return [(int(rows[i]), names[j]) for i, j in chosen], rows[is_new].tolist()


def density(places: Array) -> float:
    """Return landmarks per m^2 in the box of those that there are, with a margin."""
    extent = np.prod(np.ptp(places, axis=0) + MARGIN_M)
    return float(max(len(places), FEWEST_DENSE) / max(extent, SMALLEST_M2))


def _nearest(nis: Array, limit: float) -> list[tuple[int, int]]:
    cost = np.where(nis < limit, nis, 1e6)
    return [
        (int(i), int(j))
        for i, j in zip(*linear_sum_assignment(cost), strict=True)
        if nis[i, j] < limit
    ]


def _joint(
    nu: Array, nis: Array, inner: Array, R: Array, limit: float, fits: float
) -> list[tuple[int, int]]:
    """Return the largest set of pairs whose joint NIS passes, of these the nearest: depth first."""
    order = np.argsort(nis.min(axis=1))[:MOST_IN_SCAN]
    options = [[j for j in np.argsort(nis[i]) if nis[i, j] < limit] for i in order]
    best: list[tuple[int, int]] = []
    best_nis = np.inf

    def joint_nis(pairs: list[tuple[int, int]]) -> float:
        at = np.concatenate([[2 * j, 2 * j + 1] for _, j in pairs])
        S = inner[np.ix_(at, at)].copy()
        for n, (i, _) in enumerate(pairs):
            S[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] += R[i]
        v = np.concatenate([nu[i, j] for i, j in pairs])
        return float(v @ np.linalg.solve(S, v))

    def go(depth: int, pairs: list[tuple[int, int]], own: float) -> None:
        nonlocal best, best_nis
        if len(pairs) + len(options) - depth < len(best):
            return
        if depth == len(options):
            if len(pairs) > len(best) or (len(pairs) == len(best) and own < best_nis):
                best, best_nis = pairs, own
            return
        taken = {j for _, j in pairs}
        for j in options[depth]:
            if j not in taken:
                more = [*pairs, (int(order[depth]), int(j))]
                value = joint_nis(more)
                if value < chi2.ppf(fits, 2 * len(more)):
                    go(depth + 1, more, value)
        go(depth + 1, pairs, own)

    go(0, [], 0.0)
    return best


def _sighted(
    waiting: list[_Provisional],
    slam: MapFilter,
    problem: SlamProblem,
    fresh: list[int],
    found: NDArray[np.intp],
    k: int,
    how: AssociationSettings,
) -> list[tuple[int, int]]:
    """Take what may be new; return the pairs of landmarks that join the map now."""
    now = problem.time_s[k]
    waiting[:] = [one for one in waiting if now - problem.time_s[one.last] < how.provisional_s]
    joined: list[tuple[int, int]] = []
    if not fresh:
        return joined
    for row, place in zip(fresh, _places(slam, problem.measured[fresh]), strict=True):
        reach = max(how.provisional_m, how.provisional_share * problem.measured[row, 0])
        away = [float(np.linalg.norm(one.place - place)) for one in waiting]
        if not away or min(away) > reach:
            waiting.append(_Provisional(place, (row,), k))
            continue
        one = waiting.pop(int(np.argmin(away)))
        one = _Provisional(place, (*one.rows, row), k)
        if len(one.rows) >= how.sightings and len(slam.ids) + len(joined) < MOST_LANDMARKS:
            name = len(slam.ids) + len(joined)
            once = {int(problem.keyframe[i]): i for i in one.rows}  # a landmark is once in a scan
            found[list(once.values())] = name
            joined.append((row, name))
        else:
            waiting.append(one)
    return joined


class AssociationErrors(NamedTuple):
    """Against names that the log had."""

    n_wrong: int
    """Observations whose landmark is mostly another one's."""
    n_left_out: int
    n_split: int
    """Landmarks more than those there are: names that got several."""
    n: int


def association_errors(found: NDArray[np.intp], true: NDArray[np.intp]) -> AssociationErrors:
    """Count what went wrong, of observations (M,) with true names."""
    used = found != UNKNOWN
    wrong, owners = 0, []
    for name in np.unique(found[used]):
        names, counts = np.unique(true[used & (found == name)], return_counts=True)
        wrong += int(counts.sum() - counts.max())
        owners.append(int(names[np.argmax(counts)]))
    return AssociationErrors(wrong, int(np.sum(~used)), len(owners) - len(set(owners)), len(found))
