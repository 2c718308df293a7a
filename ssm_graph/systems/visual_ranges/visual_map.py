"""The map: key frames, their key points and the points they see, all in growing arrays.

One row a key point of a key frame, in one table; rows of key frame ``k`` are contiguous. A *track*
is one corner followed from key frame to key frame: its rows are chained, and it has a point once
the parallax is enough. What is culled keeps its place and is marked.
"""

from __future__ import annotations

import threading
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.geometry import Pose
from ssm_graph.systems.visual_ranges.result import MapSnapshot

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]

NO_POINT: Final = -1
DROPPED: Final = -2
"""Instead of a track's point: it is not to be followed any more."""


class Columns:
    """Arrays of one common length that grows: each a view of what is filled."""

    def __init__(self, **columns: tuple[tuple[int, ...], Any, Any]) -> None:
        self._spec = columns
        self._full = {
            name: np.full((64, *shape), fill, dtype=dtype)
            for name, (shape, dtype, fill) in columns.items()
        }
        self.size = 0

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._full[name][: self.size]

    def append(self, n: int, **values: Any) -> Indices:
        """Add ``n`` rows, of defaults where no value is given, and return their indices."""
        begin, end = self.size, self.size + n
        for name, (shape, dtype, fill) in self._spec.items():
            array = self._full[name]
            if end > len(array):
                longer = np.full((max(end, 2 * len(array)), *shape), fill, dtype=dtype)
                longer[:begin] = array[:begin]
                self._full[name] = array = longer
            if name in values:
                array[begin:end] = values[name]
        self.size = end
        return np.arange(begin, end)


class VisualMap:
    """Key frames (``frames``), key points (``rows``), points and tracks, in map units."""

    def __init__(self) -> None:
        f8, i8 = np.float64, np.int64
        self.frames = Columns(
            image=((), i8, -1),
            time_s=((), f8, np.nan),
            R_cw=((3, 3), f8, 0.0),
            t_cw=((3,), f8, 0.0),
            first_row=((), i8, 0),
            last_row=((), i8, 0),
            covariance=((6, 6), f8, np.nan),
            depth=((), f8, 1.0),
            grown=((), f8, 1.0),
        )
        self.rows = Columns(
            frame=((), i8, -1), pixel=((2,), f8, 0.0), xy=((2,), f8, 0.0), octave=((), i8, 0),
            descriptor=((32,), np.uint8, 0), point=((), i8, NO_POINT), track=((), i8, -1),
            previous=((), i8, -1), weight=((), f8, np.nan), variance=((), f8, 0.0),
            n_low=((), i8, 0),
        )  # fmt: skip
        self.points = Columns(
            place=((3,), f8, np.nan), valid=((), bool, True), views=((), i8, 0),
            row=((), i8, -1), born=((), i8, -1), n_expected=((), i8, 0), n_found=((), i8, 0),
            grey=((), np.uint8, 0),
        )  # fmt: skip
        self.tracks = Columns(point=((), i8, NO_POINT), first=((), i8, -1), last=((), i8, -1))
        self.images: dict[int, Image] = {}
        self.lock = threading.RLock()
        """Held while places and poses change, and while a tracker reads them."""

    @property
    def n_frames(self) -> int:
        """Key frames, culled ones included."""
        return self.frames.size

    def pose(self, k: int) -> Pose:
        """Return the pose of a key frame."""
        return Pose(self.frames["R_cw"][k].copy(), self.frames["t_cw"][k].copy())

    def set_poses(self, which: Indices, R_cw: Array, t_cw: Array) -> None:
        """Put poses (n, 3, 3), (n, 3) of key frames in place."""
        self.frames["R_cw"][which], self.frames["t_cw"][which] = R_cw, t_cw

    def add_frame(self, image_index: int, time_s: float, pose: Pose, image: Image) -> int:
        """Add a key frame without rows and return its index."""
        at = self.rows.size
        (k,) = self.frames.append(
            1, image=image_index, time_s=time_s, R_cw=pose.R_cw, t_cw=pose.t_cw,
            first_row=at, last_row=at,
        )  # fmt: skip
        self.images[int(k)] = image
        return int(k)

    def add_rows(
        self,
        k: int,
        track: Indices,
        *,
        pixel: Array,
        xy: Array,
        octave: Indices,
        descriptor: NDArray[np.uint8],
    ) -> Indices:
        """Add key points of the newest key frame, each the next of its track."""  # fmt: skip
        new = self.rows.append(
            len(track), frame=k, pixel=pixel, xy=xy, octave=octave, descriptor=descriptor,
            track=track, point=np.maximum(self.tracks["point"][track], NO_POINT),
            previous=self.tracks["last"][track],
        )  # fmt: skip
        self.tracks["last"][track] = new
        first = self.tracks["first"]
        first[track] = np.where(first[track] < 0, new, first[track])
        self.frames["last_row"][k] = self.rows.size
        seen = self.rows["point"][new]
        np.add.at(self.points["views"], seen[seen >= 0], 1)
        return new

    def new_tracks(self, n: int, point: Indices | int = NO_POINT) -> Indices:
        """Add tracks and return their indices."""
        return self.tracks.append(n, point=point)

    def rows_of(self, k: int) -> slice:
        """Return the rows of a key frame."""
        return slice(int(self.frames["first_row"][k]), int(self.frames["last_row"][k]))

    def add_points(self, track: Indices, place: Array) -> Indices:
        """Give tracks without a point one each, at places (n, 3), in all of their rows."""
        last = self.tracks["last"][track]
        k = self.rows["frame"][last]
        points = self.points.append(len(track), place=place, row=last, born=k)
        self.tracks["point"][track] = points
        row, point = last, points
        while row.size:
            self.rows["point"][row] = point
            np.add.at(self.points["views"], point, 1)
            row = self.rows["previous"][row]
            row, point = row[row >= 0], point[row >= 0]
        return points

    def observations(self, frames: Indices) -> Indices:
        """Return the rows of these key frames that see a point."""
        if len(frames) == 0:
            return np.zeros(0, dtype=np.int64)
        first, last = self.frames["first_row"][frames], self.frames["last_row"][frames]
        rows = np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)])
        return np.asarray(rows[self.rows["point"][rows] >= 0])

    def shared(self, k: int) -> Indices:
        """Return by key frame how many points of key frame ``k`` each sees."""
        mine = np.zeros(self.points.size, dtype=bool)
        mine[self.rows["point"][self.observations(np.array([k]))]] = True
        return self.views_by_frame(mine)

    def views_by_frame(self, points: Mask) -> Indices:
        """Return by key frame how many of the points (P,) that a mask names each sees."""
        point = self.rows["point"]
        seen = np.flatnonzero(point >= 0)
        seen = seen[points[point[seen]]]
        count = np.bincount(self.rows["frame"][seen], minlength=self.n_frames)
        return np.asarray(count)

    def drop_rows(self, rows: Indices) -> None:
        """Take observations from their points; their tracks end."""
        rows = rows[self.rows["point"][rows] >= 0]
        np.subtract.at(self.points["views"], self.rows["point"][rows], 1)
        track = self.rows["track"][rows]
        newest = self.tracks["last"][track] == rows
        self.tracks["point"][track[newest]] = DROPPED
        self.rows["point"][rows] = NO_POINT

    def drop_points(self, points: Indices) -> None:
        """Take points out of the map, with their observations and tracks."""
        gone = np.zeros(self.points.size, dtype=bool)
        gone[points] = True
        self.points["valid"][points] = False
        self.points["views"][points] = 0
        point = self.rows["point"]
        point[(point >= 0) & gone[np.maximum(point, 0)]] = NO_POINT
        held = self.tracks["point"]
        held[(held >= 0) & gone[np.maximum(held, 0)]] = DROPPED

    def fuse(self, kept: Indices, gone: Indices) -> None:
        """Give all observations of points ``gone`` to the points ``kept``."""
        to = np.arange(self.points.size)
        for a, b in zip(kept.tolist(), gone.tolist(), strict=True):
            root_a, root_b = int(to[a]), int(to[b])
            if root_a != root_b:
                to[to == root_b] = root_a
        moved = to != np.arange(len(to))
        for column in (self.rows["point"], self.tracks["point"]):
            on = column >= 0
            column[on] = to[column[on]]
        self.points["valid"][moved] = False
        self.points["views"][moved] = 0
        self._one_row_a_frame(np.unique(to[moved]))

    def _one_row_a_frame(self, points: Indices) -> None:
        """Leave each point at most one row in each key frame, and count its views."""
        chosen = np.zeros(self.points.size, dtype=bool)
        chosen[points] = True
        point = self.rows["point"]
        rows = np.flatnonzero((point >= 0) & chosen[np.maximum(point, 0)])
        key = point[rows] * self.n_frames + self.rows["frame"][rows]
        _, first = np.unique(key, return_index=True)
        double = np.ones(len(rows), dtype=bool)
        double[first] = False
        point[rows[double]] = NO_POINT
        self.points["views"][points] = np.bincount(
            point[rows[~double]], minlength=self.points.size
        )[points]

    def snapshot(self) -> MapSnapshot:
        """Return what stands."""
        kept = np.arange(self.n_frames)
        rows = [np.arange(*self.rows_of(int(k)).indices(self.rows.size)) for k in kept]
        index = np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
        first = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64)
        return MapSnapshot(
            image=self.frames["image"][kept].copy(),
            time_s=self.frames["time_s"][kept].copy(),
            R_cw=self.frames["R_cw"][kept].copy(),
            t_cw=self.frames["t_cw"][kept].copy(),
            covariance=self.frames["covariance"][kept].copy(),
            points=self.points["place"].copy(),
            points_views=np.where(self.points["valid"], self.points["views"], 0),
            points_grey=self.points["grey"].copy(),
            points_descriptor=self.rows["descriptor"][self.points["row"]],
            first_row=first,
            pixels=self.rows["pixel"][index].astype(np.float32),
            octave=self.rows["octave"][index],
            descriptor=self.rows["descriptor"][index],
            point=self.rows["point"][index],
            weight=self.rows["weight"][index],
        )
