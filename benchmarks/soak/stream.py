"""Days of simulated data with everything that goes wrong, and how the live estimator bears them."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.missions import sparse
from benchmarks.online.stream import HEALTHS, Answers, run_stream
from benchmarks.report import note
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.errors import error_series
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import FixedLagSmoother
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.mission.navigation import Health
from ssm_graph.simulation import DepthSettings, DvlSettings, Grade, Loss, scenario_config, simulate

HOUR_S = 3600.0
LOSS_S = (1800.0, 2400.0)
"""Begin and end within the hour"""
STUCK_S = (600.0, 1500.0)
STUCK_BEAM = 1
GAP_EVERY_S, GAP_S = 600.0, 1.0
GOOD = HEALTHS.index(Health.GOOD)
AXES = tuple(
    f"{name} {axis}"
    for name, axes in (("position", "ENU"), ("velocity", "ENU"), ("attitude", "RPH"))
    for axis in axes
)
_CHUNK = 20_000


@dataclass(frozen=True, slots=True)
class Case:
    """What goes wrong with a stream."""

    has_depth: bool = True
    outliers: float = 0.0
    """Share of the pings with one"""
    losses: bool = False
    """No bottom for ten minutes of every hour"""
    stuck: bool = False
    """One beam repeats its reading for a quarter of every hour, also while the others are gone"""
    gaps: bool = False
    """A second of the inertial data is missing of every ten minutes, at a time drawn from them"""


CASES = {
    "depth": Case(),
    "no depth": Case(has_depth=False),
    "outliers 40 %": Case(outliers=0.4),
    "bottom losses": Case(losses=True),
    "stuck beam": Case(stuck=True),
    "IMU gaps": Case(gaps=True),
    "all of these": Case(False, 0.4, losses=True, stuck=True, gaps=True),
}


class Soaked(NamedTuple):
    """What came of one case."""

    name: str
    time_s: Array
    """(N,) s, regular"""
    error: Array
    """(N, 9) east, north, up m; the same m/s; roll, pitch, heading rad"""
    sigma: Array
    """(N, 9)"""
    health: NDArray[np.intp]
    """(N,) index into `HEALTHS`"""
    latency_s: Array
    """(N,) s, of the last keyframe"""
    protection: Array
    """(N, 2) m, horizontal and up"""
    events: dict[str, int]
    refused: dict[str, int]
    rss_s: Array
    rss_mb: Array
    wall_s: float

    def pack(self) -> dict[str, Array]:
        """Return everything as arrays."""
        return {
            name: np.array(json.dumps(value) if isinstance(value, dict) else value)
            for name, value in self._asdict().items()
        }

    @classmethod
    def unpack(cls, arrays: Mapping[str, Array]) -> Soaked:
        """Return the run that was packed."""
        fields: dict[str, Any] = {name: arrays[name] for name in cls._fields}
        fields |= {name: json.loads(str(fields[name])) for name in ("events", "refused")}
        return cls(**fields | {"name": str(fields["name"]), "wall_s": float(fields["wall_s"])})

    @property
    def is_outside(self) -> NDArray[np.bool_]:
        """(N, 9) where the error is larger than three of its sigmas."""
        return np.asarray(~(np.abs(self.error) <= 3.0 * self.sigma))

    @property
    def is_good(self) -> NDArray[np.bool_]:
        """(N,) where the answer says that it may be used without a second look."""
        return np.asarray(self.health == GOOD)


def broken_mission(
    case: Case, *, duration_s: float, seed: int, dvl_hz: float, grade: Grade, realistic: bool
) -> tuple[Mission, Callable[[Array], Reference]]:
    """Return the recorded stream of a case, and the truth at any times.

    ``realistic`` instruments err as those of the grade do, and the mission states it.
    """
    starts = np.arange(0.0, duration_s, HOUR_S)
    losses = tuple(Loss(s + LOSS_S[0], s + LOSS_S[1]) for s in starts.tolist())
    config = scenario_config(
        "survey",
        duration_s=duration_s,
        seed=seed,
        grade=grade,
        dvl=DvlSettings(rate_hz=dvl_hz),
        depth=DepthSettings() if case.has_depth else None,
        outliers=sparse(case.outliers),
        losses=losses if case.losses else (),
        reference_rate_hz=0.1,
        realistic=realistic,
        calibrates=realistic,
    )
    mission = simulate(config).mission
    if case.stuck:
        mission = _with_stuck_beam(mission, starts)
    return (_with_gaps(mission, seed) if case.gaps else mission), config.trajectory.truth


def _with_stuck_beam(mission: Mission, starts: Array) -> Mission:
    dvl = mission.dvl
    speed = dvl.speed.copy()
    for begin_s in starts.tolist():
        first, last = np.searchsorted(dvl.time_s, [begin_s + t for t in STUCK_S])
        speed[first:last, STUCK_BEAM] = speed[first, STUCK_BEAM] if first < len(speed) else 0.0
    return replace(mission, dvl=replace(dvl, speed=speed))


def _with_gaps(mission: Mission, seed: int) -> Mission:
    """Return the mission with gaps at random: at one place of the pattern all would err alike."""
    imu = mission.imu
    within_s, number = imu.time_s % GAP_EVERY_S, (imu.time_s // GAP_EVERY_S).astype(np.intp)
    random = np.random.default_rng([seed, len(imu.time_s)])
    begin_s = random.uniform(GAP_S, GAP_EVERY_S - 2.0 * GAP_S, size=number[-1] + 1)
    since_s = within_s - begin_s[number]
    kept = (since_s <= 0.0) | (since_s > GAP_S)
    columns = {name: getattr(imu, name)[kept] for name in ("time_s", "gyro_b", "accel_b")}
    return replace(mission, imu=replace(imu, **columns))


def soak(
    name: str, *, hours: float, seed: int, dvl_hz: float, grade: str, realistic: bool
) -> Soaked:
    """Run a case from begin to end."""
    duration_s = hours * HOUR_S
    mission, truth = broken_mission(
        CASES[name],
        duration_s=duration_s,
        seed=seed,
        dvl_hz=dvl_hz,
        grade=Grade[grade],
        realistic=realistic,
    )
    smoother = FixedLagSmoother(vehicle_of(mission))
    events: Counter[str] = Counter()
    told_h = 0.0

    def on_minute(time_s: float) -> None:
        nonlocal told_h
        if time_s >= (told_h + 1.0) * HOUR_S:
            told_h += 1.0
            health, reason = smoother.status()
            note(f"{name}: {told_h:g} h, {health.name.lower()}: {reason}")

    run = run_stream(
        smoother,
        messages_of(mission),
        every_s=0.5 / dvl_hz,
        duration_s=duration_s,
        keeps_delayed=False,
        on_minute=on_minute,
    )
    for event in run.events:
        more = re.search(r"\(and (\d+) more since\)$", event.text)
        events[event.kind] += 1 + (int(more[1]) if more else 0)
    time_s, error, sigma = errors_of(run.answers, truth)
    return Soaked(
        name,
        time_s,
        error,
        sigma,
        run.answers.column("health").astype(np.intp),
        run.answers.column("latency_s"),
        run.answers.column("protection"),
        dict(events),
        run.refused,
        run.rss_s,
        run.rss_mb,
        run.wall_s,
    )


def errors_of(answers: Answers, truth: Callable[[Array], Reference]) -> tuple[Array, Array, Array]:
    """Return times (N,), errors (N, 9) and sigmas (N, 9) of all answers, chunk by chunk."""
    n = len(answers)
    time_s, error, sigma = np.full(n, np.nan), np.full((n, 9), np.nan), np.full((n, 9), np.inf)
    for begin in range(0, n, _CHUNK):
        rows = slice(begin, min(begin + _CHUNK, n))
        trajectory = answers.trajectory(rows)
        time_s[rows] = trajectory.time_s
        e = error_series(trajectory, truth(trajectory.time_s))
        at = begin + np.searchsorted(trajectory.time_s, e.time_s)
        error[at] = np.hstack([e.position_enu, e.velocity_enu, e.roll_pitch_heading])
        sigma[at] = np.hstack([e.position_sigma_enu, e.velocity_sigma_enu, e.attitude_sigma])
    return time_s, error, sigma


def longest_run(is_true: NDArray[np.bool_], period_s: float) -> tuple[float, int]:
    """Return the length, s, of the longest unbroken stretch, and where it begins."""
    edges = np.diff(np.concatenate([[0], is_true.astype(int), [0]]))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    if len(first) == 0:
        return 0.0, 0
    i = int(np.argmax(last - first))
    return float(last[i] - first[i]) * period_s, int(first[i])
