"""Errors that change slowly, of any instrument."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Drift:
    """Errors that change slowly, as a Gauss-Markov process; none by default.

    An estimator that models it takes the rest of the stated noise as white; one that does not
    counts the stated noise, which has to stand for both.
    """

    sigma: float = 0.0
    """Of each component, SI; above zero makes it a variable of the graph."""
    correlation_s: float = 0.0
    """It forgets within so much, s; above zero where there is a drift."""
    white_share: float = 1.0
    """Of the stated sigmas, what is left as white noise where the drift is modelled, in (0, 1]."""
