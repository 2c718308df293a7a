"""Successive keyframes as they were at one moment of their life."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States


class Stretch(NamedTuple):
    """Successive keyframes as they were at one moment, with the beams of all of them."""

    time_s: Array
    """(K,) s"""
    states: States
    """(K, ...)"""
    covariance: Array
    """(K, n, n)"""
    n_beams: Array
    """(K,)"""
    beam: Array
    """(M,) 0 to 3, of each beam speed"""
    innovation: Array
    """(M,) m/s, measured minus predicted before the first update"""
    mahalanobis_sq: Array
    """(M,)"""
    weight: Array
    """(M,)"""


def joined(stretches: Sequence[Stretch]) -> Stretch:
    """Return successive stretches as one."""
    time_s, states, *others = zip(*stretches, strict=True)
    return Stretch(
        np.concatenate(time_s),
        states[0].followed_by(*states[1:]),
        *(np.concatenate(column) for column in others),
    )
