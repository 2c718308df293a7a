"""Aids to attitude and velocity: a compass, and times at rest."""

from __future__ import annotations

from typing import final

import numpy as np

from factors.compass_heading import CompassErrors, heading_residual
from factors.standstill import standstill_residual
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import ROTATION, VELOCITY
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.aids.weighted import Measured, WeightedAid
from ssm_graph.graph.augmented_rows import Rows, RowStates
from ssm_graph.mission.aid_errors import (
    HEADING_OFFSET,
    HEADING_ONE_CYCLE,
    HEADING_RATE,
    HEADING_TWO_CYCLE,
    HEADING_WALK,
)
from ssm_graph.mission.further_aids import Headings, Standstills


@final
class HeadingAid(WeightedAid):
    """Compass headings with the errors that are to be estimated."""

    name = "heading"
    unit = "rad"
    hint = "look at its sign, declination and mounting, and at what iron is near it"

    def __init__(self, headings: Headings, extras: Extras, frame: LocalFrame) -> None:
        roots = np.full((len(headings.keyframe), 1, 1), 1.0 / headings.sigma)
        super().__init__(headings.keyframe, roots, ["heading"] * len(roots))
        self._headings, self._extras, self._frame = headings, extras, frame

    def measured(self, at: RowStates, rows: Rows | int) -> Measured:
        """Linearise headings: one component each."""
        extras, headings = self._extras, self._headings
        R_nl, R_back = self._frame.R_nl_at(at.p_n), headings.R_back[rows]
        since_s = headings.since_s[rows, None]
        offset = self._value(at, HEADING_OFFSET, 1) + self._value(at, HEADING_WALK, 1)
        offset = offset + since_s * self._value(at, HEADING_RATE, 1)
        residual = heading_residual(
            at.R_nb @ R_back,
            east_n=R_nl[..., 0],
            north_n=R_nl[..., 1],
            errors=CompassErrors(
                offset[..., 0],
                self._value(at, HEADING_ONE_CYCLE, 2),
                self._value(at, HEADING_TWO_CYCLE, 2),
            ),
            heading=headings.heading[rows],
        )
        jacobian = np.zeros((*residual.error.shape, 1, extras.width))
        turned = (R_back @ residual.error_D_rotation[..., None])[..., 0]
        jacobian[..., 0, ROTATION] = turned
        one = np.ones((*residual.error.shape, 1))
        for name, block in (
            (HEADING_OFFSET, one),
            (HEADING_RATE, since_s),
            (HEADING_WALK, one),
            (HEADING_ONE_CYCLE, residual.error_D_one_cycle),
            (HEADING_TWO_CYCLE, residual.error_D_two_cycle),
        ):
            if name in extras:
                jacobian[..., 0, extras.columns(name)] = block
        return Measured(residual.error[..., None], jacobian)

    def _value(self, at: RowStates, name: str, size: int) -> Array:
        return self._extras.value(name, at.walks, at.constants, default=np.zeros(size))


@final
class StandstillAid(WeightedAid):
    """Velocities of zero."""

    name = "standstill"
    unit = "m/s"
    hint = "look at its begin and end"

    def __init__(self, standstills: Standstills, extras: Extras) -> None:
        roots = np.eye(3) / standstills.sigma[:, None, None]
        super().__init__(standstills.keyframe, roots, ("east", "north", "up") * len(roots))
        self._width = extras.width

    def measured(self, at: RowStates, rows: Rows | int) -> Measured:  # noqa: ARG002
        """Linearise velocities: three components each."""
        residual = standstill_residual(at.v_n)
        jacobian = np.zeros((*residual.error.shape, self._width))
        jacobian[..., VELOCITY] = residual.error_D_velocity_n
        return Measured(residual.error, jacobian)
