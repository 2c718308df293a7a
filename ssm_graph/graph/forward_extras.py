"""Extra variables in the forward pass: their values so far, and the rows that depend on them."""

from __future__ import annotations

import numpy as np

from factors.dvl_calibration import Motion
from ssm_graph.data import Array
from ssm_graph.graph.extended_rows import ExtendedBeams, RowStates, fix_rows
from ssm_graph.graph.interfaces import BeamRows
from ssm_graph.problem.calibration import DEPTH_OFFSET, DVL_TIME_OFFSET
from ssm_graph.problem.error_state import STATE_DIM
from ssm_graph.problem.problem import Problem

REACH_S = 2e-3
"""How far a clock may move before the inertial readings at the pings are looked up anew."""


class ForwardExtras:
    """The extra variables of one forward pass, behind the error state in its covariance."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        extras = problem.extras
        self.walks, self.constants = np.zeros(extras.n_walks), np.zeros(extras.n_constants)
        self._beams = ExtendedBeams(problem.beams, extras, problem.frame.omega_ie_n)
        self._walk_factor, self._walk_sigma = extras.transitions(np.diff(problem.keyframe_s))
        self._motion: Motion | None = None
        self._motion_late_s = 0.0

    def begin(self, covariance: Array) -> Array:
        """Return the covariance (E, E) at the start from that of the error state."""
        extras = self._problem.extras
        whole = np.diag(np.concatenate([np.zeros(STATE_DIM), extras.sigma**2]))
        whole[:STATE_DIM, :STATE_DIM] = covariance
        return whole

    def predict(self, k: int, covariance: Array) -> None:
        """Let the walks go on from keyframe ``k``, in place."""
        if len(self.walks) == 0:
            return
        factor, end = self._walk_factor[k], STATE_DIM + len(self.walks)
        self.walks = factor * self.walks
        covariance[STATE_DIM:end] *= factor[:, None]
        covariance[:, STATE_DIM:end] *= factor
        own = np.arange(STATE_DIM, end)
        covariance[own, own] += self._walk_sigma[k] ** 2

    def correct(self, step: Array) -> None:
        """Take the part of a step that is behind the error state."""
        self.walks = self.walks + step[: len(self.walks)]
        self.constants = self.constants + step[len(self.walks) :]

    def beam_rows(
        self, rows: slice, state: tuple[Array, Array, Array, Array], g_n: Array
    ) -> BeamRows:
        """Linearise the beams of one ping, with the columns of all variables."""
        at = RowStates(*state, self.walks, self.constants, g_n)
        if DVL_TIME_OFFSET in self._problem.extras:
            self._look_up()
        return self._beams.rows(at, rows, motion=self._motion, motion_late_s=self._motion_late_s)

    def fix_rows(
        self, i: int, state: tuple[Array, Array, Array, Array], g_n: Array
    ) -> tuple[Array, Array]:
        """Return innovation (3,), m, and Jacobian (3, E) of one fix."""
        fixes = self._problem.fixes
        assert fixes is not None
        at = RowStates(*state, self.walks, self.constants, g_n)
        error, jacobian = fix_rows(fixes, self._problem.extras, at, i)
        return -error, jacobian

    def depth_row(self, H: Array, innovation: float) -> tuple[Array, float]:
        """Return a depth's row (1, E) and innovation, m, from those of the error state."""
        extras = self._problem.extras
        wide = np.zeros((1, extras.width))
        wide[:, :STATE_DIM] = H
        if DEPTH_OFFSET in extras:
            wide[:, extras.columns(DEPTH_OFFSET)] = -1.0
            value = extras.value(DEPTH_OFFSET, self.walks, self.constants, default=np.zeros(1))
            innovation += float(value[0])
        return wide, innovation

    def _look_up(self) -> None:
        offset = self._problem.extras.value(
            DVL_TIME_OFFSET, self.walks, self.constants, default=np.zeros(1)
        )
        late_s = float(offset[0])
        if self._motion is None or abs(late_s - self._motion_late_s) > REACH_S:
            self._motion, self._motion_late_s = self._beams.motion(late_s), late_s
