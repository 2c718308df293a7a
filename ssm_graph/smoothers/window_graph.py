"""The graph of a window: its keyframes, their rows where they were linearised, and their chain."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Self

import numpy as np
from scipy.linalg import solve_triangular

from factors.inertial import Intervals
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.chain import Chain
from ssm_graph.engine.error_state import InitialMoments
from ssm_graph.engine.marginal_prior import MarginalPrior, prior_at_start, prior_on
from ssm_graph.engine.states import States
from ssm_graph.graph.inertial_rows import InertialRows
from ssm_graph.smoothers.bends import bends_of
from ssm_graph.smoothers.keyframe import BeamSpeeds, Keyframe, Sensors
from ssm_graph.smoothers.keyframe_arrays import pack_keyframes, unpack_keyframes
from ssm_graph.smoothers.window_rows import (
    DepthTargets,
    beam_rows,
    depth_rows,
    depth_targets,
    fix_rows,
    no_rows,
    seen_by_beams,
    speed_rows,
)


def inertial_data(keyframes: Sequence[Keyframe]) -> Intervals:
    """Return the inertial data before keyframes, none of which is the first of all."""
    return Intervals.joined([k.inertial for k in keyframes if k.inertial is not None])


class WindowGraph:
    """Successive keyframes, each linearised at a state of its own, and the prior on the first.

    Arrays are replaced, never written into, so that a copy costs no more than its lists.
    """

    def __init__(self, sensors: Sensors, first: Keyframe, start: InitialMoments) -> None:
        self.sensors = sensors
        self.keyframes: list[Keyframe] = []
        self.at = States.at_start(start)
        """Where each keyframe is linearised"""
        self.beams = BeamSpeeds.none()
        self.state_dim = n = sensors.state_dim
        self.error, self.jacobian = np.zeros(0), np.zeros((0, n))
        """Of the beams, (M,) in m/s and (M, n)"""
        self.inertial = InertialRows(sensors.frame, sensors.extras)
        self.chain = Chain(n)
        self.prior: MarginalPrior = prior_at_start(start)
        self._depths: list[Array] = []
        self._fixes: list[Array] = []
        self._speeds: list[Array] = []
        self._between: list[Array] = []
        self._targets = depth_targets(sensors, [first], self.at, first_rise=0.0)
        self._stale = 0
        self.first_row = np.zeros(1, np.intp)
        """(K + 1,) where the beams of each keyframe begin, and where they end"""
        self.bends, self.seen_by_beams = bends_of(sensors.extras), seen_by_beams(sensors)
        self._measure(first)

    def successor(self) -> Self:
        """Return a graph that goes its own way from here, and takes the chain along."""
        twin = copy.copy(self)
        for name in ("keyframes", "_depths", "_fixes", "_speeds", "_between"):
            setattr(twin, name, getattr(self, name).copy())
        self.chain, self._stale = self.chain.successor(), 0
        return twin

    def pack(self) -> dict[str, Array]:
        """Return all that :meth:`unpack` needs to go on from here, as plain arrays."""
        n = self.state_dim
        return {
            **{f"at_{name}": column for name, column in self.at._asdict().items()},
            **{f"prior_{name}": column for name, column in self.prior._asdict().items()},
            **{f"target_{name}": column for name, column in self._targets._asdict().items()},
            **pack_keyframes(self.keyframes),
            "root": self.chain.root,
            "between": np.array(self._between).reshape(-1, n, 2 * n + 1),
        }

    @classmethod
    def unpack(
        cls,
        arrays: Mapping[str, Array],
        sensors: Sensors,
        inertial: Callable[[float, float], Intervals],
    ) -> Self:
        """Return the graph that was packed; ``inertial`` gives the data between two times."""
        keyframes = unpack_keyframes(arrays, inertial)
        at = States(*(arrays[f"at_{name}"] for name in States._fields))
        n, packed = sensors.state_dim, len(arrays["root"])
        if packed != n:
            raise DataError(
                f"checkpoint: expected keyframes of {n} states, what the vehicle asks to estimate, "
                f"got {packed}; it needs the vehicle that it was written with"
            )
        graph = cls(sensors, keyframes[0], at.moments(np.eye(n)))
        graph.keyframes, graph.at = keyframes, at
        graph.prior = MarginalPrior(*(arrays[f"prior_{n}"] for n in MarginalPrior._fields))
        graph._targets = DepthTargets(*(arrays[f"target_{n}"] for n in DepthTargets._fields))
        for keyframe in keyframes[1:]:
            graph.beams = graph.beams.followed_by(keyframe.beams)
        counts = [len(keyframe.beams.speed) for keyframe in keyframes]
        graph.first_row = np.append(0, np.cumsum(counts, dtype=np.intp))
        graph._between = list(arrays["between"])
        graph.chain = Chain(n, root=arrays["root"])
        graph.error = np.zeros(graph.first_row[-1])
        graph.jacobian = np.zeros((len(graph.error), n))
        graph._depths, graph._fixes, graph._speeds = [], [], []
        graph._measure_again(0, len(keyframes))
        return graph

    def changed_from(self, keyframe: int) -> None:
        """Have the chain eliminated again from a keyframe on."""
        self._stale = min(self._stale, keyframe)

    def append(self, keyframe: Keyframe, last: States) -> None:
        """Add a keyframe where the inertial data lead from ``last`` (1, ...), the newest one."""
        interval = inertial_data([keyframe])
        ahead = self.inertial.predict(interval, last)
        predicted, at = ahead.states, self.at.take(np.s_[-1:])
        self.at = self.at.followed_by(predicted)
        if at.is_same(last):
            self._between += list(ahead.rows(last))
        else:
            self._between += list(self.inertial.rows(interval, self.at.take(np.s_[-2:])))
        self.changed_from(len(self.keyframes) - 1)
        pair = [self.keyframes[-1], keyframe]
        both = last.followed_by(predicted)
        targets = depth_targets(self.sensors, pair, both, first_rise=0.0)
        self._targets = self._targets.followed_by(targets.take(np.s_[1:]))
        self._measure(keyframe)

    def _measure(self, keyframe: Keyframe) -> None:
        """Add a keyframe's measurements, linearised."""
        self.keyframes.append(keyframe)
        n_rows = self.first_row[-1] + len(keyframe.beams.speed)
        self.first_row = np.append(self.first_row, n_rows)
        at = self.at.take(np.s_[-1:])
        here = np.zeros(len(keyframe.beams.speed), np.intp)
        error, jacobian = beam_rows(self.sensors, keyframe.beams, at.take(here))
        self.beams = self.beams.followed_by(keyframe.beams)
        self.error = np.append(self.error, error)
        self.jacobian = np.concatenate([self.jacobian, jacobian])
        self._depths += depth_rows(self.sensors, [keyframe], at, self._targets.take(np.s_[-1:]))
        self._fixes += fix_rows(self.sensors, [keyframe], at)
        self._speeds += speed_rows(self.sensors, [keyframe], at)

    def keep_posterior(self, last: States) -> None:
        """Keep of all keyframes the newest, with what was found there as its prior."""
        self.prior = prior_on(last, self.chain.root, offset=np.zeros(self.state_dim))
        end = self.keyframes[-1]
        self.drop(len(self.keyframes) - 1)
        self._drop_rows(len(self.error))
        self.first_row = np.zeros(2, np.intp)
        self.at = last
        self.keyframes = [Keyframe.unmeasured(end.time_s, end.gyro_b, end.inertial)]
        none = no_rows(self.sensors)
        self._depths, self._fixes, self._speeds = [none], [none], [none]
        self._stale = 0

    def marginalise(self, count: int, weights: Array) -> None:
        """Leave of the first keyframes a prior on the next, made where they are linearised."""
        self.eliminate(weights)
        carried = self.chain.carried[count]
        at = self.at.take(np.s_[count : count + 1])
        self.prior = prior_on(at, carried[:, :-1], offset=carried[:, -1])
        self.drop(count)

    def drop(self, count: int) -> None:
        """Forget the first keyframes."""
        self._drop_rows(int(self.first_row[count]))
        self.first_row = self.first_row[count:] - self.first_row[count]
        self.chain.drop(count)
        self._stale = max(self._stale - count, 0)
        self.at, self._targets = self.at.take(np.s_[count:]), self._targets.take(np.s_[count:])
        for name in ("keyframes", "_depths", "_fixes", "_speeds", "_between"):
            setattr(self, name, getattr(self, name)[count:])

    def _drop_rows(self, count: int) -> None:
        self.beams = self.beams.take(np.s_[count:])
        self.error, self.jacobian = self.error[count:], self.jacobian[count:]

    def eliminate(self, weights: Array) -> None:
        """Bring the chain up to date from the first keyframe that has changed."""
        begin = self._stale
        if begin == len(self.keyframes):
            return
        first = self.first_row[begin:]
        b = slice(first[0], None)
        rows = np.column_stack([self.jacobian[b], -self.error[b]])
        rows *= (np.sqrt(weights[b]) / self.beams.sigma[b])[:, None]
        first = first - first[0]
        own = [
            np.concatenate([rows[first[i] : first[i + 1]], *aids])
            for i, aids in enumerate(
                zip(self._depths[begin:], self._fixes[begin:], self._speeds[begin:], strict=True)
            )
        ]
        carried = self.prior.rows(self.at) if begin == 0 else self.chain.carried[begin]
        self.chain.eliminate(carried, own, self._between[begin:], begin=begin)
        self._stale = len(self.keyframes)

    def prediction(self, weights: Array) -> tuple[Array, Array]:
        """Return what all before it say of the newest keyframe: step, and root of its covariance.

        The covariance is ``root @ root.T``, both (n, n); the step (n,) is off ``at``.
        """
        self.eliminate(weights)
        carried = self.chain.carried[-1]
        identity = np.eye(self.state_dim)
        solved = solve_triangular(carried[:, :-1], np.column_stack([identity, carried[:, -1]]))
        return solved[:, -1], solved[:, :-1]

    def leave_out_far(self, step: Array, root_cov: Array, *, sigmas: float) -> None:
        """Leave out depth and GNSS of the newest keyframe that are far from its prediction."""
        k = len(self.keyframes) - 1
        for name, aids in (("depth", self._depths), ("fix", self._fixes)):
            A, b = aids[k][:, :-1], aids[k][:, -1]
            root, left = A @ root_cov, b - A @ step
            distance_sq = left @ np.linalg.solve(root @ root.T + np.eye(len(b)), left)
            if distance_sq > sigmas**2 * len(b):
                self.keyframes[k] = self.keyframes[k].without(name)
                aids[k] = no_rows(self.sensors)
                self.changed_from(k)

    def linearise(self, begin: int, end: int, step: Array) -> None:
        """Move successive keyframes by ``step`` (end - begin, n) and linearise there."""
        moved = self.at.take(np.s_[begin:end]).moved(step)
        head, tail = self.at.take(np.s_[:begin]), self.at.take(np.s_[end:])
        self.at = head.followed_by(moved).followed_by(tail)
        before, behind = max(begin - 1, 0), min(end + 1, len(self.keyframes))
        if len(self.keyframes) > 1:  # a single keyframe keeps what its prediction came with
            self._linearise_between(before, behind)
        self._measure_again(begin, behind)
        self.changed_from(before)

    def _linearise_between(self, begin: int, end: int) -> None:
        """Linearise from keyframe to keyframe, and lead their depths along the way."""
        keyframes, at = self.keyframes[begin:end], self.at.take(np.s_[begin:end])
        self._between[begin : end - 1] = self.inertial.rows(inertial_data(keyframes[1:]), at)
        first_rise = float(self._targets.rise[begin])
        targets = depth_targets(self.sensors, keyframes, at, first_rise=first_rise)
        head, tail = self._targets.take(np.s_[:begin]), self._targets.take(np.s_[end:])
        self._targets = head.followed_by(targets).followed_by(tail)

    def _measure_again(self, begin: int, end: int) -> None:
        """Linearise the measurements of successive keyframes."""
        first = self.first_row
        rows = slice(first[begin], first[end])
        keyframe = np.repeat(np.arange(begin, end), np.diff(first[begin : end + 1]))
        error, jacobian = beam_rows(self.sensors, self.beams.take(rows), self.at.take(keyframe))
        self.error, self.jacobian = self.error.copy(), self.jacobian.copy()
        self.error[rows], self.jacobian[rows] = error, jacobian
        here = np.s_[begin:end]
        keyframes, at = self.keyframes[here], self.at.take(here)
        self._depths[here] = depth_rows(self.sensors, keyframes, at, self._targets.take(here))
        self._fixes[here] = fix_rows(self.sensors, keyframes, at)
        self._speeds[here] = speed_rows(self.sensors, keyframes, at)
