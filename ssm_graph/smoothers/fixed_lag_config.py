"""Settings of the fixed-lag smoother, offline and on the vehicle."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from factors.similarity import Kernel, LogKernel, Similarity
from ssm_graph.base.errors import ConfigError
from ssm_graph.engine.error_state import Linearised


@dataclass(frozen=True, slots=True)
class FixedLagConfig:
    """Settings of the fixed-lag smoother."""

    lag_s: float = 30.0
    """Keyframes older than this are marginalised; zero makes it the filter."""
    kernel: Kernel = field(default_factory=LogKernel)
    similarity: Similarity = Similarity.EXPECTED
    max_iterations: int = 50
    tolerance: float = 1e-8
    """Largest update, in its own posterior sigmas, at which a keyframe's iteration ends; not below
    1e-7 while the window has several."""
    linearised: Linearised = Linearised.EACH_PASS
    relinearise_sigmas: float = 1e-5
    """A keyframe of several is linearised anew once its attitude has moved by so many posterior
    sigmas, or anything else, which bends the measurements far less, by ten times as many."""
    relinearise_turn: float = 0.0
    """And only if its attitude has moved by so many rad, or its velocity by a hundred times as many
    m/s: what is less bends nothing, however certain."""
    reweigh: float = 1e-9
    """A beam's weight, in a window of several keyframes, is renewed once it is off by so much."""
    gate_sigmas: float = np.inf
    """Depth and GNSS further than this from what is predicted are left out."""
    first_estimates: bool = False
    """Keep the oldest keyframe where its prior was made, with the Jacobians of that point."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.lag_s) and self.lag_s >= 0.0):
            raise ConfigError(f"lag_s: expected zero or more seconds, got {self.lag_s}")
        if self.max_iterations < 1:
            raise ConfigError(f"max_iterations: expected 1 or more, got {self.max_iterations}")
        if not 0.0 < self.tolerance < 1.0:
            raise ConfigError(f"tolerance: expected a number in (0, 1), got {self.tolerance}")
        for name in ("relinearise_sigmas", "relinearise_turn", "reweigh"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ConfigError(f"{name}: expected a number in [0, 1), got {getattr(self, name)}")
        if self.linearised is Linearised.ONCE and self.lag_s > 0.0:
            raise ConfigError(f"linearised once: expected with lag_s zero, got {self.lag_s}")
