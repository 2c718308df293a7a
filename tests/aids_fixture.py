"""Simulated missions with further aids of every kind."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.mission.estimate import AidTable
from ssm_graph.sensors.compass import HeadingErrors
from ssm_graph.sensors.magnetometer import MagneticErrors
from ssm_graph.sensors.standstill import Standstill
from ssm_graph.simulation import (
    AidSettings,
    BeaconSettings,
    CompassSettings,
    GrossErrors,
    RangingSettings,
    SimulatedMission,
    UsblSettings,
)
from ssm_graph.simulation.magnetometer import MagnetometerSettings
from tests.helpers import simulated

KNOWN = BeaconSettings(3, (200.0, 60.0, -50.0))
UNKNOWN = BeaconSettings(7, (90.0, -80.0, -55.0), (30.0, -25.0, 4.0), (40.0, 40.0, 6.0))
COMPASS_ERRORS = HeadingErrors(
    offset_sigma=math.radians(4.0),
    rate_sigma=math.radians(20.0) / 3600.0,
    walk_sigma=math.radians(0.5),
    correlation_s=200.0,
    one_cycle_sigma=math.radians(2.0),
    two_cycle_sigma=math.radians(1.0),
)


IRON = MagneticErrors(
    field_sigma=0.2e-6, hard_iron_sigma=2e-6, soft_iron_sigma=0.02, walk_sigma=0.1e-6
)


def usbl(rate: float = 0.0, **changes: Any) -> AidSettings:
    """Return acoustic fixes, some of them far off."""
    return AidSettings(usbl=UsblSettings(gross=GrossErrors(rate, (20.0, 100.0)), **changes))


def ranging(*beacons: BeaconSettings, rate: float = 0.0, **changes: Any) -> AidSettings:
    """Return ranges to beacons, some of them far off."""
    gross = GrossErrors(rate, (5.0, 50.0))
    return AidSettings(ranging=RangingSettings(beacons, gross=gross, **changes))


def compass(rate: float = 0.0, **changes: Any) -> AidSettings:
    """Return a compass, disturbed now and then."""
    config: dict[str, Any] = {"errors": COMPASS_ERRORS, "gross": GrossErrors(rate, (0.2, 1.0))}
    return AidSettings(compass=CompassSettings(**(config | changes)))


def magnetometer(rate: float = 0.0, **changes: Any) -> AidSettings:
    """Return a magnetometer on a vehicle of iron, which passes more of it now and then."""
    config: dict[str, Any] = {"errors": IRON, "gross": GrossErrors(rate, (5e-6, 50e-6))}
    return AidSettings(others=(MagnetometerSettings(**(config | changes)),))


def with_every_aid(**changes: Any) -> SimulatedMission:
    """Return a short mission with all of them, a beacon whose place is not known among them."""
    aids = AidSettings(
        usbl=UsblSettings(interval_s=3.1),
        ranging=RangingSettings((KNOWN, UNKNOWN), interval_s=1.3),
        compass=CompassSettings(errors=COMPASS_ERRORS, declination=0.1),
        standstills=(Standstill(4.0, 6.5),),
        others=(MagnetometerSettings(errors=IRON),),
    )
    return simulated(**({"duration_s": 30.0, "aids": aids} | changes))


def weights_of(table: AidTable, name: str) -> Array:
    """Return the weight (M,) of each measurement of an aid, of three components or of one."""
    weight = table.weight[np.array(table.aid) == name]
    step = 3 if name in ("GNSS", "USBL", "standstill", "magnetometer", "feature") else 1
    return np.asarray(weight[::step])
