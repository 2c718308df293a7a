"""How points of the map look from a pose: where they are seen, and under which change of view."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.features import (
    EDGE_PIXELS,
    N_OCTAVES,
    OCTAVE_FACTOR,
    Image,
)
from ssm_graph.systems.visual_ranges.geometry import Pose, in_camera
from ssm_graph.systems.visual_ranges.patches import Aligned, align
from ssm_graph.systems.visual_ranges.visual_map import VisualMap

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_LEAST_COSINE: Final = 0.5
_SCALE_RANGE: Final = (0.4, 2.5)


class Seen(NamedTuple):
    """Points as a pose should see them."""

    pixel: Array
    """(n, 2)"""
    depth: Array
    """(n,)"""
    inside: Mask
    """(n,) ahead and in the image"""


def seen_from(camera: Camera, pose: Pose, places: Array) -> Seen:
    """Return where places (n, 3) appear."""
    x_c = in_camera(pose, places)
    pixel = camera.project(x_c)
    # Distortion folds what is far outside back in: only what is within reach of the lens counts.
    wide = 1.3 * np.hypot(camera.width / camera.fx, camera.height / camera.fy) / 2.0
    near = np.hypot(x_c[:, 0], x_c[:, 1]) < wide * np.abs(x_c[:, 2])
    inside = (x_c[:, 2] > 1e-3) & near & camera.contains(pixel, EDGE_PIXELS)
    return Seen(pixel, x_c[:, 2], inside)


class Change(NamedTuple):
    """How the view of a patch changes from the row it was first seen in."""

    affine: Array
    """(n, 2, 2) offsets here to offsets there, pixels"""
    scale: Array
    """(n,) size there over size here"""
    cosine: Array
    """(n,) of the angle between the two rays"""

    @property
    def usable(self) -> Mask:
        """Whether the patch can be compared at all (n,)."""
        low, high = _SCALE_RANGE
        return (self.cosine > _LEAST_COSINE) & (self.scale > low) & (self.scale < high)

    def octave(self, before: Indices) -> Indices:
        """Return the octave (n,) here of what was in octave ``before`` there."""
        shift = -np.log(np.maximum(self.scale, 1e-6)) / np.log(OCTAVE_FACTOR)
        return np.asarray(np.clip(np.round(before + shift), 0, N_OCTAVES - 1), dtype=np.int64)


def change_of_view(
    camera: Camera, world: VisualMap, rows: Indices, places: Array, pose: Pose
) -> Change:
    """Return the change from earlier rows to a pose, surfaces taken to face the earlier camera."""
    frame = world.rows["frame"][rows]
    R, t = world.frames["R_cw"][frame], world.frames["t_cw"][frame]
    depth = np.einsum("nj,nj->n", R[:, 2], places) + t[:, 2]
    pixel = world.rows["pixel"][rows]
    step = 4.0
    moved = []
    for offset in ((0.0, 0.0), (step, 0.0), (0.0, step)):
        xy = camera.normalise(pixel + np.array(offset))
        x_s = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) * depth[:, None]
        X = np.einsum("nji,nj->ni", R, x_s - t)
        moved.append(camera.project(in_camera(pose, X)))
    jacobian = np.stack([moved[1] - moved[0], moved[2] - moved[0]], axis=2) / step
    det = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
    good = np.isfinite(det) & (det > 0.05)
    affine = np.zeros_like(jacobian)
    affine[good] = np.linalg.inv(jacobian[good])
    scale = np.where(good, 1.0 / np.sqrt(np.where(good, det, 1.0)), 0.0)
    there = places + np.einsum("nji,nj->ni", R, t)
    here = places - pose.centre
    cosine = (there * here).sum(axis=1) / np.maximum(
        np.linalg.norm(there, axis=1) * np.linalg.norm(here, axis=1), 1e-12
    )
    return Change(affine, scale, cosine)


def aligned_rows(
    world: VisualMap, rows: Indices, affine: Array, image: Image, guess: Array
) -> Aligned:
    """Return where the patches of rows are in an image; likeness -1 where their image is gone."""
    frame = world.rows["frame"][rows]
    frames = np.unique(frame)
    kept = [int(k) for k in frames if int(k) in world.images]
    index = np.full(int(frame.max(initial=0)) + 1, -1)
    index[kept] = np.arange(len(kept))
    there = index[frame]
    on = there >= 0
    pixel, likeness = guess.copy(), np.full(len(rows), -1.0)
    found = align(
        [world.images[k] for k in kept], there[on], world.rows["pixel"][rows[on]], affine[on],
        image, guess[on],
    )  # fmt: skip
    pixel[on], likeness[on] = found.pixels, found.likeness
    return Aligned(pixel, likeness)
