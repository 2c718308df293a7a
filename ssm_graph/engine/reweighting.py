"""Which kernel weighs the beams, pass by pass: a warm start, its shape, graduated non-convexity.

The warm schedule lets a benign kernel come near before the one asked for takes over. Graduated
non-convexity comes to truncated least squares by way of ever less convex surrogates [1]_: with a
small ``mu`` nearly the absolute value, and ``mu`` grows from solution to solution until every
weight is 0 or 1. What is published solves every weighted least-squares problem to its end; here
Gauss-Newton passes go on while their steps exceed one sigma, five at most, and mostly there is one.
The published end, a cost that hardly changes, is not taken for an answer: updates and weights have
to settle as for every other kernel.

References
----------
.. [1] H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated Non-Convexity for Robust Spatial
   Perception: From Non-Minimal Solvers to Global Outlier Rejection", RA-L 5, 2020.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple, final

import numpy as np

from factors.kernels import GeneralKernel, TruncatedKernel, fitted_shape
from factors.similarity import WEIGHT_FLOOR, GaussianKernel, Kernel
from factors.tails import likeliest_tail, tail_evidence, tails_of
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices

NEAR_SIGMAS = 1.0
"""The next kernel takes over once the updates are below this many of their own sigmas."""
SMALLEST_MU = 1e-6
"""First ``mu`` for outliers however large; GTSAM's."""
MAX_PASSES = 5
"""For the solution at one ``mu``. Least squares on bad outliers need not settle at all: at MEMS
grade twenty passes of it ran away so far that the graduation did not come back."""
BINARY = 1e-4
"""Weights this close to 0 or 1 are taken for it; GTSAM's."""


class Anderson(NamedTuple):
    """Anderson acceleration of depth one for the fixed point of the weights [1]_.

    Plain reweighting closes in by a constant factor a pass; two passes tell the factor, and the
    rest of the way is taken at once. The fixed point stays what it is.

    References
    ----------
    .. [1] H. F. Walker, P. Ni, "Anderson Acceleration for Fixed-Point Iterations", SIAM Journal on
       Numerical Analysis 49, 2011.
    """

    weights: Array
    """(M,) to try next"""
    change: Array
    """(M,) from the weights that were used to those they led to, ``settled``"""
    settled: Array

    @classmethod
    def after(cls, last: Anderson | None, used: Array, settled: Array) -> Anderson:
        """Go on from a pass with weights ``used`` that led to ``settled``, and from the last."""
        change = settled - used
        turn = np.zeros(0) if last is None else change - last.change
        length_sq = float(turn @ turn)
        if last is None or length_sq < 1e-16:
            return cls(settled, change, settled)
        mixed = settled - float(change @ turn) / length_sq * (settled - last.settled)
        weights = np.clip(mixed, WEIGHT_FLOOR, max(1.0, 2.0 * float(settled.max())))
        return cls(weights, change, settled)


class Schedule(ABC):
    """What weighs the beams in one pass of a solution; each pass has its own."""

    wanted: Kernel
    """Of the answer."""
    kernel: Kernel
    """In force in the pass."""

    @abstractmethod
    def first_weights(self, gated: Array) -> Array:
        """Return the weights of the first pass; ``gated`` are those of the forward pass."""

    @abstractmethod
    def after(
        self, used: Array, settled: Array, *, t: Array, update_sigmas: float
    ) -> tuple[Schedule, Array]:
        """Return the schedule and the weights of the next pass.

        Parameters
        ----------
        used : (M,) weights of this pass.
        settled : (M,) weights that the kernel gives to its residuals.
        t : (M,) squared Mahalanobis lengths behind ``settled``.
        update_sigmas : largest update of the pass, in posterior sigmas.
        """

    @abstractmethod
    def may_end(self, settled: Array) -> bool:
        """Return whether settled weights of the kernel in force are the answer."""


@final
@dataclass(frozen=True, slots=True)
class WarmSchedule(Schedule):
    """A warm kernel until the updates are near, then the one asked for, with mixed weights."""

    wanted: Kernel
    kernel: Kernel
    last: Anderson | None = None

    def first_weights(self, gated: Array) -> Array:
        """Return the weights of the forward pass."""
        return gated

    def after(
        self,
        used: Array,
        settled: Array,
        *,
        t: Array,  # noqa: ARG002
        update_sigmas: float,
    ) -> tuple[Schedule, Array]:
        """Return mixed weights near the end, those of the kernel before."""
        if update_sigmas >= NEAR_SIGMAS:
            return self, settled
        step = Anderson.after(self.last, used, settled)
        is_warm = self.kernel != self.wanted
        return WarmSchedule(self.wanted, self.wanted, None if is_warm else step), step.weights

    def may_end(self, settled: Array) -> bool:  # noqa: ARG002
        """Return whether the kernel in force is the one asked for."""
        return self.kernel == self.wanted


MOST_SHAPES = 20
"""Passes in which the shape may change; from then on it stays, so that weights can settle."""


@final
@dataclass(frozen=True, slots=True)
class AdaptiveSchedule(Schedule):
    """A warm kernel until the updates are near, then the general loss of the likeliest shape [1]_.

    Shape and solution take turns. A shape that has come twice in a row is kept.

    References
    ----------
    .. [1] N. Chebrolu, T. Läbe, O. Vysotska, J. Behley, C. Stachniss, "Adaptive Robust Kernels for
       Non-Linear Least Squares Problems", RA-L 6, 2021.
    """

    wanted: GeneralKernel
    """Of the last shape"""
    kernel: Kernel
    shapes: int = 0
    """How often the shape was looked for"""
    fixed: WarmSchedule | None = None
    """Once the shape is found"""

    def first_weights(self, gated: Array) -> Array:
        """Return the weights of the forward pass."""
        return gated

    def after(
        self, used: Array, settled: Array, *, t: Array, update_sigmas: float
    ) -> tuple[Schedule, Array]:
        """Return the weights of the likeliest shape."""
        if self.fixed is not None:
            now, weights = self.fixed.after(used, settled, t=t, update_sigmas=update_sigmas)
            assert isinstance(now, WarmSchedule)
            return replace(self, fixed=now), weights
        if update_sigmas >= NEAR_SIGMAS and self.shapes == 0:
            return self, settled
        shape = fitted_shape(t, width=self.wanted.width)
        kernel = replace(self.wanted, alpha=shape)
        is_found = kernel == self.kernel or self.shapes == MOST_SHAPES
        fixed = WarmSchedule(kernel, kernel) if is_found else None
        return AdaptiveSchedule(kernel, kernel, self.shapes + 1, fixed), kernel.weight(t)

    def may_end(self, settled: Array) -> bool:  # noqa: ARG002
        """Return whether the shape is found."""
        return self.fixed is not None


class GncStart(Enum):
    """The solution from which the graduation starts."""

    ONES = "least squares with every weight 1, as published"
    GATED = "the gated forward pass, then the warm kernel"


@dataclass(frozen=True, slots=True)
class Graduation:
    """Settings of the graduation; the defaults are those of the paper and of GTSAM."""

    start: GncStart = GncStart.ONES
    mu_step: float = 1.4
    """``mu`` grows by this factor from solution to solution."""

    def __post_init__(self) -> None:
        if not 1.0 < self.mu_step < np.inf:
            raise ConfigError(f"mu_step: expected a number above 1, got {self.mu_step}")

    def __str__(self) -> str:
        return f"start={self.start.name.lower()}, step={self.mu_step:g}"


def first_mu(largest_t: float, width: float) -> float:
    """Return the first ``mu`` by remark 5 of [1]_; infinite where nothing needs to be truncated.

    ``largest_t`` is the largest squared whitened residual of the starting solution.
    """
    excess = 2.0 * largest_t - width**2
    return max(width**2 / excess, SMALLEST_MU) if excess > 0.0 else np.inf


@final
@dataclass(frozen=True, slots=True)
class GncSchedule(Schedule):
    """A starting solution, then one for each surrogate of growing ``mu``."""

    wanted: TruncatedKernel
    graduation: Graduation
    kernel: Kernel
    mu: float | None = None
    """None for the starting solution."""
    passes: int = 0
    """Of the solution at this ``mu`` so far."""

    @classmethod
    def begin(cls, wanted: TruncatedKernel, graduation: Graduation, warm: Kernel) -> GncSchedule:
        """Return that of the first pass."""
        is_from_ones = graduation.start is GncStart.ONES
        return cls(wanted, graduation, GaussianKernel() if is_from_ones else warm)

    def first_weights(self, gated: Array) -> Array:
        """Return ones, or the weights of the forward pass."""
        return np.ones_like(gated) if self.graduation.start is GncStart.ONES else gated

    def after(
        self, used: Array, settled: Array, *, t: Array, update_sigmas: float
    ) -> tuple[Schedule, Array]:
        """Return weights of the next surrogate once a solution is near, until then the same."""
        passes = self.passes + 1
        if update_sigmas >= NEAR_SIGMAS and passes < MAX_PASSES:
            return replace(self, passes=passes), settled if self.mu is None else used
        if self.mu is None:
            mu = first_mu(float(np.max(t, initial=0.0)), self.wanted.width)
        else:
            mu = self.mu * self.graduation.mu_step
        kernel = replace(self.wanted, mu=mu)
        return replace(self, kernel=kernel, mu=mu, passes=0), kernel.weight(t)

    def may_end(self, settled: Array) -> bool:
        """Return whether every weight is 0 or 1."""
        is_binary = np.minimum(settled, np.abs(1.0 - settled)) <= BINARY
        return self.mu is not None and bool(np.all(is_binary))


MOST_TAILS = 8
"""Passes in which tails may change, after each time that the measurements did; near a tie they
could go to and fro."""


class Lengths(NamedTuple):
    """Of M measurements at a solution, whitened."""

    square: Array
    """(M,) squared Mahalanobis lengths ``t``, with the posterior variance in them if asked for"""
    spread: Array
    """(M,) the posterior variance ``H P H'`` alone, summed over the components"""

    def evidence(self, tails: tuple[Kernel, ...], weights: Array, *, dim: int) -> Array:
        """Return how likely (C,) each of some tails makes them, as a logarithm.

        By its weight each counts for the share of its length that the answer leaves it.
        """
        return tail_evidence(tails, self.square, self.telling(weights, dim=dim), dim=dim)

    def telling(self, weights: Array, *, dim: int) -> Array:
        """Return the share (M,) of its length that the answer leaves each by its weight."""
        return np.clip(1.0 - weights * self.spread / dim, 0.0, 1.0)


@final
@dataclass(frozen=True, slots=True)
class TailSchedule:
    """A warm kernel until the updates are near, then for each sensor the likeliest tail.

    Tails and solution take turns until both stay, see :mod:`factors.tails`.
    """

    wanted: Kernel
    """With the heaviest tail that any sensor may have"""
    kernels: tuple[Kernel, ...]
    """In force, (S,) of the sensors"""
    begin: Indices
    """(S + 1,) where the measurements of each begin, and the end"""
    dim: Indices
    """(S,) of the measurements"""
    is_warm: bool = True
    changes: int = 0
    """How often tails were changed"""
    last: Anderson | None = None

    def weight(self, t: Array) -> Array:
        """Return the weights (M,) of all measurements."""
        own = [k.weight(t[rows], dim=int(d)) for k, rows, d in self._sensors()]
        return np.concatenate([np.zeros(0), *own])

    def _sensors(self) -> list[tuple[Kernel, slice, int]]:
        rows = [slice(a, b) for a, b in itertools.pairwise(self.begin.tolist())]
        return list(zip(self.kernels, rows, self.dim.tolist(), strict=True))

    def _found(self, lengths: Lengths, weights: Array) -> tuple[Kernel, ...]:
        tails, found = tails_of(self.wanted), []
        for _, rows, dim in self._sensors():
            own = Lengths(*(column[rows] for column in lengths))
            found.append(
                likeliest_tail(tails, own.evidence(tails, weights[rows], dim=dim), dim=dim)
            )
        return tuple(found)

    def after(
        self, used: Array, settled: Array, lengths: Lengths, *, update_sigmas: float
    ) -> tuple[TailSchedule, Array]:
        """Return the schedule and the weights (M,) of the next pass, as other schedules do."""
        if self.is_warm and update_sigmas >= NEAR_SIGMAS:
            return self, settled
        kernels = self._found(lengths, used)
        if self.changes < MOST_TAILS and (self.is_warm or kernels != self.kernels):
            changed = replace(
                self, kernels=kernels, is_warm=False, changes=self.changes + 1, last=None
            )
            return changed, changed.weight(lengths.square)
        if update_sigmas >= NEAR_SIGMAS:
            return self, settled
        step = Anderson.after(self.last, used, settled)
        return replace(self, last=step), step.weights

    def may_end(self, lengths: Lengths, used: Array) -> bool:
        """Return whether the tails in force are those that the measurements ask for."""
        if self.is_warm:
            return False
        return self.changes >= MOST_TAILS or self._found(lengths, used) == self.kernels

    def anew(self) -> TailSchedule:
        """Return the same for measurements that have changed."""
        return replace(self, changes=0, last=None)
