"""What a path lets ranges tell of scale and anchors, and how to move so that they tell more.

Squared ranges are linear in ``s^2``, ``s a`` and ``|a|^2`` with rows ``(|c|^2, c, 1)`` of the
places ``c``; these lose rank exactly where all places lie on a common plane or sphere. So a line
leaves a circle of anchors, a plane a mirror, a sphere exchanges the distance of the anchor with its
own radius, and a circle in a plane, being on both, leaves a whole family of scales.
"""

from __future__ import annotations

from enum import Enum
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array

STILL_DEPTHS: Final = 0.02
"""Map units, about depths of the scene: a path that spreads less stands still."""
TURNED_RAD: Final = 0.17
NEAR_SHAPE: Final = 0.02
"""A path is on a shape where its distance from it is less than such a share of its spread."""
NEAR_SIGMAS: Final = 0.5
"""Or less than so many sigmas of a range."""
BEND_SIGMAS: Final = 3.0
"""Up to which a bend of the ranges is none."""


class Motion(Enum):
    """The shape of a path, and what ranges from it leave open."""

    STILL = "the camera has not moved: nothing is observable"
    ROTATION = "the camera has only turned: nothing is observable"
    LINE = "a straight line: the anchor lies anywhere on a circle about it"
    LINE_THROUGH_ANCHOR = "a straight line through the anchor: its direction is not observable"
    PLANE = "a plane: the anchor has a mirror image on its other side"
    CIRCLE = "a circle in a plane: scale and anchor have a whole family of solutions"
    CIRCLE_ABOUT_ANCHOR = (
        "a circle in a plane about the anchor's axis: scale and anchor have a whole family of "
        "solutions"
    )
    SPHERE = "a sphere: exactly two scales and anchors explain the ranges"
    GENERAL = "in all directions: everything is observable"

    @property
    def leaves_scale(self) -> bool:
        """Whether the scale is not observable from one anchor."""
        lost = (Motion.STILL, Motion.ROTATION, Motion.CIRCLE, Motion.CIRCLE_ABOUT_ANCHOR)
        return self in (*lost, Motion.SPHERE)


class Shape(NamedTuple):
    """A path's shape."""

    motion: Motion
    spread: tuple[float, float, float]
    """Standard deviations along its principal axes, largest first, in the units of the path."""
    axes: Array
    """(3, 3) principal axes as rows"""
    off_shape: float
    """Root mean square of its distance from the shape."""


def shape_of(
    path: Array,
    *,
    scale: float,
    sigma_m: float,
    turned_rad: float = 0.0,
    range_m: Array | None = None,
) -> Shape:
    """Return the simplest shape that a path is on.

    Parameters
    ----------
    path : (N, 3) map units.
    scale : metres a map unit, as far as known.
    sigma_m : of a range; what is off a shape by less than half of it is on it.
    turned_rad : largest angle between two of the camera's axes.
    range_m : (N,) to one anchor, NaN where of another one or not in line of sight.
    """
    centred = path - path.mean(axis=0)
    _, singular, axes = np.linalg.svd(centred, full_matrices=False)
    first, second, third = (float(x) for x in singular / np.sqrt(len(path)))
    spread = (first, second, third)
    if first < STILL_DEPTHS:
        motion = Motion.ROTATION if turned_rad > TURNED_RAD else Motion.STILL
        return Shape(motion, spread, axes, first)
    near = max(NEAR_SHAPE * first, NEAR_SIGMAS * sigma_m / scale)
    if second < near:
        return Shape(_line(centred @ axes[0], range_m, sigma_m), spread, axes, second)
    on_circle = _off_sphere(centred @ axes[:2].T)
    if third < near:
        if on_circle < near:
            still = range_m is not None and float(np.nanstd(range_m)) < 3.0 * sigma_m
            motion = Motion.CIRCLE_ABOUT_ANCHOR if still else Motion.CIRCLE
            return Shape(motion, spread, axes, float(np.hypot(third, on_circle)))
        return Shape(Motion.PLANE, spread, axes, third)
    on_sphere = _off_sphere(centred)
    if on_sphere < near / 2.0:
        return Shape(Motion.SPHERE, spread, axes, on_sphere)
    return Shape(Motion.GENERAL, spread, axes, min(third, on_sphere))


def _line(along: Array, range_m: Array | None, sigma_m: float) -> Motion:
    """Return whether ranges (N,) bend along a line: they do not where it leads to the anchor."""
    if range_m is None:
        return Motion.LINE
    known = np.isfinite(range_m)
    rows = np.vander(along[known] / max(float(np.abs(along).max()), 1e-12), 3)
    inverse = np.linalg.pinv(rows)
    bend, sigma = float(inverse[0] @ range_m[known]), sigma_m * float(np.linalg.norm(inverse[0]))
    return Motion.LINE_THROUGH_ANCHOR if abs(bend) < BEND_SIGMAS * sigma else Motion.LINE


def _off_sphere(places: Array) -> float:
    """Return the rms distance of places (N, d) from the circle or sphere nearest to them."""
    rows = np.column_stack([2.0 * places, np.ones(len(places))])
    square = np.einsum("ni,ni->n", places, places)
    found = np.linalg.lstsq(rows, square, rcond=1e-10)[0]
    centre = found[:-1]
    radius = np.sqrt(max(float(found[-1] + centre @ centre), 0.0))
    return float(np.sqrt(np.mean((np.linalg.norm(places - centre, axis=1) - radius) ** 2)))


def advice(shape: Shape, *, scale: float, name: str, weakest: Array | None = None) -> str:
    """Return how to move so that scale and anchor become observable.

    Parameters
    ----------
    scale : metres a map unit, as far as known.
    name : of the anchor.
    weakest : (3,) direction, map axes, in which the anchor is known least.
    """
    out_cm = 100.0 * scale * shape.spread[2]
    how = {
        Motion.STILL: "move the camera: half a metre or more, in all directions",
        Motion.ROTATION: "move the camera, half a metre or more: turning shows neither scale nor "
        "anchor",
        Motion.LINE: "move sideways and up or down by 0.5 m",
        Motion.LINE_THROUGH_ANCHOR: f"move across the line to anchor {name}, in two directions, by "
        "0.5 m or more",
        Motion.PLANE: f"out-of-plane motion {out_cm:.0f} cm: move out of the plane by 0.5 m",
        Motion.CIRCLE: f"out-of-plane motion {out_cm:.0f} cm: move out of the plane by 0.5 m, or "
        f"towards the anchor {name}",
        Motion.CIRCLE_ABOUT_ANCHOR: f"out-of-plane motion {out_cm:.0f} cm: move out of the plane "
        f"by 0.5 m, and towards the anchor {name}",
        Motion.SPHERE: "leave the sphere: move towards its middle, by 0.5 m or more",
        Motion.GENERAL: "go on moving, in all directions and nearer to the anchor",
    }[shape.motion]
    if shape.motion is Motion.GENERAL and weakest is not None:
        axis = int(np.argmax(np.abs(weakest)))
        where = ("to the side", "up or down", "ahead or back")[axis]
        how = f"{how}; most of all {where} as the first image saw it"
    return how
