"""Acoustic aids: position fixes, and ranges to beacons."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from factors.beacon_range import range_residual
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, ROTATION
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.aids.positions import fix_rows
from ssm_graph.graph.aids.weighted import Measured, WeightedAid
from ssm_graph.graph.augmented_rows import Rows, RowStates
from ssm_graph.mission.aid_errors import beacon_name
from ssm_graph.mission.aids import Fixes
from ssm_graph.mission.further_aids import Ranges


@final
class UsblAid(WeightedAid):
    """Position fixes as those of GNSS, of a transponder."""

    name = "USBL"
    unit = "m"
    hint = "look at its delay, datum, lever arm and the ship's heading"

    def __init__(self, fixes: Fixes, extras: Extras) -> None:
        roots = np.linalg.inv(np.linalg.cholesky(fixes.covariance_n))
        super().__init__(fixes.keyframe, roots, ("east", "north", "up") * len(roots))
        self._fixes, self._extras = fixes, extras

    def measured(self, at: RowStates, rows: Rows | int) -> Measured:
        """Linearise fixes: three components each."""
        return Measured(*fix_rows(self._fixes, self._extras, at, rows, of_gnss=False))


@final
class RangeAid(WeightedAid):
    """Ranges to beacons, each at its place as stated or as it is estimated."""

    name = "range"
    unit = "m"
    hint = "look at places and numbers of the beacons, and the speed of sound"

    def __init__(self, ranges: Ranges, extras: Extras) -> None:
        labels = [beacon_name(int(ranges.number[i])) for i in ranges.beacon]
        super().__init__(ranges.keyframe, 1.0 / ranges.sigma[:, None, None], labels)
        self.ranges, self._extras = ranges, extras

    def is_to_known(self, i: int) -> bool:
        """Return whether one of the ranges is to a beacon at a known place."""
        return bool(self.ranges.is_known[self.ranges.beacon[i]])

    def _places_n(self, at: RowStates, beacon: NDArray[np.intp]) -> Array:
        """Return the places (..., 3) of the beacons of some ranges, m."""
        ranges = self.ranges
        found: Array = ranges.beacon_n[beacon]
        for i in np.flatnonzero(~ranges.is_known):
            name = beacon_name(int(ranges.number[i]))
            off = self._extras.value(name, at.walks, at.constants, default=np.zeros(3))
            place_n = ranges.beacon_n[i] + (ranges.R_nl[i] @ off[..., None])[..., 0]
            found = np.where(np.asarray(beacon == i)[..., None], place_n, found)
        return found

    def measured(self, at: RowStates, rows: Rows | int) -> Measured:
        """Linearise ranges: one component each."""
        ranges, beacon = self.ranges, self.ranges.beacon[rows]
        residual = range_residual(
            at.R_nb,
            at.p_n,
            lever_arm_b=ranges.lever_arm_b,
            beacon_n=self._places_n(at, beacon),
            range_m=ranges.range_m[rows],
        )
        jacobian = np.zeros((*residual.error.shape, 1, self._extras.width))
        jacobian[..., 0, ROTATION] = residual.error_D_rotation
        jacobian[..., 0, POSITION] = residual.error_D_position
        for i in np.flatnonzero(~ranges.is_known):
            name = beacon_name(int(ranges.number[i]))
            if name in self._extras:
                is_its = np.asarray(beacon == i)[..., None]
                block = residual.error_D_beacon_n @ ranges.R_nl[i]
                jacobian[..., 0, self._extras.columns(name)] = np.where(is_its, block, 0.0)
        return Measured(residual.error[..., None], jacobian)
