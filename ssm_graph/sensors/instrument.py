"""What an instrument is to the rest: a declaration of its keys, its columns and its checks.

From one declaration follow the section of ``mission.toml`` and of a vehicle file, the table, read
and written, the live message with its JSON fields and its row in a log, and what a live estimator
keeps of it. Logs hold what the instrument said; what is known to be wrong with it (a late clock,
an offset, a scale) is taken off by the log's own properties, and nowhere else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.frames import BodyAxes, to_frd
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import Key, Settings, build, written
from ssm_graph.base.tables import TIME, Table, TableSpec
from ssm_graph.base.units import wrapped
from ssm_graph.sensors.messages import Message, field_names

XYZ: Final = ("x", "y", "z")
ENU: Final = ("east", "north", "up")
SMALLEST_SIGMA: Final = 1e-9
"""SI; no instrument is that good, and weights of smaller sigmas overflow."""
_CHUNK: Final = 4096
"""Rows that are turned into messages at a time."""

Lists = Mapping[str, tuple[Settings, ...]]
"""The sections of a file that may come several times, ``[[beacon]]``."""


@dataclass(frozen=True, slots=True)
class Column:
    """One quantity of every reading: a field of log and message, one or more columns of a table."""

    field: str
    """Of the log, (N,) or (N, len(over)), and of the message."""
    pattern: str
    """Name of its column in the table; braces stand for each of ``over``."""
    over: tuple[str, ...] = ()
    limits: tuple[float, float] = (-math.inf, math.inf)
    """The least and the largest number that the column can hold, in its unit."""
    expected: str = ""
    """What is told of a number beyond."""
    told: str = "{} is out of range: a wrong unit?"
    """What is told of a message with such a number; braces stand for the value in SI units."""
    unit: float = 1.0
    """One unit of the column in SI."""
    is_body: bool = False
    """A vector in the body axes of the table."""
    wraps: bool = False
    """An angle that is kept within half a turn."""
    optional: bool = False
    """A table may lack it, and its cells may be empty."""
    blank: bool = False
    """Its cells may be empty."""
    missing: float = math.nan
    """What an empty cell stands for, SI."""
    is_live: bool = True
    """Whether messages have it."""
    is_many: bool = False
    """As many parts as the very instrument has; see :meth:`sized`."""
    is_flag: bool = False
    """Yes or no: 1 or 0 in a table."""
    message_field: str = ""
    """Of the message, where it has another name than the log's."""
    json: str = ""
    """Its key in a message; the name without the braces unless given."""

    def sized(self, count: int) -> Column:
        """Return the column of an instrument with so many parts, numbered from 1."""
        return replace(self, over=tuple(str(n) for n in range(1, count + 1)), is_many=False)

    @property
    def told_as(self) -> str:
        """The field of the message."""
        return self.message_field or self.field

    @property
    def names(self) -> tuple[str, ...]:
        """Its columns."""
        return tuple(self.pattern.format(part) for part in self.over or ("",))

    @property
    def key(self) -> str:
        """Its key in a JSON message."""
        return self.json or self.pattern.replace("{}_", "")

    def si(self, cells: Array, axes: BodyAxes) -> Array:
        """Return its cells (N, columns) as (N,) or (N, len(over)) in SI units, axes FRD."""
        values = cells * self.unit
        if self.wraps:
            values = wrapped(values)
        if self.is_body:
            values = to_frd(values, axes)
        if not math.isnan(self.missing):
            values = np.where(np.isnan(values), self.missing, values)
        return values if self.over else values[:, 0]

    def written(self, values: Array) -> dict[str, Array]:
        """Return its columns of numbers in SI units; the inverse of :meth:`si` in axes FRD."""
        columns = np.asarray(values).reshape(-1, len(self.names)) / self.unit
        return {name: columns[:, index] for index, name in enumerate(self.names)}

    def beyond(self, table: Table) -> None:
        """Raise :class:`DataError` for the first number of a table that is beyond the limits."""
        for name in self.names:
            if name in table.columns:
                values = table.columns[name]
                bad = (values < self.limits[0]) | (values > self.limits[1])
                if bad.any():
                    raise table.cell_fault(int(np.argmax(bad)), name, self.expected)

    def is_beyond(self, numbers: Sequence[float]) -> bool:
        """Return whether one of some numbers in SI units is beyond the limits; NaN is not."""
        low, high = self.limits[0] * self.unit, self.limits[1] * self.unit
        return any(number < low or number > high for number in numbers)


def read_columns(table: Table, columns: Sequence[Column], axes: BodyAxes) -> dict[str, Array]:
    """Return what columns of a table hold, by the fields of the log, SI units and axes FRD."""
    cells = table.stack([name for column in columns for name in column.names])
    edges = np.cumsum([len(column.names) for column in columns])[:-1]
    parts = zip(columns, np.split(cells, edges, axis=1), strict=True)
    return {column.field: column.si(part, axes) for column, part in parts}


def added(log: Any, stated: float | Array, off: Array) -> Array:  # noqa: ARG001
    """Return a value that was found to be off by so much."""
    return np.asarray(stated + off)


def compounded(log: Any, stated: float | Array, off: Array) -> Array:  # noqa: ARG001
    """Return a scale error that was found to be off by another, of what is left."""
    return np.asarray((1.0 + stated) * (1.0 + off) - 1.0)


class Calibrated(NamedTuple):
    """Where a file states what a calibration finds."""

    key: str
    """Of its value."""
    sigma_key: str
    """Of its prior sigma."""
    total: Callable[[Any, float | Array, Array], Array] = added
    """Makes the value of the log, of what it states and of what that was found to be off by, SI."""


@dataclass(frozen=True, slots=True)
class Instrument:
    """The declaration of one kind of instrument; those with ways of their own extend it.

    A log without rows tells all that is known of an instrument before its first reading: that is
    what a section of a file describes, and what a vehicle has.
    """

    section: str
    """Its section of ``mission.toml``, its table, and the type of its JSON messages."""
    log: type[Any]
    """What a mission holds of it: a frozen value with ``time_s`` and the fields of the columns."""
    keys: Mapping[str, Key]
    columns: tuple[Column, ...] = ()
    message: type[Message] | None = None
    """One reading; None for an instrument that is not heard live."""
    letter: str = ""
    """Stands for a reading where only the order of arrival is kept."""
    late: str = ""
    """The field of the log that says how late its stamps are, such as calibration.time_offset_s."""
    row_key: tuple[str, ...] = ()
    """Columns that tell readings of one time apart."""
    lists: Mapping[str, Mapping[str, Key]] = field(default_factory=dict)
    """Sections that may come several times and belong to it."""
    calibrated: Mapping[str, Calibrated] = field(default_factory=dict)
    """What is estimated of it, by the name of the variable."""
    is_required: bool = False
    """Every mission has one."""

    # Files.

    def bare(self, settings: Settings, lists: Lists) -> Any:  # noqa: ARG002
        """Return the log without rows that a section describes; raise where it cannot be."""
        return build(self.log, self.empty() | settings.given())

    def empty(self) -> dict[str, Any]:
        """Return the fields of a log that has no rows."""
        shapes = {c.field: (0, len(c.over)) if c.over else (0,) for c in self.columns}
        return {name: np.zeros(shape) for name, shape in {"time_s": (0,), **shapes}.items()}

    def columns_of(self, bare: Any) -> tuple[Column, ...]:  # noqa: ARG002
        """Return the columns that the table of this very instrument may have."""
        return self.columns

    def spec(self, bare: Any) -> TableSpec:
        """Return the columns of the table as a reader of tables has to know them."""
        columns = self.columns_of(bare)
        place = ("lat_deg", "lon_deg")
        return TableSpec(
            (TIME, *(name for c in columns if not c.optional for name in c.names)),
            tuple(name for c in columns if c.optional for name in c.names),
            frozenset(name for c in columns if c.blank for name in c.names),
            key=self.row_key,
            limits={name: c.limits for c in columns for name in c.names},
            nowhere=place if {*place} <= {c.pattern for c in columns} else (),
        )

    def check(self, table: Table, bare: Any, axes: BodyAxes) -> list[str]:  # noqa: ARG002
        """Refuse a table whose numbers cannot be what its columns say; return what is odd.

        ``bare`` is what :meth:`bare` made of the section; ``axes`` are those of its body vectors.
        """
        for column in self.columns_of(bare):
            column.beyond(table)
        return []

    def filled(self, table: Table, bare: Any, settings: Settings, axes: BodyAxes) -> Any:  # noqa: ARG002
        """Return the log of a checked table."""
        rows = read_columns(table, self.columns_of(bare), axes)
        return replace(bare, time_s=table.time_s, **rows)

    def cleaned(self, log: Any) -> Any:
        """Return a log that :meth:`check` has seen without what cannot have been measured."""
        return log

    def without_rows(self, log: Any) -> Any:
        """Return what is known of an instrument beside its readings."""
        return replace(log, **self.empty())

    def settings_of(self, log: Any) -> dict[str, Any]:
        """Return the section that describes an instrument, without the name of its table."""
        return written(log, self.keys)

    def lists_of(self, log: Any) -> dict[str, list[dict[str, Any]]]:  # noqa: ARG002
        """Return the sections of :attr:`lists` that describe an instrument."""
        return {}

    def table_of(self, log: Any) -> dict[str, Array]:
        """Return the columns of a log's table, in the units of the file and axes FRD."""
        columns = {TIME: log.time_s}
        for column in self.columns_of(log):
            values = getattr(log, column.field)
            is_said = values is not None and not (
                column.optional and np.all(np.isnan(values) | (values == column.missing))
            )
            if is_said:
                columns |= column.written(values)
        return columns

    # Live.

    def live_columns(self, bare: Any) -> tuple[Column, ...]:
        """Return those that a message tells."""
        return tuple(column for column in self.columns_of(bare) if column.is_live)

    def numbers(self, message: Message) -> list[float]:
        """Return a message as plain numbers in SI units, time first, NaN where one is missing."""
        row: list[float] = []
        for name in field_names(type(message)):
            value = getattr(message, name)
            row.extend(value) if isinstance(value, tuple) else row.append(float(value))
        return row

    def message_of(self, numbers: Sequence[float], bare: Any) -> Message:
        """Return the message of its numbers, time first."""
        assert self.message is not None
        parts: list[Any] = [numbers[0]]
        at = 1
        for column in self.live_columns(bare):
            size = len(column.over)
            parts.append(tuple(numbers[at : at + size]) if size else numbers[at])
            at += size or 1
        return self.message(*parts)

    def width(self, bare: Any) -> int:
        """Return how many numbers a message has beside its time."""
        return sum(len(column.names) for column in self.live_columns(bare))

    def problem(self, message: Message, bare: Any) -> str | None:
        """Return why a message cannot be a reading, None where it can."""
        for column in self.columns_of(bare):
            if not column.is_live:
                continue
            value = getattr(message, column.told_as)
            if column.is_beyond(value if column.over else (value,)):
                return column.told.format(value)
        return None

    def sifted(
        self,
        message: Message,
        near: Array,  # noqa: ARG002
        bare: Any,  # noqa: ARG002
    ) -> tuple[Message, tuple[str, str] | None]:
        """Return a message without what cannot have been measured, and what was and why.

        The message has nothing that :meth:`problem` names; ``near`` (M, 1 + width) are the readings
        before and after it, as :meth:`log_of` has them.
        """
        return message, None

    def late_s(self, bare: Any) -> float:
        """Return how late the stamps are known to be, s."""
        if not self.late:
            return 0.0
        value = bare
        for part in self.late.split("."):
            value = getattr(value, part)
        return float(value)

    def valid_s(self, message: Message, bare: Any) -> float:
        """Return when the content of a message was true, s."""
        return message.time_s - self.late_s(bare)

    def log_of(self, rows: Array, bare: Any) -> Any:
        """Return the log of rows (N, 1 + width): when they were true, then their numbers, SI."""
        parts: dict[str, Array] = {"time_s": rows[:, 0] + self.late_s(bare)}
        at = 1
        for column in self.live_columns(bare):
            size = len(column.over) or 1
            part = rows[:, at : at + size]
            parts[column.field] = part if column.over else part[:, 0]
            at += size
        return replace(bare, **parts)

    def messages_of(self, log: Any) -> Iterator[Message]:
        """Yield the readings of a log as they would have come."""
        columns = [log.time_s, *(getattr(log, c.field) for c in self.live_columns(log))]
        for start in range(0, len(log.time_s), _CHUNK):
            rows = np.column_stack([column[start : start + _CHUNK] for column in columns])
            for row in rows.tolist():
                yield self.message_of(row, log)
