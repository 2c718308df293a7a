"""Simulated missions with miscalibrated instruments, and what of it is truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.data import Array, DepthCalibration, GnssCalibration, Mission
from ssm_graph.simulation import (
    DepthProfile,
    DepthSettings,
    DvlSettings,
    GnssSettings,
    SimulatedMission,
    SurveyRoute,
)
from tests.helpers import simulated

MOUNTING: Array = Rotation.from_euler("ZYX", np.radians([2.0, 0.5, 1.0])).as_rotvec()
"""Yaw 2, pitch 0.5, roll 1 degree, as a rotation vector."""
ARM_ERROR = (0.3, 0.4, 0.0)
TRUTH: dict[str, Array] = {
    "dvl_scale": np.array([-0.03]),
    "dvl_mounting": MOUNTING,
    "dvl_lever_arm": np.array(ARM_ERROR),
    "dvl_time_offset": np.array([0.08]),
    "depth_offset": np.array([0.4]),
    "gnss_lever_arm": np.array([0.2, -0.3, 0.1]),
    "gnss_time_offset": np.array([0.2]),
}
"""What :func:`miscalibrated` does to the instruments, by variable, SI."""


def miscalibrated(**changes: Any) -> SimulatedMission:
    """Return turns at the surface with GNSS and instruments off by :data:`TRUTH`."""
    config: dict[str, Any] = {
        "duration_s": 120.0,
        "imu_rate_hz": 50.0,
        "route": SurveyRoute(line_m=40.0, depth=DepthProfile(0.3, 0.3)),
        "dvl": DvlSettings(
            misalignment=tuple(MOUNTING),
            scale_error=-0.03,
            lever_arm_error_b=ARM_ERROR,
            late_s=0.08,
        ),
        "depth": DepthSettings(offset=0.4),
        "gnss": GnssSettings(
            sigma_horizontal=0.05,
            sigma_vertical=0.1,
            lever_arm_error_b=(0.2, -0.3, 0.1),
            late_s=0.2,
        ),
    }
    return simulated(**(config | changes))


def asking(mission: Mission, **dvl: float) -> Mission:
    """Return the mission with prior sigmas for all that :func:`miscalibrated` gets wrong.

    ``dvl`` : fields of the mount that differ.
    """
    sigmas: dict[str, Any] = {
        "misalignment_sigma": np.radians(2.0),
        "scale_sigma": 0.03,
        "lever_arm_sigma": 0.5,
        "time_offset_sigma_s": 0.1,
    }
    mount = replace(mission.dvl.mount, **(sigmas | dvl))
    depth, gnss = mission.depth, mission.gnss
    if depth is not None:
        depth = replace(depth, calibration=DepthCalibration(offset_sigma=0.5))
    if gnss is not None:
        known = GnssCalibration(lever_arm_sigma=0.4, time_offset_sigma_s=0.3)
        gnss = replace(gnss, calibration=known)
    dvl_log = replace(mission.dvl, mount=mount)
    return replace(mission, dvl=dvl_log, depth=depth, gnss=gnss)


def exact(mission: Mission) -> Mission:
    """Return the mission with everything taken as stated."""
    depth, gnss = mission.depth, mission.gnss
    return replace(
        mission,
        dvl=replace(mission.dvl, mount=mission.dvl.mount.as_stated()),
        depth=None if depth is None else replace(depth, calibration=DepthCalibration()),
        gnss=None if gnss is None else replace(gnss, calibration=GnssCalibration()),
    )
