"""Position fixes of GNSS, with lever arm, clock and slow errors in doubt where asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray

from factors.gnss_position import fix_residual
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices
from ssm_graph.engine.error_state import POSITION, ROTATION, VELOCITY
from ssm_graph.engine.extras import Extra
from ssm_graph.graph.aids.aid import Aid, Linearised, RowStates, along_axes, drift_variable
from ssm_graph.imu.ping_motion import mean_gyro
from ssm_graph.sensors.acoustic import UsblLog
from ssm_graph.sensors.gnss import GnssCalibration, GnssLog
from ssm_graph.sensors.imu import ImuLog

GNSS_LEVER_ARM: Final = "gnss_lever_arm"
GNSS_TIME_OFFSET: Final = "gnss_time_offset"
GNSS_DRIFT: Final = "gnss_drift"
EAST_NORTH_UP: Final = ("east", "north", "up")
NO_HEIGHT: Final = 1e3
"""m, the sigma of a height that says nothing: far beyond what any height is uncertain by."""


@dataclass(frozen=True, slots=True, eq=False)
class Fixes(Aid):
    """Position fixes at their keyframes, in the navigation frame."""

    SHARED = frozenset({"lever_arm_b", "white_share"})
    name = "GNSS"
    unit = "m"
    hint = "look for a wrong datum or lever arm"
    LEVER_ARM: ClassVar[str] = GNSS_LEVER_ARM
    TIME_OFFSET: ClassVar[str] = GNSS_TIME_OFFSET
    DRIFT: ClassVar[str] = GNSS_DRIFT

    position_n: Array
    """(M, 3) m"""
    covariance_n: Array
    """(M, 3, 3) m^2"""
    gyro_b: Array
    """(M, 3) rad/s, at the fixes: with a clock in doubt it moves the antenna"""
    lever_arm_b: Array
    """(3,) m"""
    white_share: float = 1.0
    """Of the sigmas, what is white where their drift is a variable"""

    @classmethod
    def of_log(
        cls,
        log: GnssLog | UsblLog,
        rows: Indices,
        *,
        time_s: Array,
        keyframe: Indices,
        frame: LocalFrame,
        imu: ImuLog,
    ) -> Self:
        """Return some rows (F,) of a log of positions, valid at times (F,), at keyframes (F,)."""
        if len(rows) == 0:
            none = np.zeros((0, 3))
            return cls(keyframe, none, np.zeros((0, 3, 3)), none, log.lever_arm_b)
        place_n = frame.p_n_from_geodetic(log.lat[rows], log.lon[rows], log.height[rows])
        R_nl = frame.R_nl_at(place_n)
        covariance_l = log.sigma_enu[rows][:, :, None] ** 2 * np.eye(3)
        return cls(
            keyframe=keyframe,
            position_n=place_n,
            covariance_n=np.asarray(R_nl @ covariance_l @ np.swapaxes(R_nl, 1, 2)),
            gyro_b=mean_gyro(imu, time_s),
            lever_arm_b=log.lever_arm_b,
        )

    @property
    def root_information(self) -> Array:
        """(M, 3, 3) 1/m."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance_n)))

    @property
    def has_height(self) -> NDArray[np.bool_]:
        """(M,) whether the height says anything."""
        return np.asarray(np.trace(self.covariance_n, axis1=1, axis2=2) < NO_HEIGHT**2)

    def without_height(self, which: NDArray[np.bool_], frame: LocalFrame) -> Self:
        """Return the same with heights that say nothing where ``which`` (M,) is true."""
        up_n = frame.R_nl_at(self.position_n)[..., 2] * which[:, None]
        unknown = NO_HEIGHT**2 * up_n[:, :, None] * up_n[:, None, :]
        return self._with({"covariance_n": self.covariance_n + unknown})

    @property
    def labels(self) -> list[str]:
        """(3 M,) axes."""
        return [*EAST_NORTH_UP] * len(self)

    def rate(self, at: RowStates) -> Array:
        """Return the velocity (M, 3) of the antenna, m/s."""
        swing_b = np.cross(self.gyro_b - at.bias[..., 3:], self.lever_arm_b)
        return np.asarray(at.v_n + (at.R_nb @ swing_b[..., None])[..., 0])

    def measured(self, at: RowStates) -> Linearised:
        """Linearise fixes: three components each."""
        extras = at.extras
        residual = fix_residual(
            at.R_nb,
            at.p_n,
            at.v_n,
            lever_arm_b=self.lever_arm_b + at.value(self.LEVER_ARM, 3),
            time_offset=at.value(self.TIME_OFFSET, 1)[..., 0],
            omega_b=self.gyro_b - at.bias[..., 3:],
            position_n=self.position_n,
        )
        jacobian = np.zeros((*residual.error.shape, extras.width))
        jacobian[..., ROTATION] = residual.error_D_rotation
        jacobian[..., POSITION] = residual.error_D_position
        jacobian[..., VELOCITY] = residual.error_D_velocity_n
        if self.LEVER_ARM in extras:
            jacobian[..., extras.columns(self.LEVER_ARM)] = residual.error_D_lever_arm_b
        if self.TIME_OFFSET in extras:
            clock = residual.error_D_time_offset[..., None]
            jacobian[..., extras.columns(self.TIME_OFFSET)] = clock
        if self.DRIFT in extras:
            jacobian[..., extras.columns(self.DRIFT)] = np.eye(3)
        return Linearised(residual.error + at.value(self.DRIFT, 3), jacobian)


def gnss_variables(calibration: GnssCalibration) -> tuple[Extra, ...]:
    """Return what the sigmas of a receiver switch on."""
    arm_sigma = np.full(3, calibration.lever_arm_sigma)
    late_sigma_s = np.array([calibration.time_offset_sigma_s])
    known = (
        Extra(GNSS_LEVER_ARM, along_axes("gnss_lever_arm_{}_m"), arm_sigma, as_a_turn=1e2),
        Extra(GNSS_TIME_OFFSET, ("gnss_time_offset_s",), late_sigma_s, as_a_turn=1e1),
    )
    labels, shares = along_axes("gnss_drift_{}_m"), np.array([1.0, 1.0, calibration.drift_up_share])
    return (*known, *drift_variable(GNSS_DRIFT, labels, calibration.drift, shares=shares))
