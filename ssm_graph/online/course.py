"""The steps that a live estimator has made, and the way back for messages that come late.

Each step is a function of the one before and of the data, so that going back to before a late
message and forth again leads to what punctual messages would have led to.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.data import Array
from ssm_graph.errors import SolverError
from ssm_graph.messages import Severity
from ssm_graph.online.buffers import Buffers, Measured
from ssm_graph.online.events import EventLog
from ssm_graph.online.keyframes import KeyframeMaker
from ssm_graph.online.recovery import reanchored, what_to_forget
from ssm_graph.online.watch import LOCKED_OUT_DEPTHS, Watch, observe
from ssm_graph.problem.doubts import TRUSTED
from ssm_graph.problem.error_state import VELOCITY
from ssm_graph.smoothers.keyframe import Keyframe
from ssm_graph.smoothers.stretch import Stretch, joined
from ssm_graph.smoothers.window import Window

REACH_S: Final = 0.1
"""A late inertial sample changes keyframes that are so much older: a ping's gyro reading is a mean,
and samples are seen with their neighbours."""
ANY_SPEED: Final = 5.0
"""m/s: once its velocity is less certain than this, a vehicle's being no faster is what is left."""
LEAST_LATE_S: Final = 1.0
"""Messages may be so late whatever the lag."""


class Step(NamedTuple):
    """One keyframe, done."""

    window: Window
    watch: Watch
    left: Stretch | None
    """What left the window with it."""

    @property
    def time_s(self) -> float:
        """Of the newest keyframe."""
        return self.window.keyframes[-1].time_s


class Course:
    """Makes one step after the other, and keeps those that late messages may undo."""

    def __init__(
        self, first: Step, maker: KeyframeMaker, buffers: Buffers, events: EventLog, null_b: Array
    ) -> None:
        """``null_b`` (4,) is the array's parity: orthogonal to the speeds of any velocity."""
        self._steps = deque([first])
        self._maker, self._buffers, self._events = maker, buffers, events
        self._null = null_b
        self._settled: list[Stretch] = []

    @property
    def newest(self) -> Step:
        """The last step."""
        return self._steps[-1]

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

    def advance(self, *, is_sample: bool = False) -> int:
        """Make all steps that the data allow; return how many.

        ``is_sample`` says that nothing but one more inertial sample has come since the last call.
        """
        if is_sample and self._buffers.imu.last_s < self._maker.not_before_s:
            return 0
        count = 0
        while (measured := self._maker.next_after(self.newest.time_s)) is not None:
            self._steps.append(self._step(measured))
            count += 1
            self._let_go()
        return count

    def take_settled(self, *, all_of_them: bool = False) -> list[Stretch]:
        """Return what has left the window for good since the last call, or all there is."""
        settled, self._settled = self._settled, []
        if all_of_them:
            settled += [step.left for step in self._steps if step.left is not None]
            settled.append(self.newest.window.all)
        return settled

    def _let_go(self) -> None:
        """Forget the steps that nothing can undo any more."""
        kept_s = self.newest.time_s - max(self.newest.window.config.lag_s, LEAST_LATE_S) - REACH_S
        while len(self._steps) > 1 and self._steps[1].time_s <= kept_s:
            self._settle(self._steps.popleft())
        self._buffers.drop_before(self.oldest.window.keyframes[0].time_s - 1.0)

    def _settle(self, step: Step) -> None:
        if step.left is not None:
            self._settled.append(joined([step.left]))  # a copy: a view keeps the whole window

    def _step(self, measured: Measured) -> Step:
        last = self.newest
        keyframe = self._maker.make(measured, last_s=last.time_s)
        sigma = last.window.newest_sigma
        if len(keyframe.beams.speed) == 0 and np.linalg.norm(sigma[VELOCITY]) > ANY_SPEED:
            keyframe = replace(keyframe, speed_sigma=ANY_SPEED)
        window = last.window.successor()
        doubt = what_to_forget(last.watch, sigma, keyframe)
        try:
            if doubt is not None:
                raise SolverError(doubt)
            left = window.advance(keyframe)
            window.iterate()
            window.require_sane()
        except (SolverError, np.linalg.LinAlgError, FloatingPointError) as error:
            self._events.tell(
                keyframe.time_s, Severity.ERROR, "recovered", f"{error}: begun anew from there"
            )
            window = reanchored(last.window, keyframe, last.watch)
            refusals = last.watch.depths_refused
            fresh = Watch(
                last_beam_s=_last_beam_s(window, last.watch),
                depths_refused=refusals + (refusals == LOCKED_OUT_DEPTHS),
                force=last.watch.force,
                good_share=0.0,  # it has to prove itself
                sound_s=min(last.watch.sound_s, last.time_s),
                trouble_s=keyframe.time_s,
                trouble=str(error),
                begun_anew_s=keyframe.time_s,
            )
            return Step(window, fresh, last.window.all)
        samples = self._buffers.imu.between(last.time_s, keyframe.time_s)
        force = float(np.linalg.norm(samples[:, 4:], axis=1).mean()) if len(samples) else 9.8
        watch = observe(
            last.watch,
            keyframe,
            window,
            last_s=last.time_s,
            parity=self._agree(measured),
            force=force,
            gap_s=float(np.max(np.diff(samples[:, 0], prepend=last.time_s), initial=0.0)),
        )
        self._tell(last.watch, watch, keyframe)
        return Step(window, watch, left)

    def _agree(self, measured: Measured) -> bool:
        """Return whether all four beams of the ping are there and agree with each other."""
        pings = measured.pings
        if len(pings) == 0 or not np.all(np.isfinite(pings[-1, 1:5])):
            return False
        sigma = float(np.sqrt(np.sum((self._null * pings[-1, 5:]) ** 2)))
        return bool(abs(pings[-1, 1:5] @ self._null) < 5.0 * sigma)

    def _tell(self, before: Watch, after: Watch, keyframe: Keyframe) -> None:
        if after.trouble_s == keyframe.time_s and after.trouble != before.trouble:
            self._events.tell(keyframe.time_s, Severity.WARNING, "doubt", after.trouble)


def _last_beam_s(begun: Window, watch: Watch) -> float:
    """Return when a beam counted last, after a window has begun anew."""
    newest = begun.newest
    return float(newest.time_s[-1]) if np.any(newest.weight >= TRUSTED) else watch.last_beam_s
