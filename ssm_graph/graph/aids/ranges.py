"""Acoustic ranges to beacons, each at its place as stated or as it is estimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from factors.beacon_range import range_residual
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices, is_inside, nearest
from ssm_graph.base.usable import require_fields, require_finite, require_positive
from ssm_graph.engine.error_state import POSITION, ROTATION
from ssm_graph.engine.extras import Extra
from ssm_graph.graph.aids.aid import OF_SIZE, Aid, Keyframes, Linearised, RowStates
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.acoustic import RangeLog

_BEACON: Final = "beacon_"
"""Followed by the beacon's number."""


def beacon_name(number: int) -> str:
    """Return what the place of a beacon is called, as an extra variable."""
    return f"{_BEACON}{number}"


@dataclass(frozen=True, slots=True, eq=False)
class Ranges(Aid):
    """Ranges to B beacons at their keyframes."""

    SHARED = frozenset({"lever_arm_b", "number", "beacon_n", "R_nl", "is_known"})
    name = "range"
    unit = "m"
    hint = "look at places and numbers of the beacons, and the speed of sound"
    section = RangeLog.SECTION
    asks_for_keyframes = True

    beacon: Indices
    """(M,) which of the beacons, from 0"""
    range_m: Array
    """(M,) m"""
    sigma: Array
    """(M,) m"""
    lever_arm_b: Array
    """(3,) m"""
    number: NDArray[np.intp]
    """(B,) what the mission calls the beacons"""
    beacon_n: Array
    """(B, 3) where the mission puts them, m"""
    R_nl: Array
    """(B, 3, 3) east, north, up at them"""
    is_known: NDArray[np.bool_]
    """(B,)"""

    @classmethod
    def of(cls, aids: Aids, keyframes: Keyframes) -> Self | None:
        """Return the ranges within the keyframes."""
        log = aids.get(RangeLog)
        if log is None:
            return None
        frame, _, time_s, _ = keyframes
        used = is_inside(log.time_s, time_s[0], time_s[-1])
        number = np.array([beacon.number for beacon in log.beacons], dtype=np.intp)
        lat, lon, height = np.array([(b.lat, b.lon, b.height) for b in log.beacons]).T
        beacon_n = frame.p_n_from_geodetic(lat, lon, height)
        order = np.argsort(number)
        return cls(
            keyframe=nearest(time_s, log.time_s[used]),
            beacon=order[np.searchsorted(number[order], log.beacon[used])],
            range_m=log.range_m[used],
            sigma=log.sigma[used],
            lever_arm_b=log.lever_arm_b,
            number=number,
            beacon_n=beacon_n,
            R_nl=frame.R_nl_at(beacon_n),
            is_known=np.array([beacon.is_known for beacon in log.beacons]),
        )

    @classmethod
    def variables(cls, aids: Aids) -> tuple[Extra, ...]:
        """Return the places of beacons that are not known; of those that are heard, if any is."""
        log = aids.get(RangeLog)
        if log is None:
            return ()
        heard = np.unique(log.beacon) if len(log.beacon) else [b.number for b in log.beacons]
        return tuple(
            Extra(
                beacon_name(beacon.number),
                tuple(f"{beacon_name(beacon.number)}_{axis}_m" for axis in ("east", "north", "up")),
                beacon.position_sigma_enu,
                as_a_turn=1e2,
            )
            for beacon in log.beacons
            if not beacon.is_known and beacon.number in heard
        )

    @classmethod
    def require_usable(cls, aids: Aids) -> None:
        """Refuse numbers that are not finite, sigmas of zero, and beacons half known."""
        log = aids.get(RangeLog)
        if log is None:
            return
        finite = "time_s range_m lever_arm_b"
        require_fields("aids.ranges", log, positive="sigma", finite=finite)
        for beacon in log.beacons:
            of_beacon = f"aids.ranges.beacons, number {beacon.number}"
            require_finite(of_beacon, np.array([beacon.lat, beacon.lon, beacon.height]))
            if not beacon.is_known:
                require_positive(f"{of_beacon}, position_sigma_enu", beacon.position_sigma_enu)

    @classmethod
    def times(cls, aids: Aids) -> tuple[str, Array]:
        """Return when the ranges were measured, s."""
        log = aids.get(RangeLog)
        return "range", np.zeros(0) if log is None else log.time_s

    @property
    def waits(self) -> NDArray[np.bool_]:
        """(M,) those to beacons whose place is not known."""
        return ~self.is_known[self.beacon]

    @property
    def root_information(self) -> Array:
        """(M, 1, 1) 1/m."""
        return np.asarray(1.0 / self.sigma[:, None, None])

    @property
    def labels(self) -> list[str]:
        """(M,) the beacons."""
        return [beacon_name(int(self.number[i])) for i in self.beacon]

    def places_n(self, at: RowStates) -> Array:
        """Return the places (M, 3) of the beacons of the ranges, m."""
        places: Array = self.beacon_n[self.beacon]
        for i in np.flatnonzero(~self.is_known):
            off = at.value(beacon_name(int(self.number[i])), 3)
            place_n = self.beacon_n[i] + (self.R_nl[i] @ off[..., None])[..., 0]
            places = np.where((self.beacon == i)[..., None], place_n, places)
        return places

    def own_errors(self) -> Mapping[str, Array]:
        """Return a wrong speed of sound, and each beacon's delay where there are some, (M, 1)."""
        found = {OF_SIZE: self.range_m[:, None]}
        heard = np.unique(self.beacon)
        for beacon in heard if len(heard) > 1 else ():
            name = f" to beacon {self.number[beacon]}"
            found[name] = (self.beacon == beacon).astype(float)[:, None]
        return found

    def measured(self, at: RowStates) -> Linearised:
        """Linearise ranges: one component each."""
        residual = range_residual(
            at.R_nb,
            at.p_n,
            lever_arm_b=self.lever_arm_b,
            beacon_n=self.places_n(at),
            range_m=self.range_m,
        )
        jacobian = np.zeros((*residual.error.shape, 1, at.extras.width))
        jacobian[..., 0, ROTATION] = residual.error_D_rotation
        jacobian[..., 0, POSITION] = residual.error_D_position
        for i in np.flatnonzero(~self.is_known):
            name = beacon_name(int(self.number[i]))
            if name in at.extras:
                is_its = (self.beacon == i)[..., None]
                block = residual.error_D_beacon_n @ self.R_nl[i]
                jacobian[..., 0, at.extras.columns(name)] = np.where(is_its, block, 0.0)
        return Linearised(residual.error[..., None], jacobian)
