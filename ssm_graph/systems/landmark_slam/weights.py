"""Similarity weights that leave a sigma what it is: of normal noise they are 1 in the mean.

A kernel's weights have another mean than 1 over normal noise, so that covariances would be too
small or too large by it. The squares that a weight is judged by are divided by a constant ``c`` of
the kernel, and so is the weight, such that the information of normal noise is that of least
squares: ``E[w(t / c) / c] = 1``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from scipy.optimize import brentq

from factors.similarity import GaussianKernel, Kernel
from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array

_QUANTILES: Final = (np.arange(4000) + 0.5) / 4000.0


@lru_cache(maxsize=64)
def information_scale(kernel: Kernel, dim: int) -> float:
    """Return ``c``."""
    if isinstance(kernel, GaussianKernel):
        return 1.0
    t = chi2.ppf(_QUANTILES, dim)

    def excess(c: float) -> float:
        return float(np.mean(kernel.weight(t / c, dim=dim))) / c - 1.0

    low = 1e3  # the largest root: a kernel that ends has another one, where nothing counts
    while excess(low) < 0.0 and low > 1e-6:
        low /= 1.1
    return float(brentq(excess, low, 1.1 * low)) if low > 1e-6 else 1.0


@lru_cache(maxsize=64)
def square_share(kernel: Kernel, dim: int) -> float:
    """Return the mean of weighted squares of normal noise of variance one, at most 1 or so."""
    t = chi2.ppf(_QUANTILES, dim)
    return float(np.mean(weights_of(kernel, t, np.full(len(t), dim)) * t) / dim)


def weights_of(kernel: Kernel, t: Array, dim: Array) -> Array:
    """Return weights (M,) of measurements of ``dim`` (M,) rows with expected squares ``t``."""
    weights = np.ones_like(t)
    for size in np.unique(dim[dim > 0]).astype(int):
        c = information_scale(kernel, size)
        of_size = dim == size
        weights[of_size] = kernel.weight(t[of_size] / c, dim=size) / c
    return weights
