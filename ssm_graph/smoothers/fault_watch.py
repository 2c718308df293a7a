"""The search for lasting faults of beams within the similarity loop: when, and beside what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factors.similarity import WEIGHT_FLOOR
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.gnc import NEAR_SIGMAS
from ssm_graph.engine.states import States
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.calibration import CALIBRATIONS, DRIFTS
from ssm_graph.mission.problem import Problem, with_stated_noise
from ssm_graph.smoothers.beam_faults import FaultSearch, Found, find_beam_faults_steps

FREE_LOOKS = 2
"""So often a search may take back what the one before it found."""


def _kept(extras: Extras) -> Extras:
    """Return the variables that the search carries along in the states of the chain.

    Those of the current and of the further aids: they are nothing of the DVL's, and hold what
    would be taken for a fault. Calibrations are held at their estimates.
    """
    return extras.without(CALIBRATIONS | DRIFTS).in_the_state()


class FaultWatch:
    """Keeps the beams out of a solution that the search finds, while it is iterated."""

    def __init__(self, problem: Problem, search: FaultSearch | None) -> None:
        self._search = search
        self._extras, self._kept = problem.extras, _kept(problem.extras)
        self._linearizer = None
        if search is not None:
            self._linearizer = GraphLinearizer(
                replace(with_stated_noise(problem), extras=self._kept)
            )
        self._beams, self._time_s = problem.beams, problem.keyframe_s[problem.beams.keyframe]
        self._found = Found(np.zeros(len(self._time_s), dtype=bool), ())
        self._n_looks = 0

    def leave_out(self, weights: Array) -> Array:
        """Return the weights (M,) with the floor for what was found."""
        return np.where(self._found.is_off, WEIGHT_FLOOR, weights)

    def look_steps(
        self,
        states: States,
        rows: BeamRows,
        *,
        update_sigmas: float,
        is_settled: bool,
        aid_weights: Array | None = None,
    ) -> Steps[bool]:
        """Search once the solution is near, and whenever it has settled; return what has changed.

        The first solution may be far off where a fault has not been left out yet: its findings are
        given up again where a later one disagrees. After ``FREE_LOOKS`` they only become more, so
        that there is an end to it.
        """
        is_due = is_settled or (self._n_looks == 0 and update_sigmas < NEAR_SIGMAS)
        if self._search is None or self._linearizer is None or not is_due:
            return False
        self._n_looks += 1
        alone, before = self._without_calibration(states, rows), self._found
        found = yield from find_beam_faults_steps(
            self._linearizer, *alone, self._search, aid_weights
        )
        if self._n_looks > FREE_LOOKS:
            found = found._replace(is_off=found.is_off | before.is_off)
        self._found = found
        return not np.array_equal(found.is_off, before.is_off)

    def _without_calibration(self, states: States, rows: BeamRows) -> tuple[States, BeamRows]:
        """Return both with the variables that are kept, all of them walks."""
        n_keyframes = len(states.p_n)
        walks = [np.zeros((n_keyframes, 0))]
        for block in self._kept.blocks:
            zero = np.zeros(len(block.sigma))
            value = self._extras.value(block.name, states.walks, states.constants, default=zero)
            walks.append(np.broadcast_to(value, (n_keyframes, len(zero))))
        alone = states._replace(walks=np.hstack(walks), constants=states.constants[:0])
        columns = self._extras.columns_of(self._kept)
        return alone, BeamRows(rows.error, rows.jacobian[:, columns])

    def notes(self, error: Array) -> tuple[str, ...]:
        """Say what was left out; ``error`` (M,) is what the answer misses, predicted - measured."""
        said = []
        for beam in range(self._beams.n_beams):
            rows = np.flatnonzero(self._beams.beam == beam)
            edges = np.diff(self._found.is_off[rows].astype(int), prepend=0, append=0)
            for begin, end in zip(
                np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True
            ):
                left_out = rows[begin:end]
                said.append(
                    f"beam {beam + 1} is off from {self._time_s[left_out[0]]:.1f} s to "
                    f"{self._time_s[left_out[-1]]:.1f} s, by {-np.mean(error[left_out]):+.3f} m/s "
                    "on average, and left out there"
                )
        said.extend(
            f"one of the beams is off between {begin_s:.0f} s and {end_s:.0f} s, and the data do "
            "not say which: nothing is left out there"
            for begin_s, end_s in self._found.doubtful_s
        )
        return tuple(said)
