"""Simulated seabeds, rough as real ones are, and what a survey makes a map of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.usual import SEABED_RELIEF_M
from ssm_graph.sensors.seabed import MapErrors, SeabedGrid
from ssm_graph.simulation import checked

_REACH_M = 0.25
"""Of a bisection along a beam; its last step is linear."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TerrainSettings(checked.Settings):
    """A seabed: a plane and on it a Gaussian field with the spectrum of Goff and Jordan.

    J. A. Goff, T. H. Jordan, "Stochastic modeling of seafloor morphology", J. Geophys. Res. 93,
    1988: the power of a
    wavenumber k falls as ``(k^2 + k0^2)^-(H + 1)`` with the Hurst number H, which is 0.7 to 1 on
    real seafloors, and ``k0 = 2 pi / corner_m``.
    """

    depth_m: float = checked.positive(80.0, hint="try 80 m")
    """In the middle."""
    relief_m: float = checked.not_negative(SEABED_RELIEF_M, hint="0 is flat")
    """Standard deviation of the field."""
    corner_m: float = checked.positive(400.0, hint="try 400 m")
    """Longer waves are no higher."""
    hurst: float = checked.fraction(0.9, hint="try 0.9")
    slope: tuple[float, float] = (0.01, -0.02)
    """Of the plane, of the depth towards east and north, m/m."""
    side_m: float = checked.positive(3000.0, hint="the mission has to stay on it")
    cell_m: float = checked.positive(5.0, hint="try 5 m")


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveySettings(checked.Settings):
    """The map that somebody made of a seabed, before."""

    cell_m: float = checked.positive(10.0, hint="try 10 m")
    errors: MapErrors = MapErrors()
    """What the map is truly off by, and what is stated of it."""
    tide_m: float = checked.not_negative(0.5, hint="0 for none")
    """Amplitude of the tide that the depth sensor follows and the map does not."""
    tide_period_s: float = checked.positive(44714.0, hint="12.42 h")


ROUGH = TerrainSettings()
FLAT = TerrainSettings(relief_m=0.0, slope=(0.0, 0.0))


def seabed(
    settings: TerrainSettings, frame: LocalFrame, middle: Array, rng: np.random.Generator
) -> SeabedGrid:
    """Return a seabed about a point (2,) of the plane of a frame."""
    n = round(settings.side_m / settings.cell_m)
    # On a torus of twice the side, so that opposite edges are not alike.
    k = 2.0 * np.pi * np.fft.fftfreq(2 * n, settings.cell_m)
    k_sq = k[:, None] ** 2 + k[None, : n + 1] ** 2 + (2.0 * np.pi / settings.corner_m) ** 2
    amplitude = k_sq ** (-0.5 * (settings.hurst + 1.0))
    white = np.fft.rfft2(rng.standard_normal((2 * n, 2 * n)))
    field = np.fft.irfft2(white * amplitude, (2 * n, 2 * n))
    rough = (field * (settings.relief_m / field.std()))[:n, :n]
    side = (np.arange(n) - 0.5 * (n - 1)) * settings.cell_m
    plane = side[None, :] * settings.slope[0] + side[:, None] * settings.slope[1]
    height = -settings.depth_m - plane + rough - rough.mean()
    return SeabedGrid(
        "seabed", frame, middle[0] + side[0], middle[1] + side[0], settings.cell_m, height
    )


def surveyed(
    truth: SeabedGrid, settings: SurveySettings, rng: np.random.Generator
) -> tuple[SeabedGrid, MapErrors]:
    """Return a map of a seabed, and what is stated of it.

    It is coarser, with errors that are smooth, white, and common to all; the sigma of a cell that
    is stated holds what lies between the cells as well, as a survey's check lines would tell it.
    """
    e = settings.errors
    west, east, south, north = truth.extent
    x = np.arange(west + truth.cell_m, east - truth.cell_m, settings.cell_m)
    y = np.arange(south + truth.cell_m, north - truth.cell_m, settings.cell_m)
    rows = (y - truth.y0_m) / truth.cell_m
    columns = (x - truth.x0_m) / truth.cell_m
    height = map_coordinates(truth.height, np.meshgrid(rows, columns, indexing="ij"), order=1)
    exact = replace(
        truth, x0_m=float(x[0]), y0_m=float(y[0]), cell_m=settings.cell_m, height=height
    )
    at_x, at_y = rng.uniform(x[2], x[-3], 4000), rng.uniform(y[2], y[-3], 4000)
    between = exact.surface_at(at_x, at_y).height - truth.height_at(at_x, at_y)
    height = height + e.sigma_m * rng.standard_normal(height.shape)
    height += e.bias_sigma_m * rng.standard_normal()
    if e.smooth_sigma_m > 0.0:
        # White noise under a Gaussian of width w is alike as exp(-d^2 / 4 w^2): 1/e at 2 w.
        smooth = gaussian_filter(
            rng.standard_normal(height.shape), 0.5 * e.smooth_m / settings.cell_m
        )
        height += e.smooth_sigma_m / smooth.std() * smooth
    stated = replace(e, sigma_m=float(np.hypot(e.sigma_m, between.std())))
    return replace(exact, name="map", height=height), stated


def met(truth: SeabedGrid, from_n: Array, along_n: Array, longest_m: float) -> Array:
    """Return how far (...) rays go from points (..., 3) along directions (..., 3) to the seabed, m.

    The ray is walked in steps of half a cell until it is below the surface, and the crossing found
    by bisection; NaN where it is not met within ``longest_m`` or leaves the seabed that is known.
    """

    def above(range_m: Array) -> Array:
        point = from_n + range_m[..., None] * along_n
        _, _, height = truth.frame.geodetic_from_p_n(point)
        return np.asarray(height - truth.height_at(point[..., 0], point[..., 1]))

    shape = from_n.shape[:-1]
    low, high = np.zeros(shape), np.full(shape, np.nan)
    is_open = above(low) > 0.0
    for far in np.arange(0.5 * truth.cell_m, longest_m, 0.5 * truth.cell_m):
        if not is_open.any():
            break
        there = above(np.full(shape, far))
        high[is_open & (there <= 0.0)] = far
        low[is_open & (there > 0.0)] = far
        is_open &= there > 0.0  # beyond the edge nothing is: NaN ends the ray
    while np.nanmax(high - low, initial=0.0) > _REACH_M:
        middle = 0.5 * (low + high)
        higher = above(middle) > 0.0
        low, high = np.where(higher, middle, low), np.where(higher, high, middle)
    at_low, at_high = above(low), above(high)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(low + (high - low) * at_low / (at_low - at_high))
