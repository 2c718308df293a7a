"""The chi-square distribution under the names of ``scipy.stats``, which takes long to load.

Numbers or arrays in and out, by the same functions of ``scipy.special``, to the last bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri, gammaincinv


def sf(chi_sq: ArrayLike, dof: ArrayLike) -> Any:
    """Return the probability of more than ``chi_sq``."""
    return chdtrc(dof, chi_sq)


def logsf(chi_sq: ArrayLike, dof: ArrayLike) -> Any:
    """Return the logarithm of :func:`sf`; to the last bit above the median."""
    with np.errstate(divide="ignore"):
        return np.log(chdtrc(dof, chi_sq))


def isf(tail: ArrayLike, dof: ArrayLike) -> Any:
    """Return what is exceeded with the probability ``tail``."""
    return chdtri(dof, tail)


def ppf(share: ArrayLike, dof: Any) -> Any:
    """Return what is not exceeded with the probability ``share``; of 0.5 the median."""
    return 2 * gammaincinv(dof / 2, share)
