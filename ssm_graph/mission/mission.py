"""One recorded run as frozen values: SI units, radians, body axes forward-right-down.

Times are seconds on the mission's own clock; velocities and sigmas labelled ``enu`` are along east,
north, up at the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeVar

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, FrozenArrays, ShortRepr, optional_shaped, shaped
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog

L = TypeVar("L")


class AidLog(Protocol):
    """What one more instrument says of a run; ``sensors/`` has them, such as ``UsblLog``."""

    SECTION: ClassVar[str]
    """Of ``mission.toml``, as it is written there: ``[usbl]``"""


class Aids:
    """What a run is aided by beside beams, depth and GNSS: logs of any instruments, by their type.

    ``aids.get(UsblLog)`` is the log of that type, or None. It never changes.
    """

    __slots__ = ("_logs",)

    def __init__(self, *logs: AidLog | None) -> None:
        """Take logs in any order; None is left out."""
        self._logs = tuple(log for log in logs if log is not None)

    def __iter__(self) -> Iterator[AidLog]:
        return iter(self._logs)

    def __bool__(self) -> bool:
        return bool(self._logs)

    def __repr__(self) -> str:
        return f"Aids({', '.join(type(log).__name__ for log in self._logs)})"

    def all(self, kind: type[L]) -> tuple[L, ...]:
        """Return all logs of a type, in the order given: standstills may be several."""
        return tuple(log for log in self._logs if isinstance(log, kind))

    def get(self, kind: type[L]) -> L | None:
        """Return the log of a type, None if there is none.

        Raises
        ------
        DataError
            If there are several.
        """
        found = self.all(kind)
        if len(found) > 1:
            raise DataError(
                f"aids: expected one {kind.__name__}, got {len(found)}; put what they say into one"
            )
        return found[0] if found else None

    def __getitem__(self, kind: type[L]) -> L:
        """Return the log of a type that is known to be there."""
        log = self.get(kind)
        if log is None:
            raise DataError(f"aids: expected a {kind.__name__}, got {self}; ask with aids.get")
        return log

    def having(self, log: AidLog) -> Aids:
        """Return the same with a log in the place of all of its type, or behind the others."""
        kinds = [type(other) for other in self._logs]
        at = kinds.index(type(log)) if type(log) in kinds else len(kinds)
        others = [other for other in self._logs if type(other) is not type(log)]
        return Aids(*others[:at], log, *others[at:])

    @property
    def sections(self) -> tuple[str, ...]:
        """Sections of ``mission.toml`` that hold what there is, each once."""
        return tuple(dict.fromkeys(log.SECTION for log in self._logs))


NO_AIDS = Aids()


@dataclass(frozen=True, slots=True, eq=False)
class InitialState(FrozenArrays):
    """State at the start with its standard deviations."""

    time_s: float
    lat: float
    """rad"""
    lon: float
    """rad"""
    height: float
    """m"""
    roll: float
    """rad"""
    pitch: float
    """rad"""
    heading: float
    """rad, clockwise from north"""
    velocity_enu: Array = shaped(3)
    """(3,) m/s"""
    position_sigma_enu: Array = shaped(3)
    """(3,) m"""
    velocity_sigma_enu: Array = shaped(3)
    """(3,) m/s"""
    attitude_sigma: Array = shaped(3)
    """(3,) rad, roll, pitch, heading"""


@dataclass(frozen=True, slots=True)
class LocalStart:
    """A start at zero where no place on Earth is known: a tank, a pool, a dock.

    The axes of the answer are those of the stated heading; without one, and where neither compass
    nor gyros find north, the vehicle looks along "north" when it starts.
    """

    lat: float = math.radians(45.0)
    """rad, for gravity and the turn of the Earth only."""
    heading: float = math.nan
    """rad, clockwise from the "north" of the answer; NaN for one that is not known."""
    heading_sigma: float = math.radians(1.0)
    """rad, of a stated heading."""

    @property
    def is_heading_known(self) -> bool:
        """Whether it is stated."""
        return not math.isnan(self.heading)

    @property
    def frame(self) -> LocalFrame:
        """Navigation frame of the answer; its place on Earth is made up."""
        return LocalFrame(self.lat, 0.0, 0.0)

    @property
    def sentence(self) -> str:
        """What it means for every number, for people."""
        heading = (
            f"the heading at the start is stated, {math.degrees(self.heading) % 360.0:.1f} deg"
            if self.is_heading_known
            else "no heading is stated: unless a compass or the gyros find north, zero is where "
            "the vehicle looked when it started"
        )
        return (
            f"local start: positions are metres from the start, at zero; {heading}; latitudes and "
            "longitudes are no place on Earth"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Reference(FrozenArrays):
    """An outside trajectory, only ever compared with; NaN where a quantity is unknown."""

    time_s: Array = shaped("N")
    lat: Array = shaped("N")
    """(N,) rad"""
    lon: Array = shaped("N")
    """(N,) rad"""
    height: Array = shaped("N")
    """(N,) m"""
    velocity_enu: Array = shaped("N", 3)
    """(N, 3) m/s, or NaN"""
    roll_pitch_heading: Array = shaped("N", 3)
    """(N, 3) rad, or NaN"""
    position_sigma_enu: Array | None = optional_shaped("N", 3)
    """(N, 3) m, of the reference itself; None where it counts as exact."""


@dataclass(frozen=True, slots=True, eq=False)
class Mission(ShortRepr):
    """One recorded run: everything that an estimator may look at, and the reference."""

    name: str
    frame: LocalFrame
    """The navigation frame: origin of the file, else the first GNSS fix, else the initial state."""
    imu: ImuLog
    dvl: DvlLog
    depth: DepthLog | None = None
    gnss: GnssLog | None = None
    aids: Aids = NO_AIDS
    """What else the smoothers are aided by."""
    initial: InitialState | None = None
    reference: Reference | None = None
    local: LocalStart | None = None
    """A start at zero, where no place on Earth is known; None where one is."""
    current: CurrentModel | None = None
    """Of the water, where pings are off it; None for one that is not stated."""
    notes: tuple[str, ...] = ()
    """What the reader noticed and a user should know, one sentence each."""

    @property
    def logs(self) -> Mapping[type, Any]:
        """Every instrument's log by its type; standstills may be several, see ``aids``."""
        every = (self.imu, self.dvl, self.depth, self.gnss, *self.aids)
        return {type(log): log for log in every if log is not None}
