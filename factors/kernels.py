"""Every kernel by name, and the M-estimators: minus a loss, and the weight that follows.

With the squared whitened residual ``t`` every one of them is ``f(t) = -rho(t)``, ``rho(t) = t/2``
for small ``t`` and bounded or at least slower beyond::

    weight = 2 rho'(t) = psi(r) / r,    r = sqrt(t)

They belong with the plain residual, as published. ``f`` is convex in ``t``, so the posterior
variance may be put into ``t`` all the same.

References
----------
.. [1] P. J. Huber, "Robust Estimation of a Location Parameter", Annals of Mathematical Statistics
   35, 1964.
.. [2] P. W. Holland, R. E. Welsch, "Robust Regression Using Iteratively Reweighted Least-Squares",
   Communications in Statistics A6, 1977: scales for 95 % efficiency.
.. [3] Z. Zhang, "Parameter Estimation Techniques: a Tutorial with Application to Conic Fitting",
   Image and Vision Computing 15, 1997: Geman-McClure, without a scale.
.. [4] P. Agarwal, G. D. Tipaldi, L. Spinello, C. Stachniss, W. Burgard, "Robust Map Optimization
   Using Dynamic Covariance Scaling", ICRA 2013.
.. [5] H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated Non-Convexity for Robust Spatial
   Perception: From Non-Minimal Solvers to Global Outlier Rejection", RA-L 5, 2020.
.. [6] J. T. Barron, "A General and Adaptive Robust Loss Function", CVPR 2019.
.. [7] N. Chebrolu, T. Läbe, O. Vysotska, J. Behley, C. Stachniss, "Adaptive Robust Kernels for
   Non-Linear Least Squares Problems", RA-L 6, 2021.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Final, final

import numpy as np

from factors.similarity import (
    Array,
    ExpKernel,
    GaussianKernel,
    Kernel,
    LogKernel,
    Similarity,
    SqrtKernel,
    require_positive,
)

WIDTH_OF_99_PERCENT = 2.5758293035489004
"""Sigmas that hold 99 % of a Gaussian: the square root of chi2inv(0.99, 1)."""


class MEstimator(Kernel):
    """Minus a loss of the squared residual: ``f(0) = 0``, ``weight(0) = 1``, never above 1.

    The length of a measurement of several dimensions is weighed as a whole; the scales given here
    are those for one.
    """

    published_with: ClassVar[Similarity] = Similarity.PLAIN


@final
@dataclass(frozen=True)
class HuberKernel(MEstimator):
    """Least squares up to ``width``, the absolute value beyond [1]_."""

    name: ClassVar[str] = "huber"
    width: float = 1.345
    """Sigmas up to which a residual counts in full; 95 % efficient, and GTSAM's default."""

    def similarity(self, t: Array, *, dim: int = 1) -> Array:  # noqa: ARG002
        """Return minus the loss."""
        beyond = self.width * np.sqrt(t) - 0.5 * self.width**2
        return -np.where(t <= self.width**2, 0.5 * t, beyond)

    def _weight(self, t: Array, dim: int | Array) -> Array:  # noqa: ARG002
        return np.asarray(self.width / np.sqrt(np.maximum(t, self.width**2)))


@final
@dataclass(frozen=True)
class CauchyKernel(MEstimator):
    """``f = -width^2/2 ln(1 + t/width^2)``.

    The log kernel with ``dof = width^2``, but for its norm: the weight is 1 at ``t = 0``.
    """

    name: ClassVar[str] = "cauchy"
    width: float = 2.3849
    """Sigmas at which the weight is a half; 95 % efficient [2]_. GTSAM's default is 0.1."""

    def similarity(self, t: Array, *, dim: int = 1) -> Array:  # noqa: ARG002
        """Return minus the loss."""
        return np.asarray(-0.5 * self.width**2 * np.log1p(t / self.width**2))

    def _weight(self, t: Array, dim: int | Array) -> Array:  # noqa: ARG002
        return np.asarray(1.0 / (1.0 + t / self.width**2))


@final
@dataclass(frozen=True)
class DcsKernel(MEstimator):
    """Dynamic covariance scaling [4]_: ``s = min(1, 2 phi / (phi + t))``, weight ``s^2``.

    The paper gives the scale ``s``; the loss is what it integrates to.
    """

    name: ClassVar[str] = "dcs"
    phi: float = 1.0
    """Squared sigmas up to which a residual counts in full; 1 in the paper and in GTSAM, which is
    64 % efficient on Gaussian noise; 3.60 is 95 %."""

    def similarity(self, t: Array, *, dim: int = 1) -> Array:  # noqa: ARG002
        """Return minus the loss."""
        beyond = 1.5 * self.phi - 2.0 * self.phi**2 / (self.phi + t)
        return -np.where(t <= self.phi, 0.5 * t, beyond)

    def _weight(self, t: Array, dim: int | Array) -> Array:  # noqa: ARG002
        return np.square(np.minimum(1.0, 2.0 * self.phi / (self.phi + t)))


@final
@dataclass(frozen=True)
class GemanMcClureKernel(MEstimator):
    """``f = -width^2/2 t/(width^2 + t)``: bounded."""

    name: ClassVar[str] = "geman-mcclure"
    width: float = 1.0
    """Sigmas at which the weight is a quarter; 1 in [3]_ and in GTSAM, which is 44 % efficient on
    Gaussian noise; 3.79 is 95 %."""

    def similarity(self, t: Array, *, dim: int = 1) -> Array:  # noqa: ARG002
        """Return minus the loss."""
        return np.asarray(-0.5 * t / (1.0 + t / self.width**2))

    def _weight(self, t: Array, dim: int | Array) -> Array:  # noqa: ARG002
        return np.asarray((1.0 + t / self.width**2) ** -2.0)


@final
@dataclass(frozen=True)
class GeneralKernel(MEstimator):
    """The general loss [6]_: one shape from least squares to losses that end.

    With ``x = t/width^2`` and ``b = |alpha - 2|``, times ``width^2`` so that ``f`` begins as
    ``-t/2``::

        f = -width^2 b/alpha ((x/b + 1)^(alpha/2) - 1),    weight = (x/b + 1)^(alpha/2 - 1)

    ``alpha`` 2 is least squares, 1 Charbonnier's loss, 0 Cauchy's with ``sqrt(2) width``, -2 that
    of Geman and McClure with ``2 width``, -infinity Welsch's.
    """

    name: ClassVar[str] = "general"
    alpha: float = 0.0
    """The shape, 2 or less; see :func:`fitted_shape`."""
    width: float = 1.0
    """Sigmas (the paper's c) up to which it is near to least squares; 1 is the noise as stated."""

    def __post_init__(self) -> None:
        require_positive("width", self.width)
        if not self.alpha <= 2.0:
            raise ValueError(f"alpha: expected a number of 2 or less, got {self.alpha}")

    def similarity(self, t: Array, *, dim: int = 1) -> Array:  # noqa: ARG002
        """Return minus the loss."""
        return np.asarray(-(self.width**2) * _general_loss(t / self.width**2, self.alpha))

    def _weight(self, t: Array, dim: int | Array) -> Array:  # noqa: ARG002
        x, b = t / self.width**2, abs(self.alpha - 2.0)
        if b == 0.0:
            return np.ones_like(t)
        if math.isinf(b):
            return np.asarray(np.exp(-0.5 * x))
        # (alpha/2 - 1) = -b/2
        return np.asarray(np.exp(-0.5 * b * np.log1p(x / b)))


def _general_loss(x: Array, alpha: float) -> Array:
    """Return the general loss of squared residuals ``x`` in squared widths."""
    if alpha == 2.0:
        return np.asarray(0.5 * x)
    if math.isinf(alpha):
        return np.asarray(-np.expm1(-0.5 * x))
    b = abs(alpha - 2.0)
    if alpha == 0.0:
        return np.log1p(x / b)
    return np.asarray(b / alpha * np.expm1(0.5 * alpha * np.log1p(x / b)))


SHAPES: Final = np.linspace(-10.0, 2.0, 121)
"""Among which the shape is looked for [7]_; below -10 hardly anything changes."""
TRUNCATED_AT: Final = 10.0
"""Widths to which the density of a shape reaches [7]_: below zero it has no integral otherwise."""
_WIDTHS = np.linspace(0.0, TRUNCATED_AT, 2001)


@cache
def log_partition(alpha: float) -> float:
    """Return ``ln`` of the integral of ``exp(-loss)`` over residuals of up to 10 widths."""
    return math.log(2.0 * float(np.trapezoid(np.exp(-_general_loss(_WIDTHS**2, alpha)), _WIDTHS)))


def fitted_shape(t: Array, *, width: float = GeneralKernel.width) -> float:
    """Return the shape under which residuals are most likely [7]_.

    That of the least ``sum(loss) + N ln(width Z)``, with ``Z`` the truncated partition function:
    what a heavy tail spares of large residuals it costs on the many small ones.

    Parameters
    ----------
    t : (N,) squared whitened residuals; 2 without any.
    width : as :attr:`GeneralKernel.width`.
    """
    x = np.asarray(t, dtype=np.float64) / width**2
    costs = [
        float(_general_loss(x, alpha).sum()) + len(x) * log_partition(alpha)
        for alpha in SHAPES.round(1).tolist()
    ]
    # The last of equals: least squares where nothing is known.
    return float(SHAPES.round(1)[len(costs) - 1 - int(np.argmin(costs[::-1]))])


@final
@dataclass(frozen=True)
class TruncatedKernel(MEstimator):
    """Truncated least squares, ``f = -min(t, width^2)/2``, or a smoother surrogate of it.

    Truncated for itself, without graduation, it is a hard gate on every measurement.

    The surrogate of graduated non-convexity [5]_ fills a band about ``width^2``::

        weight = width sqrt(mu (mu + 1) / t) - mu,    mu / (mu + 1) < t / width^2 < (mu + 1) / mu

    For ``mu`` to 0 it is proportional to the absolute value, for ``mu`` to infinity truncated.
    """

    name: ClassVar[str] = "truncated"
    width: float = WIDTH_OF_99_PERCENT
    """Sigmas beyond which a residual is an outlier (the paper's c bar); GTSAM's default."""
    mu: float = math.inf
    """How far the graduation has got; infinite is truncated least squares itself."""

    def __post_init__(self) -> None:
        require_positive("width", self.width)
        if not self.mu > 0.0:
            raise ValueError(f"mu: expected a number above zero, got {self.mu}")

    def similarity(self, t: Array, *, dim: int = 1) -> Array:  # noqa: ARG002
        """Return minus the loss, eq. (13)."""
        end = self.width**2
        if math.isinf(self.mu):
            return -0.5 * np.minimum(t, end)
        low, high = self._band()
        root = self.width * math.sqrt(self.mu * (self.mu + 1.0))
        within = root * np.sqrt(t) - 0.5 * self.mu * (end + t)
        return -np.where(t <= low, 0.5 * t, np.where(t >= high, 0.5 * end, within))

    def _weight(self, t: Array, dim: int | Array) -> Array:  # noqa: ARG002
        """Return eq. (14)."""
        if math.isinf(self.mu):
            return np.where(t <= self.width**2, 1.0, 0.0)
        low, high = self._band()
        root = self.width * math.sqrt(self.mu * (self.mu + 1.0))
        within = np.clip(root / np.sqrt(np.clip(t, low, high)) - self.mu, 0.0, 1.0)
        return np.where(t <= low, 1.0, np.where(t >= high, 0.0, within))

    def _band(self) -> tuple[float, float]:
        share = self.mu / (self.mu + 1.0)
        return share * self.width**2, self.width**2 / share

    def __str__(self) -> str:
        mu = "" if math.isinf(self.mu) else f", mu={self.mu:.2g}"
        return f"truncated(width={self.width:g}{mu})"


@dataclass(frozen=True, slots=True)
class KernelChoice:
    """A kernel with at most one parameter."""

    make: Callable[..., Kernel]
    """Takes the parameter by its name, or nothing."""
    parameter: str = ""
    """``dof``, ``width`` (sigmas), ``phi`` (squared sigmas) or ``alpha``; empty where there is
    none."""

    @property
    def default(self) -> float | None:
        """The parameter where none is given."""
        return float(getattr(self.make(), self.parameter)) if self.parameter else None

    def kernel(self, value: float | None = None) -> Kernel:
        """Return the kernel; a parameter that it does not have is a ValueError."""
        if value is None:
            return self.make()
        if not self.parameter:
            raise ValueError(f"expected no parameter, got {value:g}")
        return self.make(**{self.parameter: value})


KERNELS: Final[Mapping[str, KernelChoice]] = {
    "log": KernelChoice(LogKernel, "dof"),
    "sqrt": KernelChoice(SqrtKernel, "dof"),
    "exp": KernelChoice(ExpKernel, "width"),
    "gaussian": KernelChoice(GaussianKernel),
    "huber": KernelChoice(HuberKernel, "width"),
    "cauchy": KernelChoice(CauchyKernel, "width"),
    "dcs": KernelChoice(DcsKernel, "phi"),
    "geman-mcclure": KernelChoice(GemanMcClureKernel, "width"),
    "general": KernelChoice(GeneralKernel, "alpha"),
    "truncated": KernelChoice(TruncatedKernel, "width"),
}
"""Names as on the command line."""


def parse_kernel(text: str) -> Kernel:
    """Return the kernel named, for example, ``log``, ``log:7`` or ``huber:1.5``.

    Raises
    ------
    ValueError
        The name is not known, or the number behind the colon cannot be used.
    """
    name, colon, number = text.partition(":")
    if name not in KERNELS:
        raise ValueError(f"there is no kernel {name!r}; known: {', '.join(KERNELS)}")
    choice = KERNELS[name]
    try:
        return choice.kernel(float(number) if colon else None)
    except ValueError as error:
        wanted = f"{choice.parameter} after the colon" if choice.parameter else "the name alone"
        raise ValueError(f"kernel {text!r}: expected {wanted} ({error}); try log:5") from error
