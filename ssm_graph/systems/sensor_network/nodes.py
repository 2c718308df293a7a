"""Nodes with the recommended recursion: sets, late packets put where they belong, and alarms."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.base.units import wrapped
from ssm_graph.filters.rules.ellipsoids import Ellipsoids, Mask
from ssm_graph.filters.rules.set_membership import Sets, led_on, measured, saturated, shared
from ssm_graph.systems.sensor_network.codes import (
    HEADING_STEP,
    MOST_BITS,
    Indices,
    ResidueCode,
    UniformCode,
)
from ssm_graph.systems.sensor_network.motion import HEADING, planar_image
from ssm_graph.systems.sensor_network.setting import Setting

_AXES: Final = np.eye(3)
WHAT: Final = ("east of the position", "north of the position", "heading")


@dataclass(frozen=True, slots=True)
class Alarm:
    """A proof that not all of the stated bounds are true."""

    step: int
    run: int
    node: int
    """Whose set was missed, from 1."""
    sender: int
    """Whose measurement or set missed it; the node itself for its own."""
    what: str
    """``east of the position``, ``heading``, ``set`` and so on."""

    @property
    def sentence(self) -> str:
        """The alarm for people."""
        of = "its own" if self.sender == self.node else f"node {self.sender}'s"
        return (
            f"node {self.node}, step {self.step}: nothing is both in its set and within the bound "
            f"of {of} {self.what}: that bound, the bound of the motion or that of something heard "
            "before is false; the set is led on without it"
        )


@dataclass(slots=True)
class _Moment:
    """What a step of the past needs to be gone through again."""

    k: int
    predicted: Sets
    advance: Array
    turn: Array
    values: Array
    """(R, N, N, 3) by receiver and sender; NaN where nothing came."""
    sent: Sets | None
    """Of all nodes, as they were sent then."""
    came: Mask
    """(R, N, N) whose set has come."""

    def begin_from(self, predicted: Sets) -> None:
        """Take another prediction, of a past that more was heard of."""
        self.predicted = predicted

    def of_runs(self, runs: Indices) -> _Moment:
        """Return the same of some of the runs."""
        return _Moment(
            self.k,
            self.predicted[runs],
            self.advance[runs],
            self.turn[runs],
            self.values[runs],
            None if self.sent is None else self.sent[runs],
            self.came[runs],
        )


class SetNodes:
    """All nodes of R runs side by side, or one node: the recursion that is worth its bound.

    A step is: :meth:`lead_on`, then :meth:`hear` of what is measured or has come, of this step or
    an earlier one. What comes late is put into its step, and the steps since are gone through
    again: the set is the one that it would be had all come in time.
    """

    def __init__(
        self, setting: Setting, *, center: Array, memory: int = 0, nodes: Indices | None = None
    ) -> None:
        """Start from E(center, P_0).

        Parameters
        ----------
        center : (R, N, 3)
        memory : steps that a late packet may be late.
        nodes : (N,) numbers of the nodes, from 0; None for all.
        """
        self.setting = setting
        shape = np.broadcast_to(setting.initial_variance * np.eye(3), (*center.shape, 3))
        self._sets = Sets.of(Ellipsoids(center.copy(), shape.copy()), setting.floor)
        self._due: int | None = None  # the earliest step that something new was heard of
        self.k = 0
        self._alarms: dict[Alarm, None] = {}
        self.n_ambiguous = 0
        """Residues that a set was too wide for; they were not used."""
        self._past: deque[_Moment] = deque(maxlen=memory + 1)
        self._nodes = np.arange(center.shape[1]) if nodes is None else nodes
        self._senders = _senders(setting.hears(), self._nodes)
        self._noise = np.asarray(setting.motion_bound)

    @property
    def sets(self) -> Sets:
        """(R, N) by all that was heard until now."""
        self._settle()
        return self._sets

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """All that were raised until now."""
        self._settle()
        return tuple(self._alarms)

    def lead_on(self, advance: Array, turn: Array) -> None:
        """Lead all sets on by a step: advance (..., 2) m, turn (...) rad."""
        self._settle()
        self.k += 1
        self._predict(advance, turn)
        runs, n = self._sets.low.shape[:2]
        blank = np.full((runs, n, self.setting.n_nodes, 3), np.nan)
        came = np.zeros(blank.shape[:3], bool)
        self._past.append(_Moment(self.k, self._sets, advance, turn, blank, None, came))

    def hear(self, k: int, values: Array) -> None:
        """Use measurements of step k that came now.

        Parameters
        ----------
        values : (R, N, senders, 3) east, north, heading as they are read, by receiver; NaN for
            none. Residues of a code with fewer bits are told apart here.
        """
        moment = self._moment(k)
        if moment is None or not np.isfinite(values).any():
            return
        known = np.isfinite(moment.values)
        moment.values = np.where(known, moment.values, values)
        self._due = k if self._due is None else min(k, self._due)

    def hear_sets(self, k: int, sent: Sets, came: Mask) -> None:
        """Use sets of all nodes as they were sent in step k; ``came`` (R, N, N) by receiver."""
        moment = self._moment(k)
        if moment is None or not came.any():
            return
        moment.sent = sent
        moment.came = moment.came | came
        self._due = k if self._due is None else min(k, self._due)

    def go_on_with(self, runs: Indices) -> None:
        """Lead some of the runs on, in the places of all; alarms keep the places they had."""
        self._sets = self.sets[runs]
        past = [moment.of_runs(runs) for moment in self._past]
        self._past = deque(past, maxlen=self._past.maxlen)

    def _moment(self, k: int) -> _Moment | None:
        return next((m for m in self._past if m.k == k), None)

    def _settle(self) -> None:
        """Go once through all steps from the earliest that something new was heard of."""
        if self._due is None:
            return
        later = [m for m in self._past if m.k >= (self._due or 0)]
        self._due = None
        self._sets = later[0].predicted
        for one in later:
            if one is not later[0]:
                self._predict(one.advance, one.turn)
                one.begin_from(self._sets)
            self._use(one)

    def _predict(self, advance: Array, turn: Array) -> None:
        image = planar_image(self._sets, advance, turn, self._noise)
        self._sets = saturated(led_on(self._sets, image), self.setting.saturation)

    def _use(self, moment: _Moment) -> None:
        for slot, senders in enumerate(self._senders.T):
            values = _of(moment.values, senders)
            for axis in range(3):
                self._cut(moment.k, senders, axis, values[..., axis], is_own=slot == 0)
        if moment.sent is None:
            return
        for senders in self._senders.T[1:]:
            came = _of(moment.came, senders) & (senders != self._nodes)
            if came.any():
                kept, apart = shared(self._sets, moment.sent[:, senders])
                self._sets = kept.where(came, self._sets)
                self._tell(moment.k, senders, "set", apart & came)

    def _cut(self, k: int, senders: Indices, axis: int, value: Array, *, is_own: bool) -> None:
        if not np.isfinite(value).any():
            return
        setting = self.setting
        if axis == HEADING:
            bound = (setting.compass_bound or math.inf) + UniformCode(HEADING_STEP).error
            at, half = self._sets.middle[..., 2], self._sets.half_widths[..., 2]
            # A set of more than a turn less the bound says not which turn is meant.
            near = at + wrapped(value - at)
            value = np.where(half + bound < math.pi, near, np.nan)
        else:
            bound = setting.position_bound + UniformCode(setting.step).error
            value = value if is_own else self._told_apart(axis, value)
        self._sets, missed = measured(self._sets, _AXES[axis], value, bound)
        self._tell(k, senders, WHAT[axis], missed)

    def _told_apart(self, axis: int, value: Array) -> Array:
        """Return values of residues; one's own come whole."""
        setting = self.setting
        if setting.bits >= MOST_BITS:
            return value
        code = ResidueCode(setting.step, setting.bits)
        reach = setting.position_bound
        known = np.isfinite(value)
        residue = np.rint(np.where(known, value, 0.0) / code.step) % 2**code.bits
        low, high = self._sets.low[..., axis] - reach, self._sets.high[..., axis] + reach
        told = code.value(residue, low, high)
        self.n_ambiguous += int(np.sum(known & ~np.isfinite(told)))
        return np.where(known, told, np.nan)

    def _tell(self, k: int, senders: Indices, what: str, missed: Mask) -> None:
        for run, i in zip(*np.nonzero(missed), strict=True):
            alarm = Alarm(k, int(run), int(self._nodes[i]) + 1, int(senders[i]) + 1, what)
            self._alarms.setdefault(alarm)


def _senders(heard: Array, nodes: Indices) -> Indices:
    """Return whom each node hears (N, slots): itself first, and again where there are fewer."""
    rows = [[i, *np.flatnonzero(heard[i])] for i in nodes]
    most = max(len(row) for row in rows)
    return np.array([row + [row[0]] * (most - len(row)) for row in rows], dtype=np.intp)


def _of(table: NDArray[Any], senders: Indices) -> NDArray[Any]:
    """Return the column of each receiver's sender: (R, N, ...) of (R, N, senders, ...)."""
    return np.asarray(table[:, np.arange(table.shape[1]), senders])
