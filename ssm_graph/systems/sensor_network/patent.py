"""The recursion of the patent, to the letter as far as it is known, and what its bound is worth.

Nearly all formulas of the text are lost; what is here follows from the lists of symbols under each
and from the number of their parameters (three in the prediction, six in the update: three and four
summed vectors). docs/network.md derives them and says which numbers are assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.ellipsoids import checked_shape
from ssm_graph.systems.sensor_network.codes import Indices
from ssm_graph.systems.sensor_network.motion import planar_step
from ssm_graph.systems.sensor_network.setting import Setting

_H: Final = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class Parameters(Enum):
    """The positive numbers mu and eps, free in the patent."""

    ONES = "all one"
    OPTIMAL = "those of the least trace"


class Saturation(Enum):
    """How the bound of the prediction takes the saturation into account."""

    TRACE = "min(tr M, 4 sum s^2) I, as the patent does"
    TESTED = "M where it cannot act, else as the patent does"


@dataclass(frozen=True, slots=True, eq=False)
class PatentSettings:
    """What the recursion is free to choose; defaults are the patent's, or assumed where lost."""

    lam: float | None = 3.0
    """lambda of the remainder with F = I; None for the Lagrange bound with F = diag(1, 1, 0)."""
    parameters: Parameters = Parameters.OPTIMAL
    saturation: Saturation = Saturation.TRACE
    consensus: float = 0.1
    """Gain eps_i [assumed]; weights a_ij are 1."""
    Q: Array | None = None
    """(3, 3) bounding matrix of the motion's noise; None for the least multiple of the identity."""
    R: Array | None = None
    """(2, 2) that of the positions' noise."""


def balanced(traces: Array) -> Array:
    """Return c (..., S) with ``(sum a_s)(sum a_s)' <= sum c_s a_s a_s'`` of the least trace.

    ``c_s = sum_t sqrt(tr A_t) / sqrt(tr A_s)``: pairwise parameters ``sqrt(tr A_t / tr A_s)``. Of
    a part that is zero c is infinite, and is returned as zero, for it has nothing to scale.
    """
    root = np.sqrt(traces)
    inverse = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0.0)
    return np.asarray(inverse * root.sum(axis=-1, keepdims=True))


class PatentNodes:
    """All nodes of R runs with the patent's recursion; ``center`` and ``bound`` are E(x, P)."""

    def __init__(
        self, setting: Setting, *, center: Array, settings: PatentSettings | None = None
    ) -> None:
        """Start from E(center, P_0), center (R, N, 3)."""
        self.setting = setting
        self.own = settings or PatentSettings()
        self.center = center.copy()
        identity = np.broadcast_to(np.eye(3), (*center.shape, 3))
        self.bound = setting.initial_variance * identity
        w, r = np.asarray(setting.motion_bound), setting.position_bound
        # The least multiple of the identity, as Q and R are lost: |w|^2 and |v|^2 at their corners.
        Q, R = float(w @ w) * np.eye(3), 2.0 * r**2 * np.eye(2)
        self.Q = Q if self.own.Q is None else checked_shape("Q", self.own.Q)
        self.R = R if self.own.R is None else checked_shape("R", self.own.R)
        self.E = 0.5 * setting.step**2 * np.eye(2)
        self.s_sq = float(np.sum(np.square(setting.saturation)))

    def go_on_with(self, runs: Indices) -> None:
        """Lead some of the runs on, in the places of all."""
        self.center, self.bound = self.center[runs], self.bound[runs]

    def _weights(self, *traces: Array) -> Array:
        stack = np.stack(np.broadcast_arrays(*traces), axis=-1)
        if self.own.parameters is Parameters.ONES:
            return np.full(stack.shape, float(stack.shape[-1]))
        return balanced(stack)

    def lead_on(self, advance: Array, turn: Array) -> None:
        """Predict all nodes: step three of the patent."""
        v = np.hypot(advance[..., 0], advance[..., 1])
        theta = self.center[..., 2] + np.arctan2(advance[..., 1], advance[..., 0])
        Phi = np.broadcast_to(np.eye(3), self.bound.shape).copy()
        Phi[..., 0, 2], Phi[..., 1, 2] = -v * np.sin(theta), v * np.cos(theta)
        moved = Phi @ self.bound @ np.swapaxes(Phi, -1, -2)
        if self.own.lam is None:
            remainder = 0.25 * (v * self.bound[..., 2, 2]) ** 2
            remainder = remainder[..., None, None] * np.diag([1.0, 1.0, 0.0])
        else:
            remainder = np.broadcast_to(self.own.lam * np.eye(3), moved.shape)
        parts = np.stack(np.broadcast_arrays(moved, remainder, self.Q), axis=-3)
        c = self._weights(*np.moveaxis(np.einsum("...sii->...s", parts), -1, 0))
        M = np.einsum("...s,...sij->...ij", c, parts)
        least = np.minimum(np.einsum("...ii->...", M), 4.0 * self.s_sq)
        as_patent = least[..., None, None] * np.eye(3)
        levels = np.asarray(self.setting.saturation)
        f = planar_step(self.center, advance, turn)
        if self.own.saturation is Saturation.TESTED:
            reach = np.abs(f) + np.sqrt(np.einsum("...ii->...i", M))
            free = np.all(reach <= levels, axis=-1)[..., None, None]
            as_patent = np.where(free, M, as_patent)
        self.center, self.bound = np.clip(f, -levels, levels), as_patent

    def hear(self, values: Array) -> None:
        """Gain and update of all nodes, values (R, N, 2): steps four to six of the patent."""
        P, x, eps = self.bound, self.center, self.own.consensus
        heard = self.setting.hears()
        g = np.einsum("ij,rjl->ril", heard, x) - heard.sum(axis=1)[:, None] * x
        gg = eps**2 * g[..., :, None] * g[..., None, :]
        HPH = P[..., :2, :2]
        K = self._gain(P, HPH, np.ones((*x.shape[:2], 4)))
        for _ in range(1 if self.own.parameters is Parameters.ONES else 4):
            parts = self._parts(P, K, gg)
            c = self._weights(*np.moveaxis(np.einsum("...sii->...s", parts), -1, 0))
            K = self._gain(P, HPH, c)
        parts = self._parts(P, K, gg)
        self.bound = np.einsum("...s,...sij->...ij", c, parts)
        innovation = values - x[..., :2]
        self.center = x + np.einsum("...ij,...j->...i", K, innovation) + eps * g

    def _gain(self, P: Array, HPH: Array, c: Array) -> Array:
        c1, c2, c3 = (c[..., s, None, None] for s in range(3))
        S = c1 * HPH + c2 * self.E + c3 * self.R
        return np.asarray(c1 * np.swapaxes(np.linalg.solve(S, P[..., :2, :]), -1, -2))

    def _parts(self, P: Array, K: Array, gg: Array) -> Array:
        IKH = np.eye(3) - K @ _H
        Kt = np.swapaxes(K, -1, -2)
        parts = (IKH @ P @ np.swapaxes(IKH, -1, -2), K @ self.E @ Kt, K @ self.R @ Kt, gg)
        return np.stack(parts, axis=-3)
