"""From image to image: corners followed by optical flow, and the pose that their points give.

A frame's pose is kept relative to its key frame, so that it follows every adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.extras import opencv
from ssm_graph.systems.visual_ranges.features import Image, flow
from ssm_graph.systems.visual_ranges.geometry import Pose, in_camera, refine_pose
from ssm_graph.systems.visual_ranges.settings import VisualSettings
from ssm_graph.systems.visual_ranges.views import seen_from
from ssm_graph.systems.visual_ranges.visual_map import DROPPED, VisualMap

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

OUTLIER_PIXELS: Final = 3.5
_LEAST_SHARE: Final = 0.3


class Tracks(NamedTuple):
    """Corners as they are followed."""

    track: Indices
    """(n,)"""
    pixel: Array
    """(n, 2) in the newest image"""

    def kept(self, mask: Mask) -> Tracks:
        """Return some of them."""
        return Tracks(self.track[mask], self.pixel[mask])

    def joined(self, other: Tracks) -> Tracks:
        """Return both."""
        return Tracks(
            np.concatenate([self.track, other.track]), np.concatenate([self.pixel, other.pixel])
        )

    @classmethod
    def none(cls) -> Tracks:
        """Return no tracks."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))


@dataclass
class Followed:
    """What one image gave."""

    pose: Pose | None
    n_points: int
    tracks: Tracks = field(default_factory=Tracks.none)
    depth: float = 1.0
    """median of the points seen, map units"""


class Tracker:
    """Follows the newest tracks through the images."""

    def __init__(self, camera: Camera, world: VisualMap, settings: VisualSettings) -> None:
        self._camera, self._world, self._settings = camera, world, settings
        self.tracks = Tracks.none()
        self.image: Image | None = None
        self.reference = 0
        self.relative = Pose(np.eye(3), np.zeros(3))
        """newest pose from that of the reference key frame"""
        self.velocity = Pose(np.eye(3), np.zeros(3))
        self.depth = 1.0
        self.unit = 1.0
        """of relative, velocity and depth: by how much the map around the reference key frame had
        grown when they were found; the mapping beside never touches them"""

    def whitening(self, n: int) -> Array:
        """Return one over the sigma of ``n`` tracked corners, in normalised coordinates."""
        return self._scale(np.zeros(n, dtype=np.int64))

    def _scale(self, octave: Indices) -> Array:
        return focal_scale(self._camera, octave, self._settings.pixel_sigma)

    def pose(self) -> Pose:
        """Return the newest pose, in the map as it was when it was caught up with."""
        return self.relative.after(self._world.pose(self.reference))

    def set_pose(self, pose: Pose, reference: int) -> None:
        """Hang the newest pose on a key frame."""
        self.reference = reference
        self.relative = pose.after(self._world.pose(reference).inverse())
        self.unit = float(self._world.frames["grown"][reference])

    def _catch_up(self) -> None:
        """Follow a change of the map's scale around the reference key frame."""
        unit = float(self._world.frames["grown"][self.reference])
        scale, self.unit = unit / self.unit, unit
        self.relative = Pose(self.relative.R_cw, scale * self.relative.t_cw)
        self.velocity = Pose(self.velocity.R_cw, scale * self.velocity.t_cw)
        self.depth *= scale

    def start(self, image: Image, tracks: Tracks, pose: Pose, reference: int) -> None:
        """Begin anew at an image whose pose and tracks are known, at rest."""
        self.image, self.tracks = image, tracks
        self.velocity = Pose(np.eye(3), np.zeros(3))
        self.set_pose(pose, reference)
        self.depth = float(self._world.frames["depth"][reference])

    def follow(self, image: Image) -> Followed:
        """Return the pose of the next image; none when too little is left."""
        assert self.image is not None
        with self._world.lock:
            self._catch_up()
            before, key_pose = self.pose(), self._world.pose(self.reference)
            point = self._world.tracks["point"][self.tracks.track]
            alive = point != DROPPED
            tracks, point = self.tracks.kept(alive), point[alive]
            places = self._world.points["place"][np.maximum(point, 0)]
        predicted = self.velocity.after(before)
        answer = None
        for start in (predicted, before):
            guess = self._guesses(tracks, point, places, before, start)
            pixel, found = flow(self.image, image, tracks.pixel, guess)
            answer = self._pose(tracks, point, places, pixel, found, start)
            if answer.pose is not None:
                break
        assert answer is not None
        if answer.pose is not None:
            self.velocity = answer.pose.after(before.inverse())
            self.relative = answer.pose.after(key_pose.inverse())
            self.tracks, self.image = answer.tracks, image
            self.depth = answer.depth
        return answer

    def renew(self, key_image: Image, given: Tracks, made: Tracks) -> None:
        """Take over what a key frame's mapping made of the tracks it was given.

        Corners measured anew move by as much here; what is new is followed from the key frame's
        image to the newest one.
        """
        assert self.image is not None
        with self._world.lock:
            self._catch_up()
            pose, key_pose = self.pose(), self._world.pose(self.reference)
            point = self._world.tracks["point"][made.track]
            places = self._world.points["place"][np.maximum(point, 0)]
        size = int(max(made.track.max(initial=0), self.tracks.track.max(initial=0))) + 1
        shift, is_made = np.zeros((size, 2)), np.zeros(size, dtype=bool)
        is_given = np.zeros(size, dtype=bool)
        shift[made.track], is_made[made.track] = made.pixel, True
        is_given[given.track] = True
        both = is_made[given.track]
        shift[given.track[both]] -= given.pixel[both]
        on = is_made[self.tracks.track]
        old = self.tracks.kept(on)
        fresh = ~is_given[made.track]
        new = made.kept(fresh)
        if self.image is key_image:
            moved = new
        else:
            guess = self._guesses(new, point[fresh], places[fresh], key_pose, pose)
            pixel, found = flow(key_image, self.image, new.pixel, guess)
            moved = Tracks(new.track, pixel).kept(found)
        self.tracks = Tracks(old.track, old.pixel + shift[old.track]).joined(moved)

    def _guesses(
        self, tracks: Tracks, point: Indices, places: Array, before: Pose, pose: Pose
    ) -> Array:
        """Return where tracks should be; those without a point at the median depth."""
        xy = self._camera.normalise(tracks.pixel)
        x_c = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) * self.depth
        assumed = (x_c - before.t_cw) @ before.R_cw
        seen = seen_from(self._camera, pose, np.where((point >= 0)[:, None], places, assumed))
        return np.where(seen.inside[:, None], seen.pixel, tracks.pixel)

    def _pose(
        self, tracks: Tracks, point: Indices, places: Array, pixel: Array, found: Mask, start: Pose
    ) -> Followed:
        known = np.flatnonzero(found & (point >= 0))
        least = self._settings.least_inliers
        if len(known) < least:
            return Followed(None, len(known))
        xy = self._camera.normalise(pixel[known])
        scale = self.whitening(len(known))
        limit = (OUTLIER_PIXELS / self._settings.pixel_sigma) ** 2
        refined = refine_pose(start, places[known], xy, scale)
        good = refined.square < limit
        if good.sum() < max(least, _LEAST_SHARE * len(known)):
            guess = pose_by_sampling(places[known], xy, OUTLIER_PIXELS / self._camera.fx)
            if guess is None:
                return Followed(None, int(good.sum()))
            refined = refine_pose(guess, places[known], xy, scale)
            good = refined.square < limit
            if good.sum() < max(least, _LEAST_SHARE * len(known)):
                return Followed(None, int(good.sum()))
        kept = found.copy()
        kept[known[~good]] = False
        depth = float(np.median(in_camera(refined.pose, places[known[good]])[:, 2]))
        return Followed(
            refined.pose, int(good.sum()), Tracks(tracks.track[kept], pixel[kept]), depth
        )


def focal_scale(camera: Camera, octave: Indices, pixel_sigma: float) -> Array:
    """Return one over the sigma (n, 2) of normalised coordinates, by octave (n,)."""
    sigma = pixel_sigma * 1.2 ** octave.astype(np.float64)
    return np.stack([camera.fx / sigma, camera.fy / sigma], axis=1)


def pose_by_sampling(places: Array, xy: Array, tolerance: float) -> Pose | None:
    """Return a pose by P3P on samples, or None; ``tolerance`` in normalised coordinates."""
    cv2 = opencv()
    if len(places) < 6:
        return None
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        places, xy, np.eye(3), None, iterationsCount=200, reprojectionError=tolerance,
        confidence=0.999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not ok or inliers is None or len(inliers) < 6:
        return None
    return Pose(cv2.Rodrigues(turn)[0], shift[:, 0])
