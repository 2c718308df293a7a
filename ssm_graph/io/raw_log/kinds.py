"""How messages of each instrument are written as rows of a raw log's tables, and read again."""

from __future__ import annotations

import math
from typing import Any

from ssm_graph.base.tables import TIME
from ssm_graph.base.units import exactly_in_unit
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.instrument import Instrument
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.registry import BY_LOG, INSTRUMENTS


class RowKind:
    """How messages of one instrument are written.

    What is known of the instrument, ``bare``, says how many numbers a message has.
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
