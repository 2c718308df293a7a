"""Every instrument there is: a new one is a file beside this one, and a line here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from ssm_graph.sensors.acoustic import RANGES, USBL
from ssm_graph.sensors.compass import COMPASS
from ssm_graph.sensors.depth import DEPTH
from ssm_graph.sensors.dvl_instrument import DVL
from ssm_graph.sensors.features import FEATURES
from ssm_graph.sensors.gnss import GNSS
from ssm_graph.sensors.imu import IMU
from ssm_graph.sensors.instrument import Instrument
from ssm_graph.sensors.magnetometer import MAGNETOMETER
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.standstill import AT_REST

INSTRUMENTS: Final[tuple[Instrument, ...]] = (
    IMU,
    DVL,
    DEPTH,
    GNSS,
    USBL,
    RANGES,
    COMPASS,
    MAGNETOMETER,
    AT_REST,
    FEATURES,
)
"""In the order in which a folder has their tables, and a log counts them: new ones come last, or
older logs are counted wrongly."""
BY_SECTION: Final[Mapping[str, Instrument]] = {one.section: one for one in INSTRUMENTS}
BY_LOG: Final[Mapping[type, Instrument]] = {one.log: one for one in INSTRUMENTS}
BY_MESSAGE: Final[Mapping[type[Message], Instrument]] = {
    one.message: one for one in INSTRUMENTS if one.message is not None
}
