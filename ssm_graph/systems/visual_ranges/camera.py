"""Camera models: pinhole, radial-tangential and equidistant (fisheye) distortion.

Pixels are those of images as read, the centre of the first one at (0, 0); normalised coordinates
are ``(x/z, y/z)`` in camera axes, z forward, x right, y down.

References
----------
.. [1] D. C. Brown, "Close-Range Camera Calibration", Photogrammetric Engineering 37, 1971.
.. [2] J. Kannala, S. S. Brandt, "A Generic Camera Model and Calibration Method for Conventional,
   Wide-Angle, and Fish-Eye Lenses", PAMI 28, 2006.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.frozen import ShortRepr

Array = NDArray[np.float64]

N_COEFFICIENTS: Final = {"pinhole": (0,), "radtan": (4, 5, 8), "equidistant": (4,)}
"""By model, how many coefficients of distortion it takes."""
_ITERATIONS: Final = 30
_CONVERGED: Final = 1e-12


@dataclass(frozen=True)
class Camera(ShortRepr):
    """Intrinsics of one camera."""

    width: int
    """pixels"""
    height: int
    """pixels"""
    fx: float
    """pixels"""
    fy: float
    """pixels"""
    cx: float
    """pixels"""
    cy: float
    """pixels"""
    model: str = "pinhole"
    """``pinhole``, ``radtan`` (k1, k2, p1, p2[, k3[, k4, k5, k6]]) or ``equidistant`` (k1..k4)."""
    distortion: tuple[float, ...] = ()
    """Coefficients in the order of OpenCV, of ROS and of Kalibr."""

    def __post_init__(self) -> None:
        if self.model not in N_COEFFICIENTS:
            raise ConfigError(
                f"camera model {self.model!r}: {nearest_hint(self.model, N_COEFFICIENTS)}"
            )
        if len(self.distortion) not in N_COEFFICIENTS[self.model]:
            wanted = " or ".join(map(str, N_COEFFICIENTS[self.model]))
            raise ConfigError(
                f"camera: model {self.model!r} takes {wanted} coefficients of distortion, "
                f"got {len(self.distortion)}: check the order k1, k2, p1, p2, k3"
            )
        values = (self.width, self.height, self.fx, self.fy)
        if not (
            np.isfinite([*values, self.cx, self.cy, *self.distortion]).all() and min(values) > 0
        ):
            raise ConfigError(
                f"camera: expected finite values, size and focal lengths above zero, got {self}"
            )

    def normalise(self, pixels: Array) -> Array:
        """Return undistorted normalised coordinates (n, 2) of pixels (n, 2)."""
        distorted = (np.asarray(pixels, dtype=np.float64) - self._centre) / self._focal
        if self.model == "pinhole":
            return distorted
        if self.model == "equidistant":
            return self._undistort_fisheye(distorted)
        found = distorted.copy()
        for _ in range(_ITERATIONS):  # a fixed point: the distortion's slope is well below 1
            change = distorted - self._distort(found)
            found += change
            if np.abs(change).max(initial=0.0) < _CONVERGED:
                break
        return found

    def project(self, points_c: Array) -> Array:
        """Return pixels (n, 2) of points (n, 3) in camera axes; NaN behind the camera."""
        points_c = np.asarray(points_c, dtype=np.float64)
        depth = np.where(points_c[..., 2] > 0.0, points_c[..., 2], np.nan)
        return self.distort(points_c[..., :2] / depth[..., None])

    def distort(self, normalised: Array) -> Array:
        """Return the pixels (n, 2) of undistorted normalised coordinates (n, 2)."""
        if self.model != "pinhole":
            normalised = self._distort(normalised)
        return np.asarray(normalised * self._focal + self._centre)

    def contains(self, pixels: Array, border: float = 0.0) -> NDArray[np.bool_]:
        """Return which pixels (n, 2) lie in the image, at least ``border`` pixels from its edge."""
        low, high = border, np.array([self.width, self.height]) - 1.0 - border
        with np.errstate(invalid="ignore"):
            return np.asarray(((pixels >= low) & (pixels <= high)).all(axis=-1))

    @property
    def _focal(self) -> Array:
        return np.array([self.fx, self.fy])

    @property
    def _centre(self) -> Array:
        return np.array([self.cx, self.cy])

    def _distort(self, normalised: Array) -> Array:
        """Return distorted normalised coordinates (n, 2), [1]_ or [2]_."""
        x, y = normalised[..., 0], normalised[..., 1]
        square = x * x + y * y
        if self.model == "equidistant":
            k1, k2, k3, k4 = self.distortion
            radius = np.sqrt(square)
            angle = np.arctan(radius)
            a2 = angle * angle
            bent = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
            ratio = np.divide(bent, radius, out=np.ones_like(radius), where=radius > 1e-9)
            return np.asarray(normalised * ratio[..., None])
        k1, k2, p1, p2, *more = self.distortion
        k3, k4, k5, k6 = [*more, 0.0, 0.0, 0.0, 0.0][:4]
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        radial = radial / (1.0 + square * (k4 + square * (k5 + square * k6)))
        u = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        v = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([u, v], axis=-1)

    def _undistort_fisheye(self, distorted: Array) -> Array:
        """Return undistorted coordinates by Newton's steps for the angle of view."""
        k1, k2, k3, k4 = self.distortion
        bent = np.linalg.norm(distorted, axis=-1)
        angle = bent.copy()
        for _ in range(_ITERATIONS):
            a2 = angle * angle
            value = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
            slope = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))
            change = (bent - value) / slope
            angle += change
            if np.abs(change).max(initial=0.0) < _CONVERGED:
                break
        ratio = np.divide(np.tan(angle), bent, out=np.ones_like(bent), where=bent > 1e-9)
        return np.asarray(distorted * ratio[..., None])
