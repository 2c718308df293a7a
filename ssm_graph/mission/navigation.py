"""What a live estimator answers: SI units, radians, body axes forward-right-down."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from ssm_graph.base.frozen import Array, FrozenArrays, shaped


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
    beam_weights: Array = shaped("B")
    """(B,) of the last ping, 1 = nominal; NaN for a beam that was missing."""
    protection_m: float = math.inf
    """Horizontal protection level: the radius that bounds the position's error under every fault of
    one sensor that has not been excluded, at the probability that was asked for."""
    protection_up_m: float = math.inf
    """The same of the height."""
    innovation_ratios: Mapping[str, float] = field(default_factory=dict)
    """By sensor: its low-passed innovation in sigmas, root mean square of its components. An error
    that lasts shows here long before it is out of any gate; noise alone is near 0.2."""
    witness_m: float = math.inf
    """How far the truth may be from the answer, level, as long as the bounds of a witness beside it
    are true; infinite without one, or once they were contradicted."""
    witness_up_m: float = math.inf
    """The same of the height."""
    witness_s: float = math.nan
    """When that was so, s on the vehicle's clock: a witness goes by blocks of some seconds."""
