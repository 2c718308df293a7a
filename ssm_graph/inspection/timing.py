"""How regular a sensor's times are: rate, jitter, gaps, repeats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array

GAP_STEPS: Final = 3.0
"""A step of more than so many usual ones is a gap."""
MOST_GAPS: Final = 5
"""That are told one by one, the longest."""


@dataclass(frozen=True, slots=True)
class Timing:
    """What the times of one sensor say."""

    n: int
    begin_s: float
    end_s: float
    step_s: float
    """Median from one to the next; NaN with less than two."""
    jitter_s: float
    """Spread of the steps that are no gaps: half of what holds 95 % of them."""
    n_repeats: int
    """Times that stand twice or more."""
    n_back: int
    """Times before the one in front of them."""
    gaps: tuple[tuple[float, float], ...]
    """Begin and length (s) of the longest, in order of time."""
    n_gaps: int
    in_gaps_s: float
    """Sum of all gaps, s."""

    @property
    def rate_hz(self) -> float:
        """One over the usual step; NaN where there is none."""
        return 1.0 / self.step_s if self.step_s > 0.0 else float("nan")


def timing_of(time_s: Array) -> Timing:
    """Return what times (N,) say, in the order in which they stand."""
    n = len(time_s)
    if n < 2:
        only = float(time_s[0]) if n else float("nan")
        nan = float("nan")
        return Timing(n, only, only, nan, nan, 0, 0, (), 0, 0.0)
    steps = np.diff(time_s)
    forward = steps[steps > 0.0]
    step_s = float(np.median(forward)) if len(forward) else float("nan")
    is_gap = steps > GAP_STEPS * step_s
    usual = forward[forward <= GAP_STEPS * step_s]
    low, high = np.quantile(usual, [0.025, 0.975]) if len(usual) else (np.nan, np.nan)
    at = np.flatnonzero(is_gap)
    longest = np.sort(at[np.argsort(-steps[at], kind="stable")[:MOST_GAPS]])
    return Timing(
        n=n,
        begin_s=float(time_s.min()),
        end_s=float(time_s.max()),
        step_s=step_s,
        jitter_s=0.5 * float(high - low),
        n_repeats=int(np.sum(steps == 0.0)),
        n_back=int(np.sum(steps < 0.0)),
        gaps=tuple((float(time_s[i]), float(steps[i])) for i in longest),
        n_gaps=len(at),
        in_gaps_s=float(steps[at].sum()),
    )
