"""From key frame to key frame: corners measured, points made, found again, adjusted, culled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.bundle import Adjusted, Effort, Problem, adjust, sorted_views
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.features import Image, corners, descriptors
from ssm_graph.systems.visual_ranges.geometry import Pose, reprojection_square, triangulate
from ssm_graph.systems.visual_ranges.settings import VisualSettings
from ssm_graph.systems.visual_ranges.tracking import Tracks, focal_scale
from ssm_graph.systems.visual_ranges.views import aligned_rows, change_of_view, seen_from
from ssm_graph.systems.visual_ranges.visual_map import DROPPED, VisualMap

if TYPE_CHECKING:
    from ssm_graph.systems.visual_ranges.metric import Metric

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_ALIKE: Final = 0.8
"""Correlation from which a patch is taken for the same."""
_UNLIKE: Final = 0.5
"""Correlation below which a followed corner is given up."""
_DRIFT_PIXELS: Final = 2.0
_FOUND_PIXELS: Final = 5.0
_SAME_PIXELS: Final = 2.0
_MOST_CANDIDATES: Final = 600
_NEW_POINT_SQUARE: Final = 9.0
_LOW_WEIGHT: Final = 0.41
"""About 3.5 sigmas."""
_NEIGHBOURS: Final = 20
_LEAST_SHARED: Final = 10


class Window(NamedTuple):
    """Key frames and points that are adjusted together."""

    frames: Indices
    """(K,) first the free ones"""
    n_free: int
    rows: Indices
    """(n,) observations"""
    points: Indices
    """(P,)"""


class Mapper:
    """Owns what happens to the map at a key frame."""

    def __init__(self, camera: Camera, world: VisualMap, settings: VisualSettings) -> None:
        self._camera, self._world, self._settings = camera, world, settings

    def insert(self, k: int, tracks: Tracks) -> Tracks:
        """Fill a new key frame with what was followed into it; return what to follow from there."""
        world = self._world
        image, pose = world.images[k], world.pose(k)
        tracks = self._measured(image, pose, tracks)
        tracks = tracks.joined(self._found_again(k, image, pose, tracks))
        fresh = corners(image, self._settings.n_corners, tracks.pixel)
        with world.lock:
            tracks = tracks.joined(Tracks(world.new_tracks(len(fresh)), fresh))
        self.add_rows(k, image, pose, tracks)
        self._make_points(k)
        return tracks

    def add_rows(self, k: int, image: Image, pose: Pose, tracks: Tracks) -> None:
        """Add key points of the newest key frame, each in its octave, described."""
        world = self._world
        octave = np.zeros(len(tracks.track), dtype=np.int64)
        point = world.tracks["point"][tracks.track]
        known = np.flatnonzero(point >= 0)
        if known.size:
            rows = world.points["row"][point[known]]
            places = world.points["place"][point[known]]
            change = change_of_view(self._camera, world, rows, places, pose)
            octave[known] = change.octave(world.rows["octave"][rows])
        world.add_rows(
            k, tracks.track, pixel=tracks.pixel, xy=self._camera.normalise(tracks.pixel),
            octave=octave, descriptor=descriptors(image, tracks.pixel, octave),
        )  # fmt: skip
        self.set_depth(k)

    def set_depth(self, k: int) -> None:
        """Note the median depth of the points that a key frame sees."""
        world = self._world
        point = world.rows["point"][world.observations(np.array([k]))]
        if point.size:
            pose = world.pose(k)
            depth = world.points["place"][point] @ pose.R_cw[2] + pose.t_cw[2]
            world.frames["depth"][k] = float(np.median(depth))

    def fill(self, k: int, image: Image, tracks: Tracks) -> Tracks:
        """Add fresh corners to the newest key frame, and return all to follow."""
        fresh = corners(image, self._settings.n_corners, tracks.pixel)
        new = Tracks(self._world.new_tracks(len(fresh)), fresh)
        self.add_rows(k, image, self._world.pose(k), new)
        return tracks.joined(new)

    def _measured(self, image: Image, pose: Pose, tracks: Tracks) -> Tracks:
        """Return the tracks measured against the images they were first seen in.

        What is not like it any more is given up; what has changed too much to compare stays.
        """
        world = self._world
        point = world.tracks["point"][tracks.track]
        first = world.tracks["first"][tracks.track]
        row = np.where(point >= 0, world.points["row"][np.maximum(point, 0)], first)
        on = np.flatnonzero((point != DROPPED) & (first >= 0))
        change = change_of_view(
            self._camera, world, row[on], self._assumed(row[on], point[on]), pose
        )
        on, affine = on[change.usable], change.affine[change.usable]
        found = aligned_rows(world, row[on], affine, image, tracks.pixel[on])
        moved = np.linalg.norm(found.pixels - tracks.pixel[on], axis=1)
        better = (found.likeness > _ALIKE) & (moved < _DRIFT_PIXELS)
        pixel = tracks.pixel.copy()
        pixel[on[better]] = found.pixels[better]
        kept = point != DROPPED
        kept[on[~better & (found.likeness < _UNLIKE)]] = False
        return Tracks(tracks.track, pixel).kept(kept)

    def _assumed(self, rows: Indices, point: Indices) -> Array:
        """Return the places of points; of what has none, that at its key frame's median depth."""
        world = self._world
        frame = world.rows["frame"][rows]
        x_c = np.concatenate([world.rows["xy"][rows], np.ones((len(rows), 1))], axis=1)
        x_c *= world.frames["depth"][frame][:, None]
        R, t = world.frames["R_cw"][frame], world.frames["t_cw"][frame]
        assumed = np.einsum("nji,nj->ni", R, x_c - t)
        places = world.points["place"][np.maximum(point, 0)]
        return np.where((point >= 0)[:, None], places, assumed)

    def _found_again(self, k: int, image: Image, pose: Pose, tracks: Tracks) -> Tracks:
        """Return new tracks of points of the local map that were not followed but are seen."""
        world = self._world
        point = world.tracks["point"][tracks.track]
        candidates = self._local_points(k, point[point >= 0])
        if not candidates.size:
            return Tracks.none()
        places = world.points["place"][candidates]
        seen = seen_from(self._camera, pose, places)
        rows = world.points["row"][candidates]
        change = change_of_view(self._camera, world, rows, places, pose)
        on = np.flatnonzero(seen.inside & change.usable)[:_MOST_CANDIDATES]
        world.points["n_expected"][candidates[on]] += 1
        found = aligned_rows(world, rows[on], change.affine[on], image, seen.pixel[on])
        moved = np.linalg.norm(found.pixels - seen.pixel[on], axis=1)
        good = (found.likeness > _ALIKE) & (moved < _FOUND_PIXELS)
        good &= self._camera.contains(found.pixels, 10.0)
        chosen, pixel = candidates[on[good]], found.pixels[good]
        world.points["n_found"][chosen] += 1
        # What lies on a corner that is followed is that corner.
        if len(tracks.pixel) and len(pixel):
            gap = ((pixel[:, None] - tracks.pixel[None]) ** 2).sum(axis=2)
            nearest = gap.argmin(axis=1)
            close = gap[np.arange(len(pixel)), nearest] < _SAME_PIXELS**2
            with world.lock:
                self._join(chosen[close], tracks.track[nearest[close]])
            chosen, pixel = chosen[~close], pixel[~close]
        apart = _first_of_each(pixel, _SAME_PIXELS)
        chosen, pixel = chosen[apart], pixel[apart]
        return Tracks(world.new_tracks(len(chosen), chosen), pixel)

    def _join(self, points: Indices, track: Indices) -> None:
        """Say that tracks show points: those without a point get it, others are fused."""
        world = self._world
        if not track.size:
            return
        _, first = np.unique(track, return_index=True)
        points, track = points[first], track[first]
        own = world.tracks["point"][track]
        free = own < 0
        world.tracks["point"][track[free]] = points[free]
        row, point = world.tracks["last"][track[free]], points[free]
        while row.size:
            on = row >= 0
            row, point = row[on], point[on]
            world.rows["point"][row] = point
            np.add.at(world.points["views"], point, 1)
            row = world.rows["previous"][row]
        kept, gone = points[~free], own[~free]
        swap = world.points["views"][gone] > world.points["views"][kept]
        world.fuse(np.where(swap, gone, kept), np.where(swap, kept, gone))

    def _local_points(self, k: int, followed: Indices) -> Indices:
        """Return points that neighbours of key frame ``k`` see and that are not followed."""
        world = self._world
        mine = np.zeros(world.points.size, dtype=bool)
        mine[followed] = True
        count = world.views_by_frame(mine)
        count[k] = 0
        frames = np.argsort(-count, kind="stable")[:_NEIGHBOURS]
        frames = frames[count[frames] > 0]
        local = np.unique(world.rows["point"][world.observations(frames)])
        return np.asarray(local[world.points["valid"][local] & ~mine[local]])

    def _make_points(self, k: int) -> None:
        """Make points of tracks that end in key frame ``k`` and have parallax enough by now."""
        world = self._world
        rows = np.arange(*world.rows_of(k).indices(world.rows.size))
        track = world.rows["track"][rows]
        first = world.tracks["first"][track]
        on = (world.tracks["point"][track] == -1) & (first < rows)
        rows, track, first = rows[on], track[on], first[on]
        if not rows.size:
            return
        frame = world.rows["frame"][first]
        R1, t1 = world.frames["R_cw"][frame], world.frames["t_cw"][frame]
        R2, t2 = world.pose(k)
        xy1, xy2 = world.rows["xy"][first], world.rows["xy"][rows]
        made = triangulate(R1, t1, R2, t2, xy1, xy2)
        sigma = self._settings.pixel_sigma
        good = (made.parallax > self._settings.parallax_rad) & (made.depth > 0.0).all(axis=1)
        for R, t, xy, row in ((R1, t1, xy1, first), (R2, t2, xy2, rows)):
            scale = focal_scale(self._camera, world.rows["octave"][row], sigma)
            good &= reprojection_square(R, t, made.points, xy, scale) < _NEW_POINT_SQUARE
        with world.lock:
            points = world.add_points(track[good], made.points[good])
        image = world.images[k]
        at = np.round(world.rows["pixel"][rows[good]]).astype(np.int64)
        world.points["grey"][points] = image[at[:, 1], at[:, 0]]

    def window(self, k: int) -> Window:
        """Return the key frames that share most with ``k``, and those held around them."""
        world, settings = self._world, self._settings
        shared = world.shared(k)
        shared[k] = shared.max(initial=0) + 1
        order = np.argsort(-shared, kind="stable")
        free = order[: settings.window]
        free = np.sort(free[shared[free] >= min(_LEAST_SHARED, int(shared[k]))])
        rows = world.observations(free)
        mask = np.zeros(world.points.size, dtype=bool)
        mask[world.rows["point"][rows]] = True
        count = world.views_by_frame(mask)
        count[free] = 0
        held = np.argsort(-count, kind="stable")[: settings.held]
        held = np.sort(held[count[held] > 0])
        more = world.observations(held)
        more = more[mask[world.rows["point"][more]]]
        rows = np.concatenate([rows, more])
        return self._closed(np.concatenate([free, held]), len(free), rows)

    def whole(self) -> Window:
        """Return the whole map, its first key frame held."""
        frames = np.arange(self._world.n_frames)
        order = np.concatenate([frames[1:], frames[:1]])
        return self._closed(order, len(frames) - 1, self._world.observations(frames))

    def _closed(self, frames: Indices, n_free: int, rows: Indices) -> Window:
        """Return a window of points that at least two of its rows see."""
        point = self._world.rows["point"][rows]
        count = np.bincount(point, minlength=self._world.points.size)
        rows = rows[count[point] >= 2]
        return Window(frames, n_free, rows, np.flatnonzero(count >= 2))

    def problem(
        self, window: Window, metric: Metric | None = None, *, is_free: bool = False
    ) -> Problem:
        """Return the adjustment of a window, with its ranges; ``is_free``: with their unknowns."""
        world = self._world
        frame_at = np.full(world.n_frames, -1)
        frame_at[window.frames] = np.arange(len(window.frames))
        point_at = np.full(world.points.size, -1)
        point_at[window.points] = np.arange(len(window.points))
        rows = window.rows
        scale = focal_scale(self._camera, world.rows["octave"][rows], self._settings.pixel_sigma)
        views = sorted_views(
            frame_at[world.rows["frame"][rows]], point_at[world.rows["point"][rows]],
            world.rows["xy"][rows], scale, len(window.points),
        )  # fmt: skip
        free = np.arange(len(window.frames)) < window.n_free
        if free.all():
            free[np.argmin(window.frames)] = False
        order = np.argsort(point_at[world.rows["point"][rows]], kind="stable")
        return Problem(
            world.frames["R_cw"][window.frames], world.frames["t_cw"][window.frames], free,
            world.points["place"][window.points], views,
            None if metric is None else metric.further(frame_at, is_free=is_free),
            world.rows["variance"][rows[order]],
        )  # fmt: skip

    def adjust_local(self, k: int, metric: Metric | None = None) -> None:
        """Adjust the key frames and points around key frame ``k`` and cull."""
        window = self.window(k)
        problem = self.problem(window, metric)
        steps = self._settings.local_steps
        hold = int((~problem.free).sum()) < 2
        found = adjust(problem, Effort(steps=steps, posterior_from=None, hold_scale=hold))
        self.take(window, found)

    def take(self, window: Window, found: Adjusted) -> None:
        """Put what an adjustment found in place, and cull what does not fit."""
        with self._world.lock:
            self._take(window, found)

    def _take(self, window: Window, found: Adjusted) -> None:
        world = self._world
        world.set_poses(window.frames, found.R_cw, found.t_cw)
        known = np.isfinite(found.covariance[:, 0, 0])
        world.frames["covariance"][window.frames[known]] = found.covariance[known]
        world.points["place"][window.points] = found.points
        rows = window.rows[np.argsort(world.rows["point"][window.rows], kind="stable")]
        world.rows["weight"][rows], world.rows["variance"][rows] = found.weight, found.variance
        low = found.weight < _LOW_WEIGHT
        world.rows["n_low"][rows] = np.where(low, world.rows["n_low"][rows] + 1, 0)
        self.cull(rows[low & (world.rows["n_low"][rows] >= 2)])

    def cull(self, rows: Indices) -> None:
        """Drop observations, and points that are left with too few."""
        world = self._world
        world.drop_rows(rows)
        age = world.n_frames - world.points["born"]
        least = np.where(age > 3, 3, 2)
        views = world.points["views"]
        gone = world.points["valid"] & (views < np.minimum(least, 2))
        lost = (world.points["n_expected"] >= 8) & (
            world.points["n_found"] < 0.1 * world.points["n_expected"]
        )
        followed = np.zeros(world.points.size, dtype=bool)
        point = world.tracks["point"]
        newest = world.tracks["last"] >= world.frames["first_row"][-1]
        followed[point[newest & (point >= 0)]] = True
        gone |= world.points["valid"] & lost & (views < 4) & ~followed
        world.drop_points(np.flatnonzero(gone))


def _first_of_each(pixels: Array, distance: float) -> Mask:
    """Return which pixels have no earlier one within a distance."""
    if not len(pixels):
        return np.zeros(0, dtype=bool)
    near = ((pixels[:, None] - pixels[None]) ** 2).sum(axis=2) < distance**2
    return np.asarray(~np.tril(near, -1).any(axis=1))
