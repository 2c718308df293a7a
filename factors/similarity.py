"""Similarity kernels: how much a measurement counts, given how well it agrees.

The statistical similarity of two random vectors is ``E[f(|a - b|^2)]`` with ``f`` continuous,
decreasing and convex. Its lower bound under a Gaussian posterior depends on the squared
Mahalanobis length with the posterior variance in it::

    t = (innovation^2 + H P H') / sigma^2,    weight = -2 f'(t)

Every similarity kernel has ``weight(dim) = 1``: a residual of expected size keeps its nominal
noise.
The classical M-estimators of :mod:`factors.kernels` are kernels as well, of another norm.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from enum import Enum
from typing import ClassVar, Final, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

WEIGHT_FLOOR = 1e-8
"""Smallest weight; keeps the information of a rejected measurement regular."""


def expected_mahalanobis_sq(
    innovation: Array, predicted_variance: Array, *, sigma: ArrayLike
) -> Array:
    """Return ``t = (innovation^2 + predicted_variance) / sigma^2``, all (...).

    ``predicted_variance`` is ``H P H'`` at the posterior; zero gives the plain M-estimator.
    """
    return np.asarray((innovation**2 + predicted_variance) / np.square(sigma))


class Similarity(Enum):
    """What the weight of a beam is judged by."""

    EXPECTED = "residual and posterior variance"
    PLAIN = "residual alone: the plain M-estimator"


@dataclass(frozen=True)
class Kernel(ABC):
    """A decreasing, convex function ``f`` of ``t`` and the weight ``-2 f'``, which never rises.

    Its fields are its parameters, numbers above zero. Where the weight is 1 is a matter of the
    family: at ``t = dim`` for the similarity kernels, at ``t = 0`` for M-estimators.
    """

    published_with: ClassVar[Similarity] = Similarity.EXPECTED
    """The ``t`` that the kernel was published for; the other one may be asked for."""
    name: ClassVar[str]
    """As on the command line."""

    def __post_init__(self) -> None:
        for parameter in fields(self):
            require_positive(parameter.name, getattr(self, parameter.name))

    def __str__(self) -> str:
        values = ", ".join(f"{p.name}={getattr(self, p.name):g}" for p in fields(self))
        return f"{self.name}({values})" if values else self.name

    @abstractmethod
    def similarity(self, t: Array, *, dim: int = 1) -> Array:
        """Return ``f(t)`` for measurements of dimension ``dim``."""

    @abstractmethod
    def _weight(self, t: Array, dim: int | Array) -> Array:
        """Return ``-2 f'(t)``, not floored."""

    def weight(self, t: ArrayLike, *, dim: int | Array = 1) -> Array:
        """Return the weight of measurements of dimension ``dim``, at least the floor.

        Parameters
        ----------
        t : (...) squared Mahalanobis lengths, 0 or more.
        dim : dimension of the measurements, of all or (...) of each.
        """
        return np.maximum(self.raw_weight(t, dim=dim), WEIGHT_FLOOR)

    def raw_weight(self, t: ArrayLike, *, dim: int | Array = 1) -> Array:
        """Return the weight as published, which may underflow to zero."""
        return self._weight(np.asarray(t, dtype=np.float64), dim)


LARGEST_PARAMETER: Final = 1e15


def require_positive(name: str, value: float) -> None:
    """Raise ValueError for a parameter that is no number above zero, or whose square is none."""
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{name}: expected a number above zero, got {value}")
    if not 1.0 / LARGEST_PARAMETER <= value <= LARGEST_PARAMETER:
        raise ValueError(
            f"{name}: expected a number from {1.0 / LARGEST_PARAMETER:g} to "
            f"{LARGEST_PARAMETER:g}, got {value:g}; beyond it nothing changes any more"
        )


@final
@dataclass(frozen=True)
class GaussianKernel(Kernel):
    """``f = -t/2``: least squares, every weight 1."""

    name: ClassVar[str] = "gaussian"

    def similarity(self, t: Array, *, dim: int = 1) -> Array:  # noqa: ARG002
        """Return ``-t / 2``."""
        return -0.5 * t

    def _weight(self, t: Array, dim: int | Array) -> Array:  # noqa: ARG002
        return np.ones_like(t)


@final
@dataclass(frozen=True)
class LogKernel(Kernel):
    """``f = -(dof + dim)/2 ln(1 + t/dof)``: Student's t."""

    name: ClassVar[str] = "log"
    dof: float = 5.0
    """Degrees of freedom; large is Gaussian."""

    def similarity(self, t: Array, *, dim: int = 1) -> Array:
        """Return ``f(t)``."""
        return np.asarray(-0.5 * (self.dof + dim) * np.log1p(t / self.dof))

    def _weight(self, t: Array, dim: int | Array) -> Array:
        return np.asarray((self.dof + dim) / (self.dof + t))


@final
@dataclass(frozen=True)
class SqrtKernel(Kernel):
    """``f = -sqrt((dof + dim)(dof + t))``."""

    name: ClassVar[str] = "sqrt"
    dof: float = 2.0
    """Degrees of freedom; large is Gaussian."""

    def similarity(self, t: Array, *, dim: int = 1) -> Array:
        """Return ``f(t)``."""
        return -np.sqrt((self.dof + dim) * (self.dof + t))

    def _weight(self, t: Array, dim: int | Array) -> Array:
        return np.sqrt((self.dof + dim) / (self.dof + t))


@final
@dataclass(frozen=True)
class ExpKernel(Kernel):
    """``f = width^2 exp((dim - t) / (2 width^2))``: correntropy."""

    name: ClassVar[str] = "exp"
    width: float = 5.0
    """Kernel width in sigmas; large is Gaussian."""

    def similarity(self, t: Array, *, dim: int = 1) -> Array:
        """Return ``f(t)``."""
        return np.asarray(self.width**2 * np.exp((dim - t) / (2.0 * self.width**2)))

    def _weight(self, t: Array, dim: int | Array) -> Array:
        return np.asarray(np.exp((dim - t) / (2.0 * self.width**2)))
