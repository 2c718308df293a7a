"""The steps that a live estimator has made, and the way back for messages that come late.

Each step is a function of the one before and of the data, so that going back to before a late
message and forth again leads to what punctual messages would have led to.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import SolverError
from ssm_graph.engine.error_state import VELOCITY
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.live.estimator.buffers import Buffers, Measured
from ssm_graph.live.estimator.guard import Guard, Guarded, Guardian, protection_at
from ssm_graph.live.estimator.keyframes import KeyframeMaker
from ssm_graph.live.estimator.recovery import (
    Doubt,
    Doubted,
    Reserve,
    doubt_of,
    reanchored,
    watch_after,
)
from ssm_graph.live.estimator.watch import Watch, is_sound, observe
from ssm_graph.mission.estimate import ProtectionTrack
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.navigation import Severity
from ssm_graph.smoothers.keyframe import Keyframe
from ssm_graph.smoothers.track import Stretch, joined
from ssm_graph.smoothers.window import Window

REACH_S: Final = 0.1
"""A late inertial sample changes keyframes that are so much older: a ping's gyro reading is a mean,
and samples are seen with their neighbours."""
ANY_SPEED: Final = 5.0
"""m/s: once its velocity is less certain than this, a vehicle's being no faster is what is left."""
LEAST_LATE_S: Final = 1.0
"""Messages may be so late whatever the lag."""
FRESH_S: Final = 5.0
"""Every step as old as this is kept, for what comes late comes late by little."""
SPARSE_S: Final = 2.0
"""Of older ones, each with a window of its own, one in so long; the others are made anew."""


class Step(NamedTuple):
    """One keyframe, done."""

    window: Window
    watch: Watch
    left: Stretch | None
    """What left the window since the step that is kept before it."""
    reserve: Reserve
    guard: Guard

    @property
    def time_s(self) -> float:
        """Of the newest keyframe."""
        return self.window.keyframes[-1].time_s


class Settled(NamedTuple):
    """Successive keyframes that have left the window for good."""

    stretch: Stretch
    protection: ProtectionTrack


class Course:
    """Makes one step after the other, and keeps those that late messages may go back to."""

    def __init__(
        self,
        first: Step,
        maker: KeyframeMaker,
        buffers: Buffers,
        events: EventLog,
        guardian: Guardian,
    ) -> None:
        self.guardian = guardian
        self._steps = deque([first])
        self._maker, self._buffers, self._events = maker, buffers, events
        self._settled: list[Settled] = []

    @property
    def newest(self) -> Step:
        """The last step."""
        return self._steps[-1]

    @property
    def guarded(self) -> Guarded:
        """What watches over the newest step says of it."""
        return self.guardian.told(self.newest.guard)

    @property
    def oldest(self) -> Step:
        """The oldest step that can be gone back to."""
        return self._steps[0]

    @property
    def horizon_s(self) -> float:
        """Messages older than this come too late."""
        return self.oldest.time_s + REACH_S

    def rewind(self, time_s: float) -> bool:
        """Undo the steps from a time on; return whether there were any."""
        undone = False
        while len(self._steps) > 1 and self._steps[-1].time_s >= time_s:
            self._steps.pop()
            undone = True
        return undone

    def advance(self, *, is_sample: bool = False, at_most: float = np.inf) -> int:
        """Make all steps that the data allow, but ``at_most`` so many; return how many.

        ``is_sample`` says that nothing but one more inertial sample has come since the last call.
        """
        if is_sample and self._buffers.imu.last_s < self._maker.not_before_s:
            return 0
        count = 0
        while count < at_most:
            measured = self._maker.next_after(self.newest.time_s)
            if measured is None:
                break
            self._steps.append(self._step(measured))
            count += 1
            self._let_go()
            self._thin_out()
        return count

    def take_settled(self, *, all_of_them: bool = False) -> list[Settled]:
        """Return what has left the window for good since the last call, or all there is."""
        settled, self._settled = self._settled, []
        if all_of_them:
            left = [step.left for step in self._steps if step.left is not None]
            settled += map(self._with_levels, (*left, self.newest.window.all))
        return settled

    def _with_levels(self, stretch: Stretch) -> Settled:
        return Settled(stretch, protection_at(self.newest.guard, stretch.time_s))

    def _let_go(self) -> None:
        """Forget the steps that nothing can undo any more."""
        kept_s = self.newest.time_s - max(self.newest.window.config.lag_s, LEAST_LATE_S) - REACH_S
        while len(self._steps) > 1 and self._steps[1].time_s <= kept_s:
            gone = self._steps.popleft().left
            if gone is not None:
                self._settled.append(
                    self._with_levels(joined([gone]))
                )  # a copy: a view keeps the whole window
        self._buffers.drop_before(self.oldest.window.keyframes[0].time_s - 1.0)

    def _thin_out(self) -> None:
        """Forget the step that is no longer fresh, if those beside it are close enough."""
        steps, fresh_s = self._steps, self.newest.time_s - FRESH_S
        at = bisect_left(steps, fresh_s, key=lambda step: step.time_s) - 1
        if at < 1 or steps[at + 1].time_s - steps[at - 1].time_s > SPARSE_S:
            return
        behind = steps[at + 1]
        left = [stretch for stretch in (steps[at].left, behind.left) if stretch is not None]
        steps[at + 1] = behind._replace(left=joined(left) if left else None)
        del steps[at]

    def _step(self, measured: Measured) -> Step:
        last = self.newest
        keyframe = self._maker.make(measured, last_s=last.time_s)
        sigma = last.window.newest_sigma
        if len(keyframe.beams) == 0 and np.linalg.norm(sigma[VELOCITY]) > ANY_SPEED:
            keyframe = keyframe.no_faster_than(ANY_SPEED)
        reserve = last.reserve.led_on(keyframe, last.window.inertial)
        doubt = doubt_of(last.watch, sigma, keyframe)
        if doubt is not None:
            return self._anew(keyframe, doubt, reserve)
        try:
            window, left = _advanced(last.window, keyframe)
            watch = self._observed(keyframe, window, parity=self._agree(measured))
            if watch.leaves_depth_out and DepthMeans.name in keyframe.aids:
                window, left = _advanced(last.window, keyframe.without(DepthMeans.name))
        except (SolverError, np.linalg.LinAlgError, FloatingPointError) as error:
            return self._anew(keyframe, Doubt(Doubted.ANSWER, str(error)), reserve)
        if is_sound(watch, keyframe.time_s):
            reserve = reserve.renewed(window)
        if watch.trouble_s == keyframe.time_s and watch.trouble != last.watch.trouble:
            self._events.tell(keyframe.time_s, Severity.WARNING, "doubt", watch.trouble)
        guard = self._guarded(keyframe, window)
        return Step(window, watch, left, reserve, guard)

    def _guarded(
        self, keyframe: Keyframe, window: Window, doubted: Sequence[str] | None = None
    ) -> Guard:
        """Return the guard at the next keyframe, and tell what is found to contradict."""
        last = self.newest
        state = last.window.newest_states
        guard = self.guardian.led_on(last.guard, state, keyframe, window, doubted=doubted)
        known = {one.suspect: one.is_certain for one in last.guard.contradictions}
        now = {one.suspect: one.is_certain for one in guard.contradictions}
        names = self.guardian.bank.suspects
        for suspect, is_certain in now.items():
            if is_certain > known.get(suspect, False) or suspect not in known:
                text = self.guardian.sentence(guard)
                kind = f"{'contradicted' if is_certain else 'suspected'}_{names[suspect]}"
                severity = Severity.WARNING if is_certain else Severity.INFO
                self._events.tell(keyframe.time_s, severity, kind.replace(" ", "_"), text)
        for suspect in sorted(known.keys() - now.keys()):
            text = f"nothing independent of {names[suspect]} contradicts the answer any more"
            kind = "contradiction_ended" if known[suspect] else "suspicion_ended"
            self._events.tell(keyframe.time_s, Severity.INFO, kind, text)
        return guard

    def _anew(self, keyframe: Keyframe, doubt: Doubt, reserve: Reserve) -> Step:
        """Begin a new window at the next keyframe."""
        last = self.newest
        self._events.tell(
            keyframe.time_s, Severity.ERROR, "recovered", f"{doubt.reason}: begun anew from there"
        )
        window = reanchored(last.window, keyframe, reserve.older, doubt.what)
        if doubt.what not in (Doubted.ANSWER, Doubted.VELOCITY):
            reserve = Reserve.of(window)
        watch = watch_after(last.watch, window, last.window.newest, doubt)
        guard = self._guarded(keyframe, window, doubt.what.suspects)
        return Step(window, watch, last.window.all, reserve, guard)

    def _observed(self, keyframe: Keyframe, window: Window, *, parity: bool) -> Watch:
        last, buffers = self.newest, self._buffers
        samples = buffers.inertial(buffers.imu.between(last.time_s, keyframe.time_s))
        force = float(np.linalg.norm(samples[:, 4:], axis=1).mean()) if len(samples) else 9.8
        missing, gap_s = buffers.missing(last.time_s, keyframe.time_s)
        return observe(
            last.watch,
            keyframe,
            window,
            last_s=last.time_s,
            parity=parity,
            force=force,
            gap_s=gap_s,
            missing=missing,
            frozen=buffers.frozen_until(keyframe.time_s),
        )

    def _agree(self, measured: Measured) -> bool:
        """Return whether all beams of the ping are there and agree; three or fewer never say so."""
        if len(measured.pings) == 0:
            return False
        newest, buffers = measured.pings[-1], self._buffers
        parity = buffers.vehicle.mount.parity(newest[buffers.speeds], newest[buffers.sigmas])
        return bool(parity < 5.0)


def _advanced(window: Window, keyframe: Keyframe) -> tuple[Window, Stretch | None]:
    """Return the window at the next keyframe, settled, and what has left it."""
    window = window.successor()
    left = window.advance(keyframe)
    window.iterate()
    window.require_sane()
    return window, left
