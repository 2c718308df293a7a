"""Depth: readings between keyframes, carried to the next one along the track, with an offset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from factors.depth_height import height_residual
from factors.so3 import cross
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.base.times import Indices
from ssm_graph.engine.error_state import POSITION, ROTATION
from ssm_graph.engine.extras import Extra
from ssm_graph.graph.aids.aid import Aid, Linearised, RowStates, drift_variable
from ssm_graph.imu.ping_motion import mean_gyro
from ssm_graph.sensors.depth import DepthCalibration, DepthLog
from ssm_graph.sensors.imu import ImuLog

DEPTH_OFFSET: Final = "depth_offset"
DEPTH_DRIFT: Final = "depth_drift"
GATE: Final = 5.0
"""Sigmas by which two readings of a keyframe may differ, and the next."""
FASTEST_CLIMB: Final = 5.0
"""m/s, of any underwater vehicle: so fast the way between the readings may change the height."""


@dataclass(frozen=True, slots=True, eq=False)
class Depths(ReadOnlyArrays):
    """Depth readings, each assigned to the first keyframe at or after it, as on the vehicle."""

    keyframe: Indices
    """(M,)"""
    time_s: Array
    """(M,) s"""
    depth: Array
    """(M,) m, positive down"""
    gyro_b: Array
    """(K, 3) rad/s, at the keyframes: it moves the lever arm"""
    sigma: float
    """m"""
    lever_arm_b: Array
    """(3,) m"""
    white_share: float = 1.0
    """Of the sigma, what is white where the drift is a variable"""

    @classmethod
    def of(cls, log: DepthLog, imu: ImuLog, keyframe_s: Array) -> Depths:
        """Return the readings of a log within keyframes (K,), without those the others outvote."""
        used = np.flatnonzero((log.time_s >= keyframe_s[0]) & (log.time_s <= keyframe_s[-1]))
        keyframe = np.searchsorted(keyframe_s, log.time_s[used])
        agrees = _agrees_with_most(keyframe, log.time_s[used], log.depth[used], sigma=log.sigma)
        used = used[agrees]
        return cls(
            keyframe=keyframe[agrees],
            time_s=log.time_s[used],
            depth=log.true_depth[used],
            gyro_b=mean_gyro(imu, keyframe_s) if len(used) else np.zeros((len(keyframe_s), 3)),
            sigma=log.sigma,
            lever_arm_b=log.lever_arm_b,
            white_share=log.calibration.drift.white,
        )


def _agrees_with_most(
    keyframe: Indices, time_s: Array, depth: Array, *, sigma: float
) -> NDArray[np.bool_]:
    """Return which readings (M,) agree with the median one of their keyframe.

    Where no more than half of a keyframe's readings do, nothing tells the good ones: all stay, and
    their mean is weighed as a whole.
    """
    order = np.lexsort((depth, keyframe))
    count = np.bincount(keyframe)
    middle = order[(np.cumsum(count) - count + (np.maximum(count, 1) - 1) // 2)[keyframe]]
    reach = GATE * np.sqrt(2.0) * sigma + FASTEST_CLIMB * np.abs(time_s - time_s[middle])
    agrees = np.abs(depth - depth[middle]) <= reach
    is_most = 2 * np.bincount(keyframe, weights=agrees) > count
    return np.asarray(agrees | ~is_most[keyframe])


@dataclass(frozen=True, slots=True, eq=False)
class DepthMeans(Aid):
    """The mean of each keyframe's readings.

    Between keyframes the sensor's height follows the cubic through both heights and climbs, see
    :func:`height_on_the_way`: how much it rises from the readings to
    the keyframe, on average, is a sum of these with the factors ``rise_of_...``. At the first
    keyframe it is taken as nothing: what came before it is not known.
    """

    SHARED = frozenset({"sigma", "lever_arm_b", "frame"})
    name = "depth"
    unit = "m"
    hint = "look at its zero, sign and unit"

    depth: Array
    """(M,) m, positive down"""
    count: Array
    """(M,) readings"""
    rise_of_way: Array
    """(M,) of the rise from the keyframe before"""
    rise_of_begin_s: Array
    """(M,) of the climb at the keyframe before, negative, s"""
    rise_of_end_s: Array
    """(M,) of the climb at the keyframe, s"""
    gyro_before_b: Array
    """(M, 3) rad/s, at the keyframe before: it moves the lever arm"""
    gyro_b: Array
    """(M, 3) rad/s"""
    rise: Array
    """(M,) m, from the readings to the keyframe, along the track last followed"""
    up_n: Array
    """(M, 3) the vertical at the states last followed, which alone counts"""
    target_n: Array
    """(M, 3) m, where the readings put the sensor then"""
    sigma: float
    """m, of one reading"""
    lever_arm_b: Array
    """(3,) m"""
    frame: LocalFrame

    @classmethod
    def of_readings(cls, depths: Depths, keyframe_s: Array, frame: LocalFrame) -> Self:
        """Return the means of readings at keyframes (K,)."""
        n, k = len(keyframe_s), depths.keyframe
        before = np.maximum(k - 1, 0)
        span_s = np.where(k > 0, keyframe_s[k] - keyframe_s[before], np.inf)
        s = np.where(k > 0, (depths.time_s - keyframe_s[before]) / span_s, 1.0)
        span_s = np.where(k > 0, span_s, 0.0)
        count = np.bincount(k, minlength=n)
        read = np.flatnonzero(count)

        def mean(values: Array) -> Array:
            return np.asarray(np.bincount(k, weights=values, minlength=n)[read] / count[read])

        return cls(
            keyframe=read,
            depth=mean(depths.depth),
            count=count[read].astype(np.float64),
            rise_of_way=mean(1.0 - s**2 * (3.0 - 2.0 * s)),
            rise_of_begin_s=mean(-span_s * s * (1.0 - s) ** 2),
            rise_of_end_s=mean(span_s * s**2 * (1.0 - s)),
            gyro_before_b=depths.gyro_b[np.maximum(read - 1, 0)],
            gyro_b=depths.gyro_b[read],
            rise=np.zeros(len(read)),
            up_n=np.zeros((len(read), 3)),
            target_n=np.zeros((len(read), 3)),
            sigma=depths.sigma,
            lever_arm_b=depths.lever_arm_b,
            frame=frame,
        )

    @property
    def root_information(self) -> Array:
        """(M, 1, 1) 1/m."""
        return np.asarray((np.sqrt(self.count) / self.sigma)[:, None, None])

    @property
    def labels(self) -> list[str]:
        """(M,) always the same."""
        return ["depth"] * len(self)

    def rate(self, at: RowStates) -> Array:
        """Return how fast the sensor rises (M, 1), m/s: its errors are those of its height."""
        track = height_track(
            self.frame,
            R_nb=at.R_nb,
            p_n=at.p_n,
            v_n=at.v_n,
            gyro_b=self.gyro_b,
            lever_arm_b=self.lever_arm_b,
        )
        return track.climb[:, None]

    def led_along(self, before: RowStates | None, at: RowStates) -> Self:
        """Return the same with the rises along another track, and the plane that is level there."""
        states = [at] if before is None else [at, before]
        track = height_track(
            self.frame,
            R_nb=np.array([x.R_nb for x in states]),
            p_n=np.array([x.p_n for x in states]),
            v_n=np.array([x.v_n for x in states]),
            gyro_b=np.array([self.gyro_b, self.gyro_before_b][: len(states)]),
            lever_arm_b=self.lever_arm_b,
        )
        height, climb = track.height, track.climb
        rise = self.rise
        if before is not None:
            rise = self.rise_of_way * (height[0] - height[1])
            rise = rise + self.rise_of_begin_s * climb[1] + self.rise_of_end_s * climb[0]
        too_low = rise - self.depth - height[0]
        target_n = track.sensor_n[0] + track.up_n[0] * too_low[:, None]
        return self._with({"rise": rise, "up_n": track.up_n[0], "target_n": target_n})

    def measured(self, at: RowStates) -> Linearised:
        """Linearise heights, after :meth:`led_along`: one component each."""
        residual = height_residual(
            at.R_nb,
            at.p_n,
            lever_arm_b=self.lever_arm_b,
            offset=(at.value(DEPTH_OFFSET, 1) + at.value(DEPTH_DRIFT, 1))[..., 0],
            up_n=self.up_n,
            target_n=self.target_n,
        )
        jacobian = np.zeros((*residual.error.shape, 1, at.extras.width))
        jacobian[..., 0, ROTATION] = residual.error_D_rotation
        jacobian[..., 0, POSITION] = residual.error_D_position
        own = residual.error_D_offset[..., None]
        at.extras.fill(jacobian[..., 0, :], {DEPTH_OFFSET: own, DEPTH_DRIFT: own})
        return Linearised(residual.error[..., None], jacobian)


def depth_variables(calibration: DepthCalibration) -> tuple[Extra, ...]:
    """Return what the sigmas of a depth sensor switch on."""
    offset = Extra(DEPTH_OFFSET, ("depth_offset_m",), np.array([calibration.offset_sigma]))
    return (offset, *drift_variable(DEPTH_DRIFT, ("depth_drift_m",), calibration.drift))


class HeightTrack(NamedTuple):
    """The depth sensor at keyframes."""

    height: Array
    """(...) m above the ellipsoid"""
    climb: Array
    """(...) m/s, upwards"""
    up_n: Array
    """(..., 3) local vertical"""
    sensor_n: Array
    """(..., 3) m"""


def height_track(
    frame: LocalFrame, *, R_nb: Array, p_n: Array, v_n: Array, gyro_b: Array, lever_arm_b: Array
) -> HeightTrack:
    """Return the track of a sensor ``lever_arm_b`` off the body origin, leading axes (...)."""
    arm_n = (R_nb @ lever_arm_b[..., None])[..., 0]
    swing_n = (R_nb @ cross(gyro_b, lever_arm_b)[..., None])[..., 0]
    sensor_n = p_n + arm_n
    lat, lon, height = frame.geodetic_from_p_n(np.array([p_n, sensor_n]))
    up_n = frame.up_n_at(lat[0], lon[0])
    return HeightTrack(
        height=height[1],
        climb=((v_n + swing_n) * up_n).sum(axis=-1),
        up_n=up_n,
        sensor_n=sensor_n,
    )


def height_on_the_way(
    begin: HeightTrack, end: HeightTrack, *, elapsed_s: Array, span_s: Array
) -> Array:
    """Return the sensor's height (...) after ``elapsed_s`` of ``span_s`` between two keyframes.

    It follows the cubic through both heights and climbs.
    """
    s = elapsed_s / span_s
    rise = end.height - begin.height
    return np.asarray(
        begin.height
        + rise * s**2 * (3.0 - 2.0 * s)
        + span_s * s * (1.0 - s) * (begin.climb * (1.0 - s) - end.climb * s)
    )
