"""Logs of real vehicles: speeds and turn rates, observed landmarks, and truth where there is any.

Poses stand where something was observed, and between where that lasts: what is wrong with a heading
displaces all that follows it. The odometry is integrated as it came, each speed until the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import MOST_BEARING_RAD, half_turn
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.systems.landmark_slam.models import Odometry, between
from ssm_graph.systems.landmark_slam.problem import UNKNOWN, SlamEstimate, SlamNoise, SlamProblem

SAME_TIME_S: Final = 0.01
"""Observations closer than this in time share a pose."""
LONGEST_STEP_S: Final = 1.0
"""From a pose to the next. Within a step errors of turn and of distance are taken for independent:
at 0.04 rad/sqrt(s) that leaves out 0.02 of the way, less than such odometry is worth."""
LONGEST_GAP_S: Final = 86_400.0
"""Without any observation. After a day at 0.04 rad/sqrt(s) nothing is left of a heading (12 rad); a
clock that was set while the log was written jumps by more, and each second of it is a pose."""
TRUTH_GAP_S: Final = 0.2
"""Nearer than this to samples on both sides the truth is interpolated."""
STANDSTILL: Final = 0.05
"""Share of the odometry's noise where it says that nothing moved."""
DRIFT_SIGMA: Final = (0.1, 0.1, 0.01)
"""Of distance, of turn, and rad/s: what odometry may be wrong by all along."""
START_SIGMA: Final = (1e-3, 1e-3, 1e-3)
"""m, m, rad: the start is the frame of the map."""


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkLog(ReadOnlyArrays):
    """What a vehicle recorded."""

    odometry_s: Array
    """(N,) increasing"""
    speed: Array
    """(N, 2) forward [m/s] and to the side [m/s]"""
    turn_rate: Array
    """(N,) rad/s, positive from x to y"""
    seen_s: Array
    """(M,) ascending"""
    seen: Array
    """(M, 2) range [m] and bearing [rad]; NaN where only the other was measured."""
    landmark: NDArray[np.intp]
    """(M,) name of each, a number; `UNKNOWN` where it has none."""
    noise: SlamNoise
    """Forward, sideways [m/sqrt(s)], turn [rad/sqrt(s)]; range [m, or m a metre], bearing [rad]."""
    truth_s: Array
    """(T,)"""
    truth: Array
    """(T, 3) m, m, rad; a heading may be NaN; no rows where there is none."""
    range_sigma_grows: bool = False
    """The sigma of a range is a share of it, as where a camera tells it from a known size."""
    noise_is_a_guess: bool = False
    """Nobody stated it: that of the observations is to be found from the log."""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("odometry_s", "seen_s"):
            check_times(name, getattr(self, name), may_repeat=name == "seen_s")
        check_observations(self.seen)
        twice = _seen_twice(self.seen_s, self.landmark)
        if twice is not None:
            raise DataError(
                f"observations: landmark {self.landmark[twice]} is there twice at "
                f"{self.seen_s[twice]:.3f} s; expected once in a scan; leave one out"
            )
        ReadOnlyArrays.__post_init__(self)


def check_times(name: str, time_s: Array, *, may_repeat: bool) -> None:
    """Raise where times are not finite, or go back."""
    if len(time_s) < 2 and name != "seen_s":
        raise DataError(f"{name}: expected 2 rows or more, got {len(time_s)}; is the table empty?")
    if not np.all(np.isfinite(time_s)):
        raise DataError(
            f"{name}: expected finite times, got NaN in row {_first(~np.isfinite(time_s))}"
        )
    steps = np.diff(time_s)
    bad = steps < 0.0 if may_repeat else steps <= 0.0
    if bad.any():
        row = int(np.argmax(bad)) + 1
        raise DataError(
            f"{name}: time goes from {time_s[row - 1]:.3f} to {time_s[row]:.3f} s in row "
            f"{row + 1}; expected increasing times; sort the rows, or cut the log there"
        )


def check_observations(seen: Array) -> None:
    """Raise for ranges that are not above zero and bearings in degrees."""
    r, b = seen[:, 0], seen[:, 1]
    nothing = np.isnan(r) & np.isnan(b)
    if nothing.any():
        raise DataError(f"observations: row {_first(nothing)} has neither range nor bearing")
    if np.any(r <= 0.0) or np.isinf(seen).any():
        bad = (r <= 0.0) | np.isinf(seen).any(axis=1)
        raise DataError(
            f"observations: row {_first(bad)}: expected a range above 0 m, got "
            f"{r[np.argmax(bad)]}; leave out what found nothing"
        )
    bad = np.abs(b) > MOST_BEARING_RAD
    if bad.any():
        raise DataError(
            f"observations: row {_first(bad)}: expected a bearing in radians, got "
            f"{b[np.argmax(bad)]:g}; is it in degrees?"
        )


def _first(bad: NDArray[np.bool_]) -> int:
    return int(np.argmax(bad)) + 1


def _seen_twice(time_s: Array, landmark: NDArray[np.intp]) -> int | None:
    order = np.lexsort((landmark, time_s))
    t, name = time_s[order], landmark[order]
    same = (np.diff(t) == 0.0) & (np.diff(name) == 0) & (name[1:] != UNKNOWN)
    return int(order[1:][np.argmax(same)]) if same.any() else None


def problem_of_log(log: LandmarkLog, *, start: Array | None = None) -> SlamProblem:
    """Return a log with poses where something was seen.

    Parameters
    ----------
    log : what was recorded; observations outside the times of the odometry are left out.
    start : (3,) pose of the first keyframe; that of the truth, or the origin, if None.
    """
    within = (log.seen_s >= log.odometry_s[0]) & (log.seen_s <= log.odometry_s[-1])
    if not within.any():
        raise DataError(
            "observations: none lies within the times of the odometry "
            f"({log.odometry_s[0]:.1f} to {log.odometry_s[-1]:.1f} s); are the clocks the same?"
        )
    seen_s, seen, landmark = log.seen_s[within], log.seen[within], log.landmark[within]
    is_new = np.append(True, np.diff(seen_s) > SAME_TIME_S)
    time_s, at = _filled(seen_s[is_new])
    keyframe = at[np.cumsum(is_new) - 1]
    steps = increments(log, time_s)
    control = np.hstack([steps, np.repeat(_noise_scale(log, time_s)[:, None], 3, axis=1)])
    names = np.unique(landmark[landmark != UNKNOWN])
    index = np.where(landmark == UNKNOWN, UNKNOWN, np.searchsorted(names, landmark))
    first = start
    if first is None:
        truth, is_known = truth_at(log, time_s[:1])
        first = truth[0] if is_known[0] and np.isfinite(truth[0]).all() else np.zeros(3)
    return SlamProblem(
        time_s,
        Odometry(),
        control,
        keyframe,
        index,
        seen,
        tuple(str(name) for name in names),
        np.array(first, dtype=np.float64),
        np.array(START_SIGMA),
        np.array(DRIFT_SIGMA),
        np.column_stack([seen[:, 0], np.ones(len(seen))]) if log.range_sigma_grows else None,
    )


def _filled(time_s: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return times with as many between as the longest step asks for, and where they went."""
    gaps = np.diff(time_s)
    if gaps.max(initial=0.0) > LONGEST_GAP_S:
        row = int(np.argmax(gaps))
        raise DataError(
            f"observations: none from {time_s[row]:.3f} to {time_s[row + 1]:.3f} s; expected one "
            f"in {LONGEST_GAP_S:.0f} s; was a clock set, or are times not in seconds? cut the log"
        )
    parts = np.maximum(np.ceil(gaps / LONGEST_STEP_S), 1.0).astype(np.intp)
    at = np.append(0, np.cumsum(parts))
    return np.interp(np.arange(at[-1] + 1), at, time_s), at


def _noise_scale(log: LandmarkLog, time_s: Array) -> Array:
    """Return roots (K - 1,) of the seconds of each step; those at rest count as less."""
    still = (log.turn_rate == 0.0) & np.all(log.speed == 0.0, axis=1)
    dt = np.diff(log.odometry_s) * np.where(still[:-1], STANDSTILL**2, 1.0)
    total = np.interp(time_s, log.odometry_s, np.append(0.0, np.cumsum(dt)))
    return np.asarray(np.sqrt(np.diff(total)))


def increments(log: LandmarkLog, time_s: Array) -> Array:
    """Return the motion (K - 1, 3) from each time to the next by odometry."""
    t, dt = log.odometry_s, np.diff(log.odometry_s)
    heading = np.append(0.0, np.cumsum(log.turn_rate[:-1] * dt))
    middle = heading[:-1] + 0.5 * log.turn_rate[:-1] * dt
    steps = _turned(middle, log.speed[:-1]) * dt[:, None]
    place = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    at = np.clip(np.searchsorted(t, time_s, side="right") - 1, 0, len(t) - 2)
    rest = time_s - t[at]
    own = heading[at] + log.turn_rate[at] * rest
    mid = heading[at] + 0.5 * log.turn_rate[at] * rest
    poses = np.column_stack([place[at] + _turned(mid, log.speed[at]) * rest[:, None], own])
    found = between(poses[:-1], poses[1:])
    found[:, 2] = np.diff(own)  # more than half a turn stays what it is
    return found


def _turned(heading: Array, v: Array) -> Array:
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]], axis=1)


def truth_at(log: LandmarkLog, time_s: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the truth (K, 3) at times, and where it is known."""
    t = log.truth_s
    if len(t) < 2:
        return np.full((len(time_s), 3), np.nan), np.zeros(len(time_s), dtype=bool)
    at = np.clip(np.searchsorted(t, time_s), 1, len(t) - 1)
    near = (time_s - t[at - 1] < TRUTH_GAP_S) & (t[at] - time_s < TRUTH_GAP_S)
    near &= (time_s >= t[0]) & (time_s <= t[-1])
    x, y = (np.interp(time_s, t, log.truth[:, i]) for i in range(2))
    heading = np.interp(time_s, t, np.unwrap(log.truth[:, 2]))
    return np.column_stack([x, y, half_turn(heading)]), near


class LogScore(NamedTuple):
    """An answer against the truth."""

    position_m: float
    """Root mean square in the frame of the start."""
    heading_deg: float | None
    """None where the truth knows no heading."""
    aligned_m: float
    """Root mean square after the best turn and shift of the whole path."""
    nees: float
    """Median of NEES / 2 of the position; 0.69 if consistent."""
    n_poses: int


def score_of(truth: Array, known: NDArray[np.bool_], answer: SlamEstimate) -> LogScore:
    """Return how far an answer is from a truth (K, 3) where it is known (K,)."""
    if not known.any():
        raise DataError("score_of: expected a truth at the poses, got none; is its clock the same?")
    path, true = answer.pose[known], truth[known]
    error = path[:, :2] - true[:, :2]
    turn = half_turn(path[:, 2] - true[:, 2])
    rotation, shift = aligned(path[:, :2], true[:, :2])
    left = path[:, :2] @ rotation.T + shift - true[:, :2]
    cov = answer.pose_cov[known][:, :2, :2] + 1e-12 * np.eye(2)
    nees = np.einsum("ki,ki->k", error, np.linalg.solve(cov, error[..., None])[..., 0]) / 2.0
    return LogScore(
        float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        float(np.degrees(np.sqrt(np.nanmean(turn**2)))) if np.isfinite(turn).any() else None,
        float(np.sqrt(np.mean(np.sum(left**2, axis=1)))),
        float(np.median(nees)),
        int(known.sum()),
    )


def aligned(path: Array, true: Array) -> tuple[Array, Array]:
    """Return rotation (2, 2) and shift (2,) that bring a path (K, 2) nearest to another."""
    a, b = path.mean(axis=0), true.mean(axis=0)
    u, _, vt = np.linalg.svd((true - b).T @ (path - a))
    rotation = u @ np.diag([1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation, b - rotation @ a
