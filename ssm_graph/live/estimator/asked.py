"""What a vehicle asks the estimator to find beside its states, and what it cannot have."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.aids.aid import Aid
from ssm_graph.graph.aids.depth import DepthMeans, Depths
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.live.estimator.buffers import depth_of, gnss_of
from ssm_graph.mission.calibration import calibration_extras, taken_as_exact, windowed
from ssm_graph.mission.current import current_extras
from ssm_graph.mission.problem import Beams
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.smoothers.keyframe import Sensors


def extras_of_vehicle(vehicle: Vehicle) -> Extras:
    """Return what is carried in each keyframe's state."""
    return windowed(_asked(vehicle))


def not_calibrated(vehicle: Vehicle) -> tuple[str, ...]:
    """Return the note of what it asks to calibrate and is taken as stated."""
    carried = extras_of_vehicle(vehicle)
    return taken_as_exact(_asked(vehicle).without([block.name for block in carried.blocks]))


def sensors_of_vehicle(vehicle: Vehicle, frame: LocalFrame) -> Sensors:
    """Return what is the same at all keyframes."""
    imu = ImuLog(0.0, vehicle.imu_noise, np.ones(1), np.zeros((1, 3)), np.zeros((1, 3)))
    fixes = Fixes.of_log(
        gnss_of(vehicle, np.zeros((0, 7))),
        np.zeros(0, np.intp),
        time_s=np.zeros(0),
        keyframe=np.zeros(0, np.intp),
        frame=frame,
        imu=imu,
    )
    depth, none_s = depth_of(vehicle, np.zeros((0, 2))), np.zeros(1)
    aids: list[Aid] = [fixes]
    if depth is not None:
        aids.append(DepthMeans.of_readings(Depths.of(depth, imu, none_s), none_s, frame))
    return Sensors.of(frame, Beams.of_mount(vehicle.mount), iter(aids), extras_of_vehicle(vehicle))


def _asked(vehicle: Vehicle) -> Extras:
    depth = None if vehicle.depth_sigma is None else vehicle.depth_calibration
    of_water = () if vehicle.current is None else current_extras(vehicle.current)
    of_instruments = calibration_extras(vehicle.mount, depth, vehicle.gnss_calibration)
    return Extras((*of_instruments, *of_water))
