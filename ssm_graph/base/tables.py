"""Tables of numbers in memory, and every defect named by its place; reading files is not here."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError, nearest_hint
from ssm_graph.base.frozen import Array

LARGEST_TIME_S: Final = 1e20
TIME: Final = "time_s"


class Order(Enum):
    """How the rows of a mission's tables follow each other."""

    TIME = "time"
    """Times increase strictly."""
    ARRIVAL = "arrival"
    """As they came: late, repeated and torn rows are possible."""


@dataclass(frozen=True, slots=True)
class TableSpec:
    """The columns of one kind of table."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    blank: frozenset[str] = frozenset()
    """Required columns whose cells may be empty or NaN; the optional ones always may."""
    key: tuple[str, ...] = ()
    """Columns that tell rows of one time apart; without them every time is there once."""
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """The least and the largest number that a column can hold."""
    nowhere: tuple[str, ...] = ()
    """Columns that are all exactly zero where there was nothing to measure."""

    @property
    def may_be_blank(self) -> frozenset[str]:
        """All columns that may hold NaN."""
        return self.blank | frozenset(self.optional)


@dataclass(frozen=True, slots=True, eq=False)
class TableFile(ABC):
    """Where the rows of a table stand."""

    label: str
    """How messages call the file."""

    def place(self, row: int) -> str:
        """Return where a row is: in a text its line, else its number, counted from 1."""
        return f"{self.label}: row {row + 1}"

    @abstractmethod
    def cell(self, row: int, column: str) -> str:
        """Return the content of a cell as it stands there."""


@dataclass(frozen=True, slots=True, eq=False)
class NoFile(TableFile):
    """Rows that stand in no file."""

    columns: Mapping[str, Array]

    def cell(self, row: int, column: str) -> str:  # noqa: D102
        return f"{self.columns[column][row]:.10g}"


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """The columns of one sensor table, in the units of the file."""

    file: TableFile
    columns: dict[str, Array]
    notes: tuple[str, ...] = ()
    label: str = field(init=False)
    """What messages call the table."""
    time_s: Array = field(init=False)
    """(N,) the column ``time_s``."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.file.label)
        object.__setattr__(self, "time_s", self.columns[TIME])

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def stack(self, names: Sequence[str]) -> Array:
        """Return columns side by side, (N, len(names)); NaN where the table has no such column."""
        missing = np.full(len(self), np.nan)
        return np.column_stack([self.columns.get(name, missing) for name in names])

    def fault(self, row: int, text: str) -> DataError:
        """Return an error that names the line of ``row``."""
        return DataError(f"{self.file.place(row)}: {text}")

    def cell_fault(self, row: int, column: str, text: str) -> DataError:
        """Return an error that names line, column and content of a cell."""
        return self.fault(row, f"column {column!r} holds {self.file.cell(row, column)}; {text}")


def table_of(label: str, columns: dict[str, Array]) -> Table:
    """Return columns (N,) that stand in no file as a table under a name."""
    return Table(NoFile(label, columns), columns)


def check_names(place: str, names: Iterable[str], spec: TableSpec) -> None:
    """Raise for a column that is repeated, unknown or missing."""
    counts = Counter(names)
    known = (*spec.required, *spec.optional)
    repeated = [name for name, count in counts.items() if count > 1]
    if repeated:
        raise DataError(
            f"{place}: column {repeated[0]!r} appears {counts[repeated[0]]} times; expected once; "
            "delete or rename the others"
        )
    for name in counts:
        if name not in known:
            missing = [column for column in known if column not in counts]
            hint = nearest_hint(name, missing or known)
            raise DataError(f"{place}: unknown column {name!r}; {hint}")
    for name in spec.required:
        if name not in counts:
            raise DataError(
                f"{place}: column {name!r} is missing; expected {', '.join(spec.required)}"
            )


def check_finite(table: Table, spec: TableSpec) -> None:
    """Raise for the first cell that is not finite where it has to be."""
    for name, values in table.columns.items():
        bad = np.isinf(values) if name in spec.may_be_blank else ~np.isfinite(values)
        if bad.any():
            row = int(np.argmax(bad))
            hint = "leave the cell empty" if name in spec.may_be_blank else "delete this row"
            raise table.cell_fault(row, name, f"expected a finite number; {hint}")
    if len(table) and np.abs(table.time_s).max() > LARGEST_TIME_S:
        row = int(np.argmax(np.abs(table.time_s)))
        raise table.cell_fault(row, TIME, "expected seconds; correct or delete this row")


def is_repeated(table: Table, spec: TableSpec) -> NDArray[np.bool_]:
    """Return which rows (N,) have the time, and the key, of an earlier one."""
    rows = table.stack((TIME, *spec.key))
    repeated = np.ones(len(rows), dtype=bool)
    repeated[np.unique(rows, axis=0, return_index=True)[1]] = False
    return repeated


def check_increasing(table: Table, spec: TableSpec) -> None:
    """Raise for the first time that is not after the one before."""
    step = np.diff(table.time_s)
    if np.all(step > 0.0):
        return
    is_wrong = step <= 0.0
    if spec.key:
        is_wrong = (step < 0.0) | is_repeated(table, spec)[1:]
        if not is_wrong.any():
            return
    row = int(np.argmax(is_wrong)) + 1
    count = int(np.sum(is_wrong))
    also = f" ({count} such rows in all)" if count > 1 else ""
    now, before = table.time_s[row], table.time_s[row - 1]
    if now < before:
        raise table.fault(
            row,
            f"time_s goes back from {before:.6f} to {now:.6f}{also}; expected increasing times; "
            "sort the rows by time, and split the mission where the clock was set back",
        )
    rows = np.array([values[row - 1 : row + 1] for values in table.columns.values()])
    same = np.array_equal(rows[:, 0], rows[:, 1], equal_nan=True)
    what = "the row before is repeated" if same else f"time_s repeats {now:.6f}"
    hint = "delete the copies" if same else "write the times with more digits, or delete one"
    raise table.fault(row, f"{what}{also}; expected increasing times; {hint}")
