"""Times at rest: every keyframe within one stands still.

Readings that say so under way hold for a second, and belong to the first keyframe after them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from factors.standstill import standstill_residual
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import MIN_SPACING_S
from ssm_graph.base.usable import require_fields
from ssm_graph.engine.error_state import VELOCITY
from ssm_graph.graph.aids.aid import Aid, Keyframes, Linearised, RowStates
from ssm_graph.graph.aids.gnss import EAST_NORTH_UP
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.standstill import HOLDS_S, RestLog, Standstill


@dataclass(frozen=True, slots=True, eq=False)
class Standstills(Aid):
    """Keyframes at which the vehicle stands still: velocities of zero."""

    name = "standstill"
    unit = "m/s"
    hint = "look at its begin and end"
    section = Standstill.SECTION

    sigma: Array
    """(M,) m/s"""

    @classmethod
    def of(cls, aids: Aids, keyframes: Keyframes) -> Self | None:
        """Return the keyframes within standstills; where two overlap the stricter one counts."""
        standstills, readings = aids.all(Standstill), aids.get(RestLog)
        if not standstills and readings is None:
            return None
        time_s = keyframes.time_s
        sigma = np.full(len(time_s), np.inf)
        if readings is not None:
            at = np.searchsorted(time_s, readings.time_s - MIN_SPACING_S)
            holds = (at < len(time_s)) & (readings.time_s > time_s[0] - MIN_SPACING_S)
            holds[holds] = time_s[at[holds]] - readings.time_s[holds] <= HOLDS_S
            np.minimum.at(sigma, at[holds], readings.counted_sigma[holds])
        for still in standstills:
            inside = (time_s >= still.begin_s) & (time_s <= still.end_s)
            sigma[inside] = np.minimum(sigma[inside], still.sigma)
        keyframe = np.flatnonzero(np.isfinite(sigma))
        return cls(keyframe, sigma[keyframe])

    @classmethod
    def require_usable(cls, aids: Aids) -> None:
        """Refuse readings that are not finite, and times that do not increase."""
        log = aids.get(RestLog)
        if log is not None:
            require_fields("aids.at_rest", log, increasing="time_s", positive="counted_sigma")

    @property
    def root_information(self) -> Array:
        """(M, 3, 3) s/m."""
        return np.asarray(np.eye(3) / self.sigma[:, None, None])

    @property
    def labels(self) -> list[str]:
        """(3 M,) axes."""
        return [*EAST_NORTH_UP] * len(self)

    def measured(self, at: RowStates) -> Linearised:
        """Linearise velocities: three components each."""
        residual = standstill_residual(at.v_n)
        jacobian = np.zeros((*residual.error.shape, at.extras.width))
        jacobian[..., VELOCITY] = residual.error_D_velocity_n
        return Linearised(residual.error, jacobian)


@dataclass(frozen=True, slots=True, eq=False)
class AnySpeed(Standstills):
    """Keyframes of which no more is known than how fast any vehicle is; it counts in full."""

    name = "speed"
    is_weighted = False
