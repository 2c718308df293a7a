"""What a vehicle asks the estimator to find beside its states, and what it cannot have."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.aids import AIDS
from ssm_graph.graph.aids.aid import Keyframes
from ssm_graph.live.estimator.buffers import Logs
from ssm_graph.live.estimator.keyframes import aids_at
from ssm_graph.mission.calibration import (
    calibration_extras,
    current_extras,
    taken_as_exact,
    windowed,
)
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
    at_rest = ImuLog(0.0, vehicle.imu_noise, np.ones(1), np.zeros((1, 3)), np.zeros((1, 3)))
    logs = Logs(vehicle.gnss, vehicle.depth, vehicle.aids)
    aids = (aid.take(np.s_[:0]) for aid in aids_at(logs, Keyframes(frame, at_rest, np.arange(2.0))))
    return Sensors.of(frame, Beams.of_mount(vehicle.mount), aids, extras_of_vehicle(vehicle))


def _asked(vehicle: Vehicle) -> Extras:
    depth = None if vehicle.depth is None else vehicle.depth.calibration
    of_instruments = calibration_extras(vehicle.mount, depth, vehicle.gnss.calibration)
    of_aids = (extra for kind in AIDS for extra in kind.variables(vehicle.aids))
    of_water = () if vehicle.current is None else current_extras(vehicle.current)
    return Extras((*of_instruments, *of_aids, *of_water))
