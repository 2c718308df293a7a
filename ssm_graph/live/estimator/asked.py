"""What a vehicle asks the estimator to find beside its states, and what it cannot have."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.engine.extras import Extras
from ssm_graph.mission.calibration import calibration_extras, taken_as_exact, windowed
from ssm_graph.mission.current import current_extras
from ssm_graph.mission.vehicle import Vehicle
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
    depth = vehicle.depth
    return Sensors(
        frame,
        vehicle.mount.lever_arm_b,
        np.zeros(3) if depth is None else depth.lever_arm_b,
        vehicle.gnss.lever_arm_b,
        np.inf if depth is None else depth.sigma,
        vehicle.mount.R_bd,
        extras_of_vehicle(vehicle),
    )


def _asked(vehicle: Vehicle) -> Extras:
    depth = None if vehicle.depth is None else vehicle.depth.calibration
    of_water = () if vehicle.current is None else current_extras(vehicle.current)
    of_instruments = calibration_extras(vehicle.mount, depth, vehicle.gnss.calibration)
    return Extras((*of_instruments, *of_water))
