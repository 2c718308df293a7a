"""The window with calibration and without lag, written a second time: gains and covariances.

Drifts, constants and the current are states behind the fifteen. What it shares with the window are
the residuals in :mod:`factors`, the preintegrated data, the cubic in height between keyframes, and
what is stated of each variable: its prior sigma, and how it walks. Prediction and update are those
of the filters in NumPy; all rows and the walks are written here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from factors.depth_height import height_residual
from factors.dvl_calibration import calibrated_beam_residual, no_way_back, turned_instrument
from factors.gnss_position import fix_residual
from factors.water_track import through_water
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    STATE_DIM,
    VELOCITY,
)
from ssm_graph.engine.extras import Extra
from ssm_graph.engine.states import NavigationStates, States, local_D_deviation
from ssm_graph.filters.navigation.filter import Process
from ssm_graph.filters.rules.ssm import SsmUpdate
from ssm_graph.filters.rules.update import Iterate, Runs
from ssm_graph.graph.aids.depth import DEPTH_OFFSET, HeightTrack, height_on_the_way, height_track
from ssm_graph.graph.aids.gnss import GNSS_DRIFT, GNSS_LEVER_ARM, GNSS_TIME_OFFSET
from ssm_graph.mission.calibration import (
    CURRENT,
    CURRENT_UP,
    DVL_BEAM_SCALE,
    DVL_DRIFT,
    DVL_MOUNTING,
    DVL_SCALE,
    windowed,
)
from ssm_graph.mission.problem import Problem, start_of, with_white_noise


class AugmentedHistory(NamedTuple):
    """Posteriors of one run at K keyframes, and the weights of its M beam speeds."""

    states: States
    """(K, ...)"""
    covariance: Array
    """(K, 15 + E, 15 + E)"""
    weight: Array
    """(M,)"""
    n_iterations: Array
    """(K,)"""


class Variables:
    """The extra variables of a problem as states."""

    def __init__(self, problem: Problem) -> None:
        stated = {block.name: block for block in problem.extras.blocks}
        self._blocks = [stated[block.name] for block in windowed(problem.extras).blocks]
        ends = np.cumsum([len(block.sigma) for block in self._blocks], dtype=int).tolist()
        begins = [0, *ends[:-1]]
        names = [block.name for block in self._blocks]
        self._at = {n: slice(*ab) for n, *ab in zip(names, begins, ends, strict=True)}
        self.sigma = np.concatenate([block.sigma for block in self._blocks])
        """(E,) of their priors"""

    def value(self, name: str, extra: Array, size: int) -> Array:
        """Return a variable out of all (E,); zeros for one that is not estimated."""
        return extra[self._at[name]] if name in self._at else np.zeros(size)

    def fill(self, H: Array, name: str, block: Array) -> None:
        """Write the columns of a variable into rows (..., 15 + E), if it is estimated."""
        if name in self._at:
            at = self._at[name]
            H[..., STATE_DIM + at.start : STATE_DIM + at.stop] = block

    def walk(self, span_s: float) -> tuple[Array, Array]:
        """Return factors and variances (E,) of how all of them go on."""
        steps = [_walk(block, span_s) for block in self._blocks]
        factor, variance = zip(*steps, strict=True)
        sizes = [len(block.sigma) for block in self._blocks]
        return np.repeat(np.array(factor), sizes), np.concatenate(variance)


def _walk(block: Extra, span_s: float) -> tuple[float, Array]:
    size = len(block.sigma)
    if not block.is_walk:  # it may wander by a thousandth of its sigma in an hour
        return 1.0, np.full(size, (1e-3 * block.sigma[0]) ** 2 * span_s / 3600.0)
    density_sq = np.broadcast_to(block.walk_density, size) ** 2
    if math.isinf(block.correlation_s):
        return 1.0, density_sq * span_s
    kept = math.exp(-span_s / block.correlation_s)
    return kept, density_sq * block.correlation_s * (1.0 - kept**2) / 2.0


@dataclass(frozen=True, slots=True)
class _Iterate(Iterate):
    """An iterate of one run that knows its states."""

    states: States = field(kw_only=True)


def filter_augmented(problem: Problem, rule: SsmUpdate) -> AugmentedHistory:
    """Filter one run, its calibrations, drifts and current with it."""
    problem = with_white_noise(problem)
    variables, start = Variables(problem), start_of(problem)
    process = Process([problem.chain.intervals], problem.frame)
    states = States.at_start(start)._replace(walks=np.zeros((1, len(variables.sigma))))
    P = _both(start.covariance, np.diag(variables.sigma**2))
    before: States | None = None
    found, covariances, n_iterations = [], [], []
    weight = np.ones(len(problem.beams.speed))
    for k in range(problem.n_keyframes):
        if k > 0:
            before = states
            ahead = process.predict(k - 1, states.navigation)
            factor, variance = variables.walk(float(np.diff(problem.keyframe_s)[k - 1]))
            states = States(*ahead.states, factor * states.walks)
            F = _both(ahead.transition[0], np.diag(factor))
            P = F @ P @ F.T + _both(ahead.process_cov[0], np.diag(variance))
        model = _KeyframeModel(problem, variables, k, states, before)
        n_iterations.append(0)
        if len(model.group):
            update = rule(P[None], model)
            states, P = displaced(states, update.xi), update.covariance[0]
            weight[model.beams] = update.weights[0, : len(weight[model.beams])]
            n_iterations[-1] = int(update.n_iterations[0])
        found.append(states)
        covariances.append(P)
    states = found[0].followed_by(*found[1:])
    return AugmentedHistory(states, np.array(covariances), weight, np.array(n_iterations))


def displaced(states: States, xi: Array) -> States:
    """Return the states at deviations (B, 15 + E)."""
    own = states.navigation.displaced(xi[:, :STATE_DIM])
    return States(*own, states.walks + xi[:, STATE_DIM:])


def deviation_of(states: States, other: States) -> Array:
    """Return how far other states are (B, 15 + E)."""
    own = states.navigation.deviation_of(other.navigation)
    return np.hstack([own, other.walks - states.walks])


def _both(own: Array, extra: Array) -> Array:
    n = STATE_DIM + len(extra)
    whole = np.zeros((n, n))
    whole[:STATE_DIM, :STATE_DIM], whole[STATE_DIM:, STATE_DIM:] = own, extra
    return whole


@final
class _KeyframeModel:
    """The measurements of keyframe ``k`` about the prediction: beams, then depth, then GNSS."""

    def __init__(
        self,
        problem: Problem,
        variables: Variables,
        k: int,
        predicted: States,
        before: States | None,
    ) -> None:
        self._problem, self._variables, self._predicted = problem, variables, predicted
        self.beams = np.flatnonzero(problem.beams.keyframe == k)
        """Rows of the problem's beams"""
        depths, fixes = problem.depths, problem.fixes
        none = np.zeros(0, np.intp)
        self._depths = none if depths is None else np.flatnonzero(depths.keyframe == k)
        self._fixes = none if fixes is None else np.flatnonzero(fixes.keyframe == k)
        rows = [1] * min(len(self._depths), 1) + [3] * len(self._fixes)
        of_aids = np.repeat(len(self.beams) + np.arange(len(rows)), rows)
        self.group = np.append(np.arange(len(self.beams)), of_aids)
        self.present = np.ones((1, len(self.group)), bool)
        if len(self._depths):
            self._lead_depths(k, before)

    def at(self, xi: Array) -> _Iterate:
        """Return the run at a deviation (1, 15 + E) from its prediction."""
        return self._iterate(displaced(self._predicted, xi), xi)

    def move(self, iterate: Iterate, step: Array, runs: Runs) -> _Iterate:  # noqa: ARG002
        """Return where a local step leads."""
        assert isinstance(iterate, _Iterate)
        states = iterate.states.moved(step)
        return self._iterate(states, deviation_of(self._predicted, states))

    def _iterate(self, states: States, xi: Array) -> _Iterate:
        at = NavigationStates(*(column[0] for column in states.navigation))
        parts = [self._beam_rows(at, states.walks[0])]
        if len(self._depths):
            parts.append(self._depth_row(at, states.walks[0]))
        parts += [self._fix_rows(at, states.walks[0], i) for i in self._fixes.tolist()]
        errors, rows = zip(*parts, strict=True)
        return _Iterate(
            xi,
            -np.concatenate(errors)[None],
            np.concatenate(rows)[None],
            local_D_deviation(xi[:, :STATE_DIM]),
            states=states,
        )

    def _rows(self, count: int) -> Array:
        return np.zeros((count, STATE_DIM + len(self._variables.sigma)))

    def _beam_rows(self, at: NavigationStates, extra: Array) -> tuple[Array, Array]:
        own, beams, frame = self.beams, self._problem.beams, self._problem.frame
        variables, H = self._variables, self._rows(len(self.beams))
        level = variables.value(CURRENT, extra, 2)
        current_l = np.append(level, variables.value(CURRENT_UP, extra, 1))
        relative = through_water(
            at.v_n, current_l, R_nl=frame.R_nl_at(at.p_n), is_water=beams.is_water[own]
        )
        beam_b = beams.beam_b[own]
        of_beam = variables.value(DVL_BEAM_SCALE, extra, beams.n_beams)[beams.beam[own]]
        residual = calibrated_beam_residual(
            at.R_nb,
            relative.v_n,
            at.bias,
            instrument=turned_instrument(
                variables.value(DVL_MOUNTING, extra, 3),
                beam_b,
                R_bd=beams.R_bd,
                lever_arm_b=beams.lever_arm_b,
            ),
            scale=variables.value(DVL_SCALE, extra, 1) + of_beam,
            back=no_way_back(beams.gyro_b[own]),
            speed=beams.speed[own],
            omega_ie_n=frame.omega_ie_n,
            g_n=np.zeros(3),
        )
        H[:, ROTATION], H[:, VELOCITY] = residual.error_D_rotation, residual.error_D_velocity_n
        H[:, ACCEL_BIAS], H[:, GYRO_BIAS] = residual.error_D_accel_bias, residual.error_D_gyro_bias
        variables.fill(H, DVL_MOUNTING, residual.error_D_mounting)
        variables.fill(H, DVL_SCALE, residual.error_D_scale[:, None])
        one_hot = np.eye(beams.n_beams)[beams.beam[own]]
        variables.fill(H, DVL_BEAM_SCALE, one_hot * residual.error_D_scale[:, None])
        by_current = np.einsum("mi,mij->mj", residual.error_D_velocity_n, relative.v_D_current)
        variables.fill(H, CURRENT, by_current[:, :2])
        variables.fill(H, CURRENT_UP, by_current[:, 2:])
        beam_d = beam_b @ beams.R_bd
        variables.fill(H, DVL_DRIFT, beam_d)
        error = residual.error + beam_d @ variables.value(DVL_DRIFT, extra, 3)
        return error / beams.sigma[own], H / beams.sigma[own, None]

    def _lead_depths(self, k: int, before: States | None) -> None:
        """Lead the mean of the readings since the keyframe before to where it puts the sensor."""
        depths = self._problem.depths
        assert depths is not None
        end = self._sensor_track(k, self._predicted)
        when_read = end.height
        if before is not None:
            begin_s, end_s = self._problem.keyframe_s[k - 1 : k + 1]
            when_read = height_on_the_way(
                self._sensor_track(k - 1, before),
                end,
                elapsed_s=depths.time_s[self._depths] - begin_s,
                span_s=end_s - begin_s,
            )
        too_low = np.mean(-depths.depth[self._depths] - when_read)
        self._up_n, self._sensor_n = end.up_n, end.sensor_n + too_low * end.up_n

    def _sensor_track(self, k: int, states: States) -> HeightTrack:
        depths = self._problem.depths
        assert depths is not None
        return height_track(
            self._problem.frame,
            R_nb=states.R_nb[0],
            p_n=states.p_n[0],
            v_n=states.v_n[0],
            gyro_b=depths.gyro_b[k],
            lever_arm_b=depths.lever_arm_b,
        )

    def _depth_row(self, at: NavigationStates, extra: Array) -> tuple[Array, Array]:
        depths, H = self._problem.depths, self._rows(1)
        assert depths is not None
        residual = height_residual(
            at.R_nb,
            at.p_n,
            lever_arm_b=depths.lever_arm_b,
            offset=self._variables.value(DEPTH_OFFSET, extra, 1),
            up_n=self._up_n,
            target_n=self._sensor_n,
        )
        H[:, ROTATION], H[:, POSITION] = residual.error_D_rotation, residual.error_D_position
        self._variables.fill(H, DEPTH_OFFSET, residual.error_D_offset[:, None])
        sigma = depths.sigma / math.sqrt(len(self._depths))
        return residual.error / sigma, H / sigma

    def _fix_rows(self, at: NavigationStates, extra: Array, i: int) -> tuple[Array, Array]:
        fixes, variables, H = self._problem.fixes, self._variables, self._rows(3)
        assert fixes is not None
        residual = fix_residual(
            at.R_nb,
            at.p_n,
            at.v_n,
            lever_arm_b=fixes.lever_arm_b + variables.value(GNSS_LEVER_ARM, extra, 3),
            time_offset=variables.value(GNSS_TIME_OFFSET, extra, 1)[0],
            omega_b=fixes.gyro_b[i] - at.bias[3:],
            position_n=fixes.position_n[i],
        )
        H[:, ROTATION], H[:, POSITION] = residual.error_D_rotation, residual.error_D_position
        H[:, VELOCITY] = residual.error_D_velocity_n
        variables.fill(H, GNSS_LEVER_ARM, residual.error_D_lever_arm_b)
        variables.fill(H, GNSS_TIME_OFFSET, residual.error_D_time_offset[:, None])
        variables.fill(H, GNSS_DRIFT, np.eye(3))
        error = residual.error + variables.value(GNSS_DRIFT, extra, 3)
        whiten = np.linalg.inv(np.linalg.cholesky(fixes.covariance_n[i]))
        return whiten @ error, whiten @ H
