"""What a live estimator is told and what it answers: SI units, radians, body axes FRD."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from ssm_graph.data import (
    N_BEAMS,
    Array,
    DepthCalibration,
    DvlMount,
    FrozenArrays,
    GnssCalibration,
    ImuNoise,
    InitialState,
    shaped,
)
from ssm_graph.earth import LocalFrame
from ssm_graph.water_current import CurrentModel

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One inertial sample, the mean over its interval."""

    time_s: float
    """End of the averaging interval, s on the vehicle's clock."""
    gyro_b: Vector
    """Body rate relative to inertial space, rad/s."""
    accel_b: Vector
    """Specific force, m/s^2; at rest (0, 0, -9.8)."""


@dataclass(frozen=True, slots=True)
class Ping:
    """One ping; a speed is positive when the instrument moves along the beam."""

    time_s: float
    """As stamped, s; the mount's time offset is not yet applied."""
    speed: tuple[float, float, float, float]
    """m/s; NaN marks a beam without lock."""
    sigma: tuple[float, float, float, float] | None = None
    """Standard deviations, m/s; None or NaN is the vehicle's nominal one."""
    is_water: bool = False
    """Whether it is off the water: its speeds are relative to the current, not to the ground."""


@dataclass(frozen=True, slots=True)
class DepthReading:
    """One depth reading."""

    time_s: float
    depth: float
    """m, positive down: minus the height of the sensor; its offset is not yet taken off."""


@dataclass(frozen=True, slots=True)
class Fix:
    """One GNSS fix of the antenna."""

    time_s: float
    lat: float
    """rad"""
    lon: float
    """rad"""
    height: float
    """m above the ellipsoid"""
    sigma_enu: Vector
    """m"""


Message = ImuSample | Ping | DepthReading | Fix


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle(FrozenArrays):
    """What is known of a vehicle and its instruments before the first message."""

    name: str
    imu_noise: ImuNoise
    mount: DvlMount
    beam_sigma: float
    """Nominal standard deviation of a beam speed, m/s."""
    depth_lever_arm_b: Array = shaped(3)
    """(3,) body origin to depth sensor, m."""
    gnss_lever_arm_b: Array = shaped(3)
    """(3,) body origin to antenna, m."""
    water_sigma: float | None = None
    """Nominal standard deviation of a beam speed off the water, m/s; None for as off the ground."""
    current: CurrentModel | None = None
    """What is known of the water's current; None leaves pings off the water out."""
    depth_sigma: float | None = None
    """m; None where there is no depth sensor."""
    depth_calibration: DepthCalibration = DepthCalibration()
    """What is known of the depth sensor's errors."""
    gnss_calibration: GnssCalibration = GnssCalibration()
    """What is known of the receiver's errors."""
    frame: LocalFrame | None = None
    """Navigation frame; None takes the first fix."""
    initial: InitialState | None = None
    """None lets the estimator align itself."""
    further_aids: tuple[str, ...] = ()
    """Sections of its file that only the batch smoother uses."""


class Health(Enum):
    """Whether an answer may be used; the text is shown to the user."""

    ALIGNING = "no answer yet: waiting for data to align with"
    GOOD = "position, velocity and attitude agree with all that is measured"
    DEGRADED = "aids are missing or contradict: sigmas grow and are believed, look at the reason"
    BAD = "the answer must not be used: it has run away or is being recovered"


class Severity(Enum):
    """How much an event matters to the person on watch."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened on the way and that a person may want to know."""

    time_s: float
    """On the vehicle's clock, s."""
    severity: Severity
    kind: str
    """Short and stable, for programs: ``bottom_lost``, ``message_refused``, ``recovered`` ..."""
    text: str
    """One sentence: what came, what was expected, what was done about it."""


@dataclass(frozen=True, slots=True, eq=False)
class Navigation(FrozenArrays):
    """The newest answer of a live estimator, carried to the last inertial sample."""

    time_s: float
    lat: float
    """rad"""
    lon: float
    """rad"""
    height: float
    """m above the ellipsoid"""
    health: Health
    reason: str
    """One sentence."""
    confidence: float
    """0 (do not use) to 1, for control; below 0.5 whenever the health is not good."""
    bottom_lock: bool
    """Whether the last ping is recent and had beams that count."""
    since_aid_s: float
    """Time since any velocity or position aid counted, s; infinite before the first."""
    latency_s: float
    """What the last update cost, s of computing."""
    velocity_enu: Array = shaped(3)
    """(3,) m/s"""
    roll_pitch_heading: Array = shaped(3)
    """(3,) rad"""
    position_sigma_enu: Array = shaped(3)
    """(3,) m"""
    velocity_sigma_enu: Array = shaped(3)
    """(3,) m/s"""
    attitude_sigma: Array = shaped(3)
    """(3,) rad, of roll, pitch and heading"""
    gyro_bias: Array = shaped(3)
    """(3,) rad/s"""
    accel_bias: Array = shaped(3)
    """(3,) m/s^2"""
    beam_weights: Array = shaped(N_BEAMS)
    """(4,) of the last ping, 1 = nominal; NaN for a beam that was missing."""


def bad_number(message: Message) -> str | None:
    """Return the name of the first field that is not finite, None if all are usable.

    Missing beams and sigmas of a ping are NaN on purpose; infinite ones are not.
    """
    for name in type(message).__slots__:
        value = getattr(message, name)
        if value is None:
            continue
        may_miss = isinstance(message, Ping) and name in ("speed", "sigma")
        for number in value if isinstance(value, tuple) else (value,):
            if not math.isfinite(number) and not (may_miss and math.isnan(number)):
                return name
    return None
