"""Acoustic position fixes, and ranges to beacons.

Acoustics err grossly now and then: each of their measurements is weighted as the beams are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.base.settings import (
    FILE_KEY,
    LEVER_ARM_KEY,
    Settings,
    build,
    number_key,
    sigma_key,
    written,
)
from ssm_graph.base.tables import Table
from ssm_graph.sensors.instrument import SMALLEST_SIGMA, Column, Instrument, Lists
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.place import (
    PLACE_KEYS,
    POSITION,
    SIGMA_ENU,
    PositionInstrument,
    PositionLog,
    PositionMessage,
)


@dataclass(frozen=True, slots=True, eq=False)
class UsblLog(PositionLog):
    """Acoustic position fixes of a transponder on the vehicle: USBL, or LBL as its maker solves it.

    A fix travels: it is stamped when it is known, and was valid ``delay_s`` before.
    """

    SECTION: ClassVar[str] = "[usbl]"

    delay_s: Array = shaped("N")
    """(N,) s, how much older than its stamp each fix is."""

    @property
    def valid_s(self) -> Array:
        """(N,) when the vehicle was there, s."""
        return np.asarray(self.time_s - self.delay_s)


@dataclass(frozen=True, slots=True)
class UsblFix(PositionMessage):
    """One acoustic fix of the transponder, stamped when it was known."""

    delay_s: float = 0.0
    """How much older than its stamp it is, s."""


@dataclass(frozen=True, slots=True, eq=False)
class Beacon(FrozenArrays):
    """A transponder on the seabed or at a buoy that stays where it is."""

    number: int
    """What the ranges call it."""
    lat: float
    """rad"""
    lon: float
    """rad"""
    height: float
    """m above the ellipsoid"""
    position_sigma_enu: Array = shaped(3)
    """(3,) m, prior sigmas east, north, up; above zero asks to estimate it, zero is exact."""

    @property
    def is_known(self) -> bool:
        """Whether its place is taken as stated."""
        return not self.position_sigma_enu.any()


@dataclass(frozen=True, slots=True, eq=False)
class RangeLog(FrozenArrays):
    """Acoustic ranges from the vehicle's transducer to beacons."""

    SECTION: ClassVar[str] = "[ranges]"

    beacons: tuple[Beacon, ...]
    time_s: Array = shaped("N")
    """(N,) s, increasing; ranges to several beacons may have one time."""
    beacon: Array = shaped("N")
    """(N,) number of the beacon."""
    range_m: Array = shaped("N")
    """(N,) m, one way."""
    sigma: Array = shaped("N")
    """(N,) m, above zero."""
    lever_arm_b: Array = shaped(3)
    """(3,) body origin to transducer, m."""
    nominal_sigma: float = math.nan
    """Of a range that states none, m; NaN for the median of the sigmas."""

    def __post_init__(self) -> None:
        super(RangeLog, self).__post_init__()
        numbers = [beacon.number for beacon in self.beacons]
        unknown = np.setdiff1d(self.beacon, numbers)
        if len(unknown) or len(set(numbers)) < len(numbers):
            raise DataError(
                f"RangeLog.beacon: expected numbers of the beacons {numbers}, each of them once, "
                f"got {unknown.tolist()} besides"
            )


@dataclass(frozen=True, slots=True)
class AcousticRange(Message):
    """One range to a beacon, one way."""

    MAY_MISS: ClassVar[frozenset[str]] = frozenset({"sigma"})

    beacon: float
    """Its number."""
    range_m: float
    """m"""
    sigma: float = math.nan
    """m; NaN is the nominal one."""


LONGEST_DELAY_S: Final = 3600.0
LONGEST_RANGE_M: Final = 20_000.0
"""Twice what low-frequency transponders reach."""
_DELAY: Final = Column(
    "delay_s",
    "delay_s",
    limits=(0.0, LONGEST_DELAY_S),
    expected=f"expected seconds from 0 to {LONGEST_DELAY_S:g}; is it in milliseconds?",
    told="delay {:g} s: milliseconds?",
    optional=True,
    missing=0.0,
)
_BEACON: Final = Column("beacon", "beacon", limits=(0.0, 1e6))
_RANGE: Final = Column(
    "range_m",
    "range_m",
    limits=(0.0, LONGEST_RANGE_M),
    expected=f"expected metres from 0 to {LONGEST_RANGE_M:g}; is it in mm?",
    told="range {:g} m: mm?",
)
_RANGE_SIGMA: Final = Column(
    "sigma",
    "sigma_m",
    limits=(SMALLEST_SIGMA, 1e4),
    expected="expected a standard deviation above 0, in metres",
    told="sigma {:g} m, expected above zero",
    optional=True,
)
_BEACON_KEYS: Final = {
    "number": number_key("number", 0.0, 1e6, "it is what column 'beacon' of [ranges] calls it"),
    **PLACE_KEYS,
    "position_sigma_m": sigma_key(
        *("position_sigma_enu", 1e5),
        "east, north and up; leave the key out where the place is known",
        shape=(3,),
        required=False,
    ),
}


class _Usbl(PositionInstrument):
    """The way of acoustic fixes: each was true some time before its stamp."""

    def valid_s(self, message: Message, bare: UsblLog) -> float:  # noqa: ARG002
        assert isinstance(message, UsblFix)
        return message.time_s - message.delay_s

    def log_of(self, rows: Array, bare: UsblLog) -> UsblLog:
        log: UsblLog = super().log_of(rows, bare)
        return replace(log, time_s=log.time_s + log.delay_s)


class _Ranges(Instrument):
    """The way of ranges: to beacons that the file states as well."""

    def bare(self, settings: Settings, lists: Lists) -> RangeLog:
        beacons = [_beacon(one) for one in lists["beacon"]]
        numbers = [beacon.number for beacon in beacons]
        for i, one in enumerate(lists["beacon"]):
            if numbers[i] in numbers[:i]:
                raise one.fault("number", f"{numbers[i]} is another beacon's already")
        given = self.empty() | settings.given() | {"beacons": tuple(beacons)}
        return build(RangeLog, given)

    def check(self, table: Table, bare: RangeLog, axes: BodyAxes) -> list[str]:
        notes = super().check(table, bare, axes)
        numbers = [beacon.number for beacon in bare.beacons]
        is_known = np.isin(table["beacon"], numbers)
        if not is_known.all():
            known = (
                f"expected one of {', '.join(map(str, numbers))}" if numbers else "there is none"
            )
            raise table.cell_fault(
                int(np.argmin(is_known)),
                "beacon",
                f"{known}; state the beacon's place in mission.toml under [[beacon]], with "
                "position_sigma_m where it is not known",
            )
        return notes + [
            f"{table.label}: no range is to beacon {number}"
            for number in numbers
            if number not in table["beacon"]
        ]

    def filled(self, table: Table, bare: RangeLog, settings: Settings, axes: BodyAxes) -> RangeLog:
        return _with_sigmas(super().filled(table, bare, settings, axes))

    def settings_of(self, log: RangeLog) -> dict[str, Any]:
        return super().settings_of(replace(log, nominal_sigma=_nominal_sigma(log)))

    def lists_of(self, log: RangeLog) -> dict[str, list[dict[str, Any]]]:
        sections = [
            {**written(beacon, _BEACON_KEYS), "number": beacon.number} for beacon in log.beacons
        ]
        return {"beacon": sections}

    def table_of(self, log: RangeLog) -> dict[str, Array]:
        columns = super().table_of(log)
        if np.all(log.sigma == _nominal_sigma(log)):
            columns.pop("sigma_m", None)
        return columns

    def problem(self, message: Message, bare: RangeLog) -> str | None:
        assert isinstance(message, AcousticRange)
        if message.beacon not in {beacon.number for beacon in bare.beacons}:
            return f"there is no beacon {message.beacon:g}"
        return super().problem(message, bare)

    def message_of(self, numbers: Sequence[float], bare: RangeLog) -> AcousticRange:  # noqa: ARG002
        return AcousticRange(*numbers)

    def log_of(self, rows: Array, bare: RangeLog) -> RangeLog:
        return _with_sigmas(super().log_of(rows, bare))


USBL: Final = _Usbl(
    "usbl",
    UsblLog,
    {"file": FILE_KEY, "lever_arm_m": LEVER_ARM_KEY},
    (*POSITION, SIGMA_ENU, _DELAY),
    UsblFix,
    "u",
)
RANGES: Final = _Ranges(
    "ranges",
    RangeLog,
    {"file": FILE_KEY, "noise_m": sigma_key("nominal_sigma", 1000.0), "lever_arm_m": LEVER_ARM_KEY},
    (_BEACON, _RANGE, _RANGE_SIGMA),
    AcousticRange,
    "r",
    row_key=("beacon",),
    lists={"beacon": _BEACON_KEYS},
)


def _beacon(settings: Settings) -> Beacon:
    number = settings.number("number")
    if number % 1.0:
        raise settings.fault("number", f"expected a whole number, got {number:g}")
    place = {"position_sigma_enu": np.zeros(3)} | settings.given() | {"number": int(number)}
    return build(Beacon, place)


def _with_sigmas(log: RangeLog) -> RangeLog:
    return replace(log, sigma=np.where(np.isnan(log.sigma), log.nominal_sigma, log.sigma))


def _nominal_sigma(log: RangeLog) -> float:
    """Return the standard deviation that stands for those of all ranges, m."""
    if not math.isnan(log.nominal_sigma):
        return log.nominal_sigma
    return float(np.median(log.sigma)) if log.sigma.size else 1.0
