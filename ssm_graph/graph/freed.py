"""What sensors were found to be off by, as constants of the graph.

Each number has a column on the rows of the sensor while it was off, and nothing anywhere else; the
columns stay as they were when it was found, so that the errors are linear functions of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extra, Extras
from ssm_graph.graph.aids.aid import Linearised
from ssm_graph.mission.problem import Problem

FAULTS: Final = "faults"
"""The name of these constants among the extra variables of a problem, the last of all."""


@dataclass(frozen=True, slots=True, eq=False)
class Freed:
    """F numbers that errors, predicted minus measured, are linear functions of."""

    sigma: Array
    """(F,) of their priors"""
    beams: Array
    """(M, F) on the beam speeds, m/s"""
    between: Array
    """(K - 1, 15, F) on the whitened inertial rows"""
    aids: Mapping[str, Array] = field(default_factory=dict)
    """(m, d, F) on the whitened measurements of an aid, by its name; none where nothing acts"""

    @property
    def variable(self) -> Extra:
        """The variable that a problem is given for them."""
        labels = tuple(f"fault_{i + 1}" for i in range(len(self.sigma)))
        return Extra(FAULTS, labels, self.sigma)

    @classmethod
    def nothing(cls, problem: Problem) -> Freed:
        """Return none of a problem's numbers."""
        of_beams = np.zeros((len(problem.beams.speed), 0))
        return cls(np.zeros(0), of_beams, np.zeros((problem.n_keyframes - 1, 15, 0)))

    def with_between(self, sigma: Array, between: Array) -> Freed:
        """Return the same with further numbers, of sigmas (P,), on the inertial rows alone."""

        def wider(columns: Array) -> Array:
            more = np.zeros((*columns.shape[:-1], len(sigma)))
            return np.concatenate([columns, more], axis=-1)

        return Freed(
            np.concatenate([self.sigma, sigma]),
            wider(self.beams),
            np.concatenate([self.between, between], axis=-1),
            {name: wider(columns) for name, columns in self.aids.items()},
        )

    def on_aid(self, name: str, rows: Linearised, extras: Extras, constants: Array) -> Linearised:
        """Return whitened rows (m, d) of an aid with what it is off by."""
        columns = self.aids.get(name)
        if columns is None:
            return rows
        jacobian = rows.jacobian.copy()
        jacobian[..., extras.columns(FAULTS)] = columns
        own = constants[len(constants) - len(self.sigma) :]
        return Linearised(rows.error + columns @ own, jacobian)
