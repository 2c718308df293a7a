"""What a window is told of one keyframe: its time, the inertial data and what was measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from factors.inertial import Intervals
from ssm_graph.base.earth import LocalFrame
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.aids.aid import Aid
from ssm_graph.graph.aids.standstill import AnySpeed
from ssm_graph.graph.measurements import aids_of
from ssm_graph.mission.calibration import windowed
from ssm_graph.mission.problem import Beams, Problem


class Sensors(NamedTuple):
    """What is the same at all keyframes of a vehicle: tables without a row, and variables."""

    frame: LocalFrame
    beams: Beams
    aids: Mapping[str, Aid]
    """By name"""
    extras: Extras
    """What each keyframe carries beside the error state; all of them walk"""

    @classmethod
    def of(cls, frame: LocalFrame, beams: Beams, aids: Iterator[Aid], extras: Extras) -> Sensors:
        """Return the sensors that these tables are of."""
        none = slice(0, 0)
        named = {aid.name: aid.take(none) for aid in aids}
        named[AnySpeed.name] = AnySpeed(np.zeros(0, np.intp), np.zeros(0))
        return cls(frame, replace(beams.take(none), motion=None), named, extras)

    @property
    def state_dim(self) -> int:
        """Components of a keyframe's state, n."""
        return self.extras.width


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """One keyframe."""

    time_s: float
    beams: Beams
    aids: Mapping[str, Aid] = field(default_factory=dict)
    """What else was measured at it, by name: depth, GNSS and the further aids"""
    inertial: Intervals | None = None
    """(1, ...) from the keyframe before; None for the first of all"""

    @property
    def is_measured(self) -> bool:
        """Whether anything but the inertial sensors has seen it."""
        return len(self.beams) > 0 or bool(self.aids)

    def without(self, *names: str) -> Keyframe:
        """Return the keyframe without some of its aids."""
        return replace(self, aids={n: aid for n, aid in self.aids.items() if n not in names})

    def no_faster_than(self, sigma: float) -> Keyframe:
        """Return the keyframe with a velocity of zero and a sigma, m/s, that any vehicle has."""
        speed = AnySpeed(np.zeros(1, np.intp), np.array([sigma]))
        return replace(self, aids={**self.aids, AnySpeed.name: speed})


def sensors_of(problem: Problem) -> Sensors:
    """Return what is the same at all keyframes of a mission."""
    extras = windowed(problem.extras)
    return Sensors.of(problem.frame, problem.beams, iter(aids_of(problem)), extras)


def keyframes_of(problem: Problem) -> Iterator[Keyframe]:
    """Yield the keyframes of a mission in order of time."""
    chain, beams, aids = problem.chain, replace(problem.beams, motion=None), aids_of(problem)
    edges = [
        np.searchsorted(t.keyframe, np.arange(problem.n_keyframes + 1)) for t in (beams, *aids)
    ]
    for k, time_s in enumerate(problem.keyframe_s.tolist()):
        own, *others = (slice(int(edge[k]), int(edge[k + 1])) for edge in edges)
        here = zip(aids, others, strict=True)
        yield Keyframe(
            time_s,
            beams.take(own),
            {aid.name: aid.take(rows) for aid, rows in here if rows.stop > rows.start},
            chain.intervals.take(np.s_[k - 1 : k]) if k else None,
        )
