"""Beginning anew where the answer can no longer be right, with what is still known.

What is wrong with an answer shows some seconds after it began to be wrong. So two answers of a
while ago are kept in reserve, led on by the inertial data alone: no later beam can have bent them,
and the older one is at least `RENEW_S` old whenever trouble shows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, ROTATION, VELOCITY, InitialMoments
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.graph.inertial_rows import InertialRows
from ssm_graph.live.estimator.lanes import DEPTH, DVL, FIXES
from ssm_graph.live.estimator.watch import (
    FEW,
    TORN_PINGS,
    Contradicted,
    Watch,
    counts_off_the_ground,
)
from ssm_graph.mission.answer import TRUSTED
from ssm_graph.smoothers.keyframe import Keyframe
from ssm_graph.smoothers.track import Stretch
from ssm_graph.smoothers.window import Window

RENEW_S: Final = 15.0
"""While all is sound a new answer goes into reserve so often."""
SPEED_SIGMA: Final = 3.0
"""m/s, what a vehicle's velocity can be."""
LOST_FACTOR: Final = 2.0
"""So many times less certain, the velocity that the inertial data lead to says nothing."""
POSITION_SIGMA: Final = 50.0
"""m, how far a position is doubted that GNSS or depth contradict."""
BENT_SPEED: Final = 1.0
"""m/s, with the next: so uncertain a velocity is not corrected along with so uncertain an attitude;
that would take the one for the other."""
BENT_TURN: Final = 0.05
"""rad"""
SILENCE_S: Final = 10.0
LONGEST_FEW_S: Final = 25.0
LOCKED_OUT_PINGS: Final = 3
"""Pings in a row whose beams agree with each other but not with the prediction."""
OUT_PINGS: Final = 6
"""Pings in a row without a beam that agrees with the prediction."""
LONGEST_LOCK_OUT_S: Final = 30.0
"""So long the inertial data are believed rather than beams that agree with each other."""
LOCKED_OUT_FIXES: Final = 5
LOCKED_OUT_DEPTHS: Final = 25
VOUCHED_S: Final = 15.0
"""So long a fix or a depth that agreed with the height vouches for it: depths, or fixes, that
contradict it meanwhile contradict the rest as well, and it does not follow them. Dead reckoning
alone does not lose a height by their gate within that."""
DOUBT_FACTOR: Final = 2.0
"""What an answer in reserve says is doubted by so many of its sigmas, and attitude with a position
that is contradicted."""


ASTRAY_TIMES: Final = 3
ASTRAY_S: Final = 120.0
"""A position that fixes contradict so often within so long is not mended by moving it."""


class Doubted(Enum):
    """What cannot be gone on from."""

    VELOCITY_AFTER_SILENCE = "velocity, after a silence of the beams"
    ANSWER = "everything since it was sound"
    VELOCITY = "everything since it was sound, and what the inertial data made of the velocity"
    POSITION = "position"
    HEIGHT = "height, which the depth contradicts"
    HEIGHT_OF_FIXES = "height, which fixes contradict"

    @property
    def suspects(self) -> tuple[str, ...]:
        """Whose readings contradicted the answer, or may have bent it."""
        if self in (Doubted.POSITION, Doubted.HEIGHT_OF_FIXES):
            return FIXES
        return (DEPTH,) if self is Doubted.HEIGHT else (DVL,)


class Doubt(NamedTuple):
    """Why a window has to begin anew."""

    what: Doubted
    reason: str


def doubt_of(watch: Watch, sigma: Array, keyframe: Keyframe) -> Doubt | None:
    """Say why the prediction of a keyframe cannot be gone on from; None if it can.

    ``sigma`` (15,) are those of the keyframe before.
    """
    if _is_adrift(watch, sigma, keyframe):
        return Doubt(
            Doubted.VELOCITY_AFTER_SILENCE,
            "after a silence of the beams the prediction is too uncertain to be corrected: the "
            "beams set the velocity anew",
        )
    if watch.pings_refused >= LOCKED_OUT_PINGS or watch.pings_out >= OUT_PINGS:
        out_s = keyframe.time_s - watch.out_since_s
        if out_s > LONGEST_LOCK_OUT_S:
            reason = f"for {out_s:.0f} s no beam has agreed with the velocity: they set it anew"
            return Doubt(Doubted.VELOCITY, reason)
        if watch.begun_anew_s < watch.out_since_s:
            reason = f"no beam of {watch.pings_out} pings in a row agrees with the velocity"
            return Doubt(Doubted.ANSWER, reason)
    if watch.pings_torn >= TORN_PINGS and watch.begun_anew_s < watch.torn_since_s:
        return Doubt(
            Doubted.ANSWER,
            f"{watch.pings_torn} pings in a row, whose beams agree with each other, contradict the "
            "answer in part",
        )
    few_s = keyframe.time_s - watch.few_since_s
    if len(keyframe.beams) > 2 and few_s > LONGEST_FEW_S:
        return Doubt(
            Doubted.ANSWER,
            f"most beams have contradicted the answer for {few_s:.0f} s: perhaps it follows the "
            "wrong ones",
        )
    if watch.fixes_refused >= LOCKED_OUT_FIXES:
        reason = f"{watch.fixes_refused} GNSS fixes in a row contradict the position"
        return Doubt(Doubted.POSITION, reason)
    return _doubt_of_height(watch, keyframe.time_s)


def _doubt_of_height(watch: Watch, time_s: float) -> Doubt | None:
    """Say why the height cannot be gone on from: what contradicts it, while nothing agrees."""
    is_out = watch.heights_refused >= LOCKED_OUT_FIXES
    if is_out and time_s - watch.last_depth_s > VOUCHED_S:
        reason = f"{watch.heights_refused} GNSS fixes in a row contradict the height"
        return Doubt(Doubted.HEIGHT_OF_FIXES, reason)
    # Once: if that does not help, it is the sensor.
    is_out = watch.depths_refused >= LOCKED_OUT_DEPTHS and not watch.depths_followed
    if is_out and time_s - watch.last_height_s > VOUCHED_S:
        reason = f"the depth has contradicted the height {watch.depths_refused} times in a row"
        return Doubt(Doubted.HEIGHT, reason)
    return None


def _is_adrift(watch: Watch, sigma: Array, keyframe: Keyframe) -> bool:
    """Return whether beams are back after a silence that left the prediction beyond correction."""
    return bool(
        len(keyframe.beams) > 2
        and keyframe.time_s - watch.last_beam_s > SILENCE_S
        and np.linalg.norm(sigma[ROTATION]) > BENT_TURN
        and np.linalg.norm(sigma[VELOCITY]) > BENT_SPEED
    )


def watch_after(was: Watch, begun: Window, last: Stretch, doubt: Doubt) -> Watch:
    """Return what is remembered of an answer that was begun anew, and has to prove itself.

    ``begun`` is its window, ``last`` the newest keyframe before.
    """
    newest = begun.newest
    time_s = float(newest.time_s[0])
    is_aided = bool(np.any(newest.weight >= TRUSTED))
    is_grounded = counts_off_the_ground(newest, begun.keyframes[-1])
    contradicted, moved = was.contradicted, was.moved
    if doubt.what in (Doubted.POSITION, Doubted.HEIGHT, Doubted.HEIGHT_OF_FIXES):
        reckoned_n = last.states.p_n[0] + last.states.v_n[0] * (time_s - last.time_s[0])
        contradicted = Contradicted(
            time_s,
            f"since {time_s:.0f} s: {doubt.reason} of dead reckoning, and it follows them; one of "
            "the two is wrong",
            tuple(reckoned_n.tolist()),
            float(np.sqrt(np.trace(last.covariance[0, POSITION, POSITION]))),
        )
    if doubt.what is Doubted.POSITION:
        moved = (*(t for t in moved if time_s - t < ASTRAY_S), time_s)
    return Watch(
        last_beam_s=time_s if is_aided else was.last_beam_s,
        last_ground_s=time_s if is_grounded else was.last_ground_s,
        depths_refused=was.depths_refused,
        depths_followed=was.depths_followed or doubt.what is Doubted.HEIGHT,
        depth_heard_s=was.depth_heard_s,
        depth_refused_s=was.depth_refused_s,
        refused_depth=was.refused_depth if doubt.what is not Doubted.HEIGHT else 0.0,
        leaves_depth_out=was.leaves_depth_out and doubt.what is not Doubted.HEIGHT,
        last_height_s=was.last_height_s,
        last_depth_s=was.last_depth_s,
        out_since_s=np.inf if is_aided else was.out_since_s,
        torn_since_s=was.torn_since_s,
        force=was.force,
        good_share=0.8 * FEW,  # it has to prove itself
        trouble_s=time_s,
        trouble=doubt.reason,
        begun_anew_s=time_s,
        moved=moved,
        contradicted=contradicted,
    )


def is_astray(watch: Watch) -> bool:
    """Return whether fixes have contradicted one answer after the other: the heading is wrong.

    Those that contradict a height alone say nothing of it.
    """
    return len(watch.moved) >= ASTRAY_TIMES


def reanchored(window: Window, keyframe: Keyframe, kept: Kept, what: Doubted) -> Window:
    """Return a window that begins at ``keyframe``, the next one of ``window``, without a doubt.

    With position, height, or velocity after a silence in doubt it goes on from the rest of the
    prediction, otherwise from ``kept``, an older answer led on to there by the inertial data.
    """
    if what in (Doubted.ANSWER, Doubted.VELOCITY):
        trust = kept.trust
        start = _from_reserve(kept, keyframe.time_s, has_velocity=what is Doubted.ANSWER)
    else:
        trust, start = window.trust, _from_prediction(window, keyframe, what)
    # The first keyframe of a window meets no gate: depth and fixes count from the next one on.
    first = keyframe.without(DepthMeans.name, Fixes.name)
    begun = Window(window.sensors, window.config, first, start, trust=trust)
    begun.meet_prediction()
    begun.iterate()
    return begun


def _from_reserve(kept: Kept, time_s: float, *, has_velocity: bool) -> InitialMoments:
    """Return the older answer; where its velocity says little, the place with what may have come.

    Its errors are correlated as the inertial data correlate them: a velocity that is measured
    corrects attitude and position as well.
    """
    doubted = kept._replace(covariance=kept.covariance * DOUBT_FACTOR**2)
    variance = np.trace(doubted.covariance[VELOCITY, VELOCITY])
    if not has_velocity or variance > SPEED_SIGMA**2:
        doubted = doubted.without_velocity(time_s)
    return doubted.states.moments(_regular(doubted.covariance))


def _from_prediction(window: Window, keyframe: Keyframe, what: Doubted) -> InitialMoments:
    predicted, covariance = window.predicted(keyframe)
    P = covariance.copy()
    R_nb, p_n, v_n, bias, extra = (column[0] for column in predicted[:5])
    if what is Doubted.VELOCITY_AFTER_SILENCE:
        v_n = slowed(v_n)
        forget(P, VELOCITY, SPEED_SIGMA)
    else:
        up_b = R_nb[2]
        unsure = np.outer(up_b, up_b)
        if what is Doubted.POSITION:
            P[ROTATION, ROTATION] *= DOUBT_FACTOR**2
            unsure = np.eye(3)
        P[POSITION, POSITION] += POSITION_SIGMA**2 * unsure
    return InitialMoments(R_nb, p_n, v_n, bias, _regular(P), extra)


def _regular(P: Array) -> Array:
    """Return a symmetric covariance whose Cholesky factor exists."""
    P = 0.5 * (P + P.T)
    scale = np.sqrt(np.diag(P))
    correlation = P / np.outer(scale, scale) + 1e-12 * np.eye(len(P))
    return np.asarray(correlation * np.outer(scale, scale))


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

    def at(self, time_s: float, states: States, covariance: Array) -> Kept:
        """Return the answer that is led on to states (1, ...) with their covariance (n, n)."""
        names = ("R_nb", "p_n", "v_n", "bias", "extra")
        now: dict[str, Any] = dict(zip(names, states, strict=False))
        led = self._replace(**now, covariance=covariance)
        is_lost = np.trace(covariance[VELOCITY, VELOCITY]) > (LOST_FACTOR * SPEED_SIGMA) ** 2
        return led.without_velocity(time_s) if is_lost else led

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
        assert keyframe.inertial is not None
        states = self.older.states.followed_by(self.younger.states)
        ahead = inertial.predict(keyframe.inertial, states)
        covariances = ahead.covariance(np.stack([kept.covariance for kept in self]))
        led = (
            kept.at(keyframe.time_s, ahead.states.take(np.s_[k : k + 1]), covariances[k])
            for k, kept in enumerate(self)
        )
        return Reserve(*led)

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
