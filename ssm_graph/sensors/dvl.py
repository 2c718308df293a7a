"""Doppler velocity log: where its beams point, what they read, and beams that are stuck."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, FrozenArrays, optional_shaped, shaped
from ssm_graph.sensors.drift import Drift

MOST_BEAMS: Final = 8
"""An instrument may have 1 to so many beams."""
N_BEAMS = 4


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
    speed: Array = shaped("N", "B")
    """(N, B) beam speeds, m/s; NaN marks a beam without bottom lock."""
    sigma: Array = shaped("N", "B")
    """(N, B) standard deviation of each speed, m/s, above zero."""
    range_m: Array | None = optional_shaped("N", "B")
    """(N, B) range along each beam, m; NaN where unknown."""
    water_track: Array | None = optional_shaped("N")
    """(N,) 1 where a ping is off the water, 0 where it is off the ground; None for all ground."""

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


@dataclass(frozen=True, slots=True)
class Ping:
    """One ping; a speed is positive when the instrument moves along the beam."""

    time_s: float
    """As stamped, s; the mount's time offset is not yet applied."""
    speed: tuple[float, ...]
    """(B,) m/s; NaN marks a beam without lock."""
    sigma: tuple[float, ...] | None = None
    """Standard deviations, m/s; None or NaN is the vehicle's nominal one."""
    is_water: bool = False
    """Whether it is off the water: its speeds are relative to the current, not to the ground."""


STUCK_PINGS: Final = 8
"""So many equal readings in a row, while other beams change with every ping, are no measurements.

A beam of a resting vehicle whose noise is half of its resolution repeats itself in some half of the
pings, and others change as well in most of them: eight in a row come once in a thousand pings, and
then leave out what the other beams tell too.
"""


def stuck_beams(speed: Array) -> NDArray[np.bool_]:
    """Return which beam speeds (P, B), m/s, NaN without bottom lock, belong to a stuck beam."""
    is_stuck = np.zeros(speed.shape, bool)
    if len(speed) < STUCK_PINGS:
        return is_stuck
    repeats = speed[1:] == speed[:-1]
    has_changed = np.isfinite(speed[1:] - speed[:-1]) & ~repeats
    repeats &= has_changed.any(axis=1)[:, None]
    for beam in np.flatnonzero(repeats.sum(axis=0) >= STUCK_PINGS - 1):
        edges = np.flatnonzero(np.diff(repeats[:, beam].astype(np.int8), prepend=0, append=0))
        for begin, end in edges.reshape(-1, 2).tolist():
            if end - begin >= STUCK_PINGS - 1:
                is_stuck[begin : end + 1, beam] = True
    return is_stuck


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
