"""What the graph asks of an aid: rows at states, beside those of the beams."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States


class AidRows(NamedTuple):
    """Whitened rows of an aid, ``A d = b`` with ``b`` minus the error."""

    keyframe: NDArray[np.intp]
    """(M,)"""
    error: Array
    """(M,)"""
    jacobian: Array
    """(M, width)"""


class Aid(Protocol):
    """A kind of measurement beside the beams: it counts in full, without a weight."""

    name: str
    dim: int
    """Rows of one measurement"""

    def follow(self, states: States) -> None:
        """Let what is only slowly a function of the states follow them."""

    def rows(self, states: States) -> AidRows:
        """Linearise at ``states``."""
