"""The set of one vehicle's places that its inertial, DVL, depth and fix bounds allow, by itself.

A second witness beside the smoother: it shares no weight, no linearisation and no probability with
it. Bounds are so many sigmas of what the mission states. In blocks of some seconds:

- attitude: gyros, levelled by the accelerometers with the change of the DVL's velocity taken off;
- velocity: an ellipsoid that accelerometers lead on and every beam cuts; a beam that misses it is
  left out and counted;
- place and heading: the planar sets of :mod:`.motion`, led on by what DVL velocities sum up to, cut
  by fixes and compass; height: an interval, cut by depths.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.base.units import wrapped
from ssm_graph.filters.rules.ellipsoids import Ellipsoids
from ssm_graph.filters.rules.set_membership import Sets, led_on, measured
from ssm_graph.mission.mission import InitialState, Mission
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.systems.sensor_network.motion import planar_image
from ssm_graph.systems.sensor_network.track import Track, VelocityWalk, mission_edges

_AXES: Final = np.eye(3)
_RADIUS_M: Final = 6.37e6
_FLOOR: Final = np.array([1e-3, 1e-3, 1e-6])
"""m, m, rad: half-widths that no cut goes below."""
_NOTHING: Final = np.arange(0)
LONGEST_GAP_S: Final = 0.5
"""Of inertial data: over more nothing bounds the motion. It is what a step may be at most."""
BOUNDED: Final = ("DVL", "GNSS", "depth", "compass", "gyros", "accelerometers")
"""Whose bounds may be stated apart."""


@dataclass(frozen=True, slots=True)
class WitnessBounds:
    """How far errors may go, in sigmas of what the mission states.

    The bound of a vector is one of its length: so many of the sigma of its largest component.
    """

    sigmas: float = 5.0
    """Of noise: a normal reading is beyond 5 once in two million."""
    block_s: float = 10.0
    """Over which noise averages out: the mean of n readings is within as many of its own sigmas.
    What does not average out is the drift that the mission states."""
    velocity_m_per_s: float = 0.002
    """Of what is wrong with DVL velocities all the time, beside what the mission states."""
    speed_share: float = 0.002
    """The same as a share of the speed: scale and mounting."""
    silence_s: float = 5.0
    """Without a usable beam for so long, the alarm is given."""
    times: Mapping[str, float] = field(default_factory=dict)
    """By how much the bounds of a sensor of `BOUNDED` are wider than those, where they are."""

    def of(self, sensor: str) -> float:
        """Return how many sigmas bound a sensor of `BOUNDED`."""
        return self.sigmas * self.times.get(sensor, 1.0)

    def __post_init__(self) -> None:
        for sensor, times in self.times.items():
            if sensor not in BOUNDED:
                raise ConfigError(f"times: expected one of {', '.join(BOUNDED)}, got {sensor!r}")
            if not (math.isfinite(times) and times > 0.0):
                raise ConfigError(f"times of {sensor}: expected above 0, got {times}")
        for name in ("sigmas", "block_s", "silence_s"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ConfigError(f"{name}: expected above 0, got {getattr(self, name)}")
        for name in ("velocity_m_per_s", "speed_share"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ConfigError(f"{name}: expected 0 or more, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True)
class BoundAlarm:
    """A proof that not all of the stated bounds are true."""

    time_s: float
    sensor: str
    """Whose reading missed the set: ``GNSS``, ``depth``, ``compass``, ``DVL``"""
    by: str
    """By how much of what."""

    @property
    def sentence(self) -> str:
        """The alarm for people."""
        return (
            f"{self.sensor}, {self.time_s:.0f} s: {self.by}; a bound of this sensor or of the "
            "motion before it is false; the set is led on without the reading"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Witness(ReadOnlyArrays):
    """What the bounds allow, at the ends of M blocks."""

    time_s: Array
    """(M,)"""
    center: Array
    """(M, 3) of the ellipsoids: east, north in the mission's frame [m], error of the heading that
    the gyros led on from the start, anticlockwise [rad]"""
    shape: Array
    """(M, 3, 3)"""
    low: Array
    """(M, 3) of the boxes"""
    high: Array
    """(M, 3)"""
    up_low: Array
    """(M,) m, in the mission's frame"""
    up_high: Array
    heading: Array
    """(M,) rad, clockwise from north, as the gyros led it on"""
    noise_angle: Array
    """(M,) rad: what the noise of the gyros has made of the heading at most, beside the sets"""
    alarms: tuple[BoundAlarm, ...]
    n_beams: int
    """Beam speeds that were used,"""
    n_left_out: int
    """and those that missed the set of velocities or their own ping."""

    @property
    def sets(self) -> Sets:
        """(M,) as sets."""
        e = Ellipsoids(self.center.copy(), self.shape.copy())
        return Sets(e, self.low.copy(), self.high.copy(), _FLOOR.copy())

    @property
    def half_widths(self) -> Array:
        """(M, 4) of east, north, up [m] and heading [rad]."""
        half = 0.5 * (self.high - self.low)
        up = 0.5 * (self.up_high - self.up_low)
        return np.column_stack([half[:, :2], up, half[:, 2] + self.noise_angle])


def witness(mission: Mission, start: InitialState, bounds: WitnessBounds | None = None) -> Witness:
    """Return the set of places that a mission's bounds allow, from a start on.

    Parameters
    ----------
    mission : with bottom track; depth, fixes and a compass are used where they are.
    start : state with sigmas, of which ``bounds.sigmas`` are taken as bounds.

    Raises
    ------
    DataError
        Without pings off the ground after the start, or where inertial data are missing for more
        than `LONGEST_GAP_S`.
    """
    own = bounds or WitnessBounds()
    if len(mission.dvl.of_ground().time_s) < 2:
        raise DataError("witness: expected two pings off the ground or more, got fewer")
    mission = replace(mission, imu=mission.imu.calibrated)
    stamps = mission.imu.time_s[mission.imu.time_s >= start.time_s]
    for at in np.flatnonzero(np.diff(stamps) > LONGEST_GAP_S):
        raise DataError(
            f"witness: inertial data are missing from {stamps[at]:.3f} to {stamps[at + 1]:.3f} s; "
            f"over more than {LONGEST_GAP_S:g} s no bound holds; check_integrity begins anew there"
        )
    walk = VelocityWalk(mission, start, own)
    edges = mission_edges(mission, walk.begin_s, own.block_s)
    return PlaceWalk(mission.frame, start, own).follow(mission, walk.follow(mission, edges))


def joined(parts: Sequence[Witness]) -> Witness:
    """Return sets that follow each other as one."""
    if len(parts) == 1:
        return parts[0]
    found: dict[str, Any] = {}
    for name in Witness.__slots__:
        values = [getattr(part, name) for part in parts]
        if isinstance(values[0], np.ndarray):
            found[name] = np.concatenate(values)
        else:
            found[name] = sum(values[1:], start=values[0])
    return Witness(**found)


class PlaceWalk:
    """Place, heading and height from block to block, of a whole mission or piece by piece."""

    def __init__(self, frame: LocalFrame, start: InitialState, own: WitnessBounds) -> None:
        self._own, self.frame = own, frame
        self._first_heading_s: float | None = None
        k = own.sigmas
        p_n = frame.p_n_from_geodetic(start.lat, start.lon, start.height)
        sigma = start.position_sigma_enu
        half = np.array(
            [
                max(k * sigma[0], _FLOOR[0]),
                max(k * sigma[1], _FLOOR[1]),
                max(k * float(start.attitude_sigma[2]), _FLOOR[2]),
            ]
        )
        self._sets = Sets.of_box(np.array([p_n[0], p_n[1], 0.0]), half, _FLOOR)
        self._up = (p_n[2] - k * sigma[2], p_n[2] + k * sigma[2])

    def follow(self, mission: Mission, track: Track) -> Witness:
        """Return the sets at the ends of a track's blocks; the next track goes on from there."""
        self._mission, self._track = mission, track
        self._alarms: list[BoundAlarm] = list(track.alarms)
        rows = []
        for i in range(len(track.time_s)):
            self._lead_on(i)
            self._fixes(i)
            self._compass(i)
            self._depths(i)
            e = self._sets.ellipsoid
            rows.append((e.center, e.shape, self._sets.low, self._sets.high, *self._up))
        center, shape, low, high, up_low, up_high = (
            np.array(column) for column in zip(*rows, strict=True)
        )
        return Witness(
            track.time_s.copy(),
            center,
            shape,
            low,
            high,
            up_low,
            up_high,
            track.heading.copy(),
            track.noise_angle.copy(),
            tuple(sorted(self._alarms, key=lambda a: a.time_s)),
            track.n_beams,
            track.n_left_out,
        )

    def _lead_on(self, i: int) -> None:
        track = self._track
        d, bound = track.advance[i], track.advance_bound[i]
        noise = np.array([0.0, 0.0, track.turn_bound[i]])
        image = planar_image(self._sets, d[:2], np.zeros(()), noise, advance_bound=bound[:2])
        self._sets = led_on(self._sets, image)
        self._up = (self._up[0] + d[2] - bound[2], self._up[1] + d[2] + bound[2])

    def _inside(self, time_s: Array, i: int) -> NDArray[np.intp]:
        """Return the readings within block i."""
        first, last = self._track.begin_s[i], self._track.time_s[i]
        return np.arange(*np.searchsorted(time_s, [first, last], side="right"))

    def _fixes(self, i: int) -> None:
        """Cut by the last fix of a block, and by the mean of all, whose noise averages out."""
        gnss = self._mission.gnss
        rows = self._inside(gnss.valid_s, i) if gnss else _NOTHING
        if gnss is None or len(rows) == 0:
            return
        k, track = self._own.of("GNSS"), self._track
        fix = self.frame.p_n_from_geodetic(gnss.lat[rows], gnss.lon[rows], gnss.height[rows])
        arm, led, led_bound = track.led_to_end(i, gnss.valid_s[rows], gnss.lever_arm_b)
        arm_m = float(np.linalg.norm(gnss.lever_arm_b))
        turned = float(np.max(np.abs([self._sets.low[2], self._sets.high[2]])))
        slack = turned * (np.linalg.norm(led, axis=1) + arm_m) + led_bound
        slack += arm_m * float(track.noise_angle[i] + track.tilt_bound[i])
        slack += k * gnss.calibration.drift.sigma
        values, white = fix - arm + led, k * gnss.sigma_enu[rows]
        for axis, name in ((0, "east"), (1, "north")):
            unit = f"m to the {name}"
            bound = float(white[-1, axis] + slack[-1])
            held = self._cut(i, "GNSS", axis, float(values[-1, axis]), bound, unit, 1.0)
            if held and len(rows) > 1:
                bound = _of_mean(white[:, axis]) + float(slack.mean())
                self._cut(i, "GNSS", axis, float(values[:, axis].mean()), bound, unit, 1.0)

    def _compass(self, i: int) -> None:
        log = self._mission.aids.get(HeadingLog)
        rows = self._inside(log.time_s, i) if log else _NOTHING
        if log is None or len(rows) == 0:
            return
        row, k, e = rows[-1], self._own.of("compass"), log.errors
        if self._first_heading_s is None:
            self._first_heading_s = float(log.time_s[0])
        passed = float(log.time_s[row]) - self._first_heading_s
        often = e.one_cycle_sigma + e.two_cycle_sigma
        more = e.offset_sigma + e.walk_sigma + e.rate_sigma * passed + math.sqrt(2.0) * often
        bound = k * (log.sigma + more) + float(self._track.noise_angle[i])
        if bound >= math.pi:
            return
        nominal = self._track.heading_at(float(log.time_s[row]))
        # Headings turn clockwise, the set's error anticlockwise.
        value = -float(wrapped(np.array(log.heading[row] + log.declination - nominal)))
        self._cut(i, "compass", 2, value, bound, "deg", math.degrees(1.0))

    def _cut(
        self, i: int, sensor: str, axis: int, value: float, bound: float, unit: str, per: float
    ) -> bool:
        """Cut the set by a reading; return whether the two have something in common."""
        low, high = float(self._sets.low[axis]), float(self._sets.high[axis])
        self._sets, missed = measured(self._sets, _AXES[axis], np.array(value), np.array(bound))
        if bool(missed):
            off = max(low - value - bound, value - bound - high, 0.0) * per
            by = f"{off:.2g} {unit} beyond what both bounds allow (±{bound * per:.2g})"
            self._alarms.append(BoundAlarm(float(self._track.time_s[i]), sensor, by))
        return not missed

    def _depths(self, i: int) -> None:
        """Cut by the last depth of a block, and by the mean of all."""
        log, track = self._mission.depth, self._track
        rows = self._inside(log.time_s, i) if log else _NOTHING
        if log is None or len(rows) == 0:
            return
        k, calibration = self._own.of("depth"), log.calibration
        arm, led, led_bound = track.led_to_end(i, log.time_s[rows], log.lever_arm_b)
        x, y = np.maximum(np.abs(self._sets.low[:2]), np.abs(self._sets.high[:2]))
        sagitta = float(x**2 + y**2) / (2.0 * _RADIUS_M)
        up = -log.true_depth[rows] - self.frame.height - (arm - led)[:, 2] - 0.5 * sagitta
        slack = led_bound + k * (calibration.offset_sigma + calibration.drift.sigma) + 0.5 * sagitta
        slack += float(np.linalg.norm(log.lever_arm_b) * track.tilt_bound[i])
        white = np.broadcast_to(k * log.sigma, up.shape)
        if self._cut_up(i, float(up[-1]), float(white[-1] + slack[-1])) and len(rows) > 1:
            self._cut_up(i, float(up.mean()), _of_mean(white) + float(slack.mean()))

    def _cut_up(self, i: int, up: float, bound: float) -> bool:
        """Cut the interval of heights; return whether something is left."""
        low, high = max(self._up[0], up - bound), min(self._up[1], up + bound)
        if low > high:
            by = f"{low - high:.2g} m beyond what both bounds allow (±{bound:.2g})"
            self._alarms.append(BoundAlarm(float(self._track.time_s[i]), "depth", by))
            return False
        self._up = (low, high)
        return True


def _of_mean(white: Array) -> float:
    """Return the bound of a mean whose readings (n,) have independent errors of such bounds."""
    return float(np.linalg.norm(white) / len(white))
