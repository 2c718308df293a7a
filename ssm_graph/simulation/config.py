"""The settings of a simulated mission."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation._checks import require, require_fraction, require_positive
from ssm_graph.simulation.aids import DepthSettings, GnssSettings
from ssm_graph.simulation.currents import CurrentSettings, WaterTrack
from ssm_graph.simulation.dvl_model import DvlSettings
from ssm_graph.simulation.faults import Loss, Outliers
from ssm_graph.simulation.further_aids import AidSettings
from ssm_graph.simulation.grades import IMU_NOISE, START_SIGMAS, Grade, StartSigmas
from ssm_graph.simulation.programmed import Fault
from ssm_graph.simulation.routes import Route, SurveyRoute
from ssm_graph.simulation.trajectory import Trajectory, Waves


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationConfig:
    """All of a simulated mission; angles in radians, times in seconds since the start."""

    name: str = "survey"
    """Name of the mission."""
    route: Route = SurveyRoute()
    waves: Waves = Waves()
    duration_s: float = 1200.0
    lat: float = math.radians(45.7)
    """Latitude of the start, rad, within 80 degrees of the equator."""
    lon: float = math.radians(126.6)
    """rad"""
    seed: int = 0
    """Same seed, same mission; every source of error has a stream of its own."""

    grade: Grade = Grade.NAVIGATION
    imu_noise: ImuNoise | None = None
    """Noise of the inertial sensors; None for that of the grade."""
    start_sigmas: StartSigmas | None = None
    """How well the initial state is known; None for that of the grade."""
    imu_rate_hz: float = 100.0
    reference_rate_hz: float = 10.0
    """At 10 Hz cubic interpolation of the truth errs by less than 0.1 mm."""

    dvl: DvlSettings = field(default_factory=DvlSettings)
    outliers: Outliers = Outliers()
    faults: tuple[Fault, ...] = ()
    losses: tuple[Loss, ...] = ()
    dropout_rate: float = 0.0
    """Fraction of beam readings that are missing, each beam for itself."""
    current: CurrentSettings | None = None
    """None for water at rest."""
    water_track: WaterTrack | None = None
    """None for a DVL that tracks the ground alone."""
    depth: DepthSettings | None = DepthSettings()
    """None for no depth sensor."""
    gnss: GnssSettings | None = None
    """None for no GNSS receiver."""
    aids: AidSettings = AidSettings()
    """Acoustics, compass, times at rest: none of them by default."""

    perfect_sensors: bool = False
    """Draw no sensor error at all; noise stays as stated, outliers and losses as asked for."""
    draw_initial_errors: bool = True
    """Whether the initial state has errors; its sigmas are stated in either case."""

    def __post_init__(self) -> None:
        require_positive("duration_s", self.duration_s, hint="try 1200")
        require_positive("reference_rate_hz", self.reference_rate_hz, hint="try 10 Hz")
        require_fraction("dropout_rate", self.dropout_rate)
        require(
            10.0 <= self.imu_rate_hz <= 10_000.0,
            "imu_rate_hz",
            expected="10 to 10000 Hz",
            got=self.imu_rate_hz,
            hint="try 100 Hz",
        )
        require(
            self.duration_s * self.imu_rate_hz >= 1.0,
            "duration_s",
            expected="at least one IMU sample",
            got=self.duration_s,
            hint="make the mission longer",
        )
        require(
            isinstance(self.seed, (int, np.integer)) and self.seed >= 0,
            "seed",
            expected="a whole number from 0",
            got=self.seed,
            hint="the number of the trial makes a good seed",
        )
        _ = self.trajectory  # checks the place of the start

    @property
    def trajectory(self) -> Trajectory:
        """The closed-form motion."""
        return Trajectory(self.route, self.waves, self.lat, self.lon)

    @property
    def noise(self) -> ImuNoise:
        """The noise of the inertial sensors, by default that of the grade."""
        return IMU_NOISE[self.grade] if self.imu_noise is None else self.imu_noise

    @property
    def initial_sigmas(self) -> StartSigmas:
        """Standard deviations of the initial state, by default those of the grade."""
        return START_SIGMAS[self.grade] if self.start_sigmas is None else self.start_sigmas
