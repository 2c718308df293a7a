"""The WGS-84 Earth: ellipsoid, rotation, normal gravity and the local navigation frame.

The one module whose formulas simulator and estimators share. All angles in radians, lengths in
metres, leading axes broadcast.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SEMI_MAJOR_AXIS = 6378137.0
"""m"""
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQ = FLATTENING * (2.0 - FLATTENING)
EARTH_RATE = 7.292115e-5
"""rad/s"""
GRAVITY_EQUATOR = 9.7803253359
"""m/s^2, normal gravity on the ellipsoid at the equator."""
SOMIGLIANA_K = 1.931852652458e-3
GRAVITY_RATIO = 3.449786506841e-3
"""``omega^2 a^2 b / GM``, the ``m`` of the height expansion."""


def radii_of_curvature(lat: Array | float) -> tuple[Array, Array]:
    """Return the meridian and the prime-vertical radius of curvature at ``lat``, m."""
    w_sq = 1.0 - ECCENTRICITY_SQ * np.sin(lat) ** 2
    prime_vertical = SEMI_MAJOR_AXIS / np.sqrt(w_sq)
    return np.asarray(prime_vertical * (1.0 - ECCENTRICITY_SQ) / w_sq), np.asarray(prime_vertical)


def ecef_from_geodetic(lat: Array | float, lon: Array | float, height: Array | float) -> Array:
    """Return Earth-centred Earth-fixed positions (..., 3), m."""
    lat, lon, height = np.broadcast_arrays(
        np.asarray(lat, float), np.asarray(lon, float), np.asarray(height, float)
    )
    _, radius = radii_of_curvature(lat)
    horizontal = (radius + height) * np.cos(lat)
    z = (radius * (1.0 - ECCENTRICITY_SQ) + height) * np.sin(lat)
    return np.stack([horizontal * np.cos(lon), horizontal * np.sin(lon), z], axis=-1)


def geodetic_from_ecef(p_e: Array) -> tuple[Array, Array, Array]:
    """Return ``lat, lon, height`` of Earth-fixed positions (..., 3).

    Bowring's formula followed by two fixed-point steps: exact to rounding from 10 km below the
    ellipsoid to satellite heights, the poles included.
    """
    p_e = np.asarray(p_e, float)
    if p_e.size == 3:  # one position: a twentieth of the time, for the filters ask at every ping
        x, y, z = p_e.ravel().tolist()
        one = _geodetic_from_ecef(x, y, z, math)
        lat, lon, height = (np.full(p_e.shape[:-1], value) for value in one)
        return lat, lon, height
    return _geodetic_from_ecef(p_e[..., 0], p_e[..., 1], p_e[..., 2], np)


def _geodetic_from_ecef(x: Any, y: Any, z: Any, functions: ModuleType) -> tuple[Any, Any, Any]:
    """Return ``lat, lon, height`` by the functions of ``math`` or of NumPy."""
    sin, cos, atan2 = functions.sin, functions.cos, functions.atan2
    horizontal = functions.hypot(x, y)
    semi_minor = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
    second_ecc_sq = ECCENTRICITY_SQ / (1.0 - ECCENTRICITY_SQ)
    beta = atan2(z * SEMI_MAJOR_AXIS, horizontal * semi_minor)
    for _ in range(3):
        lat = atan2(
            z + second_ecc_sq * semi_minor * sin(beta) ** 3,
            horizontal - ECCENTRICITY_SQ * SEMI_MAJOR_AXIS * cos(beta) ** 3,
        )
        beta = atan2((1.0 - FLATTENING) * sin(lat), cos(lat))
    sin_lat, cos_lat = sin(lat), cos(lat)
    surface = SEMI_MAJOR_AXIS * functions.sqrt(1.0 - ECCENTRICITY_SQ * sin_lat**2)
    return lat, atan2(y, x), horizontal * cos_lat + z * sin_lat - surface


def R_el_from_lat_lon(lat: Array | float, lon: Array | float) -> Array:
    """Return rotations (..., 3, 3) from local east-north-up axes to Earth-fixed axes."""
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    R_el = np.zeros((*np.broadcast_shapes(np.shape(lat), np.shape(lon)), 3, 3))
    R_el[..., 0, 0], R_el[..., 1, 0] = -sin_lon, cos_lon
    R_el[..., 0, 1], R_el[..., 1, 1] = -sin_lat * cos_lon, -sin_lat * sin_lon
    R_el[..., 2, 1] = cos_lat
    R_el[..., 2] = _up_e(lat, lon)
    return R_el


def _up_e(lat: Array | float, lon: Array | float) -> Array:
    """Return the normal (..., 3) of the ellipsoid in Earth-fixed axes."""
    cos_lat = np.cos(lat)
    up_e = np.empty((*np.broadcast_shapes(np.shape(lat), np.shape(lon)), 3))
    up_e[..., 0], up_e[..., 1] = cos_lat * np.cos(lon), cos_lat * np.sin(lon)
    up_e[..., 2] = np.sin(lat)
    return up_e


def normal_gravity(lat: Array | float, height: Array | float) -> Array:
    """Return the magnitude of normal (plumb-line) gravity, m/s^2.

    Somigliana on the ellipsoid, second order in height::

        gamma = gamma_0(lat) (1 - 2 (1 + f + m - 2 f sin^2 lat) h / a + 3 h^2 / a^2)

    It acts along the ellipsoid's normal, downwards, and contains the centrifugal acceleration.
    """
    sin_sq = np.sin(lat) ** 2
    gamma_0 = GRAVITY_EQUATOR * (1.0 + SOMIGLIANA_K * sin_sq)
    gamma_0 = gamma_0 / np.sqrt(1.0 - ECCENTRICITY_SQ * sin_sq)
    ratio = np.asarray(height, float) / SEMI_MAJOR_AXIS
    slope = 1.0 + FLATTENING + GRAVITY_RATIO - 2.0 * FLATTENING * sin_sq
    return np.asarray(gamma_0 * (1.0 - 2.0 * slope * ratio + 3.0 * ratio**2))


@dataclass(frozen=True)
class LocalFrame:
    """The navigation frame ``n``: Cartesian east-north-up, fixed to the Earth at an origin."""

    lat: float
    """rad"""
    lon: float
    """rad"""
    height: float
    """m above the ellipsoid"""

    @cached_property
    def R_en(self) -> Array:
        """Rotation from ``n`` to Earth-fixed axes."""
        return R_el_from_lat_lon(self.lat, self.lon)

    @cached_property
    def origin_e(self) -> Array:
        """Origin in Earth-fixed axes, m."""
        return ecef_from_geodetic(self.lat, self.lon, self.height)

    @cached_property
    def omega_ie_n(self) -> Array:
        """Earth rate in ``n``, rad/s."""
        return EARTH_RATE * np.array([0.0, np.cos(self.lat), np.sin(self.lat)])

    def p_n_from_geodetic(
        self, lat: Array | float, lon: Array | float, height: Array | float
    ) -> Array:
        """Return positions (..., 3) in ``n``, m."""
        return (ecef_from_geodetic(lat, lon, height) - self.origin_e) @ self.R_en

    def geodetic_from_p_n(self, p_n: Array) -> tuple[Array, Array, Array]:
        """Return ``lat, lon, height`` of positions (..., 3) in ``n``."""
        return geodetic_from_ecef(np.asarray(p_n) @ self.R_en.T + self.origin_e)

    def R_nl_at(self, p_n: Array) -> Array:
        """Return rotations (..., 3, 3) from local-level axes ``l`` at ``p_n`` to ``n``."""
        lat, lon, _ = self.geodetic_from_p_n(p_n)
        return np.asarray(self.R_en.T @ R_el_from_lat_lon(lat, lon))

    def g_n_at(self, p_n: Array) -> Array:
        """Return plumb-line gravity (..., 3) at positions ``p_n``, in ``n``, m/s^2."""
        lat, lon, height = self.geodetic_from_p_n(p_n)
        return np.asarray(-normal_gravity(lat, height)[..., None] * self.up_n_at(lat, lon))

    def up_n_at(self, lat: Array, lon: Array) -> Array:
        """Return the local vertical (..., 3) in ``n`` at latitudes and longitudes, rad."""
        return np.asarray(_up_e(lat, lon) @ self.R_en)
