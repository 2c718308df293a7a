"""The inertial data of a window, and the walks along them, as whitened rows."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.states import AugmentedStates
from ssm_graph.graph.inertial_rows import carried_covariance, pair_rows
from ssm_graph.imu.preintegration import gravity_gradient, gtsam_gravity
from ssm_graph.mission.problem import NO_EXTRAS
from ssm_graph.smoothers.keyframe import Keyframe, Way

_KEYS = tuple((X(i), V(i), B(i)) for i in (0, 1))


class InertialRows:
    """GTSAM's inertial factors, linearised one by one.

    They go from even to odd keyframes and back, so that each state enters GTSAM's values once.
    """

    def __init__(self, frame: LocalFrame, extras: Extras = NO_EXTRAS) -> None:
        """Take the frame, and the extra variables that states carry; all of them walk."""
        self._frame, self._extras = frame, extras
        self._gradient = gravity_gradient(frame)
        self._values = gtsam.Values()
        for pose, velocity, bias in _KEYS:
            self._values.insert(pose, pose3=gtsam.Pose3())
            self._values.insert(velocity, np.zeros(3))
            self._values.insert(bias, constant_bias=gtsam.imuBias.ConstantBias())

    def predict(self, keyframe: Keyframe, last: AugmentedStates) -> AugmentedStates:
        """Return the state (1, ...) of a new keyframe from that of the last one."""
        way = _way(keyframe)
        R_nb, p_n, v_n, bias, _ = (column[0] for column in last)
        middle = p_n + 0.5 * way.measured.deltaTij() * v_n
        way.params.n_gravity = gtsam_gravity(self._frame, middle)
        predicted = way.measured.predict(
            gtsam.NavState(gtsam.Rot3(R_nb), p_n, v_n),
            gtsam.imuBias.ConstantBias(bias[:3], bias[3:]),
        )
        extra = last.extra
        if self._extras:
            extra = extra * self._transition([keyframe])[0]
        return AugmentedStates(
            predicted.attitude().matrix()[None],
            predicted.position()[None],
            predicted.velocity()[None],
            last.bias,
            extra,
        )

    def carry(
        self,
        keyframe: Keyframe,
        last: AugmentedStates,
        predicted: AugmentedStates,
        covariance: Array,
    ) -> Array:
        """Return the covariance (n, n) at a predicted keyframe from that of the last one."""
        (pair,) = self._pairs([keyframe], last.followed_by(predicted))
        carried = carried_covariance(pair, covariance)
        if self._extras:
            (factor,), (sigma,) = self._transition([keyframe])
            carried[STATE_DIM:] *= factor[:, None]
            carried[:, STATE_DIM:] *= factor
            carried[STATE_DIM:, STATE_DIM:] += np.diag(sigma**2)
        return carried

    def set_gravity(self, ends: Sequence[Keyframe], states: AugmentedStates) -> None:
        """Let gravity of the intervals before ``ends`` follow the states (1 + len(ends), ...)."""
        gravity = gtsam_gravity(self._frame, 0.5 * (states.p_n[:-1] + states.p_n[1:]))
        for keyframe, g_n in zip(ends, gravity, strict=True):
            _way(keyframe).params.n_gravity = g_n

    def rows(self, ends: Sequence[Keyframe], states: AugmentedStates) -> list[Array]:
        """Return the rows (n, 2 n + 1) of the intervals before ``ends``, successive keyframes.

        ``states`` are those of ``ends``, and of the keyframe before the first.
        """
        pairs = self._pairs(ends, states)
        return self._with_walks(pairs, ends, states.extra) if self._extras else pairs

    def _with_walks(
        self, pairs: Sequence[Array], ends: Sequence[Keyframe], extra: Array
    ) -> list[Array]:
        """Return inertial rows (15, 31) with the columns and the rows of the walks."""
        n = self._extras.width
        begin, end, b = np.split(np.array(pairs), [STATE_DIM, 2 * STATE_DIM], axis=2)
        wide = np.zeros((len(pairs), n, 2 * n + 1))
        wide[:, :STATE_DIM, :STATE_DIM], wide[:, :STATE_DIM, -1] = begin, b[..., 0]
        wide[:, :STATE_DIM, n : n + STATE_DIM] = end
        factor, sigma = self._transition(ends)
        own = np.arange(STATE_DIM, n)
        wide[:, own, own], wide[:, own, n + own] = -factor / sigma, 1.0 / sigma
        wide[:, own, -1] = (factor * extra[:-1] - extra[1:]) / sigma
        return list(wide)

    def _transition(self, ends: Sequence[Keyframe]) -> tuple[Array, Array]:
        """Return factors and sigmas (I, E) of the walks over the intervals before ``ends``."""
        span_s = np.array([_way(keyframe).measured.deltaTij() for keyframe in ends])
        return self._extras.transitions(span_s)

    def _pairs(self, ends: Sequence[Keyframe], states: AugmentedStates) -> list[Array]:
        """Return the rows (15, 31) of the inertial factors alone."""
        poses = np.tile(np.eye(4), (len(ends) + 1, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = states.R_nb, states.p_n
        self._put(0, poses[0], states.v_n[0], states.bias[0])
        rows = []
        for i, keyframe in enumerate(ends, start=1):
            (x_i, v_i, b_i), (x_j, v_j, b_j) = _KEYS[(i - 1) % 2], _KEYS[i % 2]
            self._put(i % 2, poses[i], states.v_n[i], states.bias[i])
            factor = gtsam.GalileanCombinedImuFactor(
                x_i, v_i, x_j, v_j, b_i, b_j, _way(keyframe).measured
            )
            rows.append(
                pair_rows(
                    factor,
                    self._values,
                    self._gradient,
                    omega_ie_n=self._frame.omega_ie_n,
                    R_begin=states.R_nb[i - 1],
                    R_end=states.R_nb[i],
                    span_s=float(_way(keyframe).measured.deltaTij()),
                )
            )
        return rows

    def _put(self, which: int, pose: Array, v_n: Array, bias: Array) -> None:
        x, v, b = _KEYS[which]
        self._values.update(x, pose3=gtsam.Pose3(pose))
        self._values.update(v, v_n)
        self._values.update(b, constant_bias=gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))


def _way(keyframe: Keyframe) -> Way:
    assert keyframe.way is not None  # only the first of all has none, and nothing leads to it
    return keyframe.way
