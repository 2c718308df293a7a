"""One recorded run as frozen values: SI units, radians, body axes forward-right-down.

Times are seconds on the mission's own clock; velocities and sigmas labelled ``enu`` are along east,
north, up at the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, FrozenArrays, ShortRepr, optional_shaped, shaped
from ssm_graph.sensors.acoustic import RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.sensors.standstill import Standstill


@dataclass(frozen=True, slots=True, eq=False)
class AidLogs(ShortRepr):
    """All of them; what a mission does not have is None or empty."""

    usbl: UsblLog | None = None
    ranges: RangeLog | None = None
    heading: HeadingLog | None = None
    standstills: tuple[Standstill, ...] = ()

    @property
    def sections(self) -> tuple[str, ...]:
        """Sections of ``mission.toml`` that hold what there is."""
        present = {
            "[usbl]": self.usbl is not None,
            "[ranges]": self.ranges is not None,
            "[heading]": self.heading is not None,
            "[[standstill]]": bool(self.standstills),
        }
        return tuple(name for name, is_there in present.items() if is_there)


NO_AIDS = AidLogs()


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
    aids: AidLogs = NO_AIDS
    """What else the batch smoother is aided by."""
    initial: InitialState | None = None
    reference: Reference | None = None
    current: CurrentModel | None = None
    """Of the water, where pings are off it; None for one that is not stated."""
    notes: tuple[str, ...] = ()
    """What the reader noticed and a user should know, one sentence each."""
