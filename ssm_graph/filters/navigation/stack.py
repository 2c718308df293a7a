"""Several problems side by side, as dense arrays: filters step through all runs at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import NavigationStates
from ssm_graph.filters.navigation.process import Process
from ssm_graph.mission.bottom_track import require_bottom_track
from ssm_graph.mission.problem import Problem, start_of
from ssm_graph.sensors.dvl import N_BEAMS


@dataclass(frozen=True, slots=True, eq=False)
class BeamStack:
    """Beam speeds of B runs at K keyframes; information zero where a beam is missing."""

    speed: Array
    """(K, B, 4) m/s"""
    root_information: Array
    """(K, B, 4) 1 / sigma, s/m"""
    gyro_b: Array
    """(K, B, 1, 3) rad/s"""
    beam_b: Array
    """(B, 4, 3)"""
    lever_arm_b: Array
    """(B, 1, 3) m"""
    omega_ie_n: Array
    """(3,) rad/s"""


@dataclass(frozen=True, slots=True, eq=False)
class DepthStack:
    """Depth readings of B runs, up to D in an interval."""

    height: Array
    """(K, B, D) m, minus the depth"""
    elapsed_s: Array
    """(K, B, D) s since the keyframe before"""
    counts: Array
    """(K, B, D) 1 for a reading, 0 for none"""
    gyro_b: Array
    """(K, B, 3) rad/s"""
    sigma: Array
    """(B,) m"""
    lever_arm_b: Array
    """(B, 3) m"""


@dataclass(frozen=True, slots=True, eq=False)
class FixStack:
    """GNSS fixes of B runs; information zero where there is none."""

    position_n: Array
    """(K, B, 3) m"""
    root_information: Array
    """(K, B, 3, 3) 1/m"""
    lever_arm_b: Array
    """(B, 3) m"""


@dataclass(frozen=True, slots=True, eq=False)
class Stack:
    """What a filter needs of B problems with equal numbers of keyframes."""

    problems: tuple[Problem, ...]
    process: Process
    start: NavigationStates
    start_cov: Array
    """(B, 15, 15)"""
    span_s: Array
    """(K - 1, B) s"""
    beams: BeamStack
    depths: DepthStack | None
    fixes: FixStack | None

    @property
    def n_keyframes(self) -> int:
        """Number of keyframes of every run."""
        return self.problems[0].n_keyframes

    @property
    def frame(self) -> LocalFrame:
        """Navigation frame of all runs."""
        return self.problems[0].frame

    def silence(self, runs: NDArray[np.bool_]) -> None:
        """Take all measurements of some runs (B,) away."""
        self.beams.root_information[:, runs] = 0.0
        if self.depths is not None:
            self.depths.counts[:, runs] = 0.0
        if self.fixes is not None:
            self.fixes.root_information[:, runs] = 0.0


def stack_problems(problems: Sequence[Problem]) -> Stack:
    """Put problems side by side.

    Raises
    ------
    ConfigError
        If their numbers of keyframes differ, or only some have a depth sensor or GNSS.
    """
    first = problems[0]
    for what, same in (
        ("number of keyframes", lambda p: p.n_keyframes == first.n_keyframes),
        ("navigation frame", lambda p: p.frame == first.frame),
        ("depth sensor, or none", lambda p: (p.depths is None) == (first.depths is None)),
        ("GNSS, or none", lambda p: (p.fixes is None) == (first.fixes is None)),
    ):
        if not all(same(problem) for problem in problems):
            raise ConfigError(
                f"runs side by side: expected the same {what} in all of {len(problems)}; "
                "filter them one by one"
            )
    starts = [start_of(p) for p in problems]
    return Stack(
        problems=tuple(problems),
        process=Process([p.chain.intervals for p in problems], first.frame),
        start=NavigationStates(*(np.array([s[i] for s in starts]) for i in range(4))),
        start_cov=np.array([s.covariance for s in starts]),
        span_s=np.stack([np.diff(p.keyframe_s) for p in problems], axis=1),
        beams=_stack_beams(problems),
        depths=None if first.depths is None else _stack_depths(problems),
        fixes=None if first.fixes is None else _stack_fixes(problems),
    )


def _stack_beams(problems: Sequence[Problem]) -> BeamStack:
    shape = (problems[0].n_keyframes, len(problems), N_BEAMS)
    speed, root_information = np.zeros(shape), np.zeros(shape)
    gyro_b = np.zeros((*shape[:2], 1, 3))
    beam_b = np.zeros((len(problems), N_BEAMS, 3))
    for run, problem in enumerate(problems):
        require_bottom_track(problem)
        beams = problem.beams
        _require_single(beams.keyframe * N_BEAMS + beams.beam, problem)
        speed[beams.keyframe, run, beams.beam] = beams.speed
        root_information[beams.keyframe, run, beams.beam] = 1.0 / beams.sigma
        gyro_b[beams.keyframe, run, 0] = beams.gyro_b
        beam_b[run, beams.beam] = beams.beam_b
    return BeamStack(
        speed,
        root_information,
        gyro_b,
        beam_b,
        np.array([[p.beams.lever_arm_b] for p in problems]),
        problems[0].frame.omega_ie_n,
    )


def _require_single(slots: NDArray[np.intp], problem: Problem) -> None:
    values, counts = np.unique(slots, return_counts=True)
    if np.any(counts > 1):
        k = values[np.argmax(counts > 1)] // N_BEAMS
        raise DataError(
            f"two pings within a millisecond at {problem.keyframe_s[k]:.3f} s: a filter takes one "
            "at a time; remove the repeated ping"
        )


def _stack_depths(problems: Sequence[Problem]) -> DepthStack:
    logs = [(run, p, p.depths) for run, p in enumerate(problems) if p.depths is not None]
    counted = [np.bincount(d.keyframe, minlength=p.n_keyframes) for _, p, d in logs]
    largest = max(1, *(int(count.max()) for count in counted))
    shape = (problems[0].n_keyframes, len(problems), largest)
    height, elapsed_s, counts = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for (run, problem, depths), count in zip(logs, counted, strict=True):
        begin = np.cumsum(count) - count
        slot = np.arange(len(depths.keyframe)) - begin[depths.keyframe]
        place = (depths.keyframe, run, slot)
        before = np.maximum(depths.keyframe - 1, 0)
        height[place] = -depths.depth
        elapsed_s[place] = depths.time_s - problem.keyframe_s[before]
        counts[place] = 1.0
    return DepthStack(
        height,
        elapsed_s,
        counts,
        np.stack([d.gyro_b for _, _, d in logs], axis=1),
        np.array([d.sigma for _, _, d in logs]),
        np.array([d.lever_arm_b for _, _, d in logs]),
    )


def _stack_fixes(problems: Sequence[Problem]) -> FixStack:
    shape = (problems[0].n_keyframes, len(problems))
    position_n, root_information = np.zeros((*shape, 3)), np.zeros((*shape, 3, 3))
    levers = np.zeros((len(problems), 3))
    for run, problem in enumerate(problems):
        fixes = problem.fixes
        assert fixes is not None
        information = np.zeros((shape[0], 3, 3))
        weighted = np.zeros((shape[0], 3))
        inverse = np.linalg.inv(fixes.covariance_n)
        np.add.at(information, fixes.keyframe, inverse)
        np.add.at(weighted, fixes.keyframe, (inverse @ fixes.position_n[..., None])[..., 0])
        used = np.unique(fixes.keyframe)
        position_n[used, run] = np.linalg.solve(information[used], weighted[used][..., None])[
            ..., 0
        ]
        root_information[used, run] = np.swapaxes(np.linalg.cholesky(information[used]), 1, 2)
        levers[run] = fixes.lever_arm_b
    return FixStack(position_n, root_information, levers)
