"""Compass headings with the errors of the compass that are to be estimated.

Compasses are read faster than the vehicle turns: each keyframe takes the last reading since the one
before, led to it by the gyros.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from factors.compass_heading import CompassErrors, heading_residual
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.usable import require_fields
from ssm_graph.engine.error_state import ROTATION
from ssm_graph.engine.extras import Extra
from ssm_graph.graph.aids.aid import Aid, Keyframes, Linearised, RowStates
from ssm_graph.imu.ping_motion import last_readings_led
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.compass import HeadingLog

HEADING_OFFSET: Final = "heading_offset"
HEADING_RATE: Final = "heading_rate"
HEADING_WALK: Final = "heading_walk"
HEADING_ONE_CYCLE: Final = "heading_one_cycle"
HEADING_TWO_CYCLE: Final = "heading_two_cycle"
_WAVES: Final = ("_sine", "_cosine")


@dataclass(frozen=True, slots=True, eq=False)
class Headings(Aid):
    """Compass readings, at most one of a keyframe."""

    SHARED = frozenset({"sigma", "frame"})
    name = "heading"
    unit = "rad"
    hint = "look at its sign, declination and mounting, and at what iron is near it"
    section = HeadingLog.SECTION

    heading: Array
    """(M,) rad, clockwise from true north but for the compass's errors"""
    since_s: Array
    """(M,) from the first reading of all to each, s"""
    R_back: Array
    """(M, 3, 3) body axes at the reading to those at the keyframe"""
    sigma: float
    """rad"""
    frame: LocalFrame

    @classmethod
    def of(cls, aids: Aids, keyframes: Keyframes) -> Self | None:
        """Return the last reading up to each keyframe, of those after the keyframe before."""
        log = aids.get(HeadingLog)
        if log is None:
            return None
        frame, imu, keyframe_s, begin_s = keyframes
        time_s = log.time_s
        keyframe, reading, R_back = last_readings_led(imu, keyframe_s, time_s)
        if begin_s is None:
            begin_s = float(time_s[0]) if len(time_s) else 0.0
        return cls(
            keyframe=keyframe,
            heading=log.heading[reading] + log.declination,
            since_s=time_s[reading] - begin_s,
            R_back=R_back,
            sigma=log.sigma,
            frame=frame,
        )

    @classmethod
    def variables(cls, aids: Aids) -> tuple[Extra, ...]:
        """Return the errors of the compass whose sigmas are above zero."""
        log = aids.get(HeadingLog)
        if log is None:
            return ()
        errors, degree = log.errors, math.radians(1.0)
        every = [
            Extra(
                name,
                tuple(f"{name}{w}_{unit}" for w in waves),
                np.full(len(waves), sigma),
                si,
                as_a_turn=1.0,
            )
            for name, sigma, waves, unit, si in (
                (HEADING_OFFSET, errors.offset_sigma, ("",), "deg", degree),
                (HEADING_ONE_CYCLE, errors.one_cycle_sigma, _WAVES, "deg", degree),
                (HEADING_TWO_CYCLE, errors.two_cycle_sigma, _WAVES, "deg", degree),
                (HEADING_RATE, errors.rate_sigma, ("",), "deg_per_h", degree / 3600.0),
            )
        ]
        if errors.walk_sigma > 0.0:
            every.append(
                Extra.gauss_markov(
                    HEADING_WALK,
                    (f"{HEADING_WALK}_deg",),
                    errors.walk_sigma,
                    correlation_s=errors.correlation_s,
                    unit=degree,
                )
            )
        return tuple(extra for extra in every if extra.sigma[0] > 0.0)

    @classmethod
    def require_usable(cls, aids: Aids) -> None:
        """Refuse numbers that are not finite, and times that do not increase."""
        log = aids.get(HeadingLog)
        if log is not None:
            usable = {"increasing": "time_s", "positive": "sigma errors.correlation_s"}
            require_fields("aids.heading", log, finite="heading", **usable)

    @property
    def root_information(self) -> Array:
        """(M, 1, 1) 1/rad."""
        return np.full((len(self), 1, 1), 1.0 / self.sigma)

    @property
    def labels(self) -> list[str]:
        """(M,) always the same."""
        return ["heading"] * len(self)

    def measured(self, at: RowStates) -> Linearised:
        """Linearise headings: one component each."""
        extras, since_s = at.extras, self.since_s[:, None]
        R_nl = self.frame.R_nl_at(at.p_n)
        offset = at.value(HEADING_OFFSET, 1) + at.value(HEADING_WALK, 1)
        offset = offset + since_s * at.value(HEADING_RATE, 1)
        residual = heading_residual(
            at.R_nb @ self.R_back,
            east_n=R_nl[..., 0],
            north_n=R_nl[..., 1],
            errors=CompassErrors(
                offset[..., 0], at.value(HEADING_ONE_CYCLE, 2), at.value(HEADING_TWO_CYCLE, 2)
            ),
            heading=self.heading,
        )
        jacobian = np.zeros((*residual.error.shape, 1, extras.width))
        turned = (self.R_back @ residual.error_D_rotation[..., None])[..., 0]
        jacobian[..., 0, ROTATION] = turned
        one = np.ones((*residual.error.shape, 1))
        blocks = {
            HEADING_OFFSET: one,
            HEADING_RATE: since_s,
            HEADING_WALK: one,
            HEADING_ONE_CYCLE: residual.error_D_one_cycle,
            HEADING_TWO_CYCLE: residual.error_D_two_cycle,
        }
        extras.fill(jacobian[..., 0, :], blocks)
        return Linearised(residual.error[..., None], jacobian)
