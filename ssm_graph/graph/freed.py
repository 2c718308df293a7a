"""What sensors were found to be off by, as constants of the graph.

Each number has a column on the rows of the sensor while it was off, and nothing anywhere else; the
columns stay as they were when it was found, so that the errors are linear functions of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extra, Extras
from ssm_graph.graph.aids.aid import Linearised

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

    def on_aid(self, name: str, rows: Linearised, extras: Extras, constants: Array) -> Linearised:
        """Return whitened rows (m, d) of an aid with what it is off by."""
        columns = self.aids.get(name)
        if columns is None:
            return rows
        jacobian = rows.jacobian.copy()
        jacobian[..., extras.columns(FAULTS)] = columns
        own = constants[len(constants) - len(self.sigma) :]
        return Linearised(rows.error + columns @ own, jacobian)
