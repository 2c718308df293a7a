"""The Earth's magnetic field in the body, with what is not known of field and iron.

Magnetometers are read faster than the vehicle turns: each keyframe takes the last reading since the
one before, led to it by the gyros.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from factors import so3
from factors.magnetic_field import field_residual
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.usable import require_fields
from ssm_graph.engine.error_state import ROTATION
from ssm_graph.engine.extras import Extra
from ssm_graph.graph.aids.aid import Aid, Keyframes, Linearised, RowStates, along_axes
from ssm_graph.imu.ping_motion import last_readings_led
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.magnetometer import MICROTESLA, MagnetometerLog

EARTH_FIELD: Final = "magnetic_field"
HARD_IRON: Final = "magnetometer_hard_iron"
SOFT_IRON: Final = "magnetometer_soft_iron"
MAGNETIC_WALK: Final = "magnetometer_walk"
_SOFT_LABELS: Final = tuple(f"{SOFT_IRON}_{axes}" for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
_AS_A_TURN: Final = 20.0 * MICROTESLA
"""The level part of the field on most of the Earth: so much of iron turns it by some 1 rad."""


@dataclass(frozen=True, slots=True, eq=False)
class MagneticFields(Aid):
    """Readings of a magnetometer, at most one of a keyframe."""

    SHARED = frozenset({"sigma", "field_enu", "hard_iron_b", "soft_iron", "frame"})
    name = "magnetometer"
    unit = "uT"
    hint = "look at its axes, the stated field and declination, and at what iron is near it"
    section = MagnetometerLog.SECTION

    reading_b: Array
    """(M, 3) T"""
    R_back: Array
    """(M, 3, 3) body axes at the reading to those at the keyframe"""
    sigma: float
    """T, of each axis"""
    field_enu: Array
    """(3,) T, as it is stated"""
    hard_iron_b: Array
    """(3,) T, as it is stated, and so is the next"""
    soft_iron: Array
    """(6,)"""
    frame: LocalFrame

    @classmethod
    def of(cls, aids: Aids, keyframes: Keyframes) -> Self | None:
        """Return the last reading up to each keyframe, of those after the keyframe before."""
        log = aids.get(MagnetometerLog)
        if log is None:
            return None
        frame, imu, keyframe_s, _ = keyframes
        keyframe, reading, R_back = last_readings_led(imu, keyframe_s, log.time_s)
        return cls(
            keyframe=keyframe,
            reading_b=log.field_b[reading],
            R_back=R_back,
            sigma=log.sigma,
            field_enu=log.earth.enu,
            hard_iron_b=np.zeros(3) if log.hard_iron_b is None else log.hard_iron_b,
            soft_iron=np.zeros(6) if log.soft_iron is None else log.soft_iron,
            frame=frame,
        )

    @classmethod
    def variables(cls, aids: Aids) -> tuple[Extra, ...]:
        """Return what is not known of field and iron, where its sigma is above zero."""
        log = aids.get(MagnetometerLog)
        if log is None:
            return ()
        errors, ut = log.errors, MICROTESLA
        axes = tuple(f"{EARTH_FIELD}_{axis}_ut" for axis in ("east", "north", "up"))
        iron = along_axes(f"{HARD_IRON}_{{}}_ut")
        every = [
            Extra(EARTH_FIELD, axes, np.full(3, errors.field_sigma), ut, as_a_turn=_AS_A_TURN),
            Extra(HARD_IRON, iron, np.full(3, errors.hard_iron_sigma), ut, as_a_turn=_AS_A_TURN),
            Extra(SOFT_IRON, _SOFT_LABELS, np.full(6, errors.soft_iron_sigma), as_a_turn=1.0),
        ]
        if errors.walk_sigma > 0.0:
            every.append(
                Extra.gauss_markov(
                    MAGNETIC_WALK,
                    along_axes(f"{MAGNETIC_WALK}_{{}}_ut"),
                    errors.walk_sigma,
                    correlation_s=errors.correlation_s,
                    unit=ut,
                )
            )
        return tuple(extra for extra in every if extra.sigma[0] > 0.0)

    @classmethod
    def require_usable(cls, aids: Aids) -> None:
        """Refuse numbers that are not finite, and times that do not increase."""
        log = aids.get(MagnetometerLog)
        if log is not None:
            usable = {"increasing": "time_s", "positive": "sigma errors.correlation_s"}
            require_fields("aids.magnetometer", log, finite="field_b earth.enu", **usable)

    @property
    def root_information(self) -> Array:
        """(M, 3, 3) 1/uT."""
        return np.broadcast_to(np.eye(3) * (MICROTESLA / self.sigma), (len(self), 3, 3))

    @property
    def labels(self) -> list[str]:
        """(3 M,) body axes."""
        return ["x", "y", "z"] * len(self)

    def measured(self, at: RowStates) -> Linearised:
        """Linearise readings: three components each, body axes of the reading, in microtesla."""
        extras, R_nl = at.extras, self.frame.R_nl_at(at.p_n)
        field_enu = self.field_enu + at.value(EARTH_FIELD, 3)
        residual = field_residual(
            at.R_nb @ self.R_back,
            field_n=so3.times(R_nl, field_enu),
            hard_iron_b=self.hard_iron_b + at.value(HARD_IRON, 3) + at.value(MAGNETIC_WALK, 3),
            soft_iron=self.soft_iron + at.value(SOFT_IRON, 6),
            reading_b=self.reading_b,
        )
        jacobian = np.zeros((*residual.error.shape, extras.width))
        jacobian[..., ROTATION] = residual.error_D_rotation @ np.swapaxes(self.R_back, -1, -2)
        blocks = {
            EARTH_FIELD: residual.error_D_field_n @ R_nl,
            HARD_IRON: np.eye(3),
            MAGNETIC_WALK: np.eye(3),
            SOFT_IRON: residual.error_D_soft_iron,
        }
        extras.fill(jacobian, blocks)
        return Linearised(residual.error / MICROTESLA, jacobian / MICROTESLA)
