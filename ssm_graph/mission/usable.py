"""Last check of a mission before GTSAM sees it: GTSAM takes NaN and zero sigmas without a word."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.usable import require_finite, require_increasing, require_positive
from ssm_graph.graph.aids import AIDS
from ssm_graph.mission.mission import Mission


def require_usable(mission: Mission) -> None:
    """Raise :class:`DataError` for a value that no estimator can use, with its name and place.

    The reader of mission folders refuses all of these with file and line; missions made in Python
    come without it.
    """
    imu, dvl = mission.imu, mission.dvl
    require_finite("imu.start_s", np.array([imu.start_s]))
    require_finite("imu.time_s", imu.time_s)
    require_finite("imu.gyro_b", imu.gyro_b)
    require_finite("imu.accel_b", imu.accel_b)
    require_increasing("imu.time_s", np.concatenate([[imu.start_s], imu.time_s]))
    for name in ("gyro_density", "accel_density", "gyro_bias_sigma", "accel_bias_sigma"):
        require_positive(f"imu.noise.{name}", np.array([getattr(imu.noise, name)]))
    require_increasing("dvl.time_s", dvl.time_s)
    require_finite("dvl.mount.beams_b", dvl.mount.beams_b)
    require_finite("dvl.mount.lever_arm_b", dvl.mount.lever_arm_b)
    has_speed = ~np.isnan(dvl.speed)
    require_finite("dvl.speed", np.where(has_speed, dvl.speed, 0.0))
    require_positive("dvl.sigma", np.where(has_speed, dvl.sigma, 1.0))
    if mission.current is not None:
        require_positive("current.sigma", np.array([mission.current.sigma]))
        require_positive("current.correlation_s", np.array([mission.current.correlation_s]))
    _require_aids(mission)
    for kind in AIDS:
        kind.require_usable(mission.aids)


def _require_aids(mission: Mission) -> None:
    depth, gnss, initial = mission.depth, mission.gnss, mission.initial
    if depth is not None:
        require_increasing("depth.time_s", depth.time_s)
        require_positive("depth.sigma", np.array([depth.sigma]))
        for name in ("depth", "lever_arm_b"):
            require_finite(f"depth.{name}", getattr(depth, name))
    if gnss is not None:
        require_increasing("gnss.time_s", gnss.time_s)
        require_positive("gnss.sigma_enu", gnss.sigma_enu)
        for name in ("lat", "lon", "height", "lever_arm_b"):
            require_finite(f"gnss.{name}", getattr(gnss, name))
    if initial is not None:
        for name in ("time_s", "lat", "lon", "height", "roll", "pitch", "heading"):
            require_finite(f"initial.{name}", np.array([getattr(initial, name)]))
        require_finite("initial.velocity_enu", initial.velocity_enu)
        for name in ("position_sigma_enu", "velocity_sigma_enu", "attitude_sigma"):
            require_positive(f"initial.{name}", getattr(initial, name))
