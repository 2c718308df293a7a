"""What tests of the witness share: a survey with fixes and depth."""

from __future__ import annotations

from ssm_graph.simulation import (
    DvlSettings,
    GnssSettings,
    Grade,
    SimulatedMission,
    SimulationConfig,
    SurveyRoute,
    simulate,
)


def a_survey(
    *,
    seed: int,
    end_s: float,
    imu_rate_hz: float = 100.0,
    line_m: float = 40.0,
    fixes_from_s: float = 0.0,
) -> SimulatedMission:
    """Return a survey of a tactical grade without faults."""
    return simulate(
        SimulationConfig(
            route=SurveyRoute(line_m=line_m),
            duration_s=end_s,
            seed=seed,
            grade=Grade.TACTICAL,
            dvl=DvlSettings(noise=0.005),
            gnss=GnssSettings(windows=((fixes_from_s, end_s),)),
            imu_rate_hz=imu_rate_hz,
        )
    )
