"""The measurements of one keyframe of many runs, linearised wherever an update asks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from factors.dvl_beam import beam_residual
from factors.so3 import cross
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import GYRO_BIAS, POSITION, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.engine.states import NavigationStates, local_D_deviation
from ssm_graph.filters.rules.update import Iterate, Runs
from ssm_graph.filters.side_by_side import Measurements
from ssm_graph.graph.aids.depth import HeightTrack, height_on_the_way, height_track


@dataclass(frozen=True, slots=True)
class NavigationIterate(Iterate):
    """An iterate that knows its states."""

    states: NavigationStates = field(kw_only=True)

    def take(self, kept: NDArray[np.bool_]) -> NavigationIterate:
        """Return the iterate of some runs."""
        base = Iterate.take(self, kept)
        own = base.xi, base.innovation, base.jacobian, base.local_D_xi
        return NavigationIterate(*own, states=self.states.take(kept))


@final
class KeyframeModel:
    """Beams, depth and position fix of keyframe ``k``, about the predicted states of R runs.

    Rows are the B beams, then the depth, then three of the fix, as far as the keyframe has them;
    depth and fix have an auxiliary parameter each. Fixes of one keyframe are one.

    Parameters
    ----------
    measured : of all keyframes.
    k : the keyframe.
    predicted : its states.
    frame : of navigation.
    beam_groups : (B,) which beams share an auxiliary parameter.
    before : states at the keyframe before, None at the first.
    """

    def __init__(
        self,
        measured: Measurements,
        k: int,
        predicted: NavigationStates,
        *,
        frame: LocalFrame,
        beam_groups: NDArray[np.intp],
        before: NavigationStates | None,
    ) -> None:
        self._measured, self._frame, self._k, self._predicted = measured, frame, k, predicted
        self._root_information = 1.0 / measured.beams.sigma[k]
        self.n_beams = len(beam_groups)
        """B, how many of the rows are beams"""
        present, groups = [self._root_information > 0.0], [beam_groups]
        own_group = int(beam_groups.max(initial=-1)) + 1
        self._depth: _DepthRow | None = None
        if np.any(np.isfinite(measured.depths.depth[k])):
            self._depth = _depth_row(measured, k, predicted, before, frame)
            present.append(self._depth.root_information[:, None] > 0.0)
            groups.append(np.array([own_group]))
        has_fix = measured.fixes.root_information[k].any(axis=(1, 2))
        self._has_fix = bool(np.any(has_fix))
        if self._has_fix:
            present.append(np.repeat(has_fix[:, None], 3, axis=1))
            groups.append(np.full(3, own_group + 1))
        self.present = np.concatenate(present, axis=1)
        self.group = np.concatenate(groups)
        runs = np.arange(len(self.present))
        self.predicted = self._at(predicted, np.zeros((len(runs), STATE_DIM)), runs, None)
        """Before any correction."""

    def at(self, xi: Array) -> NavigationIterate:
        """Return all runs at deviations from their predictions."""
        if not np.any(xi):
            return self.predicted
        runs = np.arange(len(xi))
        return self._at(self._predicted.displaced(xi), xi, runs, local_D_deviation(xi))

    def move(self, iterate: Iterate, step: Array, runs: Runs) -> NavigationIterate:
        """Return where local steps lead."""
        assert isinstance(iterate, NavigationIterate)
        states = iterate.states.moved(step)
        xi = self._predicted.take(runs).deviation_of(states)
        return self._at(states, xi, runs, local_D_deviation(xi))

    def beam_innovations(self) -> Array:
        """Return measured minus predicted beam speeds (R, B) before the update, m/s, or NaN."""
        present = self.present[:, : self.n_beams]
        scale = np.where(present, self._root_information, np.nan)
        return np.asarray(self.predicted.innovation[:, : self.n_beams] / scale)

    def aid_innovations(self) -> Array:
        """Return how far (R, 4) depth and fix miss before the update, m, or NaN.

        The height first, then the fix in navigation axes.
        """
        whitened = np.full((len(self.present), 4), np.nan)
        whitened[:, self._aid_columns] = self.predicted.innovation[:, self.n_beams :]
        found = np.full_like(whitened, np.nan)
        depth = self._depth
        if depth is not None:
            has = depth.root_information > 0.0
            found[has, 0] = whitened[has, 0] / depth.root_information[has]
        if self._has_fix:
            root = self._measured.fixes.root_information[self._k]
            has = root.any(axis=(1, 2))
            found[has, 1:] = np.linalg.solve(root[has], whitened[has, 1:, None])[..., 0]
        return found

    def of_aids(self, per_row: Array) -> Array:
        """Return what rows (R, m) say of depth and fix, (R, 2), or NaN."""
        found = np.full((len(per_row), 4), np.nan)
        own = np.where(self.present, per_row, np.nan)[:, self.n_beams :]
        found[:, self._aid_columns] = own
        return found[:, :2]

    @property
    def _aid_columns(self) -> NDArray[np.intp]:
        """Return where the rows behind the beams are among those of a depth and a fix."""
        has = [self._depth is not None, *[self._has_fix] * 3]
        return np.flatnonzero(has)

    def _at(
        self, states: NavigationStates, xi: Array, runs: Runs, local_D_xi: Array | None
    ) -> NavigationIterate:
        n_rows, end = len(self.group), self.n_beams
        innovation, jacobian = np.zeros((len(runs), n_rows)), np.zeros((len(runs), n_rows, 15))
        self._beam_rows(states, runs, innovation[:, :end], jacobian[:, :end])
        if self._depth is not None:
            self._depth.fill(states, runs, innovation[:, end], jacobian[:, end])
            end += 1
        if self._has_fix:
            self._fix_rows(states, runs, innovation[:, end:], jacobian[:, end:])
        return NavigationIterate(xi, innovation, jacobian, local_D_xi, states=states)

    def _beam_rows(
        self, states: NavigationStates, runs: Runs, innovation: Array, jacobian: Array
    ) -> None:
        beams = self._measured.beams
        residual = beam_residual(
            states.R_nb[:, None],
            states.v_n[:, None],
            states.bias[:, None, 3:],
            speed=beams.speed[self._k, runs],
            gyro_b=beams.gyro_b[self._k, runs, None],
            beam_b=beams.beam_b[self._k, runs],
            lever_arm_b=beams.lever_arm_b[runs, None],
            omega_ie_n=self._frame.omega_ie_n,
        )
        scale = self._root_information[runs]
        innovation[...] = -scale * residual.error
        jacobian[..., ROTATION] = scale[..., None] * residual.error_D_rotation
        jacobian[..., VELOCITY] = scale[..., None] * residual.error_D_velocity_n
        jacobian[..., GYRO_BIAS] = scale[..., None] * residual.error_D_gyro_bias

    def _fix_rows(
        self, states: NavigationStates, runs: Runs, innovation: Array, jacobian: Array
    ) -> None:
        fixes = self._measured.fixes
        root, lever = fixes.root_information[self._k, runs], fixes.lever_arm_b[runs]
        missed = fixes.position_n[self._k, runs] - _sensor(states, lever)
        innovation[...] = (root @ missed[..., None])[..., 0]
        jacobian[..., ROTATION] = root @ cross(lever[:, None], states.R_nb)
        jacobian[..., POSITION] = root @ states.R_nb


class _DepthRow(NamedTuple):
    """The mean of the depth readings since the last keyframe, carried to this one."""

    mean: Array
    """(R,) m, how much higher the sensor is than predicted"""
    root_information: Array
    """(R,) 1/m, zero without a reading"""
    lever_arm_b: Array
    up_n: Array
    sensor_n: Array
    """(R, 3) m, as predicted"""

    def fill(
        self, states: NavigationStates, runs: Runs, innovation: Array, jacobian: Array
    ) -> None:
        """Write the row; a run without a reading gets zeros."""
        mean, scale, lever, up_n, sensor_n = (column[runs] for column in self)
        risen = (up_n * (_sensor(states, lever) - sensor_n)).sum(axis=1)
        innovation[:] = scale * (mean - risen)
        up_b = (up_n[:, None] @ states.R_nb)[:, 0]
        jacobian[:, ROTATION] = scale[:, None] * cross(lever, up_b)
        jacobian[:, POSITION] = scale[:, None] * up_b


def _depth_row(
    measured: Measurements,
    k: int,
    predicted: NavigationStates,
    before: NavigationStates | None,
    frame: LocalFrame,
) -> _DepthRow:
    depths, keyframe_s = measured.depths, measured.keyframe_s

    def track(k: int, states: NavigationStates) -> HeightTrack:
        R_nb, p_n, v_n, _ = states
        at = {"gyro_b": depths.gyro_b[k], "lever_arm_b": depths.lever_arm_b}
        return height_track(frame, R_nb=R_nb, p_n=p_n, v_n=v_n, **at)

    end, reading = track(k, predicted), depths.depth[k]
    sensor = end.height[:, None]
    if before is not None:
        sensor = height_on_the_way(
            _columns(track(k - 1, before)),
            _columns(end),
            elapsed_s=depths.time_s[k] - keyframe_s[k - 1, :, None],
            span_s=(keyframe_s[k] - keyframe_s[k - 1])[:, None],
        )
    is_read = np.isfinite(reading)
    n_readings = is_read.sum(axis=1)
    mean = np.where(is_read, -reading - sensor, 0.0).sum(axis=1) / np.maximum(n_readings, 1)
    root_information = np.sqrt(n_readings) / depths.sigma
    return _DepthRow(mean, root_information, depths.lever_arm_b, end.up_n, end.sensor_n)


def _sensor(states: NavigationStates, lever_arm_b: Array) -> Array:
    return np.asarray(states.p_n + (states.R_nb @ lever_arm_b[..., None])[..., 0])


def _columns(track: HeightTrack) -> HeightTrack:
    """Return heights and climbs as columns, to meet several readings a run."""
    return track._replace(height=track.height[:, None], climb=track.climb[:, None])
