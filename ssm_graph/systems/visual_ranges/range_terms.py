"""Ranges as terms of a bundle adjustment: all hang on key frames, so that none adds a variable.

Of every range the antenna's place is known in the axes of a key frame: a motion ``d`` that vision
gives (map units) and a lever arm ``l`` (m). With ``R_cw``, ``t_cw`` of the key frame, scale ``s``
(metres a map unit), anchor ``a`` and bias ``b`` (m), and ``u`` from the anchor to the antenna::

    x = s R_cw' (d - t_cw) + R_cw' l,    e = |x - a| + b - range,    u = (x - a) / |x - a|

The clock of the ranges may be off: at ``t + clock`` the antenna is ``clock`` times its velocity
further. Jacobians are of the left perturbation ``T_cw = Exp(rho, phi) T_cw``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.so3 import exp, log
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.systems.visual_ranges.ranges import Indices, Ranges

CLOSEST_M: Final = 1e-3
"""Nearer than this a range has no direction; the Jacobian stays finite."""
LONGEST_GAP_S: Final = 0.5
"""Between two poses, over which a range's place is not interpolated."""


class FramePoses(NamedTuple):
    """Poses of all frames, those that are lost as NaN."""

    time_s: Array
    """(N,) s, increasing"""
    R_cw: Array
    """(N, 3, 3)"""
    t_cw: Array
    """(N, 3) map units"""
    key_frame: Indices
    """(N,) index of the key frame that each hangs on; -1 for none"""


class RangeBlocks(NamedTuple):
    """Residuals of ranges and their Jacobian blocks."""

    error: Array
    """(M,) m, predicted minus measured"""
    pose: Array
    """(M, 6) w.r.t. (rho, phi) of the key frame, m per map unit and m/rad"""
    scale: Array
    """(M,) w.r.t. s, map units"""
    anchor: Array
    """(M, 3)"""
    bias: Array
    """(M,) ones"""
    clock: Array
    """(M,) m/s"""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RangeTerms(ReadOnlyArrays):
    """Ranges hung on key frames."""

    row: Indices
    """(M,) of each among all ranges"""
    key_frame: Indices
    """(M,)"""
    anchor: Indices
    """(M,)"""
    motion: Array
    """(M, 3) camera at the time of the range, key frame axes, map units"""
    velocity: Array
    """(M, 3) of it, key frame axes, map units/s"""
    lever: Array
    """(M, 3) from there to the antenna, key frame axes, m"""
    lever_rate: Array
    """(M, 3) of it, m/s"""
    range_m: Array
    """(M,)"""
    sigma_m: Array
    """(M,)"""
    axes: Array | None = None
    """(M, 3, 3) of the camera there, key frame axes; None where no lever arm is to be found"""

    def __len__(self) -> int:
        return len(self.range_m)

    def rows(self, kept: NDArray[np.bool_] | Indices) -> RangeTerms:
        """Return some of them."""
        kept_of: dict[str, Any] = {
            name: None if column is None else column[kept]
            for name in self.__dataclass_fields__
            for column in [getattr(self, name)]
        }
        return RangeTerms(**kept_of)

    def with_lever(self, change_m: Array) -> RangeTerms:
        """Return the same with a lever arm that is longer by (3,), camera axes, m."""
        if self.axes is None:
            return self
        return replace(self, lever=self.lever + self.axes @ change_m)

    def on(self, pose: Indices) -> RangeTerms:
        """Return the same on key frames counted otherwise: (M,) of each."""
        return replace(self, key_frame=pose)

    def linearise(
        self,
        R_cw: Array,
        t_cw: Array,
        s: float,
        *,
        anchors: Array,
        biases: Array,
        clock_s: float = 0.0,
    ) -> RangeBlocks:
        """Return residuals and Jacobians.

        Parameters
        ----------
        R_cw, t_cw : (K, 3, 3) and (K, 3) of all key frames.
        s : metres a map unit.
        anchors : (J, 3) m, map axes.
        biases : (J,) m
        clock_s : time of a measurement less its stamp.
        """
        R, t = R_cw[self.key_frame], t_cw[self.key_frame]
        motion = self.motion + clock_s * self.velocity
        lever = self.lever + clock_s * self.lever_rate
        from_key = motion - t
        line_c = s * from_key + lever - np.einsum("mij,mj->mi", R, anchors[self.anchor])
        distance = np.linalg.norm(line_c, axis=1)
        u_c = line_c / np.maximum(distance, CLOSEST_M)[:, None]
        return RangeBlocks(
            error=distance + biases[self.anchor] - self.range_m,
            pose=np.concatenate([-s * u_c, np.cross(u_c, s * motion + lever)], axis=1),
            scale=np.einsum("mi,mi->m", u_c, from_key),
            anchor=-np.einsum("mji,mj->mi", R, u_c),
            bias=np.ones(len(self)),
            clock=np.einsum("mi,mi->m", u_c, s * self.velocity + self.lever_rate),
        )


def hang(
    ranges: Ranges,
    frames: FramePoses,
    R_cw: Array,
    t_cw: Array,
    *,
    lever_arm_m: Array,
    clock_s: float = 0.0,
    longest_gap_s: float = LONGEST_GAP_S,
) -> RangeTerms:
    """Return the ranges that lie between two poses, on the key frame of the nearer one.

    Places are interpolated on a straight line, axes about a fixed one. Ranges before, after, and
    where frames are lost are left out.

    Parameters
    ----------
    R_cw, t_cw : (K, 3, 3) and (K, 3) of the key frames, as they stand with ``frames``.
    lever_arm_m : (3,) camera to antenna, camera axes.
    clock_s : as in :meth:`RangeTerms.linearise`; what is passed there later comes on top.
    """
    tracked = np.flatnonzero(np.isfinite(frames.t_cw).all(axis=1) & (frames.key_frame >= 0))
    time = frames.time_s[tracked]
    at = ranges.time_s + clock_s
    after = np.clip(np.searchsorted(time, at, side="right"), 1, max(len(time) - 1, 1))
    if len(time) < 2:
        after = np.zeros(0, dtype=np.intp)
        row = after
    else:
        span = time[after] - time[after - 1]
        row = np.flatnonzero((at >= time[0]) & (at <= time[-1]) & (span <= longest_gap_s))
        after = after[row]
    before, after, at = tracked[after - 1], tracked[after], at[row]
    span = frames.time_s[after] - frames.time_s[before]
    share = (at - frames.time_s[before]) / span
    R_0, R_1 = frames.R_cw[before], frames.R_cw[after]
    c_0 = -np.einsum("mji,mj->mi", R_0, frames.t_cw[before])
    c_1 = -np.einsum("mji,mj->mi", R_1, frames.t_cw[after])
    turn = log(R_0 @ np.swapaxes(R_1, 1, 2))  # of the camera, in its own axes: R_wc0' R_wc1
    key = np.where(share < 0.5, frames.key_frame[before], frames.key_frame[after])
    R_key = R_cw[key]
    R_kc = R_key @ np.swapaxes(R_0, 1, 2) @ exp(share[:, None] * turn)
    place = c_0 + share[:, None] * (c_1 - c_0)
    arm = np.asarray(lever_arm_m, dtype=np.float64)
    return RangeTerms(
        row=row,
        key_frame=key,
        anchor=ranges.anchor[row],
        motion=np.einsum("mij,mj->mi", R_key, place) + t_cw[key],
        velocity=np.einsum("mij,mj->mi", R_key, (c_1 - c_0) / span[:, None]),
        lever=R_kc @ arm,
        lever_rate=np.einsum("mij,mj->mi", R_kc, np.cross(turn / span[:, None], arm)),
        range_m=ranges.range_m[row],
        sigma_m=ranges.sigma_m[row],
        axes=R_kc,
    )


class Places(NamedTuple):
    """Where the antenna was at each range, as vision has it, in map axes."""

    camera: Array
    """(M, 3) map units"""
    velocity: Array
    """(M, 3) map units/s"""
    lever: Array
    """(M, 3) m"""
    lever_rate: Array
    """(M, 3) m/s"""
    anchor: Indices
    """(M,)"""
    range_m: Array
    """(M,)"""
    sigma_m: Array
    """(M,)"""
    time_s: Array
    """(M,)"""
    arm: Array | None = None
    """(M, 3, 3) m for each coefficient of the lever arm's error; None where it is exact"""

    def rows(self, kept: Indices) -> Places:
        """Return some of them."""
        return Places._make(None if column is None else column[kept] for column in self)


def places_of(
    terms: RangeTerms, R_cw: Array, t_cw: Array, time_s: Array, lever_sigma_m: float = 0.0
) -> Places:
    """Return the places of ranges that hang on key frames; ``time_s`` (all ranges,) their times.

    ``lever_sigma_m``: standard deviation of each of the lever arm's three numbers.
    """
    R_wc = np.swapaxes(R_cw[terms.key_frame], 1, 2)

    def turned(vector: Array) -> Array:
        return np.asarray(np.einsum("mij,mj->mi", R_wc, vector))

    return Places(
        turned(terms.motion - t_cw[terms.key_frame]),
        turned(terms.velocity),
        turned(terms.lever),
        turned(terms.lever_rate),
        terms.anchor,
        terms.range_m,
        terms.sigma_m,
        time_s[terms.row],
        lever_sigma_m * R_wc @ terms.axes if lever_sigma_m and terms.axes is not None else None,
    )
