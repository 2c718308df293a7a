"""What the first pass meets and carries beside the error state: weighted aids, extra variables.

The aids of a keyframe meet the prediction together, as beams do, for one of them judges the others:
met one after the other, a gross one that an uncertain prediction lets pass would have all later
ones refused. What a prediction and its covariance cannot mean starts without weight; the smoother,
which knows the whole mission, judges again. Ranges to a beacon whose place is unknown are left to
:mod:`ssm_graph.graph.beacon_start`, as their linearisation there would mean nothing, and sightings
of features to :mod:`ssm_graph.graph.feature_start`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.similarity import Kernel
from ssm_graph.base.frozen import Array
from ssm_graph.graph.aids.aid import Aid, RowStates
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.graph.beam_rows import BeamRows, CalibratedBeams, PreparedBeams
from ssm_graph.graph.first_weights import GATE, settled_weights
from ssm_graph.graph.measurements import Measurements
from ssm_graph.mission.calibration import CURRENTS
from ssm_graph.mission.imu_variables import GYRO_SCALE
from ssm_graph.mission.problem import Problem

REFUSED = 0.01
"""A smaller weight is none."""
LOCKED_OUT_PLACES = 3
"""After so many fixes, or depths, in a row without weight the prediction is doubted instead."""


class AidsOfKeyframe(NamedTuple):
    """The measurements of one keyframe, linearised at one state: R components of m of them."""

    aids: list[Aid]
    """(m,) of one measurement each"""
    numbers: list[int]
    """(m,) among all measurements"""
    measurement: NDArray[np.intp]
    """(R,) which of the m a component is of"""
    innovation: Array
    """(R,) measured minus predicted, whitened"""
    H: Array
    """(R, width)"""


class ForwardAids:
    """The weighted aids of a problem, keyframe by keyframe."""

    def __init__(self, aids: Measurements) -> None:
        self.weights = np.ones(len(aids))
        """(M,) of all measurements, as far as they have been met"""
        self._refused: dict[str, list[Array]] = {}
        """Innovations of the last measurements of place that were refused in a row, by name"""
        self._at: dict[int, list[tuple[Aid, int]]] = {}
        number = 0
        for aid in aids.all:
            waits = aid.waits
            for i, k in enumerate(aid.keyframe.tolist()):
                if waits is None or not waits[i]:
                    self._at.setdefault(k, []).append((aid.take(slice(i, i + 1)), number))
                number += 1

    def has(self, k: int) -> bool:
        """Return whether a keyframe has measurements to meet."""
        return k in self._at

    def lead(self, k: int, before: RowStates | None, state: RowStates) -> None:
        """Lead those of a keyframe along the way from the state before to that of it."""
        way = None if before is None else before.rows_of_one()
        own = state.rows_of_one()
        self._at[k] = [(aid.led_along(way, own), number) for aid, number in self._at[k]]

    def at(self, k: int, state: RowStates) -> AidsOfKeyframe:
        """Return the measurements of a keyframe that has some, linearised at a state."""
        here, own = self._at[k], state.rows_of_one()
        errors, jacobians = zip(*(aid.whitened(own) for aid, _ in here), strict=True)
        return AidsOfKeyframe(
            aids=[aid for aid, _ in here],
            numbers=[number for _, number in here],
            measurement=np.repeat(np.arange(len(here)), [aid.dim for aid, _ in here]),
            innovation=-np.concatenate(errors, axis=1)[0],
            H=np.concatenate(jacobians, axis=1)[0],
        )

    def weigh(
        self, met: AidsOfKeyframe, innovation: Array, predicted: Array, kernel: Kernel
    ) -> Array:
        """Return the weights (m,) of the measurements, and keep them.

        ``innovation`` (R,) is that at the prediction, ``predicted`` (R, R) the covariance of what
        was predicted, both in the measurements' sigmas.
        """
        weights = settled_weights(innovation, predicted, met.measurement, kernel)
        self.weights[met.numbers] = weights
        return weights

    def locked_out(
        self, met: AidsOfKeyframe, innovation: Array, weights: Array
    ) -> NDArray[np.bool_]:
        """Return which measurements (m,) of place have been refused too often in a row.

        ``innovation`` (R,) is that at the prediction, ``weights`` (m,) what came of them.
        """
        believed = np.zeros(len(weights), bool)
        for i, aid in enumerate(met.aids):
            if not isinstance(aid, Fixes | DepthMeans):
                continue
            refused = self._refused.setdefault(aid.name, [])
            if weights[i] >= REFUSED:
                refused.clear()
                continue
            refused.append(innovation[met.measurement == i])
            believed[i] = len(refused) >= LOCKED_OUT_PLACES
        return believed

    def common_offset(self, met: AidsOfKeyframe, believed: NDArray[np.bool_]) -> float | None:
        """Return how far off the prediction those agree it to be, in sigmas; None if they do not.

        Where they do, it is the place that was wrong; otherwise it may be what led there. What was
        remembered of them is forgotten.
        """
        largest, agree = 0.0, True
        for i in np.flatnonzero(believed):
            refused = np.array(self._refused.pop(met.aids[i].name))
            agree &= bool(np.ptp(refused, axis=0).max() < GATE * np.sqrt(2.0))
            largest = max(largest, float(np.abs(refused).max()))
        return largest if agree else None


REACH_S = 2e-2
REACH_TURN = 2e-2
"""How far clock and mounting, rad, may move before the beams are prepared anew; the rest counts to
first order, within 0.3 mm/s at 1.5 m/s."""


class ForwardExtras:
    """The extra variables of one forward pass, behind the error state in its covariance."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        extras = problem.extras
        self.walks, self.constants = np.zeros(extras.n_walks), np.zeros(extras.n_constants)
        self._beams = CalibratedBeams(problem.beams, extras, problem.frame)
        self._last: PreparedBeams | None = None

    def begin(self, covariance: Array) -> Array:
        """Return the covariance (E, E) at the start from that of the error state."""
        return self._problem.extras.behind(covariance)

    def begin_scale(self, covariance: Array, sigmas: float) -> Array:
        """Take the gyros' scale to be so many prior sigmas off, and return what is known then.

        ``covariance`` (E, E) is that at the start; of the scale half a sigma is left.
        """
        extras = self._problem.extras
        own = extras.columns(GYRO_SCALE)
        at = slice(own.start - extras.state_dim, own.stop - extras.state_dim)
        self.constants[at] = sigmas * np.sqrt(np.diagonal(covariance)[own])
        halved = covariance.copy()
        halved[own, own] *= 0.25
        return halved

    def keep(self, walks: Array, constants: Array) -> None:
        """Take the values (s,) and (C,) that a correction led to."""
        self.walks, self.constants = walks, constants

    def forget_current(self, covariance: Array, variance: float) -> None:
        """Let the current be anything of this variance, (m/s)^2, in place."""
        extras = self._problem.extras
        for name in sorted(CURRENTS):
            if name in extras:
                own = extras.columns(name)
                covariance[own] = 0.0
                covariance[:, own] = 0.0
                covariance[own, own] = variance * np.eye(own.stop - own.start)

    def moved(self, step: Array) -> tuple[Array, Array]:
        """Return walks and constants after the part of a step that is behind the error state."""
        n_walks = len(self.walks)
        return self.walks + step[:n_walks], self.constants + step[n_walks:]

    def beam_rows(
        self, rows: slice, state: tuple[Array, Array, Array, Array], g_n: Array
    ) -> BeamRows:
        """Linearise the beams of one ping, with the columns of all variables."""
        at = RowStates(*state, self.walks, self.constants, self._problem.extras, g_n)
        return self._beams.rows(at, self._prepared(at.bias), rows)

    def _prepared(self, bias: Array) -> PreparedBeams:
        """Return what beams share, made anew where the instrument has moved too far."""
        mounting, late_s = self._beams.instrument_of(self.walks, self.constants)
        last = self._last
        if (
            last is None
            or abs(float(late_s - last.time_offset)) > REACH_S
            or float(np.abs(mounting - last.mounting).max()) > REACH_TURN
        ):
            last = self._last = self._beams.prepare(self.walks, self.constants, bias)
        return last
