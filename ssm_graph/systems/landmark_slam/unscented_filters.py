"""The unscented filter of pose and map: by the points of what moves, and by all points.

Both are the same, if the root of the covariance begins with the pose and the landmarks in view:
points beyond these move neither the prediction nor an observation. The full form is kept as the
paper has it, and as a witness.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import half_turn, range_bearing
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.unscented import Spread, Transformed, root_of, unscented
from ssm_graph.systems.landmark_slam.filters import POSE, Linear, MapFilter, Seen


def _angle_at(*columns: int, width: int) -> Any:
    """Return the difference of values some columns of which are angles."""
    is_angle = np.zeros(width, dtype=bool)
    is_angle[list(columns)] = True

    def difference(a: Array, b: Array) -> Array:
        return np.where(is_angle, half_turn(a - b), a - b)

    return difference


def observe_landmarks(states: Array) -> Array:
    """Return ranges and bearings (..., 2 m) of the landmarks in states (..., 3 + 2 m)."""
    places = states[..., POSE:].reshape(*states.shape[:-1], -1, 2)
    return range_bearing(states[..., None, :POSE], places).reshape(*states.shape[:-1], -1)


class UnscentedFilter(MapFilter):
    """The unscented filter, by the points of pose and noise, and of pose and landmarks in view."""

    def __init__(self, *arguments: Any, spread: Spread | None = None, **more: Any) -> None:
        """Begin as `MapFilter` does; ``spread`` is that of the points, `Spread` if None."""
        super().__init__(*arguments, **more)
        self._points = spread or Spread()

    def _transform(
        self, function: Any, mean: Array, cov: Array, difference: Any
    ) -> tuple[Transformed, Array]:
        root, repaired = root_of(cov)
        self.n_repaired += repaired
        found = unscented(function, mean, root, spread=self._points, difference=difference)
        # half' root^-1: the slopes of the best linear function through the points.
        return found, np.asarray(np.linalg.solve(root.mT, found.half).mT)

    def _with_noise(self, cov: Array) -> tuple[Array, Array]:
        """Return mean and covariance of the pose and a noise of covariance (B, q, q)."""
        q = cov.shape[-1]
        mean = np.concatenate([self.pose, np.zeros((len(cov), q))], axis=1)
        joint = np.zeros((len(cov), POSE + q, POSE + q))
        joint[:, :POSE, :POSE], joint[:, POSE:, POSE:] = self.pose_cov, cov
        return mean, joint

    def predict(self, control: Array) -> None:
        """Move by controls (B, c)."""
        mean, cov = self._with_noise(self.noise.control)

        def moved(points: Array) -> Array:
            pose, noise = points[..., :POSE], points[..., POSE:]
            return self._motion.move(pose, control[:, None], noise)

        found, slopes = self._transform(moved, mean, cov, _angle_at(2, width=POSE))
        by_pose = slopes[..., :POSE]
        inner = by_pose @ cov[:, :POSE, :POSE] @ by_pose.mT
        self._mean[:, :POSE] = found.mean
        self._mean[:, 2] = half_turn(found.mean[:, 2])
        self._move(by_pose, found.cov - inner)

    def _linear(self, states: NDArray[np.intp], told: Array | None) -> Linear:
        del told
        cov, width = self._block(states), len(states) - POSE
        difference = _angle_at(*range(1, width, 2), width=width)
        found, slopes = self._transform(observe_landmarks, self._mean[:, states], cov, difference)
        return Linear(found.mean, slopes, found.cov - slopes @ cov @ slopes.mT)

    def _augment(self, ids: Sequence[int], told: Array, scale: Array) -> None:
        """Add landmarks where they were seen, by the points of pose, range and bearing."""
        places, by_pose, noises = [], [], []
        for i in range(len(ids)):
            mean, cov = self._with_noise(self.noise.observation * np.outer(scale[i], scale[i]))
            mean[:, POSE:] = told[:, i]
            found, slopes = self._transform(place_of_seen, mean, cov, np.subtract)
            own = slopes[..., :POSE]
            places.append(found.mean)
            by_pose.append(own)
            noises.append(found.cov - own @ cov[:, :POSE, :POSE] @ own.mT)
        self._append(
            ids, np.stack(places, axis=1), np.stack(by_pose, axis=1), np.stack(noises, axis=1)
        )


def place_of_seen(points: Array) -> Array:
    """Return where landmarks are (..., 2) that poses see: (..., 5) pose, range and bearing."""
    heading = points[..., 2] + points[..., 4]
    ray = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.asarray(points[..., :2] + points[..., 3:4] * ray)


@final
class FullUnscentedFilter(UnscentedFilter):
    """The unscented filter with the points of the whole state, as the paper has it."""

    def __init__(self, *arguments: Any, in_view_first: bool = False, **more: Any) -> None:
        """Begin as `UnscentedFilter` does.

        ``in_view_first`` takes the root of the covariance with pose and landmarks in view in front;
        else the states have the order in which they came.
        """
        super().__init__(*arguments, **more)
        self._in_view_first = in_view_first

    def predict(self, control: Array) -> None:
        """Move by controls (B, c)."""
        runs, n, q = len(self._mean), self._n, self.noise.control.shape[-1]
        mean = np.concatenate([self.mean, np.zeros((runs, q))], axis=1)
        cov = np.zeros((runs, n + q, n + q))
        cov[:, :n, :n], cov[:, n:, n:] = self._cov[:, :n, :n], self.noise.control

        def moved(points: Array) -> Array:
            after = points[..., :n].copy()
            after[..., :POSE] = self._motion.move(
                points[..., :POSE], control[:, None], points[..., n:]
            )
            return after

        root, repaired = root_of(cov)
        self.n_repaired += repaired
        difference = _angle_at(2, width=n)
        found = unscented(moved, mean, root, spread=self._points, difference=difference)
        self._mean[:, :n], self._cov[:, :n, :n] = found.mean, found.cov
        self._mean[:, 2] = half_turn(found.mean[:, 2])

    def _seen(self, ids: Sequence[int], told: Array | None) -> Seen:
        del told
        n, seen = self._n, np.concatenate([np.arange(POSE), self._states(ids)])
        order = np.arange(n)
        if self._in_view_first:
            order = np.concatenate([seen, np.setdiff1d(order, seen)])
        at = np.argsort(order)[seen]
        root, repaired = root_of(self._block(order))
        self.n_repaired += repaired
        width = 2 * len(ids)
        found = unscented(
            lambda points: observe_landmarks(points[..., at]),
            self._mean[:, order],
            root,
            spread=self._points,
            difference=_angle_at(*range(1, width, 2), width=width),
        )
        PHt = np.empty((len(root), n, width))
        PHt[:, order] = root @ found.half
        slopes = np.asarray(np.linalg.solve(root.mT, found.half).mT)
        return Seen(found.mean, found.cov, PHt, order, slopes)
