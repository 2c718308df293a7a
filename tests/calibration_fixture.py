"""A short simulated mission with miscalibrated instruments."""

from __future__ import annotations

from typing import Any

from ssm_graph.simulation import DepthProfile, SimulatedMission, SurveyRoute
from tests.calibration_cases import wrong_depth, wrong_dvl, wrong_gnss
from tests.helpers import simulated


def miscalibrated(**changes: Any) -> SimulatedMission:
    """Return turns at the surface with good GNSS, and instruments that are all off."""
    config: dict[str, Any] = {
        "duration_s": 120.0,
        "imu_rate_hz": 50.0,
        "route": SurveyRoute(line_m=40.0, depth=DepthProfile(0.3, 0.3)),
        "dvl": wrong_dvl(),
        "depth": wrong_depth(),
        "gnss": wrong_gnss(sigma_horizontal=0.05, sigma_vertical=0.1),
    }
    return simulated(**(config | changes))
