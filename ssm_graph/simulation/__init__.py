"""Simulated missions with truth; shares no formula with the estimators but the Earth itself.

``simulate(scenario_config("survey", grade=Grade.TACTICAL, seed=3)).mission``
"""

from ssm_graph.simulation.aids import (
    AidSettings,
    BeaconSettings,
    CompassSettings,
    DepthSettings,
    GnssSettings,
    GrossErrors,
    RangingSettings,
    UsblSettings,
)
from ssm_graph.simulation.beam_faults import Loss, OutlierKind, Outliers
from ssm_graph.simulation.config import SCENARIOS, Scenario, SimulationConfig, scenario_config
from ssm_graph.simulation.currents import Current, CurrentSettings, WaterTrack
from ssm_graph.simulation.dvl_model import DvlSettings, default_mount, janus_beams
from ssm_graph.simulation.faults import Fault, FaultShape, Sensor
from ssm_graph.simulation.inertial import IMU_NOISE, START_SIGMAS, Grade, StartSigmas
from ssm_graph.simulation.instruments import (
    INERTIAL_ERRORS,
    BeamNoise,
    InertialErrors,
    InstrumentErrors,
    errors_of,
)
from ssm_graph.simulation.lasting_faults import BrokenMission, with_faults
from ssm_graph.simulation.mission import SimulatedMission, simulate, with_dvl_errors
from ssm_graph.simulation.randomness import DriftSettings, SlowPart
from ssm_graph.simulation.routes import (
    DepthProfile,
    DiveRoute,
    HoverRoute,
    Route,
    SpiralRoute,
    SurveyRoute,
    TransitRoute,
)
from ssm_graph.simulation.trajectory import CALM, Trajectory, Waves

__all__ = [
    "CALM",
    "IMU_NOISE",
    "INERTIAL_ERRORS",
    "SCENARIOS",
    "START_SIGMAS",
    "AidSettings",
    "BeaconSettings",
    "BeamNoise",
    "BrokenMission",
    "CompassSettings",
    "Current",
    "CurrentSettings",
    "DepthProfile",
    "DepthSettings",
    "DiveRoute",
    "DriftSettings",
    "DvlSettings",
    "Fault",
    "FaultShape",
    "GnssSettings",
    "Grade",
    "GrossErrors",
    "HoverRoute",
    "InertialErrors",
    "InstrumentErrors",
    "Loss",
    "OutlierKind",
    "Outliers",
    "RangingSettings",
    "Route",
    "Scenario",
    "Sensor",
    "SimulatedMission",
    "SimulationConfig",
    "SlowPart",
    "SpiralRoute",
    "StartSigmas",
    "SurveyRoute",
    "Trajectory",
    "TransitRoute",
    "UsblSettings",
    "WaterTrack",
    "Waves",
    "default_mount",
    "errors_of",
    "janus_beams",
    "scenario_config",
    "simulate",
    "with_dvl_errors",
    "with_faults",
]
