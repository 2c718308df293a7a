"""Answers of a while ago, led on by the inertial data alone: no later beam can have bent them.

What is wrong with an answer shows some seconds after it began to be wrong. So two answers are kept
in reserve, the older one at least `RENEW_S` old whenever trouble shows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, VELOCITY
from ssm_graph.engine.states import States
from ssm_graph.graph.inertial_rows import InertialRows
from ssm_graph.smoothers.keyframe import Keyframe
from ssm_graph.smoothers.window import Window

RENEW_S: Final = 15.0
"""While all is sound a new answer goes into reserve so often."""
SPEED_SIGMA: Final = 3.0
"""m/s, what a vehicle's velocity can be."""
LOST_FACTOR: Final = 2.0
"""So many times less certain, the velocity that the inertial data lead to says nothing."""


class Kept(NamedTuple):
    """One answer, led on to the newest keyframe."""

    since_s: float
    """s, when it was the answer"""
    place_n: Array
    """(3,) m, where the vehicle was then"""
    place_sigma: float
    """m, in the most uncertain direction"""
    R_nb: Array
    """(1, 3, 3) now, as the next five"""
    p_n: Array
    """(1, 3) m"""
    v_n: Array
    """(1, 3) m/s"""
    bias: Array
    """(1, 6) accelerometer m/s^2, gyro rad/s"""
    extra: Array
    """(1, E) extra variables"""
    covariance: Array
    """(n, n)"""
    trust: Array
    """(B,) what each beam was worth then, 0 to 1"""

    @property
    def states(self) -> States:
        """The state (1, ...) now."""
        return States(self.R_nb, self.p_n, self.v_n, self.bias, self.extra)

    def led_on(self, keyframe: Keyframe, inertial: InertialRows) -> Kept:
        """Return the answer at the next keyframe."""
        assert keyframe.inertial is not None
        ahead = inertial.predict(keyframe.inertial, self.states)
        covariance = ahead.covariance(self.covariance)
        names = ("R_nb", "p_n", "v_n", "bias", "extra")
        now: dict[str, Any] = dict(zip(names, ahead.states, strict=False))
        led = self._replace(**now, covariance=covariance)
        is_lost = np.trace(covariance[VELOCITY, VELOCITY]) > (LOST_FACTOR * SPEED_SIGMA) ** 2
        return led.without_velocity(keyframe.time_s) if is_lost else led

    def without_velocity(self, time_s: float) -> Kept:
        """Return the answer with the velocity, and the place, that any vehicle can have by now."""
        P = self.covariance.copy()
        forget(P, VELOCITY, SPEED_SIGMA)
        way = SPEED_SIGMA * (time_s - self.since_s)
        forget(P, POSITION, float(np.hypot(self.place_sigma, way)))
        return self._replace(p_n=self.place_n[None], v_n=slowed(self.v_n), covariance=P)


class Reserve(NamedTuple):
    """Two answers of different age."""

    older: Kept
    younger: Kept

    @classmethod
    def of(cls, window: Window) -> Reserve:
        """Return a reserve that begins with the newest answer of a window."""
        kept = _kept(window)
        return cls(kept, kept)

    def led_on(self, keyframe: Keyframe, inertial: InertialRows) -> Reserve:
        """Return both answers at the next keyframe."""
        return Reserve(*(kept.led_on(keyframe, inertial) for kept in self))

    def renewed(self, window: Window) -> Reserve:
        """Return the reserve with the newest, sound answer of a window taken in, if it is time."""
        if window.keyframes[-1].time_s - self.younger.since_s < RENEW_S:
            return self
        return Reserve(self.younger, _kept(window))

    def pack(self) -> Iterator[tuple[str, Array]]:
        """Yield name and array of everything."""
        for name, kept in self._asdict().items():
            for field, value in kept._asdict().items():
                yield f"{name}_{field}", np.asarray(value)

    @classmethod
    def unpack(cls, arrays: Mapping[str, Array]) -> Reserve:
        """Return the reserve that was packed."""

        def kept(name: str) -> Kept:
            fields: dict[str, Any] = {f: arrays[f"{name}_{f}"] for f in Kept._fields}
            return Kept(**fields)

        return cls(kept("older"), kept("younger"))


def slowed(v_n: Array) -> Array:
    """Return a velocity (..., 3), m/s, that a vehicle can have."""
    speed = float(np.linalg.norm(v_n))
    return v_n * (SPEED_SIGMA / speed) if speed > SPEED_SIGMA else v_n


def forget(P: Array, part: slice, sigma: float) -> None:
    """Leave a standard deviation of a part of the error state, and nothing else of it."""
    P[part, :] = P[:, part] = 0.0
    P[part, part] = sigma**2 * np.eye(3)


def _kept(window: Window) -> Kept:
    newest = window.newest
    states, covariance = newest.states, newest.covariance[0]
    place_sigma = np.sqrt(np.linalg.eigvalsh(covariance[POSITION, POSITION])[-1])
    return Kept(newest.time_s[0], states.p_n[0], place_sigma, *states[:5], covariance, window.trust)
