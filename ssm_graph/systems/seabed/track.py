"""What is known of a dive without a map: where each beam would end, for any start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.mission.estimate import Estimate
from ssm_graph.sensors.seabed import MapErrors, SeabedGrid, TerrainLog

_NEAR_S: Final = 0.05
"""A ping and the keyframe that has its attitude are no farther apart."""


class Doubt(NamedTuple):
    """What the dead reckoning may be off by, 1 sigma."""

    yaw: float
    """rad, at the start; infinite where no heading is known"""
    rate: float
    """rad/s: the heading drifts"""
    rate_walk: float
    """rad/sqrt(s), of what the heading wanders besides"""
    scale: float
    """Of the way, relative"""
    walk: float
    """m/sqrt(s), of the position besides"""


@dataclass(frozen=True, slots=True, eq=False)
class Track(FrozenArrays):
    """Pings along the dead-reckoned way, in the plane of the map."""

    doubt: Doubt
    time_s: Array = shaped("N")
    """(N,) s"""
    x_y: Array = shaped("N", 2)
    """(N, 2) of the body origin, m, from wherever the dead reckoning began"""
    height: Array = shaped("N")
    """(N,) of the body origin above the ellipsoid, m: what the depth sensor says"""
    ends: Array = shaped("N", "B", 3)
    """(N, B, 3) of the beams from the body origin: east, north, up, m; NaN where there is none"""
    sigma: Array = shaped("N", "B")
    """(N, B) of the height that a beam ends at by its range alone, m"""
    way_m: Array = shaped("N")
    """(N,) since the ping before, m"""

    def rows(self, kept: slice | Array) -> Track:
        """Return some of the pings; the ways between them are added up."""
        total = np.cumsum(self.way_m)[kept]
        columns = {n: getattr(self, n)[kept] for n in ("time_s", "x_y", "height", "ends", "sigma")}
        return Track(self.doubt, **columns, way_m=np.diff(total, prepend=total[:1]))


def track_of(
    estimate: Estimate, log: TerrainLog, frame: LocalFrame, *, heading_known: bool = True
) -> Track:
    """Return the pings of a map's log along an estimate that did not know the map.

    Raises :class:`DataError` where no ping with ranges is at a keyframe of the estimate.
    """
    t = estimate.trajectory
    at = np.clip(np.searchsorted(t.time_s, log.time_s), 1, len(t.time_s) - 1)
    at -= log.time_s - t.time_s[at - 1] < t.time_s[at] - log.time_s
    kept = np.abs(t.time_s[at] - log.time_s) < _NEAR_S
    if not kept.any():
        raise DataError(
            "dvl: no ping with ranges lies within the estimate; are their times on one clock?"
        )
    at, rows = at[kept], log.rows(kept)
    R_lb = R_lb_from_roll_pitch_heading(*t.roll_pitch_heading[at].T)
    p_n = frame.p_n_from_geodetic(t.lat[at], t.lon[at], t.height[at])
    end_b = log.lever_arm_b + rows.range_m[..., None] * log.beams_b
    ends = np.einsum("nij,nbj->nbi", R_lb, end_b)
    down = np.abs(np.einsum("nij,bj->nbi", R_lb, log.beams_b)[..., 2])
    return Track(
        doubt=_doubt(estimate, heading_known=heading_known),
        time_s=rows.time_s,
        x_y=p_n[:, :2],
        height=t.height[at],
        ends=ends,
        sigma=log.errors.range_sigma(rows.range_m) * down,
        way_m=rows.way_m,
    )


def _doubt(estimate: Estimate, *, heading_known: bool) -> Doubt:
    """Return what the estimate says of its own errors: they grow from their first to their last."""
    t = estimate.trajectory
    span_s = max(float(t.time_s[-1] - t.time_s[0]), 1.0)
    yaw = t.attitude_sigma[:, 2]
    grown = np.sqrt(max(float(yaw[-1] ** 2 - yaw[0] ** 2), 0.0))
    # Half of the growth may be a bias and half a walk: neither alone must be too narrow.
    return Doubt(
        yaw=float(yaw[0]) if heading_known else np.inf,
        rate=max(grown, _LEAST_TURN) / span_s,
        rate_walk=max(grown, _LEAST_TURN) / np.sqrt(span_s) * _WALK_SHARE,
        scale=_SCALE,
        walk=_WALK,
    )


_LEAST_TURN: Final = np.radians(0.2)
"""rad, over a dive: no dead reckoning is trusted further here."""
_WALK_SHARE: Final = 0.3
_SCALE: Final = 0.003
"""Of a DVL whose scale was not calibrated."""
_WALK: Final = 0.05
"""m/sqrt(s): beams of 0.02 m/s at some pings a second, and more than that of a good DVL."""


class Counted(NamedTuple):
    """Sigmas of heights that a beam's end is compared with, and how much a ping counts."""

    sigma: Array
    """(..., B) m"""
    share: Array
    """(..., B) 0 to 1, of an independent one"""


def counted(grid: SeabedGrid, errors: MapErrors, track: Track, row: int) -> Counted:
    """Return the sigmas of one ping's beams, and how much it counts beside the pings before.

    Errors that last along the way, those of a cell and of the map's smooth part, are the same for
    so many pings; with d the way since the last one::

        share = s^2 / (range^2 + cell^2 max(1, 2 cell_m / d) + smooth^2 max(1, 2 smooth_m / d))
    """
    way = track.way_m[row]
    of_range = np.square(track.sigma[row])
    cell, smooth = errors.sigma_m**2, errors.smooth_sigma_m**2
    longer = cell * errors.cell_factor(grid.cell_m, way) + smooth * errors.smooth_factor(way)
    total = of_range + cell + smooth
    return Counted(np.sqrt(total), total / (of_range + longer))
