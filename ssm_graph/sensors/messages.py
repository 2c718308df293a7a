"""What a live estimator is told: one reading of one instrument at a time."""

from __future__ import annotations

import math

from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample

Message = ImuSample | Ping | DepthReading | Fix


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
