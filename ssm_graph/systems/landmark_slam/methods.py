"""Estimators by name, as studies and the command line call them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from factors.similarity import Kernel, LogKernel
from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.noise_adaptive import (
    GuardedScaling,
    LiteralScaling,
    NoiseLaw,
    SageHusa,
    StatedNoise,
    VariationalBayes,
)
from ssm_graph.systems.landmark_slam.drifting_filter import DriftingFilter
from ssm_graph.systems.landmark_slam.filters import Gate, MapFilter, SlamFilter
from ssm_graph.systems.landmark_slam.models import Motion
from ssm_graph.systems.landmark_slam.other_filters import (
    InvariantFilter,
    IteratedFilter,
    SquareRootFilter,
)
from ssm_graph.systems.landmark_slam.unscented_filters import FullUnscentedFilter, UnscentedFilter

MakeFilter = Callable[..., SlamFilter]
"""Takes motion, noise, start (B, 3), and start_cov, capacity, robust by name, as `MapFilter`."""


@dataclass(frozen=True, slots=True)
class FilterMethod:
    """A filter: where it linearises, what it believes of the noise, and what it doubts."""

    about: str
    make: MakeFilter = MapFilter
    law: NoiseLaw = field(default_factory=StatedNoise)
    robust: Gate | Kernel | None = None
    is_told: bool = False
    """Told the true sigmas, biases as noise."""

    @property
    def follows_drift(self) -> bool:
        """Whether the odometry's constant errors are states."""
        return self.make is DriftingFilter

    def begin(
        self, motion: Motion, control: Array, observation: Array, start: Array, **more: Any
    ) -> SlamFilter:
        """Return a filter at its start; sigmas (q,) and (2,), poses (B, 3)."""
        noise = self.law.begin(control, observation, len(start))
        given = {"start_cov": np.zeros((3, 3)), "robust": self.robust, **more}
        if self.follows_drift:
            given.setdefault("drift_sigma", np.zeros(0))
        return self.make(motion, noise, start, **given)


FILTERS: Final[Mapping[str, FilterMethod]] = {
    "ekf": FilterMethod("extended Kalman filter"),
    "ukf": FilterMethod("unscented filter, points of what moves (reduced)", UnscentedFilter),
    "naukf": FilterMethod(
        "the paper's: R from residuals, Q by sqrt(beta), window 30",
        UnscentedFilter,
        LiteralScaling(30),
    ),
    "naukf-200": FilterMethod("the same, window 200", UnscentedFilter, LiteralScaling(200)),
    "naukf-r": FilterMethod(
        "the paper's R alone, window 30", UnscentedFilter, LiteralScaling(30, scales_q=False)
    ),
    "guarded": FilterMethod(
        "R with a prior, Q only on evidence, within limits", UnscentedFilter, GuardedScaling()
    ),
    "vb": FilterMethod("variational Bayes of R", UnscentedFilter, VariationalBayes()),
    "sage-husa": FilterMethod(
        "mean and R of the observations, fading memory", UnscentedFilter, SageHusa()
    ),
    "iekf": FilterMethod("iterated extended filter", IteratedFilter),
    "invariant": FilterMethod("right-invariant extended filter", InvariantFilter),
    "sr-ukf": FilterMethod("unscented filter in square-root form", SquareRootFilter),
    "ukf-full": FilterMethod("unscented filter, points of the whole state", FullUnscentedFilter),
    "ekf-gate": FilterMethod("extended filter behind a gate", robust=Gate()),
    "ekf-weighted": FilterMethod(
        "extended filter, a similarity weight for each observation, drift of the odometry a state",
        DriftingFilter,
        robust=LogKernel(5.0),
    ),
    "invariant-weighted": FilterMethod(
        "right-invariant filter with similarity weights", InvariantFilter, robust=LogKernel(5.0)
    ),
    "ukf-told": FilterMethod(
        "unscented filter that knows the noise", UnscentedFilter, is_told=True
    ),
}
SMOOTHERS: Final[Mapping[str, str]] = {
    "smoother": "whole log, similarity weights, stated noise",
    "smoother-em": "whole log, similarity weights, noise from the log",
    "isam2": "pose by pose with nothing dropped, similarity weights, stated noise",
    "fixed-lag": "pose by pose, those older than the lag dropped, similarity weights, stated noise",
    "smoother-oracle": "whole log, least squares, told noise and gross observations",
}
INCREMENTAL: Final = ("isam2", "fixed-lag")
"""Smoothers that take a log as it comes."""
PAPER: Final = ("ekf", "ukf", "naukf")
DEFAULT_STUDY: Final = tuple(name for name in FILTERS if name != "ukf-full")
"""All but the one that the reduced points are held against: it costs as much as eight others."""


def check_method(name: str) -> str:
    """Return the name of a method, or raise."""
    if name not in FILTERS and name not in SMOOTHERS:
        raise ConfigError(
            f"method: expected a known one, got {name!r}; "
            f"{nearest_hint(name, [*FILTERS, *SMOOTHERS])}"
        )
    return name
