"""Readers of planar graphs: g2o, TORO and PyFG.

All three state a relation's noise in the axes of its end; g2o and TORO as an information matrix (in
an order of their own each), PyFG as a covariance. Vertices of g2o and TORO are somebody's first
guess, and only the first pose of it is taken; those of PyFG are the truth.

References
----------
.. [1] R. Kümmerle, G. Grisetti, H. Strasdat, K. Konolige, W. Burgard, "g2o: A General Framework for
   Graph Optimization", ICRA 2011.
.. [2] G. Grisetti, C. Stachniss, W. Burgard, "Nonlinear Constraint Network Optimization for
   Efficient Map Learning" (TORO), IEEE Transactions on Intelligent Transportation Systems 10, 2009.
.. [3] A. Papalia, "PyFactorGraph", Marine Robotics Group, MIT: the text format PyFG.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from factors.bearing_range import half_turn
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.graphs import START_SIGMA, SlamGraph
from ssm_graph.systems.landmark_slam.models import turned

SUFFIXES: Final = (".g2o", ".toro", ".graph", ".pyfg")
"""Files that are read here."""
_UPPER: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_TORO: Final = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
_PLANE: Final = ((0, 0), (0, 1), (1, 1))
_LETTERS: Final = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_IGNORED: Final = ("PARAMS_SE2OFFSET", "VERTEX_XY:PRIOR", "VERTEX_SE2:PRIOR", "EQUIV")
_KNOWN: Final = (
    "VERTEX_SE2, VERTEX_XY, EDGE_SE2, EDGE_SE2_XY, EDGE_BEARING_SE2_XY, EDGE_RANGE, FIX, VERTEX2, "
    "EDGE2 or BR"
)


@dataclass
class _Read:
    """What the lines of a file have told so far."""

    poses: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Time, x, y, heading"""
    landmarks: dict[str, tuple[float, ...]] = field(default_factory=dict)
    relations: list[tuple[str, str, Array, Array]] = field(default_factory=list)
    seen: list[tuple[str, str, Array, Array]] = field(default_factory=list)
    """Pose, landmark, range and bearing, sigmas"""
    ignored: list[str] = field(default_factory=list)


def read_pose_graph(path: Path, *, robot: int | None = None) -> tuple[SlamGraph, tuple[str, ...]]:
    """Return a graph and notes; ``robot`` (1 is A) of a PyFG file with several, else the first.

    Raises :class:`DataError` with the line, what was expected there and what came.
    """
    is_pyfg = path.suffix == ".pyfg"
    read = _Read()
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected a text graph, got bytes that are none") from error
    for number, text in enumerate(lines, 1):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            _take(read, words[0], words[1:], path.suffix)
        except (ValueError, IndexError, np.linalg.LinAlgError) as error:
            raise DataError(
                f"{path}:{number}: {_complaint(words[0], error)}; got {text!r}"
            ) from None
    return _graph(path, read, robot if is_pyfg else None, is_pyfg)


def _complaint(word: str, error: Exception) -> str:
    if isinstance(error, np.linalg.LinAlgError):
        return f"{word}: expected noise that is positive definite; is a sigma zero or negative"
    if isinstance(error, IndexError):
        return f"{word}: expected more numbers"
    return str(error)


def _take(read: _Read, word: str, cells: Sequence[str], suffix: str) -> None:
    is_pyfg = suffix == ".pyfg"
    if "SE3" in word or "XYZ" in word or word in ("VERTEX3", "EDGE3"):
        raise ValueError(f"{word}: expected a graph in the plane, and this one is not")
    time_s = float(cells[0]) if is_pyfg and word not in ("VERTEX_XY",) else np.nan
    rest = list(cells[1:]) if is_pyfg and word not in ("VERTEX_XY",) else list(cells)
    if word in ("VERTEX_SE2", "VERTEX2"):
        read.poses[rest[0]] = (time_s, *_numbers(rest[1:], 3))
    elif word == "VERTEX_XY":
        read.landmarks[rest[0]] = tuple(_numbers(rest[1:], 2))
    elif word in ("EDGE_SE2", "EDGE2"):
        step = _numbers(rest[2:], 3)
        if rest[0] == rest[1]:
            raise ValueError(f"{word}: expected two poses, and this is one with itself")
        cov = _noise(rest[5:], _UPPER if is_pyfg or suffix == ".g2o" else _TORO, is_pyfg)
        onto = turned(step[2])  # stated in the axes of the end
        read.relations.append((rest[0], rest[1], step, onto @ cov @ onto.T))
    elif word == "EDGE_SE2_XY":
        read.seen.append(
            (rest[0], rest[1], *_polar(_numbers(rest[2:], 2), _noise(rest[4:], _PLANE, is_pyfg)))
        )
    elif word == "EDGE_BEARING_SE2_XY":
        bearing, sigma = _numbers(rest[2:], 1)[0], _noise(rest[3:], ((0, 0),), is_pyfg)[0, 0] ** 0.5
        read.seen.append((rest[0], rest[1], np.array([np.nan, bearing]), np.array([1.0, sigma])))
    elif word == "EDGE_RANGE":
        r, sigma = _numbers(rest[2:], 1)[0], _noise(rest[3:], ((0, 0),), is_pyfg)[0, 0] ** 0.5
        if r <= 0.0:
            raise ValueError(f"{word}: expected a range above 0 m")
        read.seen.append((rest[0], rest[1], np.array([r, np.nan]), np.array([sigma, 1.0])))
    elif word == "BR":
        bearing, r, *sigmas = _numbers(rest[2:], 4)
        if r <= 0.0 or min(sigmas) <= 0.0:
            raise ValueError(f"{word}: expected a range and sigmas above 0")
        read.seen.append((rest[0], rest[1], np.array([r, bearing]), np.array(sigmas[::-1])))
    elif word in _IGNORED:
        read.ignored.append(word)
    elif word != "FIX":
        raise ValueError(f"expected {_KNOWN}")


def _numbers(cells: Sequence[str], count: int) -> Array:
    try:
        values = np.array([float(cells[i]) for i in range(count)])
    except ValueError:
        raise ValueError("expected numbers") from None
    if not np.all(np.isfinite(values)):
        raise ValueError("expected finite numbers")
    return values


def _noise(cells: Sequence[str], order: Sequence[tuple[int, int]], is_cov: bool) -> Array:
    """Return a covariance from the numbers of its half, or of that of its inverse."""
    size = 1 + max(i for i, _ in order)
    matrix = np.zeros((size, size))
    for (i, j), value in zip(order, _numbers(cells, len(order)), strict=True):
        matrix[i, j] = matrix[j, i] = value
    np.linalg.cholesky(matrix)
    return np.asarray(matrix if is_cov else np.linalg.inv(matrix))


def _polar(xy: Array, cov: Array) -> tuple[Array, Array]:
    """Return range and bearing, and their sigmas, of a place in the axes of a pose."""
    r = float(np.hypot(*xy))
    if r == 0.0:
        raise ValueError("expected a landmark away from the pose")
    along = xy / r
    across = np.array([-along[1], along[0]])
    sigma = np.array([np.sqrt(along @ cov @ along), np.sqrt(across @ cov @ across) / r])
    return np.array([r, np.arctan2(xy[1], xy[0])]), sigma


def _reversed(step: Array, cov: Array) -> tuple[Array, Array]:
    """Return a relation from its end to its beginning."""
    onto = turned(step[2])
    back = -(onto.T @ step)
    slopes = -onto.T
    slopes[0, 2], slopes[1, 2] = back[1], -back[0]
    return back, slopes @ cov @ slopes.T


def _graph(
    path: Path, read: _Read, robot: int | None, is_pyfg: bool
) -> tuple[SlamGraph, tuple[str, ...]]:
    names = {name for a, b, _, _ in read.relations for name in (a, b)}
    if not names:
        raise DataError(f"{path}: expected relations of poses (EDGE_SE2 or EDGE2), got none")
    letters = sorted({name[0] for name in names if name[0].isalpha()})
    if is_pyfg and letters:
        which = 0 if robot is None else robot - 1
        if not 0 <= which < len(letters):
            raise DataError(f"{path}: --robot: expected 1 to {len(letters)}, got {robot}")
        names = {name for name in names if name[0] == letters[which]}
    try:
        ordered = sorted(names, key=lambda name: int(name.lstrip(_LETTERS)))
    except ValueError:
        odd = next(name for name in sorted(names) if not name.lstrip(_LETTERS).isdigit())
        raise DataError(f"{path}: expected poses by number, got {odd!r}") from None
    index = {name: k for k, name in enumerate(ordered)}
    pairs, steps, covs = [], [], []
    for a, b, step, cov in read.relations:
        if a in index and b in index:
            turned_round = index[a] > index[b]
            pairs.append((index[b], index[a]) if turned_round else (index[a], index[b]))
            own = _reversed(step, cov) if turned_round else (step, cov)
            steps.append(own[0])
            covs.append(own[1])
    kept = [row for row in read.seen if row[0] in index and row[1] not in index]
    if is_pyfg:  # of another robot's poses the places are not known
        kept = [row for row in kept if row[1] in read.landmarks]
    places = sorted({row[1] for row in kept}, key=lambda name: (len(name), name))
    of = {name: i for i, name in enumerate(places)}
    kept.sort(key=lambda row: index[row[0]])
    known = np.array([read.poses.get(name, (np.nan,) * 4) for name in ordered])
    has_times = np.isfinite(known[:, 0]).all() and np.all(np.diff(known[:, 0]) > 0.0)
    start = known[0, 1:] if np.isfinite(known[0, 1:]).all() else np.zeros(3)
    has_truth = is_pyfg and np.isfinite(known[:, 1:]).all()
    left_out = len(read.ignored) + len(read.seen) - len(kept)
    notes = (f"{path.name}: {left_out} rows of other things left out",) if left_out else ()
    graph = SlamGraph(
        known[:, 0] - known[0, 0] if has_times else np.arange(len(ordered), dtype=np.float64),
        np.array(pairs, dtype=np.intp).reshape(-1, 2),
        np.array(steps).reshape(-1, 3),
        np.array(covs).reshape(-1, 3, 3),
        np.array([(index[a], of[b]) for a, b, _, _ in kept], dtype=np.intp).reshape(-1, 2),
        np.array([row[2] for row in kept]).reshape(-1, 2),
        np.array([row[3] for row in kept]).reshape(-1, 2),
        tuple(name.lstrip(_LETTERS) for name in places),
        np.array([*start[:2], float(half_turn(start[2]))]),
        np.full(3, START_SIGMA),
        known[:, 1:] if has_truth else np.zeros((0, 3)),
    )
    return graph, notes
