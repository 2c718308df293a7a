"""Frozen values that everything else works on: SI units, radians, body axes forward-right-down.

Arrays are copied in, checked for shape and made read-only. Times are seconds on the mission's own
clock; velocities and sigmas labelled ``enu`` are along east, north, up at the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_graph.aid_logs import NO_AIDS, AidLogs
from ssm_graph.earth import LocalFrame
from ssm_graph.frozen import Array as Array
from ssm_graph.frozen import FrozenArrays as FrozenArrays
from ssm_graph.frozen import ReadOnlyArrays as ReadOnlyArrays
from ssm_graph.frozen import optional_shaped as optional_shaped
from ssm_graph.frozen import read_only as read_only
from ssm_graph.frozen import shaped as shaped
from ssm_graph.water_current import CurrentModel

N_BEAMS = 4


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of the inertial sensors, as continuous-time densities."""

    gyro_density: float
    """Angular random walk, rad/s/sqrt(Hz)."""
    accel_density: float
    """Velocity random walk, m/s^2/sqrt(Hz)."""
    gyro_bias_sigma: float
    """Turn-on gyro bias, 1 sigma, rad/s."""
    accel_bias_sigma: float
    """Turn-on accelerometer bias, 1 sigma, m/s^2."""
    gyro_bias_density: float = 0.0
    """Random walk of the gyro bias, rad/s/sqrt(s)."""
    accel_bias_density: float = 0.0
    """Random walk of the accelerometer bias, m/s^2/sqrt(s)."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuLog(FrozenArrays):
    """Gyro and accelerometer readings, each the mean over its interval.

    Sample ``k`` covers ``(time_s[k-1], time_s[k]]``; the first begins at ``start_s``.
    """

    start_s: float
    """Begin of the first averaging interval, s."""
    noise: ImuNoise
    time_s: Array = shaped("N")
    """(N,) end of each averaging interval, s, strictly increasing."""
    gyro_b: Array = shaped("N", 3)
    """(N, 3) body rate relative to inertial space, rad/s."""
    accel_b: Array = shaped("N", 3)
    """(N, 3) specific force, m/s^2; at rest (0, 0, -9.8)."""


@dataclass(frozen=True, slots=True)
class Drift:
    """Errors that change slowly, as a Gauss-Markov process; none by default.

    An estimator that models it takes the rest of the stated noise as white; one that does not
    counts the stated noise, which has to stand for both.
    """

    sigma: float = 0.0
    """Of each component, SI; above zero makes it a variable of the graph."""
    correlation_s: float = 0.0
    """It forgets within so much, s; above zero where there is a drift."""
    white_share: float = 1.0
    """Of the stated sigmas, what is left as white noise where the drift is modelled, in (0, 1]."""


@dataclass(frozen=True, slots=True, eq=False)
class DvlMount(FrozenArrays):
    """Geometry of the DVL: beams in the instrument, instrument in the body."""

    beams_d: Array = shaped(N_BEAMS, 3)
    """(4, 3) beam directions as rows, instrument axes, out of the transducer."""
    R_bd: Array = shaped(3, 3)
    """(3, 3) instrument to body."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to instrument, m."""
    misalignment_sigma: float = 0.0
    """Prior sigma of each mounting angle, rad; above zero asks for its calibration."""
    scale_sigma: float = 0.0
    """Prior sigma of the scale error, 1; above zero asks for its calibration."""
    time_offset_s: float = 0.0
    """How late the DVL's stamps are, s: a ping was taken at ``stamp - time_offset_s``."""
    time_offset_sigma_s: float = 0.0
    """Prior sigma of the time offset, s; above zero asks for its calibration."""
    scale_error: float = 0.0
    """Speeds are read ``1 + scale_error`` too large."""
    scale_walk_density: float = 0.0
    """Random walk of the scale error along the mission, 1/sqrt(s); it needs a ``scale_sigma``."""
    beam_scale_error: Array = field(
        default_factory=lambda: np.zeros(N_BEAMS), metadata={"shape": (N_BEAMS,)}
    )
    """(4,) the same of each beam, on top of that of all."""
    beam_scale_sigma: float = 0.0
    """Prior sigma of each beam's own scale error, 1; above zero asks for its calibration."""
    lever_arm_sigma: float = 0.0
    """Prior sigma of each component of the lever arm, m; above zero asks for its calibration."""
    drift: Drift = Drift()
    """What the velocity is off by slowly, each of three components in instrument axes, m/s."""

    @property
    def beams_b(self) -> Array:
        """(4, 3) what each beam reads of a velocity in body axes.

        Beam directions as rows, longer than one by the known scale errors.
        """
        scale = (1.0 + self.scale_error) * (1.0 + self.beam_scale_error)
        return np.asarray((self.beams_d * scale[:, None]) @ self.R_bd.T)

    def as_stated(self) -> DvlMount:
        """Return the mount as one that is exact."""
        return replace(
            self,
            misalignment_sigma=0.0,
            scale_sigma=0.0,
            scale_walk_density=0.0,
            beam_scale_sigma=0.0,
            lever_arm_sigma=0.0,
            time_offset_sigma_s=0.0,
            drift=Drift(),
        )


@dataclass(frozen=True, slots=True, eq=False)
class DvlLog(FrozenArrays):
    """Pings off the ground or off the water; a speed is positive when moving along the beam."""

    mount: DvlMount
    time_s: Array = shaped("N")
    """(N,) s as stamped, strictly increasing; the mount's time offset is not yet applied."""
    speed: Array = shaped("N", N_BEAMS)
    """(N, 4) beam speeds, m/s; NaN marks a beam without bottom lock."""
    sigma: Array = shaped("N", N_BEAMS)
    """(N, 4) standard deviation of each speed, m/s, above zero."""
    range_m: Array | None = optional_shaped("N", N_BEAMS)
    """(N, 4) range along each beam, m; NaN where unknown."""
    water_track: Array | None = optional_shaped("N")
    """(N,) 1 where a ping is off the water, 0 where it is off the ground; None for all ground."""

    @property
    def is_water(self) -> NDArray[np.bool_]:
        """(N,) which pings are off the water: their speeds are relative to its current."""
        if self.water_track is None:
            return np.zeros(len(self.time_s), bool)
        return self.water_track > 0.0

    @property
    def hears_water(self) -> bool:
        """Whether a ping off the water has a speed."""
        return bool(np.isfinite(self.speed[self.is_water]).any())

    def of_ground(self) -> DvlLog:
        """Return the pings off the ground alone."""
        if self.water_track is None:
            return self
        kept = ~self.is_water
        return replace(
            self,
            time_s=self.time_s[kept],
            speed=self.speed[kept],
            sigma=self.sigma[kept],
            range_m=None if self.range_m is None else self.range_m[kept],
            water_track=None,
        )

    @property
    def ping_s(self) -> Array:
        """(N,) when the pings were taken: stamps less the mount's time offset, s."""
        return np.asarray(self.time_s - self.mount.time_offset_s)


def counted_sigma(
    stated: ArrayLike, is_water: ArrayLike, *, ground_sigma: float, water_sigma: float | None
) -> Array:
    """Return the standard deviations (..., 4) that beam speeds count with, m/s.

    One that the DVL does not state is the nominal one of what its ping is off.

    Parameters
    ----------
    stated : (..., 4) m/s; NaN, zero and less for none.
    is_water : (...) whether a ping is off the water.
    ground_sigma : nominal one off the ground, m/s.
    water_sigma : nominal one off the water, m/s; None or 0 for that off the ground.
    """
    nominal = np.where(is_water, water_sigma or ground_sigma, ground_sigma)[..., None]
    stated = np.asarray(stated)
    return np.where(stated > 0.0, stated, nominal)


@dataclass(frozen=True, slots=True)
class DepthCalibration:
    """What is known of the errors of a depth sensor, and what is asked for."""

    offset: float = 0.0
    """Depths are read too large by so much, m."""
    offset_sigma: float = 0.0
    """Prior sigma of what is left of that, m; above zero asks for its calibration."""


@dataclass(frozen=True, slots=True)
class GnssCalibration:
    """What is known of the errors of a GNSS receiver, and what is asked for."""

    time_offset_s: float = 0.0
    """How late its stamps are, s."""
    time_offset_sigma_s: float = 0.0
    """Prior sigma of what is left of that, s; above zero asks for its calibration."""
    lever_arm_sigma: float = 0.0
    """Prior sigma of each component of the lever arm, m; above zero asks for its calibration."""
    drift: Drift = Drift()
    """What fixes are off by slowly, each of east, north and up, m."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthLog(FrozenArrays):
    """Depth: minus the ellipsoidal height of the sensor."""

    sigma: float
    """Standard deviation, m."""
    time_s: Array = shaped("N")
    """(N,) s, strictly increasing."""
    depth: Array = shaped("N")
    """(N,) m, positive down."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to sensor, m."""
    calibration: DepthCalibration = DepthCalibration()
    """Its offset is taken off ``depth`` already."""


@dataclass(frozen=True, slots=True, eq=False)
class GnssLog(FrozenArrays):
    """Position fixes of a GNSS antenna."""

    time_s: Array = shaped("N")
    """(N,) s, strictly increasing."""
    lat: Array = shaped("N")
    """(N,) rad"""
    lon: Array = shaped("N")
    """(N,) rad"""
    height: Array = shaped("N")
    """(N,) m above the ellipsoid"""
    sigma_enu: Array = shaped("N", 3)
    """(N, 3) m, east, north, up, above zero."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to antenna, m."""
    calibration: GnssCalibration = GnssCalibration()
    """Its time offset is taken off ``time_s`` already."""


@dataclass(frozen=True, slots=True, eq=False)
class InitialState(FrozenArrays):
    """State at the start with its standard deviations."""

    time_s: float
    lat: float
    """rad"""
    lon: float
    """rad"""
    height: float
    """m"""
    roll: float
    """rad"""
    pitch: float
    """rad"""
    heading: float
    """rad, clockwise from north"""
    velocity_enu: Array = shaped(3)
    """(3,) m/s"""
    position_sigma_enu: Array = shaped(3)
    """(3,) m"""
    velocity_sigma_enu: Array = shaped(3)
    """(3,) m/s"""
    attitude_sigma: Array = shaped(3)
    """(3,) rad, roll, pitch, heading"""


@dataclass(frozen=True, slots=True, eq=False)
class Reference(FrozenArrays):
    """An outside trajectory, only ever compared with; NaN where a quantity is unknown."""

    time_s: Array = shaped("N")
    lat: Array = shaped("N")
    """(N,) rad"""
    lon: Array = shaped("N")
    """(N,) rad"""
    height: Array = shaped("N")
    """(N,) m"""
    velocity_enu: Array = shaped("N", 3)
    """(N, 3) m/s, or NaN"""
    roll_pitch_heading: Array = shaped("N", 3)
    """(N, 3) rad, or NaN"""
    position_sigma_enu: Array | None = optional_shaped("N", 3)
    """(N, 3) m, of the reference itself; None where it counts as exact."""


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """One recorded run: everything that an estimator may look at, and the reference."""

    name: str
    frame: LocalFrame
    """The navigation frame: origin of the file, else the first GNSS fix, else the initial state."""
    imu: ImuLog
    dvl: DvlLog
    depth: DepthLog | None = None
    gnss: GnssLog | None = None
    aids: AidLogs = NO_AIDS
    """What else the batch smoother is aided by."""
    initial: InitialState | None = None
    reference: Reference | None = None
    current: CurrentModel | None = None
    """Of the water, where pings are off it; None for one that is not stated."""
    notes: tuple[str, ...] = ()
    """What the reader noticed and a user should know, one sentence each."""
