"""The measurements of one keyframe of many runs, linearised wherever an update asks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

from factors.dvl_beam import beam_residual
from factors.so3 import cross
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import GYRO_BIAS, POSITION, ROTATION, STATE_DIM, VELOCITY
from ssm_graph.engine.states import NavigationStates, local_D_deviation
from ssm_graph.filters.navigation.stack import Stack
from ssm_graph.filters.rules.model import NOMINAL, Iterate, Runs
from ssm_graph.graph.aids.heights import HeightTrack, height_on_the_way, height_track
from ssm_graph.sensors.dvl import N_BEAMS


@dataclass(frozen=True, slots=True)
class NavigationIterate(Iterate):
    """An iterate that knows its states."""

    states: NavigationStates = field(kw_only=True)

    def take(self, kept: NDArray[np.bool_]) -> NavigationIterate:
        """Return the iterate of some runs."""
        base = Iterate.take(self, kept)
        return NavigationIterate(
            base.xi,
            base.innovation,
            base.jacobian,
            base.local_D_xi,
            states=self.states.take(kept),
        )


@final
class KeyframeModel:
    """Beams, depth and GNSS of keyframe ``k``, about the predicted states of B runs.

    Rows are the four beams, then the depth, then three of GNSS, as far as the keyframe has them.
    """

    def __init__(
        self,
        stack: Stack,
        k: int,
        predicted: NavigationStates,
        *,
        beam_groups: NDArray[np.intp],
        before: NavigationStates | None,
    ) -> None:
        self._stack, self._k, self._predicted = stack, k, predicted
        has_beam = stack.beams.root_information[k] > 0.0
        present, groups = [has_beam], [beam_groups]
        self._depth = _DepthRow(stack, k, predicted, before) if _has_depth(stack, k) else None
        if self._depth is not None:
            present.append(self._depth.root_information[:, None] > 0.0)
            groups.append(np.array([NOMINAL]))
        self._has_fix = stack.fixes is not None and bool(np.any(stack.fixes.root_information[k]))
        if self._has_fix:
            assert stack.fixes is not None
            has_fix = stack.fixes.root_information[k].any(axis=(1, 2))
            present.append(np.repeat(has_fix[:, None], 3, axis=1))
            groups.append(np.full(3, NOMINAL))
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

    def _at(
        self, states: NavigationStates, xi: Array, runs: Runs, local_D_xi: Array | None
    ) -> NavigationIterate:
        n_rows = len(self.group)
        innovation, jacobian = np.zeros((len(runs), n_rows)), np.zeros((len(runs), n_rows, 15))
        self._beam_rows(states, runs, innovation, jacobian)
        end = N_BEAMS
        if self._depth is not None:
            self._depth.fill(states, runs, innovation[:, end], jacobian[:, end])
            end += 1
        if self._has_fix:
            self._fix_rows(states, runs, innovation[:, end:], jacobian[:, end:])
        return NavigationIterate(xi, innovation, jacobian, local_D_xi, states=states)

    def _beam_rows(
        self, states: NavigationStates, runs: Runs, innovation: Array, jacobian: Array
    ) -> None:
        beams = self._stack.beams
        residual = beam_residual(
            states.R_nb[:, None],
            states.v_n[:, None],
            states.bias[:, None, 3:],
            speed=beams.speed[self._k, runs],
            gyro_b=beams.gyro_b[self._k, runs],
            beam_b=beams.beam_b[runs],
            lever_arm_b=beams.lever_arm_b[runs],
            omega_ie_n=beams.omega_ie_n,
        )
        scale = beams.root_information[self._k, runs]
        innovation[:, :N_BEAMS] = -scale * residual.error
        rows, scale = jacobian[:, :N_BEAMS], scale[..., None]
        rows[..., ROTATION] = scale * residual.error_D_rotation
        rows[..., VELOCITY] = scale * residual.error_D_velocity_n
        rows[..., GYRO_BIAS] = scale * residual.error_D_gyro_bias

    def _fix_rows(
        self, states: NavigationStates, runs: Runs, innovation: Array, jacobian: Array
    ) -> None:
        fixes = self._stack.fixes
        assert fixes is not None
        root, lever = fixes.root_information[self._k, runs], fixes.lever_arm_b[runs]
        antenna = states.p_n + (states.R_nb @ lever[..., None])[..., 0]
        missed = fixes.position_n[self._k, runs] - antenna
        innovation[...] = (root @ missed[..., None])[..., 0]
        jacobian[..., ROTATION] = root @ cross(lever[:, None], states.R_nb)
        jacobian[..., POSITION] = root @ states.R_nb


def _has_depth(stack: Stack, k: int) -> bool:
    return stack.depths is not None and bool(np.any(stack.depths.counts[k]))


class _DepthRow:
    """The mean of the depth readings since the last keyframe, carried to this one."""

    def __init__(
        self, stack: Stack, k: int, predicted: NavigationStates, before: NavigationStates | None
    ) -> None:
        assert stack.depths is not None
        depths = stack.depths
        end = _track(stack, k, predicted)
        counts, height = depths.counts[k], depths.height[k]
        too_low = height - end.height[:, None]
        if before is not None:
            too_low = height - height_on_the_way(
                _columns(_track(stack, k - 1, before)),
                _columns(end),
                elapsed_s=depths.elapsed_s[k],
                span_s=stack.span_s[k - 1][:, None],
            )
        n_readings = counts.sum(axis=1)
        self.mean = (counts * too_low).sum(axis=1) / np.maximum(n_readings, 1.0)
        self.root_information = np.sqrt(n_readings) / depths.sigma
        self.lever_arm_b, self.up_n = depths.lever_arm_b, end.up_n
        self.sensor_n = end.sensor_n

    def fill(
        self, states: NavigationStates, runs: Runs, innovation: Array, jacobian: Array
    ) -> None:
        """Write the row; a run without a reading gets zeros."""
        up_n, scale, lever = self.up_n[runs], self.root_information[runs], self.lever_arm_b[runs]
        risen = (up_n * (_sensor(states, lever) - self.sensor_n[runs])).sum(axis=1)
        innovation[:] = scale * (self.mean[runs] - risen)
        up_b = (up_n[:, None] @ states.R_nb)[:, 0]
        jacobian[:, ROTATION] = scale[:, None] * cross(lever, up_b)
        jacobian[:, POSITION] = scale[:, None] * up_b


def _sensor(states: NavigationStates, lever_arm_b: Array) -> Array:
    return np.asarray(states.p_n + (states.R_nb @ lever_arm_b[..., None])[..., 0])


def _track(stack: Stack, k: int, states: NavigationStates) -> HeightTrack:
    assert stack.depths is not None
    return height_track(
        stack.frame,
        R_nb=states.R_nb,
        p_n=states.p_n,
        v_n=states.v_n,
        gyro_b=stack.depths.gyro_b[k],
        lever_arm_b=stack.depths.lever_arm_b,
    )


def _columns(track: HeightTrack) -> HeightTrack:
    """Return heights and climbs as columns, to meet several readings a run."""
    return track._replace(height=track.height[:, None], climb=track.climb[:, None])
