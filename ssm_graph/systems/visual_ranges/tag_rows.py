"""Rows of a path that few marks and ranges hold together: what each measures, and by how much.

Marks of known numbers (April tags) are seen too seldom for a pose an image, so that the path is a
smooth one: every knot has a pose, a velocity and a turn rate, whose accelerations are white. A mark
is seen by a left camera and by a right one, whose axes and distance are known but for a little; a
range hangs on the knot that is nearest in time. Blocks of a knot are rotation ``R_mc @ Exp(phi)``,
a shift along the camera's axes (m), velocity (map axes, m/s), turn rate (camera axes, rad/s), and
the bias of each anchor, which walks as antennas turn; constants are marks, anchors, the ranges'
clock, the right camera's turn and the logarithm of the baseline's factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.reprojection import reprojection_residual
from factors.scaled_range import scaled_range_residual
from factors.so3 import Jacobians, exp, left_jacobian, log, skew
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.systems.visual_ranges.camera import Camera

Indices = NDArray[np.intp]

DIM: Final = 12
"""States of a knot, but for the biases."""
N_RIG: Final = 5
"""Constants after marks and anchors: clock, turn of the right camera, baseline."""


class TagSightings(NamedTuple):
    """Marks seen in the images of one camera, or two that are rectified together."""

    camera: Camera
    time_s: Array
    """(n,) never falling"""
    tag: Indices
    """(n,) number of each mark"""
    left: Array
    """(n, 2) pixels"""
    right: Array
    """(n, 2) pixels, NaN where not seen"""
    baseline_m: float
    """Of the right camera along x."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TagProblem(ReadOnlyArrays):
    """All that was measured; marks are numbered from 0."""

    time_s: Array
    """(K,) of the knots"""
    knot: Indices
    """(n,) of each sighting, never falling"""
    tag: Indices
    """(n,)"""
    seen: Array
    """(n, 2, 2) normalised coordinates in the left and the right image; NaN where not seen"""
    seen_sigma: float
    """Of a normalised coordinate."""
    baseline_m: float
    """From the left camera to the right, along x; as stated."""
    range_knot: Indices
    """(M,) of each range, never falling"""
    delay_s: Array
    """(M,) time of each range less that of its knot"""
    anchor: Indices
    """(M,)"""
    range_m: Array
    """(M,)"""
    range_sigma: Array
    """(M,) m"""
    lever_arm_m: Array
    """(3,) left camera to antenna, camera axes"""

    def window(self, begin: int, end: int, tags: Indices) -> TagProblem:
        """Return what knots from ``begin`` up to ``end`` measure, of these marks, counted anew."""
        seen = slice(*np.searchsorted(self.knot, (begin, end)))
        heard = slice(*np.searchsorted(self.range_knot, (begin, end)))
        column = np.zeros(int(self.tag.max(initial=0)) + 1, dtype=np.intp)
        column[tags] = np.arange(len(tags))
        return TagProblem(
            self.time_s[begin:end], self.knot[seen] - begin, column[self.tag[seen]],
            self.seen[seen], self.seen_sigma, self.baseline_m, self.range_knot[heard] - begin,
            self.delay_s[heard], self.anchor[heard], self.range_m[heard],
            self.range_sigma[heard], self.lever_arm_m,
        )  # fmt: skip


class TagValues(NamedTuple):
    """Where a solution stands."""

    R_mc: Array
    """(K, 3, 3) camera to map"""
    place: Array
    """(K, 3) of the left camera, m"""
    velocity: Array
    """(K, 3) map axes, m/s"""
    rate: Array
    """(K, 3) camera axes, rad/s"""
    tags: Array
    """(T, 3) m"""
    anchors: Array
    """(J, 3) m; none before the ranges have a start"""
    biases: Array
    """(K, J) m"""
    clock_s: float
    """Time of a range less its stamp."""
    turn: Array
    """(3,) rotation vector of the right camera's axes in those of the left, rad"""
    log_base: float = 0.0
    """Of the true baseline over the stated one."""

    @property
    def dim(self) -> int:
        """States of a knot, n."""
        return DIM + len(self.anchors)

    @property
    def n_constants(self) -> int:
        """C."""
        return 3 * len(self.tags) + 3 * len(self.anchors) + N_RIG

    def moved(self, step: Array, constants: Array) -> TagValues:
        """Return the values after a step (K, n) of the knots and one (C,) of the constants."""
        T = 3 * len(self.tags)
        return TagValues(
            self.R_mc @ exp(step[:, :3]),
            self.place + np.einsum("kij,kj->ki", self.R_mc, step[:, 3:6]),
            self.velocity + step[:, 6:9],
            self.rate + step[:, 9:DIM],
            self.tags + constants[:T].reshape(-1, 3),
            self.anchors + constants[T:-N_RIG].reshape(-1, 3),
            self.biases + step[:, DIM:],
            self.clock_s + float(constants[-5]),
            log(exp(self.turn) @ exp(constants[-4:-1])),
            self.log_base + float(constants[-1]),
        )

    def times(self, scale: float) -> TagValues:
        """Return the values in a unit that is so many times shorter."""
        return self._replace(
            place=scale * self.place, velocity=scale * self.velocity, tags=scale * self.tags,
            anchors=scale * self.anchors, log_base=self.log_base + float(np.log(scale)),
        )  # fmt: skip


class OwnRows(NamedTuple):
    """Whitened rows of single knots; zero where nothing was seen."""

    knot: Indices
    """(m,)"""
    rows: Array
    """(m, 12 + C)"""
    error: Array
    """(m,) predicted minus measured"""


def sighting_rows(problem: TagProblem, values: TagValues) -> OwnRows:
    """Return the four rows (4 n, ...) of each sighting: left x, y, right x, y."""
    k, n, dim = problem.knot, len(problem.knot), values.dim
    R, p, X = values.R_mc[k], values.place[k], values.tags[problem.tag]
    base = np.array([problem.baseline_m * np.exp(values.log_base), 0.0, 0.0])
    rows, error = np.zeros((n, 2, 2, dim + values.n_constants)), np.zeros((n, 2, 2))
    m, two = np.arange(n)[:, None, None], np.arange(2)[:, None]
    at = (dim + 3 * problem.tag[:, None] + np.arange(3))[:, None, :]
    for side, (offset, turn) in enumerate(((0.0 * base, np.eye(3)), (base, exp(values.turn)))):
        found = reprojection_residual(R @ turn, p + R @ offset, X, seen=problem.seen[:, side])
        by_turn = found.error_D_pose[..., :3]
        by_shift = found.error_D_pose[..., 3:] @ turn.T
        rows[:, side, :, :3] = by_turn @ turn.T - by_shift @ skew(offset)
        rows[:, side, :, 3:6] = by_shift
        rows[:, side][m, two, at] = found.error_D_point
        if side:
            rows[:, side, :, -4:-1], rows[:, side, :, -1] = by_turn, by_shift @ offset
        error[:, side] = found.error
    there = np.isfinite(problem.seen)
    scale = there / problem.seen_sigma
    rows, error = rows * scale[..., None], np.where(there, error, 0.0) * scale
    return OwnRows(np.repeat(k, 4), rows.reshape(4 * n, -1), error.reshape(-1))


def range_rows(problem: TagProblem, values: TagValues) -> OwnRows:
    """Return a row (M, ...) of each range; none before anchors are known."""
    dim, T = values.dim, len(values.tags)
    width = dim + values.n_constants
    if not len(values.anchors):
        return OwnRows(np.zeros(0, dtype=np.intp), np.zeros((0, width)), np.zeros(0))
    k, j, n = problem.range_knot, problem.anchor, len(problem.range_m)
    after = problem.delay_s + values.clock_s
    v, w = values.velocity[k], values.rate[k]
    gone = after[:, None] * w
    turned = exp(gone)
    found = scaled_range_residual(
        values.R_mc[k] @ turned,
        values.place[k],
        np.zeros(n),
        values.anchors[j],
        values.biases[k, j],
        after,
        range_m=problem.range_m,
        lever_arm_c=problem.lever_arm_m,
        velocity_m=v,
    )
    rows, m = np.zeros((n, width)), np.arange(n)
    by_turn = found.error_D_rotation[:, None]
    rows[:, :3] = (by_turn @ turned.mT)[:, 0]
    rows[:, 9:12] = after[:, None] * (by_turn @ left_jacobian(-gone))[:, 0]
    rows[:, 3:6] = (found.error_D_position[:, None] @ turned.mT)[:, 0]
    rows[:, 6:9] = -after[:, None] * found.error_D_anchor
    rows[m, DIM + j] = 1.0
    at = (dim + 3 * (T + j))[:, None] + np.arange(3)
    rows[m[:, None], at] = found.error_D_anchor
    rows[:, -5] = found.error_D_clock + (by_turn @ w[..., None])[:, 0, 0]
    white = 1.0 / problem.range_sigma
    return OwnRows(k, rows * white[:, None], found.error * white)


def motion_rows(time_s: Array, values: TagValues, density: Array) -> tuple[Array, Array]:
    """Return whitened rows (K - 1, n, 2 n) from each knot to the next, and errors (K - 1, n).

    Accelerations of rotation and place are white, and so are the rates of biases; ``density`` (3,)
    of all, rad^2/s^3, m^2/s^3 and m^2/s.
    """
    dt = np.diff(time_s)[:, None]
    R, p, v, w = values[:4]
    turn = log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
    back = Jacobians.of(turn).left_inverse()
    n, dim = len(dt), values.dim
    J, error = np.zeros((n, dim, 2 * dim)), np.zeros((n, dim))
    own, next_ = J[..., :dim], J[..., dim:]
    long = dt[:, :, None] * np.eye(3)
    error[:, :3] = turn - dt * w[:-1]
    error[:, 3:6] = p[1:] - p[:-1] - dt * v[:-1]
    error[:, 6:9], error[:, 9:12] = v[1:] - v[:-1], w[1:] - w[:-1]
    error[:, DIM:] = np.diff(values.biases, axis=0)
    own[:, :3, :3], next_[:, :3, :3] = -back, back.mT  # of -turn: the right one
    own[:, :3, 9:12] = own[:, 3:6, 6:9] = -long
    own[:, 3:6, 3:6], next_[:, 3:6, 3:6] = -R[:-1], R[1:]
    same = np.arange(6, dim)
    own[:, same, same], next_[:, same, same] = -1.0, 1.0
    # Inverse Cholesky factor of [[t^3/3, t^2/2], [t^2/2, t]] for each axis: the rate first.
    white = np.ones((n, dim))
    for near, far, q in (
        (slice(0, 3), slice(9, 12), density[0]),
        (slice(3, 6), slice(6, 9), density[1]),
    ):
        J[:, near] -= 0.5 * dt[..., None] * J[:, far]
        error[:, near] -= 0.5 * dt * error[:, far]
        white[:, near], white[:, far] = np.sqrt(12.0 / (q * dt**3)), 1.0 / np.sqrt(q * dt)
    white[:, DIM:] = 1.0 / np.sqrt(density[2] * dt)
    return J * white[..., None], error * white
