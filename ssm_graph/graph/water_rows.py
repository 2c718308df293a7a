"""The current in the rows of beams: what those off the water are relative to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factors.water_track import ThroughWater, through_water
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extras
from ssm_graph.mission.current import CURRENT, CURRENT_UP
from ssm_graph.mission.problem import Beams


class WaterRows:
    """Beams of a problem, some of which may be off the water."""

    def __init__(self, beams: Beams, extras: Extras, frame: LocalFrame) -> None:
        self._is_water, self._extras, self._frame = beams.is_water, extras, frame
        self._has_current = CURRENT in extras

    def relative(
        self,
        v_n: Array,
        *,
        p_n: Array,
        walks: Array,
        rows: slice | NDArray[np.intp],
    ) -> ThroughWater | None:
        """Return velocities relative to what reflects each beam; None for all off the ground.

        Parameters
        ----------
        v_n, p_n : (M, 3) m/s and m, of each row, or (3,) of all.
        walks : (M, s) or (s,), extra variables of their keyframes.
        rows : which rows those are.
        """
        is_water = self._is_water[rows]
        if not (self._has_current and is_water.any()):
            return None
        R_nl = np.zeros((len(is_water), 3, 3))
        R_nl[is_water] = self._frame.R_nl_at(p_n if p_n.ndim == 1 else p_n[is_water])
        return through_water(v_n, self._current(walks), R_nl=R_nl, is_water=is_water)

    def fill(self, jacobian: Array, error_D_velocity_n: Array, relative: ThroughWater) -> None:
        """Write the columns of the current into rows (M, E) with those of the velocity (M, 3)."""
        block = (error_D_velocity_n[:, None, :] @ relative.v_D_current)[:, 0]
        jacobian[:, self._extras.columns(CURRENT)] = block[:, :2]
        if CURRENT_UP in self._extras:
            jacobian[:, self._extras.columns(CURRENT_UP)] = block[:, 2:]

    def _current(self, walks: Array) -> Array:
        """Return the current (..., 3) along east, north, up, m/s."""
        nothing = np.zeros(0)
        level = self._extras.value(CURRENT, walks, nothing, default=nothing)
        still = np.zeros((*level.shape[:-1], 1))
        return np.concatenate(
            [level, self._extras.value(CURRENT_UP, walks, nothing, default=still)], axis=-1
        )
