"""Measurements of several problems side by side, as dense arrays: filters step all runs at once.

Shapes: K keyframes, R runs, B beams, D depth readings between two keyframes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.mission.problem import Problem, require_bottom_track


class BeamGrid(NamedTuple):
    """Beam speeds; zeros with an infinite sigma where a beam is missing."""

    speed: Array
    """(K, R, B) m/s"""
    sigma: Array
    """(K, R, B) m/s"""
    gyro_b: Array
    """(K, R, 3) rad/s, mean over the ping"""
    beam_b: Array
    """(K, R, B, 3)"""
    lever_arm_b: Array
    """(R, 3) m"""


class DepthGrid(NamedTuple):
    """Depth readings since the keyframe before; NaN where there is none."""

    depth: Array
    """(K, R, D) m"""
    time_s: Array
    """(K, R, D) s"""
    gyro_b: Array
    """(K, R, 3) rad/s, at the keyframes"""
    sigma: Array
    """(R,) m"""
    lever_arm_b: Array
    """(R, 3) m"""


class FixGrid(NamedTuple):
    """Position fixes, those of one keyframe as one; information zero where there is none."""

    position_n: Array
    """(K, R, 3) m"""
    root_information: Array
    """(K, R, 3, 3) 1/m, ``W`` with ``W' W`` the information"""
    lever_arm_b: Array
    """(R, 3) m"""


class Measurements(NamedTuple):
    """All measurements of R runs."""

    keyframe_s: Array
    """(K, R) s"""
    beams: BeamGrid
    depths: DepthGrid
    fixes: FixGrid

    def silence(self, runs: NDArray[np.bool_]) -> None:
        """Take all measurements of some runs (R,) away."""
        self.beams.sigma[:, runs] = np.inf
        self.depths.depth[:, runs] = np.nan
        self.fixes.root_information[:, runs] = 0.0


def side_by_side(problems: Sequence[Problem]) -> Measurements:
    """Lay the measurements of problems side by side.

    Raises :class:`ConfigError` where their numbers of keyframes or of beams differ, and for pings
    off the water. Raises :class:`DataError` for two pings at one keyframe.
    """
    require_alike(
        problems,
        {
            "number of keyframes": lambda problem: problem.n_keyframes,
            "number of beams": lambda problem: problem.beams.n_beams,
        },
    )
    for problem in problems:
        require_bottom_track(problem)
    return Measurements(
        np.stack([problem.keyframe_s for problem in problems], axis=1),
        _beam_grid(problems),
        _depth_grid(problems),
        _fix_grid(problems),
    )


def require_alike(
    problems: Sequence[Problem], kinds: Mapping[str, Callable[[Problem], object]]
) -> None:
    """Raise :class:`ConfigError` where something of the problems, by its name, is not the same."""
    for what, of in kinds.items():
        found = [of(problem) for problem in problems]
        if any(value != found[0] for value in found):
            got = ", ".join(dict.fromkeys(map(str, found)))
            raise ConfigError(
                f"runs side by side: expected the same {what} in all of {len(problems)}, got "
                f"{got}; filter them one by one"
            )


def _beam_grid(problems: Sequence[Problem]) -> BeamGrid:
    n_beams = problems[0].beams.n_beams
    shape = (problems[0].n_keyframes, len(problems))
    speed, sigma = np.zeros((*shape, n_beams)), np.full((*shape, n_beams), np.inf)
    gyro_b, beam_b = np.zeros((*shape, 3)), np.zeros((*shape, n_beams, 3))
    for run, problem in enumerate(problems):
        beams = problem.beams
        place = beams.keyframe, run, beams.beam
        slots, counts = np.unique(beams.keyframe * n_beams + beams.beam, return_counts=True)
        if np.any(counts > 1):
            at_s = problem.keyframe_s[slots[np.argmax(counts > 1)] // n_beams]
            raise DataError(
                f"two pings within a millisecond at {at_s:.3f} s: a filter takes one at a time; "
                "remove the repeated ping"
            )
        speed[place], sigma[place], beam_b[place] = beams.speed, beams.sigma, beams.beam_b
        gyro_b[place[:2]] = beams.gyro_b
    levers = np.array([problem.beams.lever_arm_b for problem in problems])
    return BeamGrid(speed, sigma, gyro_b, beam_b, levers)


def _depth_grid(problems: Sequence[Problem]) -> DepthGrid:
    n_keyframes, n_runs = problems[0].n_keyframes, len(problems)
    own = [(run, p.depths) for run, p in enumerate(problems) if p.depths is not None]
    counts = [np.bincount(depths.keyframe, minlength=n_keyframes) for _, depths in own]
    widest = max((int(count.max()) for count in counts), default=0)
    depth, time_s = np.full((2, n_keyframes, n_runs, widest), np.nan)
    gyro_b, levers = np.zeros((n_keyframes, n_runs, 3)), np.zeros((n_runs, 3))
    sigma = np.ones(n_runs)
    for (run, depths), count in zip(own, counts, strict=True):
        begin = np.cumsum(count) - count
        slot = np.arange(len(depths.keyframe)) - begin[depths.keyframe]
        depth[depths.keyframe, run, slot] = depths.depth
        time_s[depths.keyframe, run, slot] = depths.time_s
        gyro_b[:, run], sigma[run], levers[run] = depths.gyro_b, depths.sigma, depths.lever_arm_b
    return DepthGrid(depth, time_s, gyro_b, sigma, levers)


def _fix_grid(problems: Sequence[Problem]) -> FixGrid:
    shape = (problems[0].n_keyframes, len(problems))
    position_n, root_information = np.zeros((*shape, 3)), np.zeros((*shape, 3, 3))
    levers = np.zeros((len(problems), 3))
    for run, problem in enumerate(problems):
        fixes = problem.fixes
        if fixes is None:
            continue
        information, weighted = np.zeros((shape[0], 3, 3)), np.zeros((shape[0], 3))
        inverse = np.linalg.inv(fixes.covariance_n)
        np.add.at(information, fixes.keyframe, inverse)
        np.add.at(weighted, fixes.keyframe, (inverse @ fixes.position_n[..., None])[..., 0])
        used = np.unique(fixes.keyframe)
        mean = np.linalg.solve(information[used], weighted[used][..., None])
        position_n[used, run] = mean[..., 0]
        root_information[used, run] = np.swapaxes(np.linalg.cholesky(information[used]), 1, 2)
        levers[run] = fixes.lever_arm_b
    return FixGrid(position_n, root_information, levers)
