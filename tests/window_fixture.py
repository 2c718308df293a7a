"""A short simulated mission with instruments that are off in what a window estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssm_graph.mission.estimate import Calibration, Estimate
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.depth import DepthCalibration
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.gnss import GnssCalibration
from ssm_graph.simulation import (
    DepthProfile,
    DepthSettings,
    DriftSettings,
    DvlSettings,
    GnssSettings,
    SimulatedMission,
    SurveyRoute,
)
from ssm_graph.smoothers.fixed_lag import FixedLagConfig
from tests.calibration_cases import MOUNTING, SCALE, as_stated
from tests.helpers import simulated

SHORT = FixedLagConfig(8.0, tolerance=1e-2, max_iterations=5, relinearise_sigmas=1e-2, reweigh=1e-2)


def off(**changes: object) -> SimulatedMission:
    """Return turns with a DVL off in scale and mounting, and slow errors of DVL and GNSS."""
    config = {
        "duration_s": 60.0,
        "imu_rate_hz": 50.0,
        "route": SurveyRoute(line_m=20.0, depth=DepthProfile(0.3, 0.3)),
        "dvl": DvlSettings(
            misalignment=tuple(MOUNTING),
            scale_error=SCALE,
            rate_hz=1.0,
            drift=DriftSettings(0.01, 40.0),
        ),
        "depth": DepthSettings(offset=0.4),
        "gnss": GnssSettings(
            sigma_horizontal=0.1, sigma_vertical=0.2, drift=DriftSettings(0.3, 40.0)
        ),
    }
    return simulated(**(config | changes))


def asked(mission: Mission) -> Mission:
    """Return the mission with prior sigmas of all that is off, and both drifts."""
    mission = as_stated(mission)
    assert mission.gnss is not None
    assert mission.depth is not None
    mount = replace(
        mission.dvl.mount,
        scale_sigma=0.03,
        misalignment_sigma=np.radians(2.0),
        beam_scale_sigma=0.002,
        drift=Drift(0.01, 40.0, white_share=0.8),
    )
    gnss = GnssCalibration(
        lever_arm_sigma=0.1, time_offset_sigma_s=0.1, drift=Drift(0.3, 40.0, white_share=0.8)
    )
    return replace(
        mission,
        dvl=replace(mission.dvl, mount=mount),
        gnss=replace(mission.gnss, calibration=gnss),
        depth=replace(mission.depth, calibration=DepthCalibration(offset_sigma=0.5)),
    )


def found(estimate: Estimate) -> Calibration:
    """Return the calibration of an estimate that has one."""
    assert estimate.calibration is not None
    return estimate.calibration
