"""Last check of a mission before GTSAM sees it: GTSAM takes NaN and zero sigmas without a word."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.usable import (
    require_fields,
    require_finite,
    require_increasing,
    require_positive,
)
from ssm_graph.graph.aids import AIDS
from ssm_graph.mission.mission import Mission


def require_usable(mission: Mission) -> None:
    """Raise :class:`DataError` for a value that no estimator can use, with its name and place.

    The reader of mission folders refuses all of these with file and line; missions made in Python
    come without it.
    """
    imu, dvl, current, depth = mission.imu, mission.dvl, mission.current, mission.depth
    noise = "noise.gyro_density noise.accel_density noise.gyro_bias_sigma noise.accel_bias_sigma"
    require_fields("imu", imu, finite="start_s time_s gyro_b accel_b", positive=noise)
    require_increasing("imu.time_s", np.concatenate([[imu.start_s], imu.time_s]))
    require_fields("dvl", dvl, increasing="time_s", finite="mount.beams_b mount.lever_arm_b")
    has_speed = ~np.isnan(dvl.speed)
    require_finite("dvl.speed", np.where(has_speed, dvl.speed, 0.0))
    require_positive("dvl.sigma", np.where(has_speed, dvl.sigma, 1.0))
    if current is not None:
        require_fields("current", current, positive="sigma correlation_s")
    if depth is not None:
        known = {"positive": "sigma", "finite": "depth lever_arm_b"}
        require_fields("depth", depth, increasing="time_s", **known)
    if mission.gnss is not None:
        known = {"positive": "sigma_enu", "finite": "lat lon height lever_arm_b"}
        require_fields("gnss", mission.gnss, increasing="time_s", **known)
    if mission.initial is not None:
        state = "time_s lat lon height roll pitch heading velocity_enu"
        sigmas = "position_sigma_enu velocity_sigma_enu attitude_sigma"
        require_fields("initial", mission.initial, finite=state, positive=sigmas)
    for kind in AIDS:
        kind.require_usable(mission.aids)
