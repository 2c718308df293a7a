"""Variables beside the states of the keyframes: what they are called, their priors, their columns.

A constant holds for the whole mission, a walk has a value at every keyframe. Each is a deviation
from what the mission states, so that its prior mean is zero; a measurement that depends on it fills
the columns of that name beside those of its keyframe's error state::

    | error state 15 | walks of that keyframe | constants |
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.engine.error_state import STATE_DIM, InitialMoments

WANDER: Final = 1e-3
"""Share of its prior sigma that a constant may wander in an hour where it is carried in the state:
without any, what a window keeps of it would be infinitely stiff."""


@dataclass(frozen=True, slots=True, eq=False)
class Extra(ReadOnlyArrays):
    """One named variable of any dimension with its prior."""

    name: str
    labels: tuple[str, ...]
    """(d,) each component for people, with the unit that it is shown in."""
    sigma: Array
    """(d,) of its prior; of a walk, at the first keyframe."""
    unit: float = 1.0
    """SI units in one of those shown."""
    walk_density: float | Array = 0.0
    """Per square root of a second, of all components or (d,) of each; zero for a constant."""
    correlation_s: float = math.inf
    """A walk forgets within so much; infinite for a random walk, which does not."""
    as_a_turn: float = 1e6
    """So much of it bends what is measured as much as a turn of 1 rad; of most, measurements are
    linear functions."""

    @classmethod
    def gauss_markov(
        cls,
        name: str,
        labels: tuple[str, ...],
        sigma: float | Array,
        *,
        correlation_s: float,
        unit: float = 1.0,
    ) -> Self:
        """Return a walk that keeps its variance; ``sigma`` is of all components, or (d,)."""
        of_each = np.broadcast_to(sigma, len(labels))
        density = of_each * math.sqrt(2.0 / correlation_s)
        return cls(name, labels, of_each, unit, density, correlation_s)

    @property
    def is_lasting(self) -> bool:
        """Whether it tells what lasts of an instrument: a calibration, or the place of a beacon."""
        return math.isinf(self.correlation_s)

    @property
    def is_walk(self) -> bool:
        """Whether it has a value at every keyframe."""
        return bool(np.all(np.asarray(self.walk_density) > 0.0))


class Extras:
    """The extra variables of a problem, walks before constants, each in the order given."""

    def __init__(self, blocks: tuple[Extra, ...] = ()) -> None:
        walks = [block for block in blocks if block.is_walk]
        constants = [block for block in blocks if not block.is_walk]
        self.blocks = (*walks, *constants)
        self.n_walks = sum(len(block.sigma) for block in walks)
        self.n_constants = sum(len(block.sigma) for block in constants)
        self._columns: dict[str, slice] = {}
        begin = STATE_DIM
        for block in self.blocks:
            self._columns[block.name] = slice(begin, begin + len(block.sigma))
            begin += len(block.sigma)
        self.width = begin
        """Columns of a row"""

    def __bool__(self) -> bool:
        return bool(self.blocks)

    def __contains__(self, name: str) -> bool:
        return name in self._columns

    @property
    def state_dim(self) -> int:
        """Columns of the error state and the walks of one keyframe."""
        return STATE_DIM + self.n_walks

    @property
    def sigma(self) -> Array:
        """(E,) prior sigmas of all, in the order of the columns."""
        return np.concatenate([np.zeros(0), *(block.sigma for block in self.blocks)])

    @property
    def walks(self) -> Extras:
        """Those that have a value at every keyframe."""
        return Extras(tuple(block for block in self.blocks if block.is_walk))

    def columns(self, name: str) -> slice:
        """Return the columns of a variable in a row."""
        return self._columns[name]

    def fill(self, rows: Array, blocks: Mapping[str, Array]) -> None:
        """Write derivatives to those variables that there are into rows (..., width), in place."""
        for name, block in blocks.items():
            if name in self:
                rows[..., self.columns(name)] = block

    def only(self, names: Collection[str]) -> Extras:
        """Return those of these names."""
        return Extras(tuple(block for block in self.blocks if block.name in names))

    def without(self, names: Collection[str]) -> Extras:
        """Return those of other names."""
        return Extras(tuple(block for block in self.blocks if block.name not in names))

    def in_the_state(self) -> Extras:
        """Return the same, in the same order, with constants that wander a little: all are walks.

        So can a keyframe carry all of them, and no other one has to be asked.
        """
        return Extras(
            tuple(
                block
                if block.is_walk
                else replace(block, walk_density=WANDER * float(block.sigma[0]) / math.sqrt(3600.0))
                for block in self.blocks
            )
        )

    def behind(self, covariance: Array) -> Array:
        """Return the covariance (width, width) at the start from that of the error state."""
        whole = np.diag(np.concatenate([np.zeros(STATE_DIM), self.sigma**2]))
        whole[:STATE_DIM, :STATE_DIM] = covariance
        return whole

    def columns_of(self, others: Extras) -> NDArray[np.intp]:
        """Return the columns that a row of some of these variables has here."""
        blocks = [np.r_[self.columns(block.name)] for block in others.blocks]
        return np.concatenate([np.arange(STATE_DIM), *blocks])

    def value(self, name: str, walks: Array, constants: Array, *, default: Array) -> Array:
        """Return a variable's value, (d,) or (..., d) with the walks at (...) rows.

        Parameters
        ----------
        name : of the variable.
        walks : (..., s) of the keyframes asked for.
        constants : (C,)
        default : what is returned for a variable that there is not.
        """
        if name not in self._columns:
            return default
        columns = self._columns[name]
        if columns.start < self.state_dim:
            return walks[..., columns.start - STATE_DIM : columns.stop - STATE_DIM]
        return constants[columns.start - self.state_dim : columns.stop - self.state_dim]

    def transitions(self, span_s: Array) -> tuple[Array, Array]:
        """Return how walks go on over K spans of time: factors and noise sigmas, both (K, s)."""
        factors, sigmas = [np.zeros((len(span_s), 0))], [np.zeros((len(span_s), 0))]
        for block in self.blocks:
            if not block.is_walk:
                continue
            kept = np.exp(-span_s / block.correlation_s)
            grown_s = span_s
            if math.isfinite(block.correlation_s):
                grown_s = 0.5 * block.correlation_s * (1.0 - kept**2)
            density = np.broadcast_to(block.walk_density, len(block.sigma))
            factors.append(np.repeat(kept[:, None], len(block.sigma), axis=1))
            sigmas.append(np.sqrt(grown_s)[:, None] * density)
        return np.hstack(factors), np.hstack(sigmas)


def with_extras(
    start: InitialMoments, extras: Extras, known: Extras | None = None
) -> InitialMoments:
    """Return the moments of a keyframe that carries these extra variables.

    What ``start`` carries are ``known``, some of them; the others begin at their priors.
    """
    if not extras:
        return start
    covariance, extra = extras.behind(np.zeros((STATE_DIM, STATE_DIM))), np.zeros(extras.width)
    columns = extras.columns_of(known or Extras())
    covariance[np.ix_(columns, columns)] = start.covariance
    extra[columns[STATE_DIM:]] = start.extra
    return start._replace(covariance=covariance, extra=extra[STATE_DIM:])
