"""Doppler velocity log: where its beams point and what they read."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import rotation_zyx
from ssm_graph.base.frozen import Array, FrozenArrays, optional_shaped, shaped
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.messages import Message

MOST_BEAMS: Final = 8
"""An instrument may have 1 to so many beams."""


@dataclass(frozen=True, slots=True, eq=False)
class DvlMount(FrozenArrays):
    """Geometry of the DVL: beams in the instrument, instrument in the body.

    An instrument that gives a velocity alone has three beams along its axes.
    """

    beams_d: Array = shaped("B", 3)
    """(B, 3) beam directions as rows, instrument axes, out of the transducer; 1 to 8 of them."""
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
    beam_scale_error: Array | None = optional_shaped("B")
    """(B,) the same of each beam, on top of that of all; None for none."""
    beam_scale_sigma: float = 0.0
    """Prior sigma of each beam's own scale error, 1; above zero asks for its calibration."""
    lever_arm_sigma: float = 0.0
    """Prior sigma of each component of the lever arm, m; above zero asks for its calibration."""
    drift: Drift = Drift()
    """What the velocity is off by slowly, each of three components in instrument axes, m/s."""
    drift_z_share: float = 1.0
    """Of its sigma, what the component along the z axis has. Four beams at 30 degrees that err each
    for itself make it 0.41: what they have in common is read along z, ``tan(30) / sqrt(2)``."""

    def __post_init__(self) -> None:
        super(DvlMount, self).__post_init__()
        if not 1 <= self.n_beams <= MOST_BEAMS:
            raise DataError(
                f"DvlMount.beams_d: expected 1 to {MOST_BEAMS} beams, got {self.n_beams}"
            )

    @property
    def n_beams(self) -> int:
        """How many beams the instrument has, B."""
        return len(self.beams_d)

    @property
    def beam_scale_errors(self) -> Array:
        """(B,) scale error of each beam, on top of that of all."""
        return np.zeros(self.n_beams) if self.beam_scale_error is None else self.beam_scale_error

    @property
    def beams_b(self) -> Array:
        """(B, 3) what each beam reads of a velocity in body axes.

        Beam directions as rows, longer than one by the known scale errors.
        """
        scale = (1.0 + self.scale_error) * (1.0 + self.beam_scale_errors)
        return np.asarray((self.beams_d * scale[:, None]) @ self.R_bd.T)

    def parity(self, speed: Array, sigma: Array) -> Array:
        """Return how far beam speeds (..., B) contradict each other, in sigmas.

        B beams measure three components, and B - 3 combinations of them, the parities, read nothing
        of any velocity: the largest of these counts. NaN where a beam is missing, and of
        instruments of three beams or fewer, which agree with anything.
        """
        if self.n_beams < 4:
            return np.full(speed.shape[:-1], np.nan)
        null = np.linalg.svd(self.beams_b.T)[2][3:]
        largest = np.abs(speed @ null.T) / np.sqrt(sigma**2 @ (null**2).T)
        return np.asarray(largest.max(axis=-1))

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
            drift_z_share=1.0,
        )


@dataclass(frozen=True, slots=True, eq=False)
class DvlLog(FrozenArrays):
    """Pings off the ground or off the water; a speed is positive when moving along the beam."""

    mount: DvlMount
    time_s: Array = shaped("N")
    """(N,) s as stamped, strictly increasing; the mount's time offset is not yet applied."""
    speed: Array = shaped("N", "B")
    """(N, B) beam speeds, m/s; NaN marks a beam without bottom lock."""
    sigma: Array = shaped("N", "B")
    """(N, B) standard deviation of each speed, m/s, above zero."""
    range_m: Array | None = optional_shaped("N", "B")
    """(N, B) range along each beam, m; NaN where unknown."""
    water_track: Array | None = optional_shaped("N")
    """(N,) 1 where a ping is off the water, 0 where it is off the ground; None for all ground."""
    covariance: Array | None = optional_shaped("N", "B", "B")
    """(N, B, B) of the speeds of a ping, m^2/s^2, of an instrument whose speeds err together;
    NaN in pings that state none, None for none at all. ``sigma`` holds its diagonal."""

    def __post_init__(self) -> None:
        super(DvlLog, self).__post_init__()
        if self.speed.shape[1] != self.mount.n_beams:
            raise DataError(
                f"DvlLog.speed: expected a column for each of the mount's {self.mount.n_beams} "
                f"beams, got {self.speed.shape[1]}"
            )

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
        rows: dict[str, Any] = {
            name: None if getattr(self, name) is None else getattr(self, name)[kept]
            for name in ("time_s", "speed", "sigma", "range_m", "covariance")
        }
        return replace(self, water_track=None, **rows)

    def independent(self) -> tuple[Array, Array, Array]:
        """Return speeds (N, B) and their sigmas (N, B) that err independently, and what they read.

        The third, (N, B, 3), is what each reads of a velocity in body axes. Without a covariance
        that is the beams themselves; with one, speeds and directions are turned to its principal
        axes, ping by ping: where ``C = U diag(s^2) U'``, the speeds ``U' speed`` of the directions
        ``U' beams`` have the sigmas ``s``. A ping that lacks a speed keeps its beams, with the
        marginal sigmas.
        """
        beams_b = np.broadcast_to(self.mount.beams_b, (*self.speed.shape, 3))
        if self.covariance is None:
            return self.speed, self.sigma, beams_b
        speed, sigma, beams_b = self.speed.copy(), self.sigma.copy(), beams_b.copy()
        whole = np.isfinite(speed).all(axis=1) & np.isfinite(self.covariance).all(axis=(1, 2))
        variance, axes = np.linalg.eigh(self.covariance[whole])
        turned = np.swapaxes(axes, 1, 2)
        speed[whole] = np.einsum("nij,nj->ni", turned, speed[whole])
        sigma[whole] = np.sqrt(variance)
        beams_b[whole] = turned @ self.mount.beams_b
        return speed, sigma, beams_b

    def altitude(self, R_nb: Array | None = None) -> Array:
        """Return the height of the instrument over the bottom (N,), m; NaN where no beam says.

        It is the mean over the beams with a range; of water track it is none.

        Parameters
        ----------
        R_nb : (N, 3, 3) attitudes at the pings, third axis down; level when left out.
        """
        if self.range_m is None:
            return np.full(len(self.time_s), np.nan)
        beams_b = self.mount.beams_d @ self.mount.R_bd.T
        down = beams_b[:, 2] if R_nb is None else R_nb[:, 2] @ beams_b.T
        heights = np.where(self.is_water[:, None], np.nan, self.range_m * down)
        known = np.isfinite(heights)
        count = np.where(known.any(axis=1), known.sum(axis=1), np.nan)
        return np.asarray(np.where(known, heights, 0.0).sum(axis=1) / count)

    @property
    def valid_s(self) -> Array:
        """(N,) when the pings were taken: stamps less the mount's time offset, s."""
        return np.asarray(self.time_s - self.mount.time_offset_s)


@dataclass(frozen=True, slots=True)
class Ping(Message):
    """One ping; a speed is positive when the instrument moves along the beam.

    The mount's time offset is not yet taken off its stamp.
    """

    MAY_MISS: ClassVar[frozenset[str]] = frozenset({"speed", "sigma"})

    speed: tuple[float, ...]
    """(B,) m/s; NaN marks a beam without lock."""
    sigma: tuple[float, ...] | None = None
    """Standard deviations, m/s; None or NaN is the vehicle's nominal one."""
    is_water: bool = False
    """Whether it is off the water: its speeds are relative to the current, not to the ground."""


def beams_from_angles(azimuth: Array, janus: float) -> Array:
    """Return unit beam directions (B, 3) in instrument axes, radians.

    ``janus`` is counted from the vertical (instrument z), ``azimuth`` from x towards y.
    """
    down = np.full_like(azimuth, np.cos(janus))
    return np.stack([np.cos(azimuth) * np.sin(janus), np.sin(azimuth) * np.sin(janus), down], -1)


def R_bd_from_rpy(roll_pitch_yaw: Array) -> Array:
    """Return the mounting ``Rz(yaw) Ry(pitch) Rx(roll)``, (3, 3), instrument to body, radians."""
    roll, pitch, yaw = roll_pitch_yaw
    return rotation_zyx(yaw, pitch, roll)


def rpy_from_R_bd(R_bd: Array) -> Array:
    """Return roll, pitch, yaw (3,) of a mounting, radians; yaw is 0 where the pitch is vertical."""
    horizontal = math.hypot(R_bd[0, 0], R_bd[1, 0])
    pitch = math.atan2(-R_bd[2, 0], horizontal)
    if horizontal < 1e-9:
        return np.array([math.atan2(math.copysign(1.0, pitch) * R_bd[0, 1], R_bd[1, 1]), pitch, 0])
    return np.array([math.atan2(R_bd[2, 1], R_bd[2, 2]), pitch, math.atan2(R_bd[1, 0], R_bd[0, 0])])


_NOISE_OF_EMPTY_LOG: Final = 0.01


def empty_dvl(mount: DvlMount) -> DvlLog:
    """Return the log without pings of an instrument."""
    none = np.zeros((0, mount.n_beams))
    return DvlLog(mount=mount, time_s=np.zeros(0), speed=none, sigma=none)


def counted_sigma(
    stated: ArrayLike, is_water: ArrayLike, *, ground_sigma: float, water_sigma: float | None
) -> Array:
    """Return the standard deviations (..., B) that beam speeds count with, m/s.

    One that the DVL does not state is the nominal one of what its ping is off.

    Parameters
    ----------
    stated : (..., B) m/s; NaN, zero and less for none.
    is_water : (...) whether a ping is off the water.
    ground_sigma : nominal one off the ground, m/s.
    water_sigma : nominal one off the water, m/s; None or 0 for that off the ground.
    """
    nominal = np.where(is_water, water_sigma or ground_sigma, ground_sigma)[..., None]
    stated = np.asarray(stated)
    return np.where(stated > 0.0, stated, nominal)


def nominal_sigma(log: DvlLog) -> float:
    """Return the standard deviation that stands for those of all beams off the ground, m/s."""
    sigma = log.sigma[~log.is_water] if (~log.is_water).any() else log.sigma
    return float(np.median(sigma)) if sigma.size else _NOISE_OF_EMPTY_LOG


def sigma_off_water(log: DvlLog) -> float:
    """Return the standard deviation that stands for those of all beams off the water, m/s."""
    return float(np.median(log.sigma[log.is_water]))
