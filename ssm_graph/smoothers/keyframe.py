"""What a window is told of one keyframe: its time, the inertial data and what was measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from factors.inertial import Intervals
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extras
from ssm_graph.mission.calibration import windowed
from ssm_graph.mission.problem import Beams, Problem
from ssm_graph.mission.timeline import Indices


class Sensors(NamedTuple):
    """What is the same at all keyframes of a vehicle."""

    frame: LocalFrame
    dvl_arm_b: Array
    """(3,) m, body origin to instrument, as the next two"""
    depth_arm_b: Array
    gnss_arm_b: Array
    depth_sigma: float
    """m"""
    R_bd: Array
    """(3, 3) mounting, instrument to body"""
    extras: Extras
    """What each keyframe carries beside the error state; all of them walk"""

    @property
    def state_dim(self) -> int:
        """Components of a keyframe's state, n."""
        return self.extras.width


class BeamSpeeds(NamedTuple):
    """Beam speeds of some keyframes, one row each, in order of time."""

    beam: Array
    """(M,) 0 to 3"""
    speed: Array
    """(M,) m/s"""
    sigma: Array
    """(M,) m/s"""
    gyro_b: Array
    """(M, 3) rad/s, mean over the ping"""
    beam_b: Array
    """(M, 3) unit vectors"""
    is_water: Array
    """(M,) 1 off the water, relative to its current, 0 off the ground"""

    @classmethod
    def none(cls) -> BeamSpeeds:
        """Return no rows."""
        none, none_b = np.zeros(0), np.zeros((0, 3))
        return cls(none, none, none, none_b, none_b, none)

    def followed_by(self, other: BeamSpeeds) -> BeamSpeeds:
        """Return these rows, then the others."""
        return BeamSpeeds(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def take(self, rows: slice) -> BeamSpeeds:
        """Return some rows."""
        return BeamSpeeds(*(column[rows] for column in self))


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """One keyframe."""

    time_s: float
    gyro_b: Array
    """(3,) rad/s at the keyframe: it moves the lever arms of depth sensor and antenna"""
    beams: BeamSpeeds
    depth_s: Array
    """(D,) s, readings since the keyframe before"""
    depth: Array
    """(D,) m, positive down"""
    fix_n: Array
    """(F, 3) m, GNSS antenna"""
    fix_cov_n: Array
    """(F, 3, 3) m^2"""
    speed_sigma: float = np.inf
    """m/s, of any vehicle's velocity: all that is known where beams have been silent for long"""
    inertial: Intervals | None = None
    """(1, ...) from the keyframe before; None for the first of all"""

    @property
    def is_measured(self) -> bool:
        """Whether anything but the inertial sensors has seen it."""
        n_measured = len(self.beams.speed) + len(self.depth) + len(self.fix_n)
        return n_measured > 0 or np.isfinite(self.speed_sigma)

    def without(self, name: str) -> Keyframe:
        """Return the keyframe without its ``depth`` or its ``fix``."""
        if name == "depth":
            return replace(self, depth_s=self.depth_s[:0], depth=self.depth[:0])
        return replace(self, fix_n=self.fix_n[:0], fix_cov_n=self.fix_cov_n[:0])

    @classmethod
    def unmeasured(cls, time_s: float, gyro_b: Array, inertial: Intervals | None) -> Keyframe:
        """Return a keyframe as the inertial sensors alone know it."""
        none, no_fix = np.zeros(0), np.zeros((0, 3))
        beams = BeamSpeeds.none()
        return cls(
            time_s, gyro_b, beams, none, none, no_fix, np.zeros((0, 3, 3)), inertial=inertial
        )


def sensors_of(problem: Problem) -> Sensors:
    """Return what is the same at all keyframes of a mission."""
    depths, fixes = problem.depths, problem.fixes
    return Sensors(
        problem.frame,
        problem.beams.lever_arm_b,
        np.zeros(3) if depths is None else depths.lever_arm_b,
        np.zeros(3) if fixes is None else fixes.lever_arm_b,
        np.inf if depths is None else depths.sigma,
        problem.beams.R_bd,
        windowed(problem.extras),
    )


def keyframes_of(problem: Problem) -> Iterator[Keyframe]:
    """Yield the keyframes of a mission in order of time."""
    chain, beams, depths, fixes = problem.chain, problem.beams, problem.depths, problem.fixes
    none = np.zeros(0)
    for k, time_s in enumerate(problem.keyframe_s.tolist()):
        b = _rows_of(k, beams.keyframe)
        d = slice(0, 0) if depths is None else _rows_of(k, depths.keyframe)
        f = slice(0, 0) if fixes is None else _rows_of(k, fixes.keyframe)
        gyro_b = np.zeros(3)
        if depths is not None:
            gyro_b = depths.gyro_b[k]
        elif fixes is not None and f.stop > f.start:
            gyro_b = fixes.gyro_b[f.start]
        yield Keyframe(
            time_s=time_s,
            gyro_b=gyro_b,
            beams=beam_speeds(beams, b),
            depth_s=none if depths is None else depths.time_s[d],
            depth=none if depths is None else depths.depth[d],
            fix_n=np.zeros((0, 3)) if fixes is None else fixes.position_n[f],
            fix_cov_n=np.zeros((0, 3, 3)) if fixes is None else fixes.covariance_n[f],
            inertial=chain.intervals.take(np.s_[k - 1 : k]) if k else None,
        )


def beam_speeds(beams: Beams, rows: slice = np.s_[:]) -> BeamSpeeds:
    """Return some of a problem's beam speeds."""
    return BeamSpeeds(
        beams.beam[rows].astype(float),
        beams.speed[rows],
        beams.sigma[rows],
        beams.gyro_b[rows],
        beams.beam_b[rows],
        beams.is_water[rows].astype(float),
    )


def _rows_of(k: int, keyframe: Indices) -> slice:
    """Return which rows of a table, sorted by ``keyframe``, belong to one."""
    begin, end = np.searchsorted(keyframe, [k, k + 1])
    return slice(int(begin), int(end))
