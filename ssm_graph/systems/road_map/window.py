"""A stretch of a drive as one stiff piece: the curves of its pictures, and how it was driven."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.systems.road_map.drive import Curves


@dataclass(frozen=True, slots=True, eq=False)
class Window(FrozenArrays):
    """Pictures (K) with their curves (C), each of as many points (m).

    Motion is that of the chassis, in the axes of the first picture.
    """

    time_s: Array = shaped("K")
    motion: Array = shaped("K", 3)
    """x, y [m] and yaw [rad] of each picture by dead reckoning from the first."""
    picture: Array = shaped("C")
    """Of which picture a curve is, from 0."""
    points: Array = shaped("C", "m", 2)
    """m, in the vehicle's axes at the picture."""
    kind: Array = shaped("C")
    mark: Array = shaped("C")
    sigma_m: Array = shaped("C")

    @property
    def overlap(self) -> float:
        """How many pictures see the same place: 1 or more, all where the vehicle stands."""
        length = float(np.hypot(*np.diff(self.motion[:, :2], axis=0).T).sum())
        seen = float(np.median(np.ptp(self.points[..., 0], axis=1)))
        n = len(self.time_s)
        return float(np.clip(n * seen / max(length, 1e-6), 1.0, n))

    @property
    def stiff(self) -> Array:
        """(C, m, 2) m, the points in the axes of the last picture, the window being one piece."""
        poses = self.poses_from(np.zeros(3))[self.picture.astype(int)]
        return np.stack(in_plane(poses[:, None], self.points), axis=-1)

    def poses_from(self, last: Array) -> Array:
        """Return the poses (..., K, 3) of the pictures that end at the poses ``last`` (..., 3)."""
        end = self.motion[-1]
        yaw = last[..., 2] - end[2]
        c, s = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
        dx, dy = self.motion[:, 0] - end[0], self.motion[:, 1] - end[1]
        return np.stack(
            [
                last[..., 0, None] + c * dx - s * dy,
                last[..., 1, None] + s * dx + c * dy,
                yaw[..., None] + self.motion[:, 2],
            ],
            axis=-1,
        )


def window_of(
    curves: Curves, groups: list[tuple[float, slice]], motion: Array, n_points: int
) -> Window | None:
    """Return the window of some pictures; None where nothing was seen in them.

    ``motion`` (K, 3) are the poses of dead reckoning at the pictures, in any axes.
    """
    picture = np.concatenate([np.full(g.stop - g.start, k) for k, (_, g) in enumerate(groups)])
    if len(picture) == 0:
        return None
    rows = np.concatenate([np.arange(g.start, g.stop) for _, g in groups])
    first = motion[0]
    c, s = np.cos(first[2]), np.sin(first[2])
    d = motion - first
    relative = np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]])
    return Window(
        np.array([t for t, _ in groups]),
        relative,
        picture,
        curves.points(rows, n_points),
        curves.kind[rows],
        curves.mark[rows],
        curves.sigma_m[rows],
    )


def in_plane(poses: Array, points: Array) -> tuple[Array, Array]:
    """Return x and y (...), m, of points (..., 2) in the axes of poses (..., 3)."""
    c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    px, py = points[..., 0], points[..., 1]
    return poses[..., 0] + c * px - s * py, poses[..., 1] + s * px + c * py
