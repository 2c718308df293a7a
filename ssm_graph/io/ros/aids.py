"""Messages of ROS that further aids come as: acoustics, headings, magnetic fields, times at rest.

None has a type of its own, a USBL fix is a ``NavSatFix`` as one of GNSS is: which topic is which
aid has to be said. What each measures, its noise and where it sits is the vehicle's to state.
Facts, and where they come from:

* ``NavSatFix`` and ``Range`` are stamped when they were true, and come late (REP 103, header).
* ``Range`` has no number of a beacon: it is the one at the end of ``frame_id``, as in ``beacon_7``.
* An orientation turns body axes to east-north-up (REP 103): yaw 0 looks east.
* ``MagneticField`` is in tesla, in the axes of the body.
* ``Bool`` has no header: it is true when it comes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes, turned
from ssm_graph.io.ros.messages import DEFAULTS, FIX_TYPE, IMU_TYPE, RosOptions, fix, stamp_s
from ssm_graph.sensors.acoustic import AcousticRange, UsblFix
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.magnetometer import MagneticReading
from ssm_graph.sensors.messages import Message, bad_number
from ssm_graph.sensors.standstill import RestReading

AID_TYPES: Final[Mapping[str, tuple[str, ...]]] = {
    "usbl": (FIX_TYPE,),
    "ranges": ("sensor_msgs/msg/Range",),
    "heading": ("geometry_msgs/msg/QuaternionStamped", IMU_TYPE),
    "magnetometer": ("sensor_msgs/msg/MagneticField",),
    "at_rest": ("std_msgs/msg/Bool",),
}
"""By the section of the instrument, the types that it may come as."""
_LEAST_LENGTH: Final = 0.9
"""Of a quaternion: drivers that know no orientation leave it zero."""
_FORWARD: Final[Mapping[BodyAxes, int]] = {BodyAxes.FRD: 0, BodyAxes.FLU: 0, BodyAxes.RFU: 1}
"""Which body axis looks ahead."""


def aid_message(
    section: str, message: Any, received_s: float, options: RosOptions = DEFAULTS
) -> Message | None:
    """Return what an aid says, None where it says nothing.

    Raises :class:`DataError`: the message cannot be used.
    """
    found = _MAKERS[section](message, received_s, options)
    bad = None if found is None else bad_number(found)
    if bad is not None:
        raise DataError(f"{type(message).__name__}: {bad} is not a finite number")
    return found


def _usbl(message: Any, received_s: float, options: RosOptions) -> UsblFix:
    place = fix(message, received_s, options)
    return UsblFix(place.time_s, place.lat, place.lon, place.height, place.sigma_enu)


def _range(message: Any, received_s: float, options: RosOptions) -> AcousticRange:  # noqa: ARG001
    frame_id, reach = str(message.header.frame_id), float(message.range)
    number = re.search(r"(\d{1,6})\Z", frame_id)
    if number is None:
        raise DataError(
            f"Range: expected the beacon's number at the end of frame_id, got {frame_id!r}"
        )
    if not 0.0 < reach < math.inf:
        raise DataError(f"Range: expected metres above zero, got {reach:g}")
    variance = float(getattr(message, "variance", 0.0))
    sigma = math.sqrt(variance) if 0.0 < variance < math.inf else math.nan
    return AcousticRange(stamp_s(message, received_s), float(number[1]), reach, sigma)


def _heading(message: Any, received_s: float, options: RosOptions) -> HeadingReading:
    if hasattr(message, "orientation_covariance") and float(message.orientation_covariance[0]) < 0:
        raise DataError("Imu: the message says that it has no orientation")
    q = message.orientation if hasattr(message, "orientation") else message.quaternion
    x, y, z, w = (float(value) for value in (q.x, q.y, q.z, q.w))
    if not x * x + y * y + z * z + w * w > _LEAST_LENGTH:
        raise DataError("expected an orientation of length 1, got one that is zero")
    east, north = ((w * w + x * x - y * y - z * z), 2.0 * (x * y + w * z))
    if _FORWARD[options.body]:
        east, north = 2.0 * (x * y - w * z), (w * w - x * x + y * y - z * z)
    return HeadingReading(stamp_s(message, received_s), math.atan2(east, north))


def _magnetic(message: Any, received_s: float, options: RosOptions) -> MagneticReading:
    field = message.magnetic_field
    vector = (float(field.x), float(field.y), float(field.z))
    return MagneticReading(stamp_s(message, received_s), turned(vector, options.body))


def _rest(message: Any, received_s: float, options: RosOptions) -> RestReading | None:  # noqa: ARG001
    return RestReading(received_s) if message.data else None


_MAKERS: Final[Mapping[str, Callable[[Any, float, RosOptions], Message | None]]] = {
    "usbl": _usbl,
    "ranges": _range,
    "heading": _heading,
    "magnetometer": _magnetic,
    "at_rest": _rest,
}
