"""Ranges with all their faults: along a simulated path, or the true path of a real recording.

Nothing of it is shared with the estimator: ranges are distances from the antenna's true place at
their own times, and what is in the way makes them longer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.ranges import Ranges, screened_ranges
from ssm_graph.systems.visual_ranges.sequence import Sequence

EXCESS_M: Final = 0.3
EXCESS_MEAN_M: Final = 0.8
"""A range that is not in line of sight is too long by the one, and an exponential of the other."""
BURST_S: Final = 1.0
ASSUMED_SOUND_SPEED: Final = 1500.0
"""m/s"""


@dataclass(frozen=True, slots=True)
class RangeFaults:
    """How ranges are measured, and what is wrong with them."""

    rate_hz: float = 10.0
    """Of each anchor; their times are spread and jitter by a fifth of the period."""
    sigma_m: float = 0.08
    bias_m: float = 0.05
    """Of all anchors."""
    bias_walk_m: float = 0.0
    """Random walk of each anchor's bias, m after one second."""
    nlos_share: float = 0.0
    """Of ranges, in bursts of a second, too long by 0.3 m and an exponential of 0.8 m."""
    occlusion: bool = True
    """Whether walls in the way make ranges too long in the same manner."""
    clock_s: float = 0.0
    """The stamps of the ranges less the time of the measurement."""
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Camera to antenna, camera axes."""
    silent_s: tuple[float, float] = (0.0, 0.0)
    """Without any range from, to."""
    lost_share: float = 0.0
    sound_speed_m_per_s: float = 0.0
    """True one, of an acoustic range: two-way, stamped when the reply comes; 0 for radio."""
    assumed_sound_speed_m_per_s: float = ASSUMED_SOUND_SPEED
    """By which times become ranges."""

    def __post_init__(self) -> None:
        for name in ("nlos_share", "lost_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"{name}: expected 0 to 1, got {getattr(self, name):g}; try 0.3")
        if not 0.0 < self.sigma_m < np.inf:
            raise ConfigError(f"sigma_m: expected above 0, got {self.sigma_m:g}; try 0.08")
        if not np.isfinite([self.bias_m, self.bias_walk_m, self.clock_s]).all():
            raise ConfigError(
                "biases and clock of ranges: expected finite numbers, got "
                f"{self.bias_m:g} m, {self.bias_walk_m:g} m and {self.clock_s:g} s"
            )
        check_span("silent_s", self.silent_s)


def check_span(name: str, span_s: tuple[float, float]) -> None:
    """Raise where a time from ... to is not one."""
    if not (np.isfinite(span_s).all() and span_s[0] <= span_s[1]):
        raise ConfigError(f"{name}: expected from and to, s, got {span_s[0]:g} {span_s[1]:g}")


def simulated_ranges(
    asked: RangeFaults,
    antenna: Callable[[Array], Array],
    anchors: Array,
    span_s: tuple[float, float],
    seed: int,
    is_blocked: Callable[[Array, Array], NDArray[np.bool_]] | None = None,
) -> tuple[Ranges, NDArray[np.bool_], Array]:
    """Return ranges, whether they are too long, and their biases.

    Parameters
    ----------
    antenna : true place (n, 3), m, at times (n,), s.
    anchors : (J, 3) m
    span_s : first and last time.
    is_blocked : whether something is between places (n, 3) and (n, 3).
    """
    rng, begin_s = np.random.default_rng((seed, 6)), span_s[0]
    columns: list[tuple[Array, Array, NDArray[np.bool_], Array]] = []
    for j, anchor in enumerate(anchors):
        n, period = int((span_s[1] - begin_s) * asked.rate_hz), 1.0 / asked.rate_hz
        time = (np.arange(n) + j / len(anchors) + rng.uniform(0.0, 0.2, n)) * period
        place = antenna(begin_s + time)
        distance = np.linalg.norm(place - anchor, axis=1)
        if asked.sound_speed_m_per_s:
            distance = _two_ways(asked, antenna, anchor, begin_s + time)
            time = time + 2.0 * distance / asked.assumed_sound_speed_m_per_s
        nlos = _bursts(time, asked.nlos_share, rng)
        if asked.occlusion and is_blocked is not None:
            nlos |= is_blocked(place, np.broadcast_to(anchor, place.shape))
        bias = asked.bias_m + asked.bias_walk_m * np.sqrt(period) * np.cumsum(rng.normal(size=n))
        noise = asked.sigma_m * rng.standard_normal(n)
        excess = EXCESS_M + rng.exponential(EXCESS_MEAN_M, n)
        measured = distance + bias + noise + np.where(nlos, excess, 0.0)
        heard = (rng.uniform(size=n) >= asked.lost_share) & (measured > 0.0)
        heard &= (time < asked.silent_s[0]) | (time >= asked.silent_s[1])
        columns.append((begin_s + time[heard], measured[heard], nlos[heard], bias[heard]))
    names = [f"A{j}" for j, column in enumerate(columns) for _ in column[0]]
    if not columns:
        columns = [(np.zeros(0), np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0))]
    time, measured, nlos, bias = (np.concatenate(c) for c in zip(*columns, strict=True))
    order = np.argsort(time, kind="stable")
    ranges = screened_ranges(
        time[order] + asked.clock_s,
        [names[i] for i in order],
        measured[order],
        np.full(len(order), asked.sigma_m),
        source="simulated ranges",
    )
    return ranges, nlos[order], bias[order]


def _two_ways(
    asked: RangeFaults, antenna: Callable[[Array], Array], anchor: Array, ping_s: Array
) -> Array:
    """Return half of both legs (n,) of pings at times (n,), m by the assumed sound speed.

    The reply reaches the antenna where it is by then, found by iteration.
    """
    out = np.linalg.norm(antenna(ping_s) - anchor, axis=1)
    back = out.copy()
    for _ in range(4):
        comes = ping_s + (out + back) / asked.sound_speed_m_per_s
        back = np.linalg.norm(antenna(comes) - anchor, axis=1)
    ratio = asked.assumed_sound_speed_m_per_s / asked.sound_speed_m_per_s
    return np.asarray(0.5 * (out + back) * ratio)


def with_simulated_ranges(
    sequence: Sequence,
    anchors: Array,
    seed: int,
    asked: RangeFaults = RangeFaults(),
) -> Sequence:
    """Return a real recording with ranges simulated along its true path, which replace its own.

    Between true poses places are interpolated by cubic splines, axes about fixed ones. Anchors
    (J, 3) are in the axes of the truth.

    Raises :class:`DataError` where there is no truth.
    """
    truth = sequence.truth
    if truth is None or len(truth.time_s) < 4:
        raise DataError(f"{sequence.name}: ranges are simulated along a true path; there is none")
    place = CubicSpline(truth.time_s, truth.position_m)
    turn = Slerp(truth.time_s, Rotation.from_quat(truth.quaternion))
    lever = np.array(asked.lever_arm_m)

    def antenna(time: Array) -> Array:
        time = np.clip(time, truth.time_s[0], truth.time_s[-1])
        return np.asarray(place(time) + turn(time).apply(lever))

    span = float(truth.time_s[0]), float(truth.time_s[-1])
    ranges, _, _ = simulated_ranges(asked, antenna, anchors, span, seed)
    return replace(sequence, ranges=ranges, anchor_truth_m=anchors, lever_arm_m=asked.lever_arm_m)


def _bursts(time_s: Array, share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which times fall into bursts of a second that cover a share of all seconds."""
    if not len(time_s):
        return np.zeros(0, dtype=bool)
    second = (time_s / BURST_S).astype(int)
    n = second.max() + 1
    chosen = np.zeros(n, dtype=bool)
    chosen[rng.permutation(n)[: round(share * n)]] = True
    return np.asarray(chosen[second])
