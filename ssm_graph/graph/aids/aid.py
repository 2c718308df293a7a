"""What an aid is: a table of its measurements at keyframes, and its rows at their states.

Batch, window and vehicle use the very same: a window's keyframe carries the rows of each table that
belong to it. A new aid is a file beside this one and a line in :data:`ssm_graph.graph.aids.AIDS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import ClassVar, Final, NamedTuple, Self, final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.base.times import Indices
from ssm_graph.engine.extras import Extra, Extras
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.imu import ImuLog

OF_SIZE: Final = " scale"
"""Behind the name of an aid: it reads too much by a share of what it measures."""

Rows = slice | NDArray[np.intp] | NDArray[np.bool_]


class Keyframes(NamedTuple):
    """Where and when measurements are wanted, with the inertial data that lead to there."""

    frame: LocalFrame
    imu: ImuLog
    time_s: Array
    """(K,) s"""
    begin_s: float | None = None
    """s, from where on errors that grow are counted; None for the first reading of each log"""


class RowStates(NamedTuple):
    """The state of each row's own keyframe, leading axes (...), or one for all rows."""

    R_nb: Array
    p_n: Array
    v_n: Array
    bias: Array
    walks: Array
    constants: Array
    """(C,) the same for all"""
    extras: Extras
    """What walks and constants are, and the columns of the rows"""
    g_n: Array
    """Gravity, m/s^2; a clock in doubt asks for it"""

    def value(self, name: str, size: int) -> Array:
        """Return an extra variable (..., size), zero where it is not one of them."""
        return self.extras.value(name, self.walks, self.constants, default=np.zeros(size))

    def rows_of_one(self) -> RowStates:
        """Return the state of a single keyframe with a leading axis of one row."""
        R_nb, p_n, v_n, bias, walks = (column[None] for column in self[:5])
        return RowStates(R_nb, p_n, v_n, bias, walks, self.constants, self.extras, self.g_n[None])


class Linearised(NamedTuple):
    """Measurements at their states; leading axes are those of the states."""

    error: Array
    """(..., d) predicted minus measured"""
    jacobian: Array
    """(..., d, width)"""


@dataclass(frozen=True, slots=True, eq=False)
class Table(ReadOnlyArrays):
    """Measurements at their keyframes, one row each, in the order of the keyframes."""

    SHARED: ClassVar[frozenset[str]] = frozenset()
    """Fields that are the same of all rows"""

    keyframe: Indices
    """(M,)"""

    def __len__(self) -> int:
        return len(self.keyframe)

    @classmethod
    @cache
    def columns(cls) -> tuple[str, ...]:
        """Names of the fields that have a row for each measurement."""
        return tuple(spec.name for spec in fields(cls) if spec.name not in cls.SHARED)

    def take(self, rows: Rows) -> Self:
        """Return some of the rows."""
        return self._with({name: getattr(self, name)[rows] for name in self.columns()})

    def _with(self, columns: Mapping[str, Array | Indices]) -> Self:
        """Return the same with other columns: `dataclasses.replace` takes many times this."""
        return type(self)(*[columns.get(n, getattr(self, n)) for n in self._names()])

    @classmethod
    @cache
    def _names(cls) -> tuple[str, ...]:
        return tuple(spec.name for spec in fields(cls))

    def joined(self, tables: Sequence[Self]) -> Self:
        """Return the rows of several tables, one after the other, with what these share."""
        names = self.columns()
        return self._with({n: np.concatenate([getattr(t, n) for t in tables]) for n in names})

    def followed_by(self, other: Self) -> Self:
        """Return these rows, then the others."""
        if len(self) == 0 or len(other) == 0:
            return other if len(self) == 0 else self
        return self.joined([self, other])

    def at(self, keyframe: int) -> Self:
        """Return the rows of one keyframe."""
        begin, end = np.searchsorted(self.keyframe, [keyframe, keyframe + 1]).tolist()
        return self.take(slice(begin, end))

    def moved_to(self, keyframe: int | Indices) -> Self:
        """Return the same rows at other keyframes."""
        return self._with({"keyframe": np.full(len(self), keyframe, np.intp)})

    def pack(self) -> Iterator[tuple[str, Array]]:
        """Yield name and array of each column, for checkpoints."""
        for name in self.columns():
            yield name, np.asarray(getattr(self, name), dtype=np.float64)

    def unpack(self, arrays: Mapping[str, Array]) -> Self:
        """Return these with the rows that were packed."""
        types = {name: getattr(self, name).dtype for name in self.columns()}
        return self._with({name: arrays[name].astype(t) for name, t in types.items()})


@dataclass(frozen=True, slots=True, eq=False)
class Aid(Table, ABC):
    """A kind of measurement beside the beams.

    A measurement of several components, a position fix, is right or wrong as a whole and has one
    weight.
    """

    name: ClassVar[str]
    unit: ClassVar[str]
    """Of its errors: m, rad or m/s"""
    hint: ClassVar[str]
    """What to look at when it contradicts the answer."""
    section: ClassVar[str] = ""
    """Of ``mission.toml``"""
    is_weighted: ClassVar[bool] = True
    """Whether each measurement has a weight, as every beam has; otherwise it counts in full"""
    asks_for_keyframes: ClassVar[bool] = False
    """Whether each of them asks for a keyframe of its own; see :meth:`times`"""
    is_live: ClassVar[bool] = True
    """Whether the live estimator uses them; otherwise they are in its log alone"""

    @classmethod
    def of(cls, aids: Aids, keyframes: Keyframes) -> Self | None:  # noqa: ARG003
        """Return what the log of a mission says at keyframes; None without a log.

        Each measurement belongs to the keyframe that it asked for, or to the first one after it, so
        that what a keyframe has does not depend on later ones.
        """
        return None

    @classmethod
    def variables(cls, aids: Aids) -> tuple[Extra, ...]:  # noqa: ARG003
        """Return what is to be estimated of the instrument."""
        return ()

    @classmethod
    def require_usable(cls, aids: Aids) -> None:
        """Raise :class:`ssm_graph.base.errors.DataError` for what no estimator can use."""

    @classmethod
    def times(cls, aids: Aids) -> tuple[str, Array]:  # noqa: ARG003
        """Return what one measurement is called, and the times (N,) that ask for a keyframe, s."""
        return cls.name, np.zeros(0)

    @property
    def waits(self) -> NDArray[np.bool_] | None:
        """(M,) of what nobody knows the place of: a first pass leaves it to a search along it."""
        return None

    @property
    @abstractmethod
    def root_information(self) -> Array:
        """(M, d, d) whitens the errors."""

    @property
    @abstractmethod
    def labels(self) -> list[str]:
        """(M d,) what the components of all measurements are called."""

    @abstractmethod
    def measured(self, at: RowStates) -> Linearised:
        """Linearise the measurements at their states."""

    def rate(self, at: RowStates) -> Array | None:  # noqa: ARG002
        """Return by what (M, d) its measurements grow in a second, None where clocks say little.

        Their errors, predicted minus measured, grow by as much in each second that they are late.
        """
        return None

    def own_errors(self) -> Mapping[str, Array]:
        """Return what (M, d) a unit of each error of its own adds to what it measures, by name.

        A name stands behind that of the aid; :data:`OF_SIZE` is a share of the measurement.
        """
        return {}

    def led_along(self, before: RowStates | None, at: RowStates) -> Self:  # noqa: ARG002
        """Return the same after states of the keyframes before and of their own, if they follow.

        Without those before, the way from there to here stays as it was.
        """
        return self

    @final
    @property
    def dim(self) -> int:
        """Components of each measurement."""
        return int(self.root_information.shape[-1])

    @final
    def whitened(self, at: RowStates) -> Linearised:
        """Linearise with errors of unit variance."""
        root, (error, jacobian) = self.root_information, self.measured(at)
        return Linearised((root @ error[..., None])[..., 0], root @ jacobian)


def along_axes(pattern: str) -> tuple[str, ...]:
    """Return the labels of three components."""
    return tuple(pattern.format(axis) for axis in "xyz")


def drift_variable(
    name: str, labels: tuple[str, ...], drift: Drift, *, shares: Array | float = 1.0
) -> tuple[Extra, ...]:
    """Return a drift with a component for each label, or nothing.

    ``shares`` are those of its sigma that the components (d,) have.
    """
    if drift.sigma == 0.0:
        return ()
    sigma = drift.sigma * shares
    return (Extra.gauss_markov(name, labels, sigma, correlation_s=drift.correlation_s),)
