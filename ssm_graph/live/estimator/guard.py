"""What watches over the answer beside the window: lanes, what contradicts, how far it may be off.

Everything is a function of the data up to a keyframe, as the window is, and goes with its steps.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, VELOCITY
from ssm_graph.engine.states import States
from ssm_graph.live.estimator.lanes import FIXES, SUSPECT_OF, LaneBank, Lanes
from ssm_graph.live.estimator.separation import (
    Contradiction,
    IntegrityConfig,
    Judge,
    Protection,
    Separations,
    pack_contradictions,
    unpack_contradictions,
)
from ssm_graph.mission.estimate import ProtectionTrack
from ssm_graph.smoothers.keyframe import Keyframe, Sensors
from ssm_graph.smoothers.window import Window

UNSETTLED: Final = 2.0
"""Lags until a keyframe settles: it leaves the window, and then no late message undoes that."""
SPARE_S: Final = 15.0


class Guard(NamedTuple):
    """What is known at a keyframe."""

    lanes: Lanes
    contradictions: tuple[Contradiction, ...]
    protection: Protection
    fixed_s: float
    """When the position was last known by itself: by a fix, or where all began, s"""
    levels: Array
    """(K, 3) time, s, and protection levels, m, of all keyframes that have not settled"""

    @property
    def time_s(self) -> float:
        """Of the keyframe, s."""
        return float(self.levels[-1, 0])

    def pack(self) -> Iterator[tuple[str, Array]]:
        """Yield name and array of all but the contradictions."""
        yield from self.lanes.pack()
        yield "levels", self.levels
        yield "fixed_s", np.array(self.fixed_s)


def protection_at(guard: Guard, time_s: Array) -> ProtectionTrack:
    """Return the protection levels at keyframes (K,), infinite where there were no lanes yet."""
    known_s = guard.levels[:, 0]
    at = np.minimum(np.searchsorted(known_s, time_s), len(known_s) - 1)
    found = np.where((known_s[at] == time_s)[:, None], guard.levels[at, 1:], np.inf)
    return ProtectionTrack(time_s, *found.T)


class Guarded(NamedTuple):
    """What a user is told of it."""

    contradiction: str
    """Which sensors contradict the answer; empty where none does"""
    shortfall: str
    """Why it is protected worse than was asked for; empty where it is not"""
    protection: Protection
    ratios: dict[str, float]
    """Low-passed innovation of each sensor, in sigmas"""


class Guardian:
    """Makes one guard of the one before."""

    def __init__(self, sensors: Sensors, config: IntegrityConfig) -> None:
        self._frame, self.config = sensors.frame, config
        self.bank = LaneBank(sensors)
        self.judge = Judge(self.bank, config)

    def begin(self, window: Window, known: Sequence[Mapping[str, Any]] = ()) -> Guard:
        """Return the guard of a window that has just begun; ``known`` is what is remembered."""
        time_s = window.keyframes[-1].time_s
        contradictions = unpack_contradictions(known, self.bank.suspects)
        lanes = self.bank.begin(window, [one.suspect for one in contradictions])
        found = self.judge.separations(lanes)
        return self._guard(lanes, found, contradictions, window, time_s, np.zeros((0, 3)))

    def led_on(
        self,
        guard: Guard,
        last: States,
        keyframe: Keyframe,
        window: Window,
        *,
        doubted: Sequence[str] | None = None,
    ) -> Guard:
        """Return the guard at the next keyframe, with which the window is settled.

        ``last`` (1, ...) is the newest state of the window before; ``doubted`` are those suspects
        that made it begin anew there, None where it goes on.
        """
        if doubted is None:
            lanes = self.bank.led_on(guard.lanes, last, keyframe, window)
        else:
            lanes = self.bank.after_doubt(guard.lanes, last, keyframe, window, doubted)
        is_fixed = any(SUSPECT_OF.get(name) in FIXES for name in window.keyframes[-1].aids)
        found = self.judge.separations(lanes)
        lanes, known = self.judge.judged(lanes, found, guard.contradictions, keyframe.time_s)
        fixed_s = keyframe.time_s if is_fixed else guard.fixed_s
        unsettled_s = UNSETTLED * window.config.lag_s + SPARE_S
        levels = guard.levels[guard.levels[:, 0] > keyframe.time_s - unsettled_s]
        return self._guard(lanes, found, known, window, fixed_s, levels)

    def _guard(
        self,
        lanes: Lanes,
        found: Separations,
        known: tuple[Contradiction, ...],
        window: Window,
        fixed_s: float,
        levels: Array,
    ) -> Guard:
        newest = window.newest_states
        time_s = window.keyframes[-1].time_s
        R_lb = self._frame.R_nl_at(newest.p_n[0]).T @ newest.R_nb[0]
        level = self.judge.protection(lanes, found, R_lb, time_s=time_s, fixed_s=fixed_s)
        return Guard(lanes, known, level, fixed_s, np.vstack([levels, [time_s, *level]]))

    def told(self, guard: Guard) -> Guarded:
        """Return what a user is told."""
        return Guarded(
            self.sentence(guard), self._shortfall(guard), guard.protection, self._ratios(guard)
        )

    def sentence(self, guard: Guard) -> str:
        """Say what contradicts the answer; an empty text where nothing does."""
        return self.judge.sentence(guard.lanes, guard.contradictions, guard.time_s)

    def covering(self, guard: Guard, covariance: Array) -> Array:
        """Return the covariance (n, n) of an answer with what it may be off by beside its noise.

        That is what jumps of a bias may have moved it by, and how far the lanes of suspicions that
        are not decided are from it: in velocity and position in any direction, for where another
        sensor lies than the suspected one, the lane is off as well.
        """
        n, lanes = len(covariance), guard.lanes
        lasting = self.judge.undecided(guard.contradictions, guard.time_s)
        off = lanes.deviation[self.bank.held[[one.suspect for one in lasting]], :n]
        grown = np.asarray(covariance + lanes.jumps.unexcluded(n) + off.T @ off)
        for part in (VELOCITY, POSITION):
            grown[part, part] += np.sum(off[:, part] ** 2) * np.eye(part.stop - part.start)
        return grown

    def _shortfall(self, guard: Guard) -> str:
        """Say that the answer is protected worse than was asked for, if so."""
        names = ("horizontal", "vertical")
        asked = (self.config.protection_m, self.config.protection_up_m)
        for name, level, wanted in zip(names, guard.protection, asked, strict=True):
            if not level < wanted:
                return (
                    f"the {name} protection level is {level:.3g} m, below {wanted:g} m was asked "
                    "for: a fault of one sensor could move the answer so far unseen"
                )
        return ""

    def _ratios(self, guard: Guard) -> dict[str, float]:
        """Return the low-passed innovation of each sensor that was heard, in sigmas."""
        found = {}
        for name, ratio in zip(self.bank.suspects, guard.lanes.ratio, strict=True):
            seen = ratio[np.isfinite(ratio)]
            if len(seen):
                found[name] = float(np.sqrt(np.mean(seen**2)))
        return found

    def plain(self, guard: Guard) -> list[Any]:
        """Return the contradictions as plain values."""
        return pack_contradictions(guard.contradictions, self.bank.suspects)

    def unpack(
        self, arrays: Mapping[str, Array], known: Sequence[Mapping[str, Any]], window: Window
    ) -> Guard:
        """Return the guard that was packed; one that begins where there is none."""
        if "jump_score" not in arrays or len(arrays["begun_s"]) != len(self.bank.suspect):
            return self.begin(window, known)
        contradictions = unpack_contradictions(known, self.bank.suspects)
        levels = arrays["levels"]
        return Guard(
            Lanes.unpack(arrays),
            contradictions,
            Protection(*levels[-1, 1:].tolist()),
            float(arrays["fixed_s"]),
            levels,
        )
