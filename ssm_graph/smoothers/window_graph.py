"""The graph of a window: its keyframes, their rows where they were linearised, and their chain."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import solve_triangular

from factors.inertial import Intervals
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices
from ssm_graph.engine.chain import Chain
from ssm_graph.engine.error_state import GYRO_BIAS, ROTATION, STATE_DIM, VELOCITY, InitialMoments
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.marginal_prior import MarginalPrior, moved_chart, prior_at_start, prior_on
from ssm_graph.engine.states import States
from ssm_graph.graph.beam_rows import BeamRows, CalibratedBeams, linearize_beams
from ssm_graph.graph.inertial_rows import Ahead, InertialRows
from ssm_graph.mission.problem import Beams
from ssm_graph.smoothers.keyframe import Keyframe, Sensors
from ssm_graph.smoothers.window_aids import WindowAids, row_states

_LISTS = ("keyframes", "_between")


class Bends(NamedTuple):
    """How much each of the n components of a keyframe's state bends what is measured there."""

    share: Array
    """(n,) of what the attitude bends, by the same number of sigmas"""
    as_a_turn: Array
    """(n,) what bends as much as a turn of 1 rad: metres, metres per second, biases ..."""

    @classmethod
    def of(cls, extras: Extras) -> Bends:
        """Return those of the error state and of the extra variables behind it."""
        share = np.full(extras.width, 0.1)
        share[:3] = 1.0
        of_state = np.repeat([1.0, 1e4, 1e2, 1e6, 1e6], 3)
        of_extras = (np.full(len(block.sigma), block.as_a_turn) for block in extras.blocks)
        return cls(share, np.concatenate([of_state, *of_extras]))


def beam_rows(sensors: Sensors, beams: Beams, states: States) -> BeamRows:
    """Return errors (M,) in m/s and Jacobians (M, n) of beams, each with its own state."""
    if not sensors.extras:
        return linearize_beams(
            beams,
            R_nb=states.R_nb,
            v_n=states.v_n,
            bias=states.bias,
            omega_ie_n=sensors.frame.omega_ie_n,
        )
    extended = CalibratedBeams(beams, sensors.extras, sensors.frame)
    at = row_states(sensors, states)
    return extended.rows(at, extended.prepare(at.walks, at.constants, at.bias))


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
        self.beams = sensors.beams
        self.aids = WindowAids(sensors)
        self.state_dim = n = sensors.state_dim
        self.error, self.jacobian = np.zeros(0), np.zeros((0, n))
        """Of the beams, (M,) in m/s and (M, n)"""
        self.inertial = InertialRows(sensors.frame, sensors.extras)
        self.ahead: Ahead | None = None
        """Where the inertial data led to the newest keyframe, None of the first"""
        self.chain = Chain(n)
        self.prior: MarginalPrior = prior_at_start(start)
        self._between: list[Array] = []
        self._stale = 0
        self.first_row = self.keyframe_of_row = np.zeros(0, np.intp)
        self._number_rows(np.zeros(1, np.intp))
        self.bends = Bends.of(sensors.extras)
        self.seen_by_beams = np.r_[ROTATION, VELOCITY, GYRO_BIAS, STATE_DIM:n]
        """Components of the state that a beam may depend on"""
        self._measure(first)

    def _number_rows(self, first_row: Indices) -> None:
        """Take (K + 1,) where the beams of each keyframe begin, and where they end."""
        self.first_row = first_row
        count = first_row[1:] - first_row[:-1]
        self.keyframe_of_row = np.repeat(np.arange(len(count)), count)

    def successor(self) -> Self:
        """Return a graph that goes its own way from here, and takes the chain along."""
        twin = copy.copy(self)
        for name in _LISTS:
            setattr(twin, name, getattr(self, name).copy())
        twin.aids = self.aids.copy()
        self.chain, self._stale = self.chain.successor(), 0
        return twin

    def pack(self) -> dict[str, Array]:
        """Return all that :meth:`unpack` needs to go on from here, as plain arrays."""
        n = self.state_dim
        return {
            **{f"at_{name}": column for name, column in self.at._asdict().items()},
            **{f"prior_{name}": column for name, column in self.prior._asdict().items()},
            **{f"beams_{name}": column for name, column in self.beams.pack()},
            **dict(self.aids.pack()),
            "time_s": np.array([keyframe.time_s for keyframe in self.keyframes]),
            "first_row": self.first_row.astype(np.float64),
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
        at = States(*(arrays[f"at_{name}"] for name in States._fields))
        n, packed = sensors.state_dim, len(arrays["root"])
        if packed != n:
            raise DataError(
                f"checkpoint: expected keyframes of {n} states, what the vehicle asks to estimate, "
                f"got {packed}; it needs the vehicle that it was written with"
            )
        beams = sensors.beams.unpack({name: arrays[f"beams_{name}"] for name in Beams.columns()})
        first_row = arrays["first_row"].astype(np.intp)
        aids, times = WindowAids.unpack(arrays, sensors, at), arrays["time_s"].tolist()
        intervals = [None, *(inertial(begin_s, end_s) for begin_s, end_s in pairwise(times))]
        keyframes = [
            Keyframe(time_s, beams.take(slice(*first_row[k : k + 2])), aids.at(k), intervals[k])
            for k, time_s in enumerate(times)
        ]
        graph = cls(sensors, keyframes[0], at.moments(np.eye(n)))
        graph.keyframes, graph.at, graph.beams, graph.aids = keyframes, at, beams, aids
        graph.prior = MarginalPrior(*(arrays[f"prior_{n}"] for n in MarginalPrior._fields))
        graph._number_rows(first_row)
        graph._between = list(arrays["between"])
        graph.chain = Chain(n, root=arrays["root"])
        graph._linearise_beams(0, len(keyframes))
        return graph

    @property
    def is_eliminated(self) -> bool:
        """Whether the chain is up to date."""
        return self._stale == len(self.keyframes)

    def changed_from(self, keyframe: int) -> None:
        """Have the chain eliminated again from a keyframe on."""
        self._stale = min(self._stale, keyframe)

    def append(self, keyframe: Keyframe, last: States, step: Array) -> None:
        """Add a keyframe where the inertial data lead from ``last`` (1, ...), the newest one.

        ``step`` (n,) is by how much that lies off where it is linearised.
        """
        self.ahead = ahead = self.inertial.predict(inertial_data([keyframe]), last)
        self.at = self.at.followed_by(ahead.states)
        (rows,) = ahead.rows(last)
        if step.any():  # to the errors of the keyframe before about where it is linearised
            n = len(step)
            rows[:, :n] = rows[:, :n] @ moved_chart(step)
            rows[:, -1] += rows[:, :n] @ step
        self._between.append(rows)
        self.changed_from(len(self.keyframes) - 1)
        self._measure(keyframe, last)

    def _measure(self, keyframe: Keyframe, before: States | None = None) -> None:
        """Add a keyframe's measurements, linearised; ``before`` (1, ...) is the state before."""
        self.keyframes.append(keyframe)
        self.beams = self.beams.followed_by(keyframe.beams)
        self._number_rows(np.append(self.first_row, len(self.beams)))
        at = self.at.take(np.s_[-1:])
        here = np.zeros(len(keyframe.beams), np.intp)
        error, jacobian = beam_rows(self.sensors, keyframe.beams, at.take(here))
        self.error = np.append(self.error, error)
        self.jacobian = np.concatenate([self.jacobian, jacobian])
        self.aids.append(keyframe, len(self.keyframes) - 1, at, before)

    def keep_posterior(self, last: States) -> None:
        """Keep of all keyframes the newest, with what was found there as its prior."""
        self.prior = prior_on(last, self.chain.root, offset=np.zeros(self.state_dim))
        end = self.keyframes[-1]
        self.drop(len(self.keyframes) - 1)
        self._drop_rows(len(self.error))
        self._number_rows(np.zeros(2, np.intp))
        self.at = last
        self.keyframes = [Keyframe(end.time_s, self.sensors.beams, inertial=end.inertial)]
        self.aids.drop(1)
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
        self._number_rows(self.first_row[count:] - self.first_row[count])
        self.chain.drop(count)
        self._stale = max(self._stale - count, 0)
        self.at = self.at.take(np.s_[count:])
        self.aids.drop(count)
        for name in _LISTS:
            setattr(self, name, getattr(self, name)[count:])

    def _drop_rows(self, count: int) -> None:
        self.beams = self.beams.take(np.s_[count:])
        self.error, self.jacobian = self.error[count:], self.jacobian[count:]

    def eliminate(self, weights: Array) -> None:
        """Bring the chain up to date from the first keyframe that has changed."""
        if self.is_eliminated:
            return
        begin = self._stale
        row, n_keyframes = self.first_row[begin], len(self.keyframes)
        of_beams = np.empty((len(self.error) - row, self.state_dim + 1))
        of_beams[:, :-1] = self.jacobian[row:]
        np.negative(self.error[row:], out=of_beams[:, -1])
        of_beams *= (np.sqrt(weights[row:]) / self.beams.sigma[row:])[:, None]
        keyframe, of_aids = self.aids.rows(begin)
        rows = np.concatenate([of_beams, of_aids])
        own = [rows]
        if begin + 1 < n_keyframes:
            keyframe = np.concatenate([self.keyframe_of_row[row:], keyframe])
            order = np.argsort(keyframe, kind="stable")
            rows = rows[order]
            edges = np.searchsorted(keyframe[order], np.arange(begin, n_keyframes + 1)).tolist()
            own = [rows[first:last] for first, last in pairwise(edges)]
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

    def linearise(self, begin: int, end: int, step: Array) -> None:
        """Move successive keyframes by ``step`` (end - begin, n) and linearise there."""
        moved = self.at.take(np.s_[begin:end]).moved(step)
        if end - begin < len(self.keyframes):
            head, tail = self.at.take(np.s_[:begin]), self.at.take(np.s_[end:])
            moved = head.followed_by(moved, tail)
        self.at = moved
        before, behind = max(begin - 1, 0), min(end + 1, len(self.keyframes))
        if len(self.keyframes) > 1:  # a single keyframe keeps what its prediction came with
            keyframes, at = self.keyframes[before + 1 : behind], self.at.take(np.s_[before:behind])
            self._between[before : behind - 1] = self.inertial.rows(inertial_data(keyframes), at)
        self._linearise_beams(begin, behind)
        self.aids.linearise(begin, behind, self.at)
        self.changed_from(before)

    def _linearise_beams(self, begin: int, end: int) -> None:
        """Linearise the beams of successive keyframes."""
        rows = slice(self.first_row[begin], self.first_row[end])
        keyframe = self.keyframe_of_row[rows]
        beams = self.beams if len(keyframe) == len(self.error) else self.beams.take(rows)
        error, jacobian = beam_rows(self.sensors, beams, self.at.take(keyframe))
        if len(error) < len(self.error):
            parts = [(self.error, error), (self.jacobian, jacobian)]
            error, jacobian = (
                np.concatenate([old[: rows.start], new, old[rows.stop :]]) for old, new in parts
            )
        self.error, self.jacobian = error, jacobian
