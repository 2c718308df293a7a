"""Motion over the rotating WGS-84 Earth in closed form: a route with waves on top of it.

Frames: ``e`` Earth-fixed, ``l`` local east-north-up, ``b`` body forward-right-down. Attitude is a
chain of elementary turns from Earth-fixed to body axes, longitude and latitude among them; rates
and velocities follow from its Taylor series (:mod:`.taylor`), so no strapdown formula is shared
with the estimators.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ssm_graph.base.earth import (
    EARTH_RATE,
    ECCENTRICITY_SQ,
    SEMI_MAJOR_AXIS,
    normal_gravity,
    radii_of_curvature,
)
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Reference
from ssm_graph.simulation import checked
from ssm_graph.simulation.routes import Route
from ssm_graph.simulation.taylor import Series, atan2, sin_cos, sqrt, time_series

Vector = tuple[Series, Series, Series]

_LAT = checked.Rule(
    lambda lat: abs(lat) <= math.radians(80.0),
    "a latitude between -80 and 80 degrees, in radians",
    "convert degrees with math.radians",
)
_LON = checked.Rule(
    lambda lon: math.isfinite(lon) and abs(lon) <= 2.0 * math.pi,
    "a longitude in radians",
    "convert degrees with math.radians",
)

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


@dataclass(frozen=True, slots=True)
class Waves(checked.Settings):
    """Sinusoidal motion that the sea adds to the route; amplitudes of zero are calm water."""

    roll: float = math.radians(4.0)
    """Amplitude, rad."""
    pitch: float = math.radians(3.0)
    """Amplitude, rad."""
    yaw: float = math.radians(1.0)
    """Amplitude, rad."""
    heave_m: float = 0.3
    """Amplitude, m."""
    roll_period_s: float = checked.positive(7.0, hint="try 7 s")
    pitch_period_s: float = checked.positive(6.0, hint="try 7 s")
    yaw_period_s: float = checked.positive(8.0, hint="try 7 s")
    heave_period_s: float = checked.positive(6.5, hint="try 7 s")


CALM = Waves(roll=0.0, pitch=0.0, yaw=0.0, heave_m=0.0)
"""No waves at all."""


class Turn(NamedTuple):
    """Rotation about one coordinate axis by an angle that changes with time."""

    axis: int
    angle: Series
    sine: Series
    cosine: Series

    def forward(self, v: Vector) -> Vector:
        """Return ``R v``, from the turned axes to the old ones."""
        return self._apply(v, self.sine)

    def backward(self, v: Vector) -> Vector:
        """Return ``R.T v``, from the old axes to the turned ones."""
        return self._apply(v, -self.sine)

    def _apply(self, v: Vector, sine: Series) -> Vector:
        i, j = (self.axis + 1) % 3, (self.axis + 2) % 3
        out = list(v)
        out[i] = self.cosine * v[i] - sine * v[j]
        out[j] = sine * v[i] + self.cosine * v[j]
        return out[0], out[1], out[2]


def _turn(axis: int, angle: Series) -> Turn:
    return Turn(axis, angle, *sin_cos(angle))


class Motion(NamedTuple):
    """The motion at many epochs, with derivatives."""

    lat: Series
    lon: Series
    height: Series
    p_e: Vector
    """Body origin in Earth-fixed axes, m."""
    to_level: tuple[Turn, Turn]
    """From Earth-fixed to local north-east-down axes."""
    to_body: tuple[Turn, Turn, Turn]
    """Heading, pitch, roll: from north-east-down to body axes."""

    def body_from_earth(self, v_e: Vector) -> Vector:
        """Return ``R_eb.T v_e``."""
        for turn in (*self.to_level, *self.to_body):
            v_e = turn.backward(v_e)
        return v_e

    def earth_from_body(self, v_b: Vector) -> Vector:
        """Return ``R_eb v_b``, as a function of time."""
        for turn in reversed((*self.to_level, *self.to_body)):
            v_b = turn.forward(v_b)
        return v_b

    def point_e(self, lever_arm_b: Array) -> Vector:
        """Return where a point fixed to the body is, Earth-fixed axes, m."""
        offset = self.earth_from_body(constants(lever_arm_b))
        x, y, z = (p + d for p, d in zip(self.p_e, offset, strict=True))
        return x, y, z

    def omega_ib_b(self) -> Array:
        """Return the body rate (..., 3) relative to inertial space, rad/s.

        The turn about the Earth's axis is that of longitude and the Earth's own together; each
        turn of the chain adds its rate about its own axis.
        """
        rates = [self.to_level[0].angle.rate + EARTH_RATE, self.to_level[1].angle.rate]
        rates += [turn.angle.rate for turn in self.to_body]
        omega: Vector = constants(np.zeros(3))
        for turn, rate in zip((*self.to_level, *self.to_body), rates, strict=True):
            turned = list(turn.backward(omega))
            turned[turn.axis] = turned[turn.axis] + Series([rate])
            omega = (turned[0], turned[1], turned[2])
        return stacked(omega)

    def specific_force_b(self) -> Array:
        """Return the specific force (..., 3) in body axes, m/s^2.

        In the rotating Earth frame ``f = p'' + 2 omega x p' - g``; plumb-line gravity ``g`` holds
        the centrifugal term and acts along the ellipsoid's normal.
        """
        x, y, z = self.p_e
        gravity = Series([normal_gravity(self.lat.value, self.height.value)])
        up_e = self._up_e()
        f_e: Vector = (
            Series([x.acceleration - 2.0 * EARTH_RATE * y.rate]) + gravity * up_e[0],
            Series([y.acceleration + 2.0 * EARTH_RATE * x.rate]) + gravity * up_e[1],
            Series([z.acceleration]) + gravity * up_e[2],
        )
        return stacked(self.body_from_earth(f_e))

    def _up_e(self) -> Vector:
        up: Vector = constants(np.array([0.0, 0.0, -1.0]))
        for turn in reversed(self.to_level):
            up = turn.forward(up)
        return up


def constants(vector: Array) -> Vector:
    """Return a vector that does not change with time, as series of order 2."""
    zero = np.array(0.0)
    x, y, z = (Series([np.array(float(value)), zero, zero]) for value in vector)
    return x, y, z


def stacked(v: Vector, *, derivative: int = 0) -> Array:
    """Return one Taylor coefficient of a vector as an array (..., 3)."""
    parts = np.broadcast_arrays(*(series.coefficients[derivative] for series in v))
    return np.stack(parts, axis=-1)


@dataclass(frozen=True, slots=True)
class Trajectory(checked.Settings):
    """A route laid on the ellipsoid, with waves.

    Latitude and longitude are linear in the route's north and east metres, by the radii of
    curvature at the start. Heading follows the course made good and pitch the slope of the path,
    unless the route sets its own heading; then the path's pitch is zero.
    """

    route: Route
    waves: Waves
    lat: float = checked.field(_LAT)
    """Latitude of the start, rad."""
    lon: float = checked.field(_LON)
    """Longitude of the start, rad."""

    def at(self, time_s: ArrayLike) -> Motion:
        """Return the motion at these times, s since the start."""
        t = time_series(np.asarray(time_s, dtype=np.float64), order=2)
        east, north, path_height = self.route.east_north_height(t)
        meridian, prime_vertical = radii_of_curvature(self.lat)
        lat = north / float(meridian) + self.lat
        lon = east / float(prime_vertical * np.cos(self.lat)) + self.lon
        heave, _ = sin_cos(_phase(t, self.waves.heave_period_s, 0.7))
        height = path_height + heave * self.waves.heave_m
        sin_cos_lat = sin_cos(lat)
        sin_cos_lon = sin_cos(lon)
        p_e = _ecef(sin_cos_lat, sin_cos_lon, height)
        sine, cosine = sin_cos_lat
        to_level = (
            Turn(2, lon, *sin_cos_lon),
            # The angle -lat - pi/2 takes the north-east-down axes to the Earth's.
            Turn(1, -lat - 0.5 * math.pi, -cosine, -sine),
        )
        to_body = self._attitude(t, p_e, to_level, path_height)
        return Motion(lat, lon, height, p_e, to_level, to_body)

    def _attitude(
        self, t: Series, p_e: Vector, to_level: tuple[Turn, Turn], path_height: Series
    ) -> tuple[Turn, Turn, Turn]:
        """Return the turns by heading, pitch and roll, to first order in time."""
        waves = self.waves
        yaw, _ = sin_cos(_phase(t, waves.yaw_period_s, 1.3))
        pitch, _ = sin_cos(_phase(t, waves.pitch_period_s, 2.1))
        roll, _ = sin_cos(_phase(t, waves.roll_period_s, 0.4))
        pitch = pitch * waves.pitch
        heading = self.route.heading(t)
        if heading is None:
            v: Vector = (p_e[0].derivative(), p_e[1].derivative(), p_e[2].derivative())
            for turn in to_level:
                v = turn.backward(v)
            north, east, _ = v
            heading = atan2(east, north)
            pitch = pitch + atan2(path_height.derivative(), sqrt(north * north + east * east))
        heading = heading + yaw * waves.yaw
        return _turn(2, heading), _turn(1, pitch), _turn(0, roll * waves.roll)

    def path_depth(self, time_s: ArrayLike) -> Array:
        """Return the depth of the route without waves, m: what tells a surfaced vehicle."""
        t = time_series(np.asarray(time_s, dtype=np.float64), order=1)
        height = self.route.east_north_height(t)[2].value
        return -np.broadcast_to(height, t.value.shape)

    def truth(self, time_s: ArrayLike) -> Reference:
        """Return the true position, velocity and attitude at these times."""
        time_s = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        motion = self.at(time_s)
        velocity: Vector = (
            Series([motion.p_e[0].rate]),
            Series([motion.p_e[1].rate]),
            Series([motion.p_e[2].rate]),
        )
        for turn in motion.to_level:
            velocity = turn.backward(velocity)
        north, east, down = np.moveaxis(stacked(velocity), -1, 0)
        heading, pitch, roll = (turn.angle.value for turn in motion.to_body)
        angles = np.broadcast_arrays(roll, pitch, heading % (2.0 * math.pi), time_s)[:3]
        return Reference(
            time_s=time_s,
            lat=motion.lat.value,
            lon=motion.lon.value,
            height=motion.height.value,
            velocity_enu=np.stack([east, north, -down], axis=-1),
            roll_pitch_heading=np.stack(angles, axis=-1),
        )

    def R_eb(self, time_s: ArrayLike) -> Rotation:
        """Return the rotations from body to Earth-fixed axes."""
        from scipy.spatial.transform import Rotation

        motion = self.at(np.atleast_1d(time_s))
        level = np.stack([turn.angle.value for turn in motion.to_level], axis=-1)
        body = np.stack(
            np.broadcast_arrays(*(turn.angle.value for turn in motion.to_body)), axis=-1
        )
        return Rotation.from_euler("ZY", level) * Rotation.from_euler("ZYX", body)


def _phase(t: Series, period_s: float, phase: float) -> Series:
    return t * (2.0 * math.pi / period_s) + phase


def _ecef(
    sin_cos_lat: tuple[Series, Series], sin_cos_lon: tuple[Series, Series], height: Series
) -> Vector:
    """Return the Earth-fixed position; :func:`earth.ecef_from_geodetic` for Taylor series."""
    sin_lat, cos_lat = sin_cos_lat
    sin_lon, cos_lon = sin_cos_lon
    w = sqrt(1.0 - sin_lat * sin_lat * ECCENTRICITY_SQ)
    radius = SEMI_MAJOR_AXIS / w
    horizontal = (radius + height) * cos_lat
    return (
        horizontal * cos_lon,
        horizontal * sin_lon,
        (radius * (1.0 - ECCENTRICITY_SQ) + height) * sin_lat,
    )
