"""Acoustic position fixes, USBL or LBL: keyframes of their own, when they were valid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.times import is_inside, nearest
from ssm_graph.base.usable import require_fields
from ssm_graph.graph.aids.aid import Keyframes
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.acoustic import UsblLog


@dataclass(frozen=True, slots=True, eq=False)
class UsblFixes(Fixes):
    """Position fixes as those of GNSS, of a transponder that is where it is written to be."""

    name = "USBL"
    hint = "look at its delay, datum, lever arm and the ship's heading"
    section = UsblLog.SECTION
    asks_for_keyframes = True
    LEVER_ARM: ClassVar[str] = ""
    TIME_OFFSET: ClassVar[str] = ""
    DRIFT: ClassVar[str] = ""

    @classmethod
    def of(cls, aids: Aids, keyframes: Keyframes) -> Self | None:
        """Return the fixes that were valid within the keyframes."""
        log = aids.get(UsblLog)
        if log is None:
            return None
        frame, imu, time_s, _ = keyframes
        fix = np.flatnonzero(is_inside(log.valid_s, time_s[0], time_s[-1]))
        fix = fix[np.argsort(log.valid_s[fix], kind="stable")]
        valid_s = log.valid_s[fix]
        keyframe = nearest(time_s, valid_s)
        return cls.of_log(log, fix, time_s=valid_s, keyframe=keyframe, frame=frame, imu=imu)

    @classmethod
    def require_usable(cls, aids: Aids) -> None:
        """Refuse numbers that are not finite, and sigmas of zero."""
        log = aids.get(UsblLog)
        if log is not None:
            finite = "time_s delay_s lat lon height lever_arm_b"
            require_fields("aids.usbl", log, positive="sigma_enu", finite=finite)

    @classmethod
    def times(cls, aids: Aids) -> tuple[str, Array]:
        """Return when the fixes were valid, s."""
        log = aids.get(UsblLog)
        return "USBL fix", np.zeros(0) if log is None else log.valid_s
