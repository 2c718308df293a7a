"""Transverse Mercator, to well below a millimetre within a zone (Krueger's series).

After C. F. F. Karney, "Transverse Mercator with an accuracy of a few nanometers", J. Geodesy 85,
2011, with the terms up to n^4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ssm_graph.base.earth import ECCENTRICITY_SQ, FLATTENING, SEMI_MAJOR_AXIS
from ssm_graph.base.frozen import Array

_N: Final = FLATTENING / (2.0 - FLATTENING)
_E: Final = math.sqrt(ECCENTRICITY_SQ)
_RADIUS: Final = SEMI_MAJOR_AXIS / (1.0 + _N) * (1.0 + _N**2 / 4.0 + _N**4 / 64.0)
_ALPHA: Final = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16 + 41 * _N**4 / 180,
    13 * _N**2 / 48 - 3 * _N**3 / 5 + 557 * _N**4 / 1440,
    61 * _N**3 / 240 - 103 * _N**4 / 140,
    49561 * _N**4 / 161280,
)
"""Karney's eq. (35)."""
_BETA: Final = (
    _N / 2 - 2 * _N**2 / 3 + 37 * _N**3 / 96 - _N**4 / 360,
    _N**2 / 48 + _N**3 / 15 - 437 * _N**4 / 1440,
    17 * _N**3 / 480 - 37 * _N**4 / 840,
    4397 * _N**4 / 161280,
)
"""Karney's eq. (36)."""


@dataclass(frozen=True, slots=True)
class TransverseMercator:
    """A plane that touches (or cuts, where the scale is below 1) the Earth along a meridian."""

    lat0: float
    """Latitude of the origin, rad."""
    lon0: float
    """Longitude of the meridian, rad."""
    scale: float = 1.0
    """On the meridian."""
    x0: float = 0.0
    """x of the origin, m."""
    y0: float = 0.0
    """y of the origin, m."""

    def forward(self, lat: ArrayLike, lon: ArrayLike) -> Array:
        """Return x and y (..., 2), m, of latitudes and longitudes (...), rad."""
        x, y = self._raw(np.asarray(lat, dtype=np.float64), np.asarray(lon, dtype=np.float64))
        _, y0 = self._raw(np.asarray(self.lat0), np.asarray(self.lon0))
        return np.stack([x + self.x0, y - y0 + self.y0], axis=-1)

    def inverse(self, x_y: Array) -> tuple[Array, Array]:
        """Return latitudes and longitudes (...), rad, of points (..., 2), m."""
        _, y0 = self._raw(np.asarray(self.lat0), np.asarray(self.lon0))
        raw = (x_y[..., 1] - self.y0 + y0) + 1j * (x_y[..., 0] - self.x0)
        zeta = raw / (self.scale * _RADIUS)
        plane = zeta - sum(b * np.sin(2 * k * zeta) for k, b in enumerate(_BETA, 1))
        xi, eta = plane.real, plane.imag
        tau_ = np.sin(xi) / np.hypot(np.sinh(eta), np.cos(xi))
        tau = tau_
        for _ in range(3):  # Newton, Karney's eq. (19) to (21)
            root = np.hypot(1.0, tau)
            sigma = np.sinh(_E * np.arctanh(_E * tau / root))
            error = tau * np.hypot(1.0, sigma) - sigma * root - tau_
            slope = (np.hypot(1.0, sigma) * root - sigma * tau) * (1.0 - _E**2) * root
            tau = tau - error / slope * (1.0 + (1.0 - _E**2) * tau**2)
        return np.arctan(tau), self.lon0 + np.arctan2(np.sinh(eta), np.cos(xi))

    def _raw(self, lat: Array, lon: Array) -> tuple[Array, Array]:
        tau = np.tan(lat)
        sigma = np.sinh(_E * np.arctanh(_E * np.sin(lat)))
        tau_ = tau * np.hypot(1.0, sigma) - sigma * np.hypot(1.0, tau)
        turn = np.cos(lon - self.lon0)
        plane = np.arctan2(tau_, turn) + 1j * np.arcsinh(
            np.sin(lon - self.lon0) / np.hypot(tau_, turn)
        )
        zeta = plane + sum(a * np.sin(2 * k * plane) for k, a in enumerate(_ALPHA, 1))
        return self.scale * _RADIUS * zeta.imag, self.scale * _RADIUS * zeta.real


class Utm(NamedTuple):
    """Positions on the Universal Transverse Mercator grid, all in one zone."""

    zone: int
    """1 to 60"""
    is_north: bool
    easting: Array
    """(N,) m"""
    northing: Array
    """(N,) m, with 10,000 km added in the south"""

    @property
    def name(self) -> str:
        """``UTM 33N, EPSG:32633``."""
        half, base = ("N", 32600) if self.is_north else ("S", 32700)
        return f"UTM {self.zone}{half}, EPSG:{base + self.zone}"


def utm(lat: Array, lon: Array, *, of: tuple[float, float]) -> Utm:
    """Return positions (N,), rad, in the zone of one, ``of`` (latitude and longitude, rad).

    North of 56 degrees the zones of Norway and Svalbard are wider or narrower than six degrees.
    """
    first_lat = math.degrees(of[0])
    first_lon = (math.degrees(of[1]) + 180.0) % 360.0 - 180.0
    zone = int((first_lon + 180.0) // 6.0) + 1
    if 56.0 <= first_lat < 64.0 and 3.0 <= first_lon < 12.0:
        zone = 32
    if 72.0 <= first_lat <= 84.0 and 0.0 <= first_lon < 42.0:
        zone = 31 + 2 * int((first_lon + 3.0) // 12.0)
    is_north = first_lat >= 0.0
    plane = TransverseMercator(0.0, math.radians(6.0 * zone - 183.0), 0.9996, 500e3)
    easting, northing = plane.forward(lat, lon).T
    return Utm(zone, is_north, easting, northing if is_north else northing + 10e6)
