"""Messages as rows of the tables of a mission folder, and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from ssm_graph.io.mission_folder.keys import ACCEL, GYRO, SPEED, SPEED_SIGMA, WATER_TRACK
from ssm_graph.io.tables.table import POSITION, POSITION_SIGMA, TIME
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message

ARRIVALS: Final = "arrivals"
"""The file of a log that has a letter for every row, in order of arrival."""


@dataclass(frozen=True, slots=True)
class RowKind:
    """How messages of one type are written."""

    file: str
    letter: bytes
    """One byte that stands for such a message where only the order of arrival is kept."""
    columns: tuple[str, ...]
    numbers: Callable[[Any], tuple[float, ...]]
    """The cells of a message, NaN where one is empty or not a number."""
    message: Callable[[list[float]], Message]
    """The message of the cells."""
    has_blanks: bool = False
    """NaN is written as an empty cell."""

    @property
    def header(self) -> bytes:
        """The first line of the table."""
        return f"{','.join(self.columns)}\n".encode()

    def row(self, message: Message) -> bytes:
        """Return a message as a line of the table."""
        line = ",".join([repr(float(number)) for number in self.numbers(message)])
        return f"{line.replace('nan', '') if self.has_blanks else line}\n".encode()

    def parse(self, line: bytes) -> Message | None:
        """Return the message of a line; None for the header and for a torn line."""
        cells = line.split(b",")
        if len(cells) != len(self.columns):
            return None
        try:
            if self.has_blanks:
                return self.message([float(cell) if cell else math.nan for cell in cells])
            return self.message([float(cell) for cell in cells])
        except ValueError:
            return None


def degrees_of(angle: float) -> float:
    """Return degrees from which :func:`math.radians` makes the same float, or a neighbour.

    Radians of one size lie up to twice as dense as the degrees they come from, so that not every
    float has degrees of its own; the neighbour is less than 5e-16 rad away, 3 nm on the Earth.
    """
    degrees = math.degrees(angle)
    for near in (degrees, math.nextafter(degrees, math.inf), math.nextafter(degrees, -math.inf)):
        if math.radians(near) == angle:
            return near
    return degrees


def _ping_numbers(ping: Ping) -> tuple[float, ...]:
    sigma = (math.nan,) * len(SPEED_SIGMA) if ping.sigma is None else ping.sigma
    return (ping.time_s, *ping.speed, *sigma, float(ping.is_water))


def _ping(cells: list[float]) -> Ping:
    time_s, v1, v2, v3, v4, s1, s2, s3, s4, water = cells
    has_sigma = not all(math.isnan(sigma) for sigma in (s1, s2, s3, s4))
    sigma = (s1, s2, s3, s4) if has_sigma else None
    return Ping(time_s, (v1, v2, v3, v4), sigma, is_water=water > 0.0)


def _fix_numbers(fix: Fix) -> tuple[float, ...]:
    lat_deg, lon_deg = degrees_of(float(fix.lat)), degrees_of(float(fix.lon))
    return (fix.time_s, lat_deg, lon_deg, fix.height, *fix.sigma_enu)


def _fix(cells: list[float]) -> Fix:
    time_s, lat_deg, lon_deg, height, east, north, up = cells
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    return Fix(time_s, lat, lon, height, (east, north, up))


ROW_KINDS: Final[Mapping[type, RowKind]] = {
    ImuSample: RowKind(
        file="imu.csv",
        letter=b"i",
        columns=(TIME, *GYRO, *ACCEL),
        numbers=lambda sample: (sample.time_s, *sample.gyro_b, *sample.accel_b),
        message=lambda cells: ImuSample(
            cells[0], (cells[1], cells[2], cells[3]), (cells[4], cells[5], cells[6])
        ),
    ),
    Ping: RowKind(
        file="dvl.csv",
        letter=b"d",
        columns=(TIME, *SPEED, *SPEED_SIGMA, WATER_TRACK),
        numbers=_ping_numbers,
        message=_ping,
        has_blanks=True,
    ),
    DepthReading: RowKind(
        file="depth.csv",
        letter=b"z",
        columns=(TIME, "depth_m"),
        numbers=lambda reading: (reading.time_s, reading.depth),
        message=lambda cells: DepthReading(cells[0], cells[1]),
    ),
    Fix: RowKind(
        file="gnss.csv",
        letter=b"g",
        columns=(TIME, *POSITION, *POSITION_SIGMA),
        numbers=_fix_numbers,
        message=_fix,
    ),
}
"""By the type of the message, in the order in which a log lists its tables."""
