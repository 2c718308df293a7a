"""Rows of depth and GNSS, which count in full."""

from __future__ import annotations

import numpy as np

from factors.depth_height import height_residual
from ssm_graph.engine.error_state import POSITION, ROTATION
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.positions import fix_rows
from ssm_graph.graph.aids.rows import AidRows
from ssm_graph.graph.augmented_rows import states_of
from ssm_graph.graph.depth import DepthTargets, depth_targets
from ssm_graph.mission.aids import Depths, Fixes
from ssm_graph.mission.calibration import DEPTH_OFFSET
from ssm_graph.mission.problem import Problem


class DepthAid:
    """Depth, with an offset where one is asked for."""

    name = "depth"
    dim = 1

    def __init__(self, problem: Problem, depths: Depths) -> None:
        self._problem, self._depths = problem, depths
        self._targets: DepthTargets | None = None

    def follow(self, states: States) -> None:
        """Lead the readings along the track of ``states``."""
        problem = self._problem
        self._targets = depth_targets(self._depths, states, problem.frame, problem.keyframe_s)

    def rows(self, states: States) -> AidRows:
        """Return one row for each keyframe with a reading; to be called after :meth:`follow`."""
        assert self._targets is not None
        extras, (k, target_n, up_n, root) = self._problem.extras, self._targets
        offset = extras.value(DEPTH_OFFSET, states.walks[k], states.constants, default=np.zeros(1))[
            ..., 0
        ]
        residual = height_residual(
            states.R_nb[k],
            states.p_n[k],
            lever_arm_b=self._depths.lever_arm_b,
            offset=offset,
            up_n=up_n,
            target_n=target_n,
        )
        jacobian = np.zeros((len(k), extras.width))
        jacobian[:, ROTATION] = residual.error_D_rotation
        jacobian[:, POSITION] = residual.error_D_position
        if DEPTH_OFFSET in extras:
            jacobian[:, extras.columns(DEPTH_OFFSET)] = residual.error_D_offset[:, None]
        return AidRows(k, residual.error * root, jacobian * root[:, None])


class GnssAid:
    """Position fixes, with lever arm and clock in doubt where that is asked for."""

    name = "GNSS"
    dim = 3

    def __init__(self, problem: Problem, fixes: Fixes) -> None:
        self._extras, self._fixes = problem.extras, fixes
        self._whiten = np.linalg.inv(np.linalg.cholesky(fixes.covariance_n))

    def follow(self, states: States) -> None:
        """Do nothing: a fix is where it is."""

    def rows(self, states: States) -> AidRows:
        """Return three rows for each fix."""
        keyframe = self._fixes.keyframe
        at = states_of(states, keyframe, g_n=states.p_n)
        error, jacobian = fix_rows(self._fixes, self._extras, at, np.s_[:])
        return AidRows(
            np.repeat(keyframe, 3),
            (self._whiten @ error[..., None])[..., 0].ravel(),
            (self._whiten @ jacobian).reshape(-1, self._extras.width),
        )
