"""Ranges of the DVL against a map of the seabed: each beam's for itself, with its own weight."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from factors.terrain_range import beam_ends, terrain_residual
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import MIN_SPACING_S, Indices, is_inside, nearest
from ssm_graph.base.usable import require_fields
from ssm_graph.engine.error_state import POSITION, ROTATION
from ssm_graph.engine.extras import Extra
from ssm_graph.graph.aids.aid import Aid, Keyframes, Linearised, RowStates
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.seabed import MapErrors, SeabedGrid, TerrainLog

MAP_BIAS: Final = "map_bias"
MAP_SMOOTH: Final = "map_smooth"
MAP_APART: Final = "map_apart"
"""What a map is off by over a stretch: under all beams, and how much more under some of them."""


@dataclass(frozen=True, slots=True, eq=False)
class TerrainRanges(Aid):
    """Ranges along beams at their keyframes, linearised against the map at every state anew."""

    SHARED = frozenset({"grid", "errors", "inside"})
    name = "seabed"
    unit = "m"
    hint = "look at the map's datum, its place and its sigma"
    section = TerrainLog.SECTION

    beam: Indices
    """(M,) from 0"""
    end_b: Array
    """(M, 3) where the beam ends, from the body origin, body axes, m"""
    range_sigma: Array
    """(M,) m"""
    cell_factor: Array
    """(M,) by how much the variance of a cell counts more: several pings meet the same one"""
    apart: Array
    """(M, B - 1) what of the beams' differences is each one's own part of what the map is off by"""
    sigma: Array
    """(M,) m, of the height, where the states last were"""
    grid: SeabedGrid
    errors: MapErrors
    inside: Array
    """(R, C) of the grid's cells: how much a range counts there; falls to 0 towards its edges"""

    @classmethod
    def of(cls, aids: Aids, keyframes: Keyframes) -> Self | None:
        """Return the ranges of pings that are keyframes."""
        log = aids.get(TerrainLog)
        if log is None:
            return None
        time_s = keyframes.time_s
        inside = np.flatnonzero(is_inside(log.time_s, time_s[0], time_s[-1]))
        at = nearest(time_s, log.time_s[inside])
        near = np.abs(time_s[at] - log.time_s[inside]) < MIN_SPACING_S
        inside, at = inside[near], at[near]
        row, beam = np.nonzero(np.isfinite(log.range_m[inside]))
        range_m = log.range_m[inside][row, beam]
        range_sigma = log.errors.range_sigma(range_m)
        factor = log.errors.cell_factor(log.grid.cell_m, log.way_m[inside])[row]
        return cls(
            keyframe=at[row],
            beam=beam,
            end_b=log.lever_arm_b + range_m[:, None] * log.beams_b[beam],
            range_sigma=range_sigma,
            cell_factor=factor,
            apart=differences(len(log.beams_b))[beam],
            sigma=np.hypot(range_sigma, log.errors.sigma_m * np.sqrt(factor)),
            grid=log.grid,
            errors=log.errors,
            inside=log.grid.inside(),
        )

    @classmethod
    def variables(cls, aids: Aids) -> tuple[Extra, ...]:
        """Return what the map is off by, as a whole and over stretches."""
        log = aids.get(TerrainLog)
        if log is None:
            return ()
        e, n_beams = log.errors, len(log.beams_b)
        common, apart = log.smooth_sigmas
        stays_s = e.smooth_m / log.speed
        each = (
            (MAP_BIAS, 1, e.bias_sigma_m, e.bias_correlation_s),
            (MAP_SMOOTH, 1, common, stays_s),
            (MAP_APART, n_beams - 1, apart, stays_s),
        )
        return tuple(
            Extra.gauss_markov(
                name,
                tuple(f"{name}{'' if size == 1 else f'_{i + 1}'}_m" for i in range(size)),
                sigma,
                correlation_s=span_s,
            )
            for name, size, sigma, span_s in each
            if sigma > 0.0 and size > 0
        )

    @classmethod
    def require_usable(cls, aids: Aids) -> None:
        """Refuse times that do not increase, and a geometry that is not finite."""
        log = aids.get(TerrainLog)
        if log is not None:
            require_fields("aids.map", log, increasing="time_s", finite="beams_b lever_arm_b way_m")

    @property
    def root_information(self) -> Array:
        """(M, 1, 1) 1/m."""
        return np.asarray(1.0 / self.sigma[:, None, None])

    @property
    def labels(self) -> list[str]:
        """(M,) the beams."""
        return [f"beam {beam + 1}" for beam in self.beam.tolist()]

    def led_along(self, before: RowStates | None, at: RowStates) -> Self:  # noqa: ARG002
        """Return the same with the sigma that the map has where the beams end."""
        if self.grid.sigma is None:
            return self
        end_n = beam_ends(at.R_nb, at.p_n, end_b=self.end_b)
        cell = self.grid.sigma_at(end_n[..., 0], end_n[..., 1], self.errors)
        return replace(self, sigma=np.hypot(self.range_sigma, cell * np.sqrt(self.cell_factor)))

    def measured(self, at: RowStates) -> Linearised:
        """Linearise ranges: one component each; one that ends off the map says nothing.

        Towards an edge of the map they say less and less: a range that says all or nothing by where
        the last step put its end would not let the steps settle.
        """
        end_n = beam_ends(at.R_nb, at.p_n, end_b=self.end_b)
        above, grows, known = above_seabed(self.grid, end_n)
        found = at.value(MAP_APART, self.apart.shape[-1])
        bias = at.value(MAP_BIAS, 1) + at.value(MAP_SMOOTH, 1)
        residual = terrain_residual(
            at.R_nb,
            end_b=self.end_b,
            above=above,
            above_D_point=grows,
            bias=bias[..., 0] + (self.apart * found).sum(axis=-1),
        )
        jacobian = np.zeros((*above.shape, 1, at.extras.width))
        jacobian[..., 0, ROTATION] = residual.error_D_rotation
        jacobian[..., 0, POSITION] = residual.error_D_position
        own = residual.error_D_bias[..., None]
        blocks = {MAP_BIAS: own, MAP_SMOOTH: own, MAP_APART: own * self.apart}
        at.extras.fill(jacobian[..., 0, :], blocks)
        counts = np.where(known, self.grid.between(self.inside, end_n[..., 0], end_n[..., 1]), 0.0)
        jacobian *= counts[..., None, None]
        return Linearised((counts * residual.error)[..., None], jacobian)


def differences(n_beams: int) -> Array:
    """Return directions (B, B - 1), of length 1, of what B numbers differ by: their sums are 0."""
    return np.linalg.svd(np.ones((1, n_beams)))[2][1:].T


def above_seabed(grid: SeabedGrid, point_n: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return how high points (..., 3) are above the map, how that grows, and where it is known."""
    lat, lon, height = grid.frame.geodetic_from_p_n(point_n)
    surface = grid.surface_at(point_n[..., 0], point_n[..., 1])
    known = np.isfinite(surface.height)
    grows = grid.frame.up_n_at(lat, lon)
    grows[..., :2] -= np.where(known[..., None], surface.slope, 0.0)
    return height - np.where(known, surface.height, 0.0), grows, known
