"""Simulated missions with miscalibrated instruments, and what of it is truth."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.base.frozen import Array
from ssm_graph.graph.aids.depth import DEPTH_OFFSET
from ssm_graph.graph.aids.gnss import GNSS_LEVER_ARM, GNSS_TIME_OFFSET
from ssm_graph.mission.calibration import (
    DVL_LEVER_ARM,
    DVL_MOUNTING,
    DVL_SCALE,
    DVL_TIME_OFFSET,
)
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.depth import DepthCalibration
from ssm_graph.sensors.gnss import GnssCalibration
from ssm_graph.simulation import DepthSettings, DvlSettings, GnssSettings

MOUNTING: Final[Array] = Rotation.from_euler("ZYX", np.radians([2.0, 0.5, 1.0])).as_rotvec()
"""Yaw 2, pitch 0.5, roll 1 degree, as a rotation vector."""
SCALE: Final = -0.03
ARM_ERROR: Final = (0.3, 0.4, 0.0)
"""0.5 m in all."""
LATE_S: Final = 0.08
DVL: Final[dict[str, Array]] = {
    DVL_SCALE: np.array([SCALE]),
    DVL_MOUNTING: MOUNTING,
    DVL_LEVER_ARM: np.array(ARM_ERROR),
    DVL_TIME_OFFSET: np.array([LATE_S]),
}
"""What is wrong with the DVL, by variable, SI."""
AIDS: Final[dict[str, Array]] = {
    DEPTH_OFFSET: np.array([0.4]),
    GNSS_LEVER_ARM: np.array([0.2, -0.3, 0.1]),
    GNSS_TIME_OFFSET: np.array([0.2]),
}
"""What is wrong with depth and GNSS."""


def wrong_dvl(**changes: Any) -> DvlSettings:
    """Return a DVL that is off by :data:`DVL`."""
    settings = DvlSettings(
        misalignment=tuple(MOUNTING),
        scale_error=SCALE,
        lever_arm_error_b=ARM_ERROR,
        late_s=LATE_S,
    )
    return replace(settings, **changes)


def wrong_depth() -> DepthSettings:
    """Return a depth sensor that is off by :data:`AIDS`."""
    return DepthSettings(offset=float(AIDS[DEPTH_OFFSET][0]))


def wrong_gnss(**changes: Any) -> GnssSettings:
    """Return a receiver that is off by :data:`AIDS`."""
    arm = tuple(AIDS[GNSS_LEVER_ARM].tolist())
    settings = GnssSettings(lever_arm_error_b=arm, late_s=float(AIDS[GNSS_TIME_OFFSET][0]))
    return replace(settings, **changes)


def as_stated(mission: Mission) -> Mission:
    """Return the mission with every instrument taken as stated."""
    depth, gnss = mission.depth, mission.gnss
    return replace(
        mission,
        dvl=replace(mission.dvl, mount=mission.dvl.mount.as_stated()),
        depth=None if depth is None else replace(depth, calibration=DepthCalibration()),
        gnss=None if gnss is None else replace(gnss, calibration=GnssCalibration()),
    )


def asking(mission: Mission, variables: Collection[str] = (*DVL, *AIDS), **dvl: float) -> Mission:
    """Return the mission with prior sigmas for some variables, all else taken as stated.

    ``dvl`` : fields of the mount that differ.
    """
    sigmas = {
        DVL_SCALE: {"scale_sigma": 0.03},
        DVL_MOUNTING: {"misalignment_sigma": np.radians(2.0)},
        DVL_LEVER_ARM: {"lever_arm_sigma": 0.5},
        DVL_TIME_OFFSET: {"time_offset_sigma_s": 0.1},
    }
    fields: dict[str, Any] = {}
    for name, sigma in sigmas.items():
        if name in variables:
            fields |= sigma
    mission = as_stated(mission)
    depth, gnss = mission.depth, mission.gnss
    if depth is not None and DEPTH_OFFSET in variables:
        depth = replace(depth, calibration=DepthCalibration(offset_sigma=0.5))
    if gnss is not None:
        doubts = GnssCalibration(
            time_offset_sigma_s=0.3 if GNSS_TIME_OFFSET in variables else 0.0,
            lever_arm_sigma=0.4 if GNSS_LEVER_ARM in variables else 0.0,
        )
        gnss = replace(gnss, calibration=doubts)
    mount = replace(mission.dvl.mount, **(fields | dvl))
    return replace(mission, dvl=replace(mission.dvl, mount=mount), depth=depth, gnss=gnss)


def knowing_dvl(mission: Mission) -> Mission:
    """Return the mission with what is wrong with its DVL stated: that of the oracle."""
    mission = as_stated(mission)
    mount = mission.dvl.mount
    mount = replace(
        mount,
        R_bd=mount.R_bd @ Rotation.from_rotvec(MOUNTING).as_matrix(),
        lever_arm_b=mount.lever_arm_b + ARM_ERROR,
        scale_error=SCALE,
        time_offset_s=LATE_S,
    )
    return replace(mission, dvl=replace(mission.dvl, mount=mount))
