"""Messages as rows of the tables of a mission folder, and back, and a mission as messages."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from typing import Any, Final

from ssm_graph.base.tables import TIME
from ssm_graph.base.units import exactly_in_unit
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.instrument import Instrument
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.registry import BY_LOG, BY_SECTION, INSTRUMENTS

ARRIVALS: Final = "arrivals"
"""The file of a log that has a letter for every row, in order of arrival."""


class RowKind:
    """How messages of one instrument are written.

    Parameters
    ----------
    instrument : one that is heard live.
    bare : what is known of it: how many numbers a message has.
    """

    def __init__(self, instrument: Instrument, bare: Any) -> None:
        columns = instrument.live_columns(bare)
        self._instrument, self._bare = instrument, bare
        self._units = [1.0, *(c.unit for c in columns for _ in c.names)]
        self._scaled = [i for i, unit in enumerate(self._units) if unit != 1.0]
        self._may_miss = [False, *(c.optional or c.blank for c in columns for _ in c.names)]
        self._has_blanks = any(self._may_miss)
        self.file = f"{instrument.section}.csv"
        self.letter = instrument.letter.encode()
        """One byte that stands for such a message where only the order of arrival is kept."""
        self.columns = (TIME, *(name for c in columns for name in c.names))

    @property
    def header(self) -> bytes:
        """The first line of the table."""
        return f"{','.join(self.columns)}\n".encode()

    def row(self, message: Message) -> bytes:
        """Return a message as a line of the table; a number that is missing is an empty cell."""
        cells = self._instrument.numbers(message)
        for i in self._scaled:
            cells[i] = exactly_in_unit(cells[i], self._units[i])
        line = ",".join([repr(float(cell)) for cell in cells])
        return f"{line.replace('nan', '') if self._has_blanks else line}\n".encode()

    def parse(self, line: bytes) -> Message | None:
        """Return the message of a line; None for the header and for a torn line."""
        cells = line.split(b",")
        if len(cells) != len(self.columns):
            return None
        try:
            numbers = [
                math.nan if not cell and may_miss else float(cell)
                for cell, may_miss in zip(cells, self._may_miss, strict=True)
            ]
        except ValueError:
            return None
        for i in self._scaled:
            numbers[i] *= self._units[i]
        return self._instrument.message_of(numbers, self._bare)


def row_kinds(vehicle: Vehicle) -> dict[type[Message], RowKind]:
    """Return by the type of the message how each is written, in the order of a log's tables.

    What the vehicle does not have is logged as well where it comes.
    """
    logs = {BY_LOG[kind].section: log for kind, log in vehicle.bare_logs.items()}
    return {
        one.message: RowKind(one, logs.get(one.section))
        for one in INSTRUMENTS
        if one.message is not None
    }


ALWAYS: Final = ("imu.csv", "dvl.csv", "depth.csv", "gnss.csv")
"""Tables that every log has, whatever came."""


def messages_of(mission: Mission) -> Iterator[Message]:
    """Yield all messages of a mission in order of time.

    An IMU sample stands at the end of its interval, a ping at its stamp. Of equal times they come
    in the order of the registry: IMU, DVL, depth, GNSS. Rows are turned into messages as they are
    asked for, so that a day of data needs no more memory than the mission itself.
    """
    every = (mission.imu, mission.dvl, mission.depth, mission.gnss, *mission.aids)
    logs: dict[type, Any] = {type(log): log for log in every}
    streams = [
        one.messages_of(logs[one.log])
        for one in BY_SECTION.values()
        if one.message is not None and one.log in logs
    ]
    return heapq.merge(*streams, key=lambda message: message.time_s)
