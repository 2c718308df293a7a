"""The settings of a simulated mission, and scenarios by name for quick experiments."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.sensors.compass import HeadingErrors
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation import checked
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
from ssm_graph.simulation.currents import CurrentSettings, WaterTrack
from ssm_graph.simulation.dvl_model import DvlSettings, default_mount, janus_beams
from ssm_graph.simulation.faults import Fault
from ssm_graph.simulation.inertial import IMU_NOISE, Grade, StartSigmas
from ssm_graph.simulation.instruments import SIMPLE, InstrumentErrors, errors_of
from ssm_graph.simulation.routes import (
    DepthProfile,
    DiveRoute,
    HoverRoute,
    Route,
    SpiralRoute,
    SurveyRoute,
    TransitRoute,
)
from ssm_graph.simulation.trajectory import Trajectory, Waves

MOST_SAMPLES: Final = 2e8
"""Of an inertial log; more are 10 GB."""
_IMU_RATE = checked.Rule(lambda rate: 10.0 <= rate <= 10_000.0, "10 to 10000 Hz", "try 100 Hz")
_SEED = checked.Rule(
    lambda seed: isinstance(seed, (int, np.integer)) and bool(seed >= 0),
    "a whole number from 0",
    "the number of the trial makes a good seed",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationConfig(checked.Settings):
    """All of a simulated mission; angles in radians, times in seconds since the start."""

    name: str = "survey"
    """Name of the mission."""
    route: Route = SurveyRoute()
    waves: Waves = Waves()
    duration_s: float = checked.positive(1200.0, hint="try 1200")
    lat: float = math.radians(45.7)
    """Latitude of the start, rad, within 80 degrees of the equator."""
    lon: float = math.radians(126.6)
    """rad"""
    seed: int = checked.field(_SEED, 0)
    """Same seed, same mission; every source of error has a stream of its own."""

    grade: Grade = Grade.NAVIGATION
    imu_noise: ImuNoise | None = None
    """Noise of the inertial sensors; None for that of the grade."""
    start_sigmas: StartSigmas | None = None
    """How well the initial state is known; None for that of the grade."""
    imu_rate_hz: float = checked.field(_IMU_RATE, 100.0)
    reference_rate_hz: float = checked.positive(10.0, hint="try 10 Hz")
    """At 10 Hz cubic interpolation of the truth errs by less than 0.1 mm."""

    dvl: DvlSettings = field(default_factory=DvlSettings)
    outliers: Outliers = Outliers()
    faults: tuple[Fault, ...] = ()
    losses: tuple[Loss, ...] = ()
    dropout_rate: float = checked.fraction(0.0)
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

    realistic: bool = False
    """Whether instruments err as real ones of the grade: scale factors, slow noise and more."""
    instruments: InstrumentErrors | None = None
    """Their sizes one by one; None for those of the grade if ``realistic``, for none otherwise."""
    calibrates: bool = False
    """Whether the mission states what its instruments err in slowly, and asks for the calibration
    of what stays the same."""
    perfect_sensors: bool = False
    """Draw no sensor error at all; noise stays as stated, outliers and losses as asked for."""
    draw_initial_errors: bool = True
    """Whether the initial state has errors; its sigmas are stated in either case."""

    def __post_init__(self) -> None:
        super(SimulationConfig, self).__post_init__()
        checked.require(
            self.duration_s * self.imu_rate_hz >= 1.0,
            "SimulationConfig.duration_s",
            expected="at least one IMU sample",
            got=self.duration_s,
            hint="make the mission longer",
        )
        checked.require(
            self.duration_s * self.imu_rate_hz <= MOST_SAMPLES,
            "SimulationConfig.duration_s",
            expected=f"at most {MOST_SAMPLES:g} IMU samples",
            got=self.duration_s,
            hint="make the mission shorter, or lower the rate",
        )
        named = [("Outliers.beam", self.outliers.beams)]
        named += [("Fault.beams", fault.beams) for fault in self.faults]
        named += [("Loss.beams", loss.beams or ()) for loss in self.losses]
        named += [("WaterTrack.beams", self.water_track.beams or ())] if self.water_track else []
        for where, beams in named:
            checked.require_beams(where, beams, self.dvl.mount.n_beams)
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
    def errors(self) -> InstrumentErrors:
        """What instruments do beyond their stated noise."""
        if self.perfect_sensors or not (self.realistic or self.instruments):
            return SIMPLE
        return self.instruments or errors_of(self.grade)


@dataclass(frozen=True, slots=True)
class Scenario:
    """Settings that belong together, with a line of description."""

    description: str
    make: Callable[[], SimulationConfig]

    @property
    def config(self) -> SimulationConfig:
        """The settings, made when they are asked for: a list of names needs none."""
        return self.make()


def _demo() -> SimulationConfig:
    return SimulationConfig(
        name="demo",
        route=SurveyRoute(
            line_m=225.0, depth=DepthProfile(start_m=0.3, end_m=25.0, mid_s=110.0, tau_s=25.0)
        ),
        duration_s=1200.0,
        seed=1,
        dvl=DvlSettings(first_s=0.903, jitter_s=0.02, seabed_depth_m=45.0),
        outliers=Outliers(OutlierKind.SPARSE, rate=0.1),
        faults=(Fault(beams=(1,), start_s=600.0, end_s=615.0, offset_m_per_s=0.8),),
        losses=(Loss(start_s=800.0, end_s=840.0),),
        dropout_rate=0.03,
        gnss=GnssSettings(),
    )


_AIDED = AidSettings(
    usbl=UsblSettings(interval_s=10.0, gross=GrossErrors(0.05, (20.0, 100.0))),
    ranging=RangingSettings(
        (
            BeaconSettings(1, (300.0, 100.0, -60.0)),
            BeaconSettings(
                2,
                enu=(-100.0, 400.0, -60.0),
                stated_off=(50.0, -30.0, 5.0),
                position_sigma=(60.0, 60.0, 8.0),
            ),
        ),
        gross=GrossErrors(0.05, (5.0, 50.0)),
    ),
    compass=CompassSettings(
        errors=HeadingErrors(
            offset_sigma=math.radians(3.0),
            walk_sigma=math.radians(1.0),
            one_cycle_sigma=math.radians(2.0),
        ),
        gross=GrossErrors(0.05, (0.2, 1.0)),
    ),
)

SCENARIOS: Final[Mapping[str, Scenario]] = MappingProxyType(
    {
        "survey": Scenario(
            "lawn-mower lines of 300 m at 30 m depth, 20 min, in waves",
            lambda: SimulationConfig(name="survey"),
        ),
        "spiral": Scenario(
            "flat spiral outwards from a radius of 15 m at 20 m depth, 20 min, in waves",
            lambda: SimulationConfig(name="spiral", route=SpiralRoute()),
        ),
        "dive": Scenario(
            "helix from the surface to 60 m and up again within 20 min, GNSS at the surface",
            lambda: SimulationConfig(name="dive", route=DiveRoute(), gnss=GnssSettings()),
        ),
        "hover": Scenario(
            "station keeping with slow sway at 15 m depth, 20 min, in waves",
            lambda: SimulationConfig(name="hover", route=HoverRoute()),
        ),
        "transit": Scenario(
            "straight run of 14.4 km at 40 m depth, 2 h, in waves",
            lambda: SimulationConfig(name="transit", route=TransitRoute(), duration_s=7200.0),
        ),
        "aided": Scenario(
            "survey with late acoustic fixes, ranges to a known and an unknown beacon, a compass; "
            "5 % of them grossly wrong",
            lambda: SimulationConfig(name="aided", aids=_AIDED),
        ),
        "three-beams": Scenario(
            "survey with a DVL of three beams around",
            lambda: SimulationConfig(
                name="three-beams", dvl=DvlSettings(mount=default_mount(janus_beams(3)))
            ),
        ),
        "velocity": Scenario(
            "survey with a DVL that gives a velocity alone: three beams along its axes",
            lambda: SimulationConfig(
                name="velocity", dvl=DvlSettings(mount=default_mount(np.eye(3)))
            ),
        ),
        "midwater": Scenario(
            "survey lines at 30 m depth, 40 min, a tide of 0.5 m/s: half without bottom lock",
            lambda: SimulationConfig(
                name="midwater",
                duration_s=2400.0,
                losses=(Loss(start_s=600.0, end_s=1800.0),),
                current=CurrentSettings(tide=0.5, vertical_sigma=0.01),
                water_track=WaterTrack(every=10),
            ),
        ),
        "demo": Scenario(
            "GNSS start, dive, 20 min of survey lines: outliers, a burst, dropouts, a bottom loss",
            _demo,
        ),
    }
)
"""What can be simulated by name."""


def scenario_config(name: str, **changes: Any) -> SimulationConfig:
    """Return the settings of a scenario, with fields of :class:`SimulationConfig` changed."""
    scenario = SCENARIOS.get(name)
    if scenario is None:
        raise ConfigError(f"there is no scenario {name!r}; {nearest_hint(name, SCENARIOS)}")
    known = SimulationConfig.__dataclass_fields__
    for key in changes:
        if key not in known:
            raise ConfigError(
                f"scenario {name!r} has no setting {key!r}; {nearest_hint(key, known)}"
            )
    return replace(scenario.config, **changes)
