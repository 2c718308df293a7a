"""Scenarios by name, for the command line and for quick experiments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.sensors.compass import HeadingErrors
from ssm_graph.simulation.aids import GnssSettings
from ssm_graph.simulation.config import SimulationConfig
from ssm_graph.simulation.currents import CurrentSettings, WaterTrack
from ssm_graph.simulation.dvl_model import DvlSettings
from ssm_graph.simulation.faults import Loss, OutlierKind, Outliers
from ssm_graph.simulation.further_aids import (
    AidSettings,
    BeaconSettings,
    CompassSettings,
    GrossErrors,
    RangingSettings,
    UsblSettings,
)
from ssm_graph.simulation.programmed import Fault
from ssm_graph.simulation.routes import (
    DepthProfile,
    DiveRoute,
    HoverRoute,
    SpiralRoute,
    SurveyRoute,
    TransitRoute,
)


@dataclass(frozen=True, slots=True)
class Scenario:
    """Settings that belong together, with a line of description."""

    description: str
    config: SimulationConfig


_DEMO = SimulationConfig(
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
            SimulationConfig(name="survey"),
        ),
        "spiral": Scenario(
            "flat spiral outwards from a radius of 15 m at 20 m depth, 20 min, in waves",
            SimulationConfig(name="spiral", route=SpiralRoute()),
        ),
        "dive": Scenario(
            "helix from the surface to 60 m and up again within 20 min, GNSS at the surface",
            SimulationConfig(name="dive", route=DiveRoute(), gnss=GnssSettings()),
        ),
        "hover": Scenario(
            "station keeping with slow sway at 15 m depth, 20 min, in waves",
            SimulationConfig(name="hover", route=HoverRoute()),
        ),
        "transit": Scenario(
            "straight run of 14.4 km at 40 m depth, 2 h, in waves",
            SimulationConfig(name="transit", route=TransitRoute(), duration_s=7200.0),
        ),
        "aided": Scenario(
            "survey with late acoustic fixes, ranges to a known and an unknown beacon, a compass; "
            "5 % of them grossly wrong",
            SimulationConfig(name="aided", aids=_AIDED),
        ),
        "midwater": Scenario(
            "survey lines at 30 m depth, 40 min, a tide of 0.5 m/s: half without bottom lock",
            SimulationConfig(
                name="midwater",
                duration_s=2400.0,
                losses=(Loss(start_s=600.0, end_s=1800.0),),
                current=CurrentSettings(tide=0.5, vertical_sigma=0.01),
                water_track=WaterTrack(every=10),
            ),
        ),
        "demo": Scenario(
            "GNSS start, dive, 20 min of survey lines: outliers, a burst, dropouts, a bottom loss",
            _DEMO,
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
