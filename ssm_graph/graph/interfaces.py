"""What the similarity loop needs of a linearised graph, whichever variables that has."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from ssm_graph.data import Array
from ssm_graph.graph.marginal_prior import MarginalPrior
from ssm_graph.graph.states import States
from ssm_graph.problem.problem import Problem


class BeamRows(NamedTuple):
    """Linearised beams, one row each, not whitened."""

    error: Array
    """(M,) m/s, predicted minus measured."""
    jacobian: Array
    """(M, 15) with respect to the keyframe's error state, (M, E) if there are extra variables."""


class Misfit(NamedTuple):
    """How far one kind of measurement misses an answer."""

    sum_sq: float
    """Sum of its squared whitened errors"""
    n_rows: int
    n_factors: int


class Step(Protocol):
    """A Gauss-Newton step, and the posterior covariance at the states where it begins."""

    @property
    def delta(self) -> Any:
        """What the linearizer's ``retract`` takes."""

    @property
    def covariance(self) -> Array:
        """(K, 15, 15) of the error state of every keyframe."""

    @property
    def neighbour_covariance(self) -> Array:
        """(K - 1, 15, 15) of the error states of every keyframe and the next."""

    @property
    def sigma(self) -> Array:
        """Posterior sigmas in the shape of what ``retract`` moves by."""

    @property
    def extras_covariance(self) -> Array:
        """(E, E) of the walks at the last keyframe and of the constants."""

    def variance(self, keyframe: NDArray[np.intp], rows: Array) -> Array:
        """Return ``H P H'`` (M,) of rows of beams at their keyframes."""


class Linearizer(Protocol):
    """A problem's graph, linearised and solved at any states and beam weights."""

    problem: Problem
    inertial: gtsam.NonlinearFactorGraph
    prior: MarginalPrior

    def follow(self, states: States) -> bool:
        """Let gravity and the depth targets follow the states; to be called before the others.

        Returns whether beams linearised before are to be linearised anew.
        """

    def beam_rows(self, states: States) -> BeamRows:
        """Linearise all beams at ``states``."""

    def solve(self, states: States, beam_rows: BeamRows, weights: Array) -> Step:
        """Return the step at ``states``, with their beam rows and weights (M,)."""

    def retract(self, states: States, delta: Any, *, scale: float = 1.0) -> tuple[States, Array]:
        """Return the states moved by ``scale * delta``, and that step as an array."""

    def cost(self, states: States, beam_rows: BeamRows, weights: Array) -> float:
        """Return half the weighted sum of squares that :meth:`solve` makes least."""

    def misfits(self, states: States) -> dict[str, Misfit]:
        """Return the misfit of GNSS, depth and inertial data, by name, where there are any."""
