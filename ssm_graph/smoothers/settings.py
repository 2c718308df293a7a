"""Settings of the batch smoother."""

from __future__ import annotations

from dataclasses import dataclass, field

from factors.kernels import GeneralKernel, TruncatedKernel
from factors.similarity import Kernel, LogKernel, Similarity
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.usual import MAX_ITERATIONS
from ssm_graph.engine.reweighting import (
    AdaptiveSchedule,
    GncSchedule,
    Graduation,
    Schedule,
    WarmSchedule,
)
from ssm_graph.smoothers.faults.search import FaultSearch

WARM_KERNEL = LogKernel()
"""Kernel of the first pass and of the first iterations, whichever is asked for in the end."""


@dataclass(frozen=True, slots=True)
class SmootherConfig:
    """Settings of the similarity loop."""

    kernel: Kernel = field(default_factory=LogKernel)
    similarity: Similarity | None = None
    """What a beam is judged by; None for what the kernel was published with."""
    graduation: Graduation | None = None
    """Come to a truncated kernel by graduated non-convexity; None goes straight to the kernel."""
    adapt_shape: bool = False
    """Give a general kernel the shape under which the residuals of the beams are likeliest."""
    fault_search: FaultSearch | None = None
    """Look for sensors that are off for long, and take that off; None does not."""
    adapt_noise: bool = False
    """Repeat the solution with the sigma of each beam that its errors ask for."""
    max_iterations: int = MAX_ITERATIONS
    tolerance: float = 1e-3
    """Updates in their own posterior sigmas, and changes of weights, below which it has settled."""

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise ConfigError(f"max_iterations: expected 1 or more, got {self.max_iterations}")
        if not 0.0 < self.tolerance < 1.0:
            raise ConfigError(f"tolerance: expected a number in (0, 1), got {self.tolerance}")
        if self.graduation is not None and not isinstance(self.kernel, TruncatedKernel):
            raise ConfigError(f"graduation: expected with a TruncatedKernel, got {self.kernel}")
        if self.adapt_shape and not isinstance(self.kernel, GeneralKernel):
            raise ConfigError(f"adapt_shape: expected with a GeneralKernel, got {self.kernel}")

    @property
    def judged_by(self) -> Similarity:
        """What a beam is judged by, whether asked for or the kernel's own."""
        return self.similarity or self.kernel.published_with

    @property
    def weighting(self) -> str:
        """Kernel and schedule as text, for example ``log(dof=5)``."""
        if self.adapt_shape:
            assert isinstance(self.kernel, GeneralKernel)
            return f"adaptive(width={self.kernel.width:g})"
        if self.graduation is None:
            return str(self.kernel)
        assert isinstance(self.kernel, TruncatedKernel)
        return f"gnc-tls(width={self.kernel.width:g}, {self.graduation})"

    def schedule(self) -> Schedule:
        """Return which kernel weighs the beams, pass by pass, from the begin."""
        if self.adapt_shape:
            assert isinstance(self.kernel, GeneralKernel)
            return AdaptiveSchedule(self.kernel, WARM_KERNEL)
        if self.graduation is None:
            return WarmSchedule(self.kernel, WARM_KERNEL)
        assert isinstance(self.kernel, TruncatedKernel)
        return GncSchedule.begin(self.kernel, self.graduation, WARM_KERNEL)
