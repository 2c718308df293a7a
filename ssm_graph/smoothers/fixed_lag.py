"""The fixed-lag smoother: the newest states of a mission, each keyframe as it comes.

Keyframes older than the lag are marginalised into a square-root prior; the weights of all beams in
the window keep being recomputed, and freeze when their keyframe leaves. With a lag of zero it is
the filter: predict, marginalise the old keyframe, iterate the beams of the new one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ssm_graph.data import Array
from ssm_graph.estimate import BeamTable, Estimate, Status
from ssm_graph.problem.problem import Problem
from ssm_graph.problem.trajectory import trajectory_from_states
from ssm_graph.smoothers.window import FixedLagConfig, Track, Window

__all__ = ["FixedLagConfig", "FixedLagRun", "FixedLagSmoother", "Track"]

OnKeyframe = Callable[[int, int], None]
"""Called after each keyframe with its number and how many there are."""


class FixedLagRun(NamedTuple):
    """What a fixed-lag smoother found."""

    newest: Track
    """Each keyframe as known when it was the newest: what a vehicle navigates by."""
    delayed: Track
    """Each keyframe as known when it left the window."""
    n_iterations: Array
    """(K,)"""


class FixedLagSmoother:
    """Estimate a mission keyframe by keyframe."""

    def __init__(self, config: FixedLagConfig | None = None) -> None:
        self.config = config or FixedLagConfig()

    def solve(
        self, problem: Problem, *, on_keyframe: OnKeyframe | None = None
    ) -> tuple[Estimate, Estimate]:
        """Return the newest states and those that left the window, as estimates.

        Raises
        ------
        SolverError
            If no finite solution was found.
        """
        begin = time.perf_counter()
        run = self.run(problem, on_keyframe=on_keyframe)
        wall_s = time.perf_counter() - begin
        newest, delayed = (
            self._estimate(problem, track, run.n_iterations, wall_s, name)
            for track, name in ((run.newest, "newest"), (run.delayed, "delayed"))
        )
        return newest, delayed

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
        beams = problem.beams
        at_limit = int(np.sum(n_iterations >= self.config.max_iterations))
        return Estimate(
            method=f"fixed lag {self.config.lag_s:g} s, {name} states",
            kernel=str(self.config.kernel),
            status=Status.CONVERGED,
            reason=f"{np.mean(n_iterations):.1f} iterations a keyframe, {at_limit} of "
            f"{len(n_iterations)} keyframes at the limit of {self.config.max_iterations}",
            trajectory=trajectory_from_states(problem, track, track.covariance),
            beams=BeamTable(
                time_s=problem.keyframe_s[beams.keyframe],
                beam=(beams.beam + 1).astype(np.float64),
                innovation=track.innovation,
                mahalanobis_sq=track.mahalanobis_sq,
                weight=track.weight,
            ),
            iterations=(),
            wall_s=wall_s,
            cost=np.nan,
            start=problem.start,
            notes=problem.notes,
        )
