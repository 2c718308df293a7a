"""What linearising beams gives, and what is said of other measurements."""

from __future__ import annotations

from typing import NamedTuple

from ssm_graph.data import Array


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
