"""How heavy the tail of a sensor's noise is, found from what it measured.

The log kernel is Student's t: few degrees of freedom let go of gross errors, and cost accuracy
where there are none, 3 to 4 % of a sigma with five. With the auxiliary parameter of each
measurement at its optimum the evidence lower bound for a number of them is the density itself at
the expected squared length [1]_::

    ln G((dof + dim)/2) - ln G(dof/2) - dim/2 ln dof - (dof + dim)/2 ln(1 + t/dof)

summed over measurements. One that its own answer follows has ``t = dim`` whatever it is worth and
tells nothing: each counts for the share of its length that the answer leaves.

References
----------
.. [1] C. Liu, D. B. Rubin, "ML Estimation of the t Distribution Using EM and Its Extensions, ECM
   and ECME", Statistica Sinica 5, 1995.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import numpy as np

from factors.similarity import Array, Kernel, LogKernel

LIGHTER: Final = (10.0, 20.0, 40.0)
"""Degrees of freedom that sound noise is given; more would gain 0.2 % of a sigma at most, and the
first gross error would count for more."""
DOUBTED_SQ: Final = 36.0
"""``t`` of the one measurement that every sensor is believed to have had before its first: six
sigmas, the gate of the vehicle. It takes some 60 sound fixes, or 200 depths, to outweigh it."""


@cache
def tails_of(kernel: Kernel) -> tuple[Kernel, ...]:
    """Return the kernel and those of the same family with lighter tails; most have none."""
    if not isinstance(kernel, LogKernel):
        return (kernel,)
    return (kernel, *(LogKernel(dof) for dof in LIGHTER if dof > kernel.dof))


def tail_evidence(tails: tuple[Kernel, ...], t: Array, telling: Array, *, dim: int) -> Array:
    """Return how likely (C,) each of some tails makes measurements, as a logarithm.

    Parameters
    ----------
    tails : C kernels, those of :func:`tails_of`.
    t : (M,) squared Mahalanobis lengths, posterior variance included.
    telling : (M,) what each counts for, 0 to 1: ``1 - weight H P H' / dim``, whitened.
    dim : of the measurements.
    """
    if len(tails) < 2:
        return np.zeros(1)
    dof, constant = _densities(tails, dim)
    logs = np.log1p(t / dof[:, None]) @ telling
    return np.asarray(constant * telling.sum() - 0.5 * (dof + dim) * logs)


@cache
def _densities(tails: tuple[Kernel, ...], dim: int) -> tuple[Array, Array]:
    """Return degrees of freedom (C,) and the densities' constants, as logarithms."""
    dof = np.array([kernel.dof for kernel in tails if isinstance(kernel, LogKernel)])
    constant = [
        math.lgamma(0.5 * (nu + dim)) - math.lgamma(0.5 * nu) - 0.5 * dim * math.log(nu)
        for nu in dof.tolist()
    ]
    return dof, np.array(constant)


@cache
def _doubt(tails: tuple[Kernel, ...], dim: int) -> Array:
    return tail_evidence(tails, np.array([DOUBTED_SQ]), np.ones(1), dim=dim)


def likeliest_tail(tails: tuple[Kernel, ...], evidence: Array, *, dim: int) -> Kernel:
    """Return the likeliest of some tails after evidence (C,) and the doubt before any."""
    return tails[int(np.argmax(evidence + _doubt(tails, dim)))]
