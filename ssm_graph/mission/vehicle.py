"""What is known of a vehicle before its first message."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.mission.mission import NO_AIDS, Aids, InitialState, LocalStart
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import DvlMount, empty_dvl
from ssm_graph.sensors.gnss import GNSS, GnssLog
from ssm_graph.sensors.imu import ImuLog, ImuNoise
from ssm_graph.sensors.imu_calibration import ImuCalibration
from ssm_graph.sensors.standstill import Standstill

GNSS_AT_ORIGIN: Final = GnssLog(**GNSS.empty(), lever_arm_b=np.zeros(3))
"""A receiver of which nothing is stated: its antenna at the body's origin, its clock exact."""


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle:
    """What is known of a vehicle and its instruments before the first message.

    Of each instrument beside IMU and DVL it has a log without rows: noise, lever arm, calibration.
    """

    name: str
    imu_noise: ImuNoise
    mount: DvlMount
    beam_sigma: float
    """Nominal standard deviation of a beam speed, m/s."""
    water_sigma: float | None = None
    """Nominal standard deviation of a beam speed off the water, m/s; None for as off the ground."""
    current: CurrentModel | None = None
    """What is known of the water's current; None leaves pings off the water out."""
    depth: DepthLog | None = None
    """None where there is no depth sensor."""
    gnss: GnssLog = GNSS_AT_ORIGIN
    aids: Aids = NO_AIDS
    """What else it has."""
    frame: LocalFrame | None = None
    """Navigation frame; None takes the first fix."""
    initial: InitialState | None = None
    """None lets the estimator align itself."""
    local: LocalStart | None = None
    """A start at zero where no place on Earth is known; None where one is."""
    imu_calibration: ImuCalibration = ImuCalibration()
    """Of what inertial messages read."""

    @property
    def bare_logs(self) -> Mapping[type, Any]:
        """Every instrument as a log without rows, by the type of the log."""
        none = np.zeros((0, 3))
        imu = ImuLog(0.0, self.imu_noise, np.zeros(0), none, none, self.imu_calibration)
        logs = (imu, empty_dvl(self.mount), self.depth, self.gnss, *self.aids)
        return {
            type(log): log for log in logs if log is not None and not isinstance(log, Standstill)
        }
