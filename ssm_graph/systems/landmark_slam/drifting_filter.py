"""The extended filter that also finds what the odometry is wrong by all along.

Taken for noise of each step, an error that stays adds up as a walk and not as a line: over a minute
in which nothing is seen it is believed too small. Here it is a state.
"""

from __future__ import annotations

from typing import Any, Final, final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.filters import POSE, MapFilter
from ssm_graph.systems.landmark_slam.models import turned

DRIFT: Final = 3
"""States of the odometry: see `SlamProblem.drift_sigma`."""


@final
class DriftingFilter(MapFilter):
    """State: pose, drift of the odometry, landmarks."""

    def __init__(self, *arguments: Any, drift_sigma: Array, **more: Any) -> None:
        """Begin; ``drift_sigma`` (3,) of each component, or no rows: the extended filter."""
        super().__init__(*arguments, **more)
        runs, begin = len(self._mean), POSE + len(drift_sigma)
        self._mean = np.hstack([self._mean, np.zeros((runs, len(drift_sigma)))])
        wide = np.zeros((runs, self._mean.shape[1], self._mean.shape[1]))
        wide[:, :POSE, :POSE] = self._cov[:, :POSE, :POSE]
        wide[:, POSE:begin, POSE:begin] = np.diag(np.square(drift_sigma))
        self._cov, self._n, self._first_place = wide, begin, begin

    @property
    def drift(self) -> Array:
        """(B, 3) of the odometry, or no columns."""
        return self._mean[:, POSE : self._first_place]

    def predict(self, control: Array, slopes: Array | None = None) -> None:
        """Move by controls (B, c); their increments follow the drift by ``slopes`` (B, 3, 3)."""
        if slopes is None or self._first_place == POSE:
            super().predict(control)
            return
        put_right = control.copy()
        put_right[:, :POSE] += (slopes @ self.drift[..., None])[..., 0]
        moved, by_pose, by_noise = self._motion.slopes(self.pose, put_right)
        follows = np.concatenate([by_pose, turned(self.pose[:, 2]) @ slopes], axis=2)
        self._mean[:, :POSE] = moved
        n, P, both = self._n, self._cov, POSE + DRIFT
        rows = follows @ P[:, :both, :n]
        noise = by_noise @ self.noise.control @ by_noise.mT
        P[:, :POSE, :POSE] = rows[:, :, :both] @ follows.mT + noise
        P[:, :POSE, POSE:n] = rows[:, :, POSE:]
        P[:, POSE:n, :POSE] = P[:, :POSE, POSE:n].mT
