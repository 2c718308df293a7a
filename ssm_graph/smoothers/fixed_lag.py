"""A mission keyframe by keyframe: the newest states as each comes, and those that the lag leaves.

Keyframes older than the lag are marginalised into a square-root prior; the weights of all beams in
the window keep being recomputed, and freeze when their keyframe leaves. With a lag of zero it is
the filter: predict, marginalise the old keyframe, iterate the beams of the new one.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, at_once
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import with_extras
from ssm_graph.graph.measurements import aid_table, doubts_of_aids
from ssm_graph.mission.answer import RecursiveBeams, recursive_estimate
from ssm_graph.mission.estimate import Estimate, OnKeyframe
from ssm_graph.mission.problem import Problem, start_of, with_white_noise
from ssm_graph.smoothers.keyframe import keyframes_of, sensors_of
from ssm_graph.smoothers.track import (
    Stretch,
    calibration_of_last,
    current_along,
    joined,
    undetermined,
)
from ssm_graph.smoothers.window import FixedLagConfig, Window
from ssm_graph.smoothers.window_graph import beam_rows

__all__ = ["FixedLagConfig", "FixedLagEstimates", "FixedLagRun", "run_fixed_lag", "solve_fixed_lag"]


class FixedLagRun(NamedTuple):
    """What a fixed-lag smoother found."""

    newest: Stretch
    """Each keyframe as known when it was the newest: what a vehicle navigates by."""
    delayed: Stretch
    """Each keyframe as known when it left the window."""
    n_iterations: Array
    """(K,)"""


class FixedLagEstimates(NamedTuple):
    """Both tracks of :class:`FixedLagRun`, as estimates."""

    newest: Estimate
    delayed: Estimate


def solve_fixed_lag(
    problem: Problem, config: FixedLagConfig | None = None, *, on_keyframe: OnKeyframe | None = None
) -> FixedLagEstimates:
    """Return the newest states of a mission and those that left the window, as estimates.

    Raises
    ------
    SolverError
        If no finite solution was found.
    """
    config = config or FixedLagConfig()
    begin = time.perf_counter()
    run = run_fixed_lag(problem, config, on_keyframe=on_keyframe)
    wall_s = time.perf_counter() - begin
    return FixedLagEstimates(
        *(
            _estimate(problem, config, getattr(run, name), run.n_iterations, wall_s, name)
            for name in FixedLagEstimates._fields
        )
    )


def run_fixed_lag_steps(
    problem: Problem, config: FixedLagConfig, *, on_keyframe: OnKeyframe | None = None
) -> Steps[FixedLagRun]:
    """Go through the keyframes one by one."""
    problem = with_white_noise(problem)
    keyframes = keyframes_of(problem)
    first = next(keyframes)
    sensors = sensors_of(problem)
    window = Window(sensors, config, first, with_extras(start_of(problem), sensors.extras))
    newest, delayed, n_iterations = [], [], []
    for number, keyframe in enumerate(itertools.chain([first], keyframes), start=1):
        if number > 1:
            delayed.append(window.advance(keyframe))
        n_iterations.append((yield from window.iterate_steps()))
        newest.append(window.newest)
        if on_keyframe is not None:
            on_keyframe(number, problem.n_keyframes)
        yield 1.0
    delayed.append(window.all)
    return FixedLagRun(joined(newest), joined(delayed), np.array(n_iterations, float))


run_fixed_lag = at_once(run_fixed_lag_steps)


def _estimate(
    problem: Problem,
    config: FixedLagConfig,
    track: Stretch,
    n_iterations: Array,
    wall_s: float,
    name: str,
) -> Estimate:
    sensors, extras = sensors_of(problem), problem.extras
    beams = replace(problem.beams, motion=None)
    error = beam_rows(sensors, beams, track.states.take(beams.keyframe)).error
    judged = [track.aids[name] for name in sensors.aids if name in track.aids]
    span_s = float(problem.keyframe_s[-1] - problem.keyframe_s[0])
    calibration = calibration_of_last(sensors.extras, track, span_s=span_s)
    estimate = recursive_estimate(
        replace(
            problem, extras=extras.without([block.name for block in sensors.extras.blocks]), aids=()
        ),
        track.states,
        track.covariance[:, :STATE_DIM, :STATE_DIM],
        RecursiveBeams(
            track.innovation if name == "newest" else None,
            track.mahalanobis_sq,
            track.weight,
            error,
        ),
        n_iterations,
        max_iterations=config.max_iterations,
        method=f"fixed lag {config.lag_s:g} s, {name} states",
        kernel=str(config.kernel),
        wall_s=wall_s,
        doubts=doubts_of_aids(judged),
    )
    return replace(
        estimate,
        calibration=calibration,
        notes=estimate.notes + undetermined(calibration),
        current=current_along(sensors.extras, track),
        aids=aid_table(judged),
    )
