"""The fixed-lag smoother: the newest states of a mission, each keyframe as it comes.

Keyframes older than the lag are marginalised into a square-root prior; the weights of all beams in
the window keep being recomputed, and freeze when their keyframe leaves. With a lag of zero it is
the filter: predict, marginalise the old keyframe, iterate the beams of the new one.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from ssm_graph.data import Array
from ssm_graph.estimate import Estimate, OnKeyframe
from ssm_graph.problem.problem import Problem
from ssm_graph.problem.recursive import RecursiveBeams, recursive_estimate
from ssm_graph.smoothers.window import FixedLagConfig, Track, Window

__all__ = ["FixedLagConfig", "FixedLagRun", "FixedLagSmoother", "Track"]


class FixedLagRun(NamedTuple):
    """What a fixed-lag smoother found."""

    newest: Track
    """Each keyframe as known when it was the newest: what a vehicle navigates by."""
    delayed: Track
    """Each keyframe as known when it left the window."""
    n_iterations: Array
    """(K,)"""


class FixedLagEstimates(NamedTuple):
    """Both tracks of :class:`FixedLagRun`, as estimates."""

    newest: Estimate
    delayed: Estimate


class FixedLagSmoother:
    """Estimate a mission keyframe by keyframe."""

    def __init__(self, config: FixedLagConfig | None = None) -> None:
        self.config = config or FixedLagConfig()

    def solve(
        self, problem: Problem, *, on_keyframe: OnKeyframe | None = None
    ) -> FixedLagEstimates:
        """Return the newest states and those that left the window, as estimates.

        Raises
        ------
        SolverError
            If no finite solution was found.
        """
        begin = time.perf_counter()
        run = self.run(problem, on_keyframe=on_keyframe)
        wall_s = time.perf_counter() - begin
        return FixedLagEstimates(
            *(
                self._estimate(problem, track, run.n_iterations, wall_s, name)
                for track, name in ((run.newest, "newest"), (run.delayed, "delayed"))
            )
        )

    def run(self, problem: Problem, *, on_keyframe: OnKeyframe | None = None) -> FixedLagRun:
        """Go through the keyframes one by one."""
        window = Window(problem, self.config)
        n_keyframes = problem.n_keyframes
        n_iterations = np.zeros(n_keyframes)
        newest = Track.empty(n_keyframes, len(problem.beams.speed))
        for k in range(n_keyframes):
            window.advance(k)
            n_iterations[k] = window.iterate()
            window.copy_newest(newest)
            if on_keyframe is not None:
                on_keyframe(k + 1, n_keyframes)
        return FixedLagRun(newest, window.track, n_iterations)

    def _estimate(
        self, problem: Problem, track: Track, n_iterations: Array, wall_s: float, name: str
    ) -> Estimate:
        innovation = track.innovation if name == "newest" else None
        return recursive_estimate(
            problem,
            track,
            track.covariance,
            RecursiveBeams(innovation, track.mahalanobis_sq, track.weight),
            n_iterations,
            max_iterations=self.config.max_iterations,
            method=f"fixed lag {self.config.lag_s:g} s, {name} states",
            kernel=str(self.config.kernel),
            wall_s=wall_s,
        )
