"""The start: relative pose of two images, by essential matrix and by homography, and first points.

References
----------
.. [1] D. Nister, "An Efficient Solution to the Five-Point Relative Pose Problem", PAMI 26, 2004.
.. [2] E. Malis, M. Vargas, "Deeper Understanding of the Homography Decomposition for Vision-Based
   Control", INRIA 6303, 2007.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.extras import opencv
from ssm_graph.systems.visual_ranges.geometry import (
    Pose,
    Triangulated,
    reprojection_square,
    triangulate,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_MATCHES: Final = 80
LEAST_POINTS: Final = 50
LEAST_PARALLAX: Final = np.deg2rad(1.0)
_POINT_PARALLAX: Final = np.deg2rad(0.5)
_EPIPOLAR_PIXELS: Final = 1.0
_HOMOGRAPHY_PIXELS: Final = 2.0
_REPROJECTION_PIXELS: Final = 2.0
_RIVAL_SHARE: Final = 0.75


class Start(NamedTuple):
    """Two poses and the points they see; the median depth in the first is 1."""

    pose: Pose
    """of the second image; the first is the identity"""
    points: Array
    """(n, 3)"""
    good: Mask
    """(n,) points that may be used"""


class NoStart(NamedTuple):
    """Why two images do not start a map."""

    reason: str


def two_view(xy1: Array, xy2: Array, focal: float) -> Start | NoStart:
    """Return the start from matched normalised coordinates (n, 2), focal length in pixels."""
    if len(xy1) < LEAST_MATCHES:
        return NoStart(f"{len(xy1)} matches, {LEAST_MATCHES} needed")
    found: list[tuple[int, int, Pose, Triangulated, Mask]] = []
    for R, t in _hypotheses(xy1, xy2, focal):
        made = triangulate(np.eye(3), np.zeros(3), R, t, xy1, xy2)
        scale = np.full((len(xy1), 2), focal / _REPROJECTION_PIXELS)
        fits = reprojection_square(np.eye(3), np.zeros(3), made.points, xy1, scale) < 1.0
        fits &= reprojection_square(R, t, made.points, xy2, scale) < 1.0
        fits &= (made.depth > 0.0).all(axis=1)
        good = fits & (made.parallax > _POINT_PARALLAX)
        found.append((int(good.sum()), len(found), Pose(R, t), made, good))
    if not found:
        return NoStart("neither an essential matrix nor a homography fits")
    found.sort(key=lambda entry: (-entry[0], entry[1]))
    n_good, _, pose, made, good = found[0]
    if n_good < LEAST_POINTS:
        return NoStart(f"{n_good} points in front of both cameras, {LEAST_POINTS} needed")
    parallax = float(np.median(made.parallax[good]))
    if parallax < LEAST_PARALLAX:
        return NoStart(f"parallax {np.rad2deg(parallax):.2f} deg: move sideways")
    rivals = [n for n, _, other, _, _ in found[1:] if _differ(pose, other)]
    if rivals and rivals[0] > _RIVAL_SHARE * n_good:
        return NoStart(f"two motions fit, {n_good} and {rivals[0]} points: a plane, or no parallax")
    depth = float(np.median(made.points[good, 2]))
    return Start(Pose(pose.R_cw, pose.t_cw / depth), made.points / depth, good)


def _differ(a: Pose, b: Pose) -> bool:
    """Return whether two relative poses are more than 3 deg apart in rotation or direction."""
    turn = (np.trace(a.R_cw.T @ b.R_cw) - 1.0) / 2.0
    along = a.t_cw @ b.t_cw / (np.linalg.norm(a.t_cw) * np.linalg.norm(b.t_cw))
    return bool(min(turn, along) < np.cos(np.deg2rad(3.0)))


def _hypotheses(xy1: Array, xy2: Array, focal: float) -> list[tuple[Array, Array]]:
    """Return relative poses, translation of length 1, by both models."""
    cv2 = opencv()
    found: list[tuple[Array, Array]] = []
    E, _ = cv2.findEssentialMat(
        xy1, xy2, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=_EPIPOLAR_PIXELS / focal
    )
    if E is not None and E.shape[0] % 3 == 0:
        for i in range(E.shape[0] // 3):
            R1, R2, t = cv2.decomposeEssentialMat(E[3 * i : 3 * i + 3])
            found += [(R, sign * t[:, 0]) for R in (R1, R2) for sign in (1.0, -1.0)]
    H, _ = cv2.findHomography(xy1, xy2, cv2.RANSAC, _HOMOGRAPHY_PIXELS / focal)
    if H is not None:
        _, turns, shifts, _ = cv2.decomposeHomographyMat(H, np.eye(3))
        for R, t in zip(turns, shifts, strict=True):
            length = float(np.linalg.norm(t))
            if length > 1e-9:
                found.append((R, t[:, 0] / length))
    return found
