"""Messages of ROS 2 drivers turned into those of `ssm_graph.messages`.

Only attributes are looked at, so objects of ``rclpy`` and of the ``rosbags`` library both work, and
neither has to be installed.  Facts that decide signs and axes, and where they come from:

* ``Imu``: ``linear_acceleration`` is specific force, +9.8 upwards at rest (REP 145), in body axes
  forward-left-up (REP 103) unless the options say otherwise.
* ``marine_acoustic_msgs/Dvl``: instrument axes are x forward, y starboard, z the way it looks.  The
  sign of ``beam_velocity`` is nowhere written down: drivers differ, so the options say it.  No flag
  per beam exists; a negative range, or fewer ``num_good_beams`` than speeds, tells of missing ones.
  ``velocity_mode`` is 1 for speeds off the bottom and 2 for those off the water; drivers that leave
  it 0 know the bottom alone.
* ``dvl_msgs/DVL`` (Water Linked): a beam's velocity is positive when the instrument moves along the
  beam; ids are 0 to 3; the message says nothing about directions. Beams flagged valid in a report
  whose velocity is not may be false locks (17 such reports of 303 in a recorded log); an altitude
  would tell, but the ROS drivers repeat the last one then. None of these beams is used. It tracks
  the bottom alone.
* ``FluidPressure`` is absolute, in pascal; ``NavSatFix.altitude`` is above the WGS-84 ellipsoid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, NamedTuple

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes, turned
from ssm_graph.base.frozen import Vector
from ssm_graph.base.units import SEA_WATER, STANDARD_ATMOSPHERE, STANDARD_GRAVITY, wrapped
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.place import LATITUDES_DEG, LONGITUDES_DEG

IMU_TYPE: Final = "sensor_msgs/msg/Imu"
MARINE_DVL_TYPE: Final = "marine_acoustic_msgs/msg/Dvl"
WATER_LINKED_TYPE: Final = "dvl_msgs/msg/DVL"
WATER_LINKED_TYPES: Final = (WATER_LINKED_TYPE, "waterlinked_a50_ros_driver/msg/DVL")
"""Of ROS 2 and of ROS 1, which have one layout."""
TWIST_TYPE: Final = "geometry_msgs/msg/TwistWithCovarianceStamped"
PRESSURE_TYPE: Final = "sensor_msgs/msg/FluidPressure"
FIX_TYPE: Final = "sensor_msgs/msg/NavSatFix"

FIX_SIGMA: Final = (5.0, 5.0, 10.0)
"""m east, north, up, of a fix that does not say how good it is."""

_LARGEST_NUMBER: Final = 1e9
"""SI; whatever the unit, a larger number of an IMU is damage."""
_NANOSECONDS: Final = 1_000_000_000
_WATER_TRACK: Final = 2
"""``DVL_MODE_WATER`` of ``marine_acoustic_msgs``."""
_COVARIANCE_UNKNOWN: Final = 0


class BeamSign(Enum):
    """When a driver's beam speed is positive."""

    ALONG = "the instrument moves along the beam, away from its transducer"
    AGAINST = "the instrument moves against the beam"


@dataclass(frozen=True, slots=True)
class RosOptions:
    """What the messages do not say of themselves."""

    body: BodyAxes = BodyAxes.FLU
    """Axes of the IMU messages, which are those of the body."""
    beam_sign: BeamSign = BeamSign.ALONG
    """Of ``marine_acoustic_msgs``; that of Water Linked is known."""
    water_density: float = SEA_WATER
    """kg/m^3"""
    atmosphere: float = STANDARD_ATMOSPHERE
    """Pa at the surface; 0 for a sensor that reads zero there."""
    surface_height: float | None = None
    """Height of the water's surface above the ellipsoid, m; None takes 0 or finds it in a bag."""
    fix_sigma_enu: Vector = FIX_SIGMA
    """m, of a fix that does not say how good it is."""
    n_beams: int = 4
    """Transducers of the DVL, the first ones of a message that has room for more."""

    @property
    def weight_density(self) -> float:
        """Rise of the pressure with depth, Pa/m."""
        return self.water_density * STANDARD_GRAVITY


DEFAULTS: Final = RosOptions()


class DvlReport(NamedTuple):
    """One message of a DVL: the ping, and what else the message says of the beams."""

    ping: Ping
    range_m: tuple[float, ...]
    """(B,) m along the beams, NaN where unknown."""
    beams_d: tuple[Vector, ...] | None
    """Beam directions as the message states them; None where it does not."""
    velocity_d: Vector
    """The velocity that the instrument made of its beams, m/s, NaN where there is none."""
    covariance_d: tuple[float, ...]
    """(9,) of that velocity, m^2/s^2, row by row; NaN where it states none."""


def stamp_s(message: Any, received_s: float) -> float:
    """Return the header's stamp in seconds, the nearest float; for a stamp of zero, receipt."""
    stamp = message.header.stamp
    nanoseconds = int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec)
    return nanoseconds / _NANOSECONDS if nanoseconds else received_s


def imu_sample(message: Any, received_s: float, options: RosOptions = DEFAULTS) -> ImuSample:
    """Return ``sensor_msgs/Imu`` in forward-right-down axes.

    Raises :class:`DataError`: the message has no turn rate or no acceleration, or they are not
    finite.

    ``received_s`` is its time where the header's stamp is zero; the options name its axes.
    """
    for field in ("angular_velocity", "linear_acceleration"):
        if float(getattr(message, f"{field}_covariance")[0]) == -1.0:
            raise DataError(f"Imu: the message says that it has no {field}")
    return ImuSample(
        time_s=stamp_s(message, received_s),
        gyro_b=_in_frd(message, "angular_velocity", options.body),
        accel_b=_in_frd(message, "linear_acceleration", options.body),
    )


def dvl_report(message: Any, received_s: float, options: RosOptions = DEFAULTS) -> DvlReport:
    """Return ``marine_acoustic_msgs/Dvl``, ``dvl_msgs/DVL`` or a twist, told apart by their fields.

    Beams without bottom lock are NaN in the ping, and all are in that of a twist: a velocity alone.

    Raises :class:`DataError`: the beams of the message are not numbered 0 to 3.
    """
    if hasattr(message, "twist"):
        report = _twist
    else:
        report = _water_linked if hasattr(message, "beams") else _marine
    return report(message, stamp_s(message, received_s), options)


def is_off_water(message: Any) -> bool:
    """Return whether a ``marine_acoustic_msgs/Dvl`` holds speeds through the water."""
    return int(message.velocity_mode) == _WATER_TRACK


def ping(message: Any, received_s: float, options: RosOptions = DEFAULTS) -> Ping:
    """Return what a live estimator needs of a DVL message; raises as `dvl_report`."""
    return dvl_report(message, received_s, options).ping


def depth_reading(message: Any, received_s: float, options: RosOptions = DEFAULTS) -> DepthReading:
    """Return ``sensor_msgs/FluidPressure`` as minus the ellipsoidal height of the sensor.

    With ``weight_density`` the density of the water times standard gravity::

        depth = (fluid_pressure - atmosphere) / weight_density - surface_height

    Raises :class:`DataError` for an absolute pressure that is not above 0, which is no reading.
    """
    pressure = _finite(message, "fluid_pressure")
    if options.atmosphere > 0.0 >= pressure:
        raise DataError(
            f"FluidPressure: expected an absolute pressure in Pa, got {pressure:g}; for a sensor "
            "that reads 0 at the surface give  --atmosphere 0"
        )
    below = (pressure - options.atmosphere) / options.weight_density
    return DepthReading(stamp_s(message, received_s), below - (options.surface_height or 0.0))


def depth_sigma(message: Any, options: RosOptions = DEFAULTS) -> float:
    """Return the standard deviation that ``FluidPressure`` states, m; NaN where it states none."""
    return _sigma(message.variance) / options.weight_density


def fix(message: Any, received_s: float, options: RosOptions = DEFAULTS) -> Fix:
    """Return ``sensor_msgs/NavSatFix``.

    Raises :class:`DataError`: the receiver had no fix, the position is no place on Earth, or the
    altitude is missing.
    """
    if int(message.status.status) < 0:
        raise DataError("NavSatFix: the receiver says that it has no fix")
    lat, lon = _finite(message, "latitude"), _finite(message, "longitude")
    is_on_earth = abs(lat) <= LATITUDES_DEG[1] and LONGITUDES_DEG[0] <= lon <= LONGITUDES_DEG[1]
    if not is_on_earth or lat == lon == 0.0:
        raise DataError(f"NavSatFix: expected degrees of a place on Earth, got {lat:g}, {lon:g}")
    return Fix(
        time_s=stamp_s(message, received_s),
        lat=math.radians(lat),
        lon=float(wrapped(math.radians(lon))),
        height=_finite(message, "altitude"),
        sigma_enu=_fix_sigma(message, options.fix_sigma_enu),
    )


def has_stated_sigma(message: Any) -> bool:
    """Return whether a ``NavSatFix`` says in full how good it is."""
    nothing = (math.nan, math.nan, math.nan)
    return all(math.isfinite(sigma) for sigma in _fix_sigma(message, nothing))


CONVERTERS: Final[Mapping[str, Callable[..., Message]]] = {
    IMU_TYPE: imu_sample,
    MARINE_DVL_TYPE: ping,
    WATER_LINKED_TYPE: ping,
    PRESSURE_TYPE: depth_reading,
    FIX_TYPE: fix,
}
"""By message type; all raise `DataError` for a message that cannot be used."""


def _marine(message: Any, time_s: float, options: RosOptions) -> DvlReport:
    sign, n_beams = 1.0 if options.beam_sign is BeamSign.ALONG else -1.0, options.n_beams
    if n_beams > len(message.beam_velocity):
        raise DataError(f"Dvl: expected {n_beams} beams, got room for {len(message.beam_velocity)}")
    sigma = tuple(_sigma(value) for value in message.beam_velocity_covar)[:n_beams]
    good = _good_beams(message)
    speed = tuple(
        sign * float(value) if is_good else math.nan
        for value, is_good in zip(message.beam_velocity, good, strict=True)
    )
    return DvlReport(
        ping=Ping(
            time_s=time_s,
            speed=speed[:n_beams],
            sigma=None if all(math.isnan(value) for value in sigma) else sigma,
            is_water=is_off_water(message),
        ),
        range_m=tuple(
            _range(value) if message.beam_ranges_valid else math.nan for value in message.range
        )[:n_beams],
        beams_d=tuple(_vector(beam) for beam in message.beam_unit_vec)[:n_beams],
        velocity_d=_vector(message.velocity),
        covariance_d=_covariance(getattr(message, "velocity_covar", ())),
    )


def _good_beams(message: Any) -> list[bool]:
    """Return which beams saw the bottom.

    Drivers leave speed 0 and range -1 in a beam that did not; where even then more speeds than
    ``num_good_beams`` are left, nobody can say which are good, and none is used.
    """
    if not message.beam_velocities_valid:
        return [False] * len(message.beam_velocity)
    nearest = math.ulp(0.0) if message.beam_ranges_valid else 0.0
    speeds = [float(speed) for speed in message.beam_velocity]
    good = [
        math.isfinite(speed) and not float(distance) < nearest
        for speed, distance in zip(speeds, message.range, strict=True)
    ]
    count = int(message.num_good_beams)
    if sum(good) > count:
        good = [one and speed != 0.0 for one, speed in zip(good, speeds, strict=True)]
    return good if sum(good) <= count else [False] * len(good)


def _water_linked(message: Any, time_s: float, options: RosOptions) -> DvlReport:
    n_beams = options.n_beams
    speed, ranges = [math.nan] * n_beams, [math.nan] * n_beams
    ids = [int(beam.id) for beam in message.beams]
    if len(set(ids)) != len(ids) or not set(ids) <= set(range(n_beams)):
        raise DataError(f"DVL: expected beams with ids 0 to {n_beams - 1}, got {ids}")
    for beam in message.beams if message.velocity_valid else ():
        if beam.valid and math.isfinite(beam.velocity):
            speed[int(beam.id)] = float(beam.velocity)
            ranges[int(beam.id)] = _range(beam.distance)
    return DvlReport(
        ping=Ping(time_s, tuple(speed)),
        range_m=tuple(ranges),
        beams_d=None,
        velocity_d=_vector(message.velocity)
        if message.velocity_valid
        else (math.nan, math.nan, math.nan),
        covariance_d=_covariance(getattr(message, "covariance", ())),
    )


def _twist(message: Any, time_s: float, options: RosOptions) -> DvlReport:
    """Return a velocity in the body's axes, turned to forward-right-down."""
    missing = (math.nan,) * options.n_beams
    velocity = _vector(message.twist.twist.linear)
    matrix = [float(value) for value in message.twist.covariance]
    linear = _covariance(matrix[6 * row + column] for row in range(3) for column in range(3))
    columns = [turned((linear[k], linear[3 + k], linear[6 + k]), options.body) for k in range(3)]
    rows = [turned((columns[0][k], columns[1][k], columns[2][k]), options.body) for k in range(3)]
    return DvlReport(
        ping=Ping(time_s, missing),
        range_m=missing,
        beams_d=None,
        velocity_d=turned(velocity, options.body),
        covariance_d=tuple(value for row in rows for value in row),
    )


def _fix_sigma(message: Any, instead: Vector) -> Vector:
    if int(message.position_covariance_type) == _COVARIANCE_UNKNOWN:
        return instead
    stated = [_sigma(message.position_covariance[index]) for index in (0, 4, 8)]
    east, north, up = (
        sigma if math.isfinite(sigma) else other
        for sigma, other in zip(stated, instead, strict=True)
    )
    return (east, north, up)


def _in_frd(message: Any, field: str, axes: BodyAxes) -> Vector:
    vector = _vector(getattr(message, field))
    if not all(abs(value) < _LARGEST_NUMBER for value in vector):
        raise DataError(f"{type(message).__name__}: {field} is not finite, or damaged: {vector}")
    return turned(vector, axes)


def _finite(message: Any, field: str) -> float:
    value = float(getattr(message, field))
    if not math.isfinite(value):
        raise DataError(f"{type(message).__name__}: {field} is not finite: {value}")
    return value


def _sigma(variance: Any) -> float:
    """Return the root of a variance; NaN for one that is unknown, which is 0 or below."""
    value = float(variance)
    return math.sqrt(value) if 0.0 < value < math.inf else math.nan


def _range(value: Any) -> float:
    distance = float(value)
    return distance if 0.0 < distance < math.inf else math.nan


def _vector(value: Any) -> Vector:
    return (float(value.x), float(value.y), float(value.z))


def _covariance(values: Iterable[Any]) -> tuple[float, ...]:
    """Return nine numbers; NaN where there are others, or a variance is not above zero."""
    found = tuple(float(value) for value in values)
    is_stated = len(found) == 9 and all(found[i] > 0.0 for i in (0, 4, 8))
    return found if is_stated else (math.nan,) * 9
