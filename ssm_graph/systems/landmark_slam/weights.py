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

from factors.mixture import likeliest_mixture
from factors.similarity import GaussianKernel, Kernel
from factors.tails import likeliest_tail, tails_of
from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.engine.reweighting import Lengths

MOST_HIDDEN: Final = 1.2
"""Times the stated noise over what the median says, beyond which no gross ones are told from it."""
DECISIVE: Final = 10.0
"""Logarithm of odds; a weight that ends is taken for nothing less."""
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


def tail_of(kernel: Kernel, lengths: Lengths, weights: Array, dim: Array) -> Kernel:
    """Return the kernel that makes measurements likeliest, if one may choose for this one.

    For the logarithm's: one of the same family with a lighter tail (`factors.tails`), or, where
    some are gross and all else is normal, the mixture of both (`factors.mixture`; of measurements
    with one number of rows). Those that err less than stated hide their tail: they count as if
    their median were as stated.

    Parameters
    ----------
    kernel : with the heaviest tail that they may have.
    lengths : of M measurements.
    weights : (M,)
    dim : (M,) of their rows; of those without any nothing is asked.
    """
    tails, mixture = tails_of(kernel), None
    if len(tails) == 1:
        return kernel
    evidence, largest = np.zeros(len(tails)), int(np.max(dim, initial=1))
    for size in range(1, largest + 1):
        own = dim == size
        if not own.any():
            continue
        square = lengths.square[own]
        hidden = max(chi2.ppf(0.5, size) / float(np.median(square)), 1.0)
        part = Lengths(hidden * square, lengths.spread[own])
        evidence += part.evidence(tails, weights[own], dim=size)
        if own.all() and hidden < MOST_HIDDEN:
            mixture = likeliest_mixture(square, part.telling(weights, dim=size), dim=size)
    if mixture is not None and mixture.evidence > np.max(evidence) + DECISIVE:
        return mixture.kernel
    return likeliest_tail(tails, evidence, dim=largest)
