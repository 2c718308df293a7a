"""What sensors were found to be off by, as constants of the graph.

Each number has a column on the rows of the sensor while it was off, and nothing anywhere else. The
columns stay as they were when it was found, so that the errors are linear functions of it; but for
scale and mounting of the DVL, which turn its beams: at 6 deg the cosine is 0.5 % of the speed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import so3
from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extra, Extras
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.aid import Linearised
from ssm_graph.graph.beam_rows import WaterRows
from ssm_graph.mission.problem import Problem

FAULTS: Final = "faults"
"""The name of these constants among the extra variables of a problem, the last of all."""


class OfArray(NamedTuple):
    """A stretch over which the beams are longer, and turned in the body."""

    inside: NDArray[np.bool_]
    """(M,) the beam speeds"""
    columns: slice
    """Of its d numbers among all"""
    combined: Array
    """(4, d) scale (1) and rotation vector (3, rad, body axes) as sums of the numbers"""


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
    array: tuple[OfArray, ...] = ()
    """Those on the array of the DVL, one after the other"""

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

    @property
    def has_beam(self) -> NDArray[np.bool_]:
        """(M,) which of the beam speeds something acts on."""
        return np.asarray(np.any([self.beams.any(axis=1), *(one.inside for one in self.array)], 0))

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
            self.array,
        )

    def held(self, beam_b: Array, off_by: Array, *, unscaled: OfArray | None = None) -> Array:
        """Return the directions (M, 3) of beams, as long as they read, for numbers (F,).

        ``unscaled`` is a stretch whose scale is left out: that of a DVL that reads zero is -1.
        """
        held_b = beam_b
        for one in self.array:
            scale, *turn_b = one.combined @ off_by[one.columns]
            factor = 1.0 if one is unscaled else 1.0 + scale
            turned = factor * held_b @ so3.exp(np.array(turn_b)).T
            held_b = np.where(one.inside[:, None], turned, held_b)
        return held_b

    def on_beams(self, problem: Problem, states: States, beam_b: Array, off_by: Array) -> Array:
        """Return the columns (M, F) on the beam speeds at states, for beams (M, 3) as stated."""
        if not self.array:
            return self.beams
        columns = self.beams.copy()
        for one in self.array:
            scale, *turn_b = one.combined @ off_by[one.columns]
            by = array_columns(problem, states, self.held(beam_b, off_by, unscaled=one))
            turn = (1.0 + scale) * by[:, 1:] @ so3.left_jacobian(np.array(turn_b))
            own = np.hstack([by[:, :1], turn]) @ one.combined
            columns[:, one.columns] = own * one.inside[:, None]
        return columns

    def on_aid(self, name: str, rows: Linearised, extras: Extras, constants: Array) -> Linearised:
        """Return whitened rows (m, d) of an aid with what it is off by."""
        columns = self.aids.get(name)
        if columns is None:
            return rows
        jacobian = rows.jacobian.copy()
        jacobian[..., extras.columns(FAULTS)] = columns
        own = constants[len(constants) - len(self.sigma) :]
        return Linearised(rows.error + columns @ own, jacobian)


def array_columns(problem: Problem, states: States, beam_b: Array) -> Array:
    """Return what scale (1) and a turn (3, rad, body axes) do to the beam speeds (M, 4), m/s.

    ``beam_b`` (M, 3) are the beams' directions in body axes.
    """
    beams, k = problem.beams, problem.beams.keyframe
    R_nb, v_n = states.R_nb[k], states.v_n[k]
    water = WaterRows(beams, problem.extras, problem.frame)
    through = water.relative(v_n, p_n=states.p_n[k], walks=states.walks[k], rows=np.s_[:])
    v_n = v_n if through is None else through.v_n
    rate_b = beams.gyro_b - states.bias[k, 3:]
    v_b = np.einsum("mij,mi->mj", R_nb, v_n) + so3.cross(rate_b, beams.lever_arm_b)
    along = np.einsum("mi,mi->m", beam_b, v_b)
    return np.column_stack([along, so3.cross(beam_b, v_b)])
