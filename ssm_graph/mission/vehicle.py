"""What is known of a vehicle before its first message."""

from __future__ import annotations

from dataclasses import dataclass

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.mission.mission import InitialState
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthCalibration
from ssm_graph.sensors.dvl import DvlMount
from ssm_graph.sensors.gnss import GnssCalibration
from ssm_graph.sensors.imu import ImuNoise


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle(FrozenArrays):
    """What is known of a vehicle and its instruments before the first message."""

    name: str
    imu_noise: ImuNoise
    mount: DvlMount
    beam_sigma: float
    """Nominal standard deviation of a beam speed, m/s."""
    depth_lever_arm_b: Array = shaped(3)
    """(3,) body origin to depth sensor, m."""
    gnss_lever_arm_b: Array = shaped(3)
    """(3,) body origin to antenna, m."""
    water_sigma: float | None = None
    """Nominal standard deviation of a beam speed off the water, m/s; None for as off the ground."""
    current: CurrentModel | None = None
    """What is known of the water's current; None leaves pings off the water out."""
    depth_sigma: float | None = None
    """m; None where there is no depth sensor."""
    depth_calibration: DepthCalibration = DepthCalibration()
    """What is known of the depth sensor's errors."""
    gnss_calibration: GnssCalibration = GnssCalibration()
    """What is known of the receiver's errors."""
    frame: LocalFrame | None = None
    """Navigation frame; None takes the first fix."""
    initial: InitialState | None = None
    """None lets the estimator align itself."""
    further_aids: tuple[str, ...] = ()
    """Sections of its file that only the batch smoother uses."""
