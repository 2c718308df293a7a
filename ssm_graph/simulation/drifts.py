"""Errors that stay alike for a while and then forget: Gauss-Markov processes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.simulation._checks import require_not_negative, require_positive


@dataclass(frozen=True, slots=True)
class DriftSettings:
    """How large an error is that changes slowly, and how slowly."""

    sigma: float
    """Standard deviation at any time, of each component."""
    correlation_s: float
    """Time after which 1/e of it is left in the mean, s."""

    def __post_init__(self) -> None:
        require_not_negative("DriftSettings.sigma", self.sigma, hint="try 0.006 m/s or 0.5 m")
        require_positive("DriftSettings.correlation_s", self.correlation_s, hint="try 60 s")


def draw_drift(settings: DriftSettings, time_s: Array, rng: np.random.Generator) -> Array:
    """Return three independent components (N, 3) at increasing times (N,)."""
    unit = rng.standard_normal((len(time_s), 3))
    return settings.sigma * gauss_markov(unit, time_s, settings.correlation_s)


def gauss_markov(unit: Array, time_s: Array, correlation_s: float) -> Array:
    """Return processes of variance 1, (N, d), at increasing times (N,).

    ``unit`` (N, d) are the standard normal numbers that drive them.
    """
    kept = np.exp(-np.diff(time_s) / correlation_s)
    fresh = np.sqrt(1.0 - kept**2)[:, None] * unit[1:]
    process = unit.copy()
    for k in range(len(kept)):
        process[k + 1] = kept[k] * process[k] + fresh[k]
    return process
