"""A stretch of a mission as a problem of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssm_graph.imu.preintegration import InertialChain
from ssm_graph.problem.problem import Beams, Depths, Fixes, Problem
from ssm_graph.problem.timeline import Indices


def window_of(problem: Problem, keyframes: range, *, measured: range | None = None) -> Problem:
    """Return the problem of successive keyframes, counted from zero anew.

    Parameters
    ----------
    problem : the mission.
    keyframes : its keyframes in the window.
    measured : those whose measurements come along; all of the window when left out.
    """
    measured = keyframes if measured is None else measured
    first, last = keyframes.start, keyframes.stop - 1
    chain = problem.chain
    return replace(
        problem,
        keyframe_s=problem.keyframe_s[first : last + 1],
        chain=InertialChain(chain.measurements[first:last], chain.params[first:last], chain.frame),
        beams=_beams(problem.beams, measured, first),
        depths=None if problem.depths is None else _depths(problem.depths, measured, keyframes),
        fixes=None if problem.fixes is None else _fixes(problem.fixes, measured, first),
    )


def rows_in(keyframe: Indices, keyframes: range) -> slice:
    """Return which rows of a table, sorted by ``keyframe``, belong to successive keyframes."""
    begin, end = np.searchsorted(keyframe, [keyframes.start, keyframes.stop])
    return slice(int(begin), int(end))


def _beams(beams: Beams, measured: range, first: int) -> Beams:
    rows = rows_in(beams.keyframe, measured)
    return replace(
        beams,
        keyframe=beams.keyframe[rows] - first,
        beam=beams.beam[rows],
        speed=beams.speed[rows],
        sigma=beams.sigma[rows],
        gyro_b=beams.gyro_b[rows],
        beam_b=beams.beam_b[rows],
    )


def _depths(depths: Depths, measured: range, keyframes: range) -> Depths:
    rows = rows_in(depths.keyframe, measured)
    return replace(
        depths,
        keyframe=depths.keyframe[rows] - keyframes.start,
        time_s=depths.time_s[rows],
        depth=depths.depth[rows],
        gyro_b=depths.gyro_b[keyframes.start : keyframes.stop],
    )


def _fixes(fixes: Fixes, measured: range, first: int) -> Fixes:
    rows = rows_in(fixes.keyframe, measured)
    return replace(
        fixes,
        keyframe=fixes.keyframe[rows] - first,
        position_n=fixes.position_n[rows],
        covariance_n=fixes.covariance_n[rows],
    )
