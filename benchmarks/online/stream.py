"""A recorded stream pushed through the live estimator, and what it answered on the way."""

from __future__ import annotations

import dataclasses
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.report import rms
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.errors import error_series
from ssm_graph.live.estimator import FixedLagSmoother
from ssm_graph.live.estimator.answers import Delayed
from ssm_graph.mission.estimate import Trajectory
from ssm_graph.mission.mission import Reference
from ssm_graph.mission.navigation import Event, Health, Navigation
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message

HEALTHS = tuple(Health)
TAKE_S = 60.0
"""Delayed states and events are taken, and the resident size is read, so often."""
_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6
_VECTORS = ("velocity_enu", "roll_pitch_heading", "velocity_sigma_enu", "attitude_sigma")
_COLUMNS = {"time_s": 1, **dict.fromkeys(("place", "position_sigma_enu", *_VECTORS), 3)}
_COLUMNS |= dict.fromkeys(("health", "latency_s", "cpu_s", "newest_s"), 1) | {"protection": 2}
_ENDS = np.cumsum(list(_COLUMNS.values())).tolist()
_SLICES = {
    name: slice(end - width, end)
    for (name, width), end in zip(_COLUMNS.items(), _ENDS, strict=True)
}


def rss_mb() -> float:
    """Return the resident size of this process, MB."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * _PAGE_MB


class Answers:
    """Newest states, as asked for on the way; memory for all of them is taken at once."""

    def __init__(self, capacity: int) -> None:
        self._rows = np.full((capacity, _ENDS[-1]), np.nan)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, navigation: Navigation, *, cpu_s: float, newest_s: float) -> None:
        """Keep an answer, the dearest push before it, and what it took to ask for it, s."""
        n = navigation
        row = self._rows[self._count]
        row[:] = (
            *(n.time_s, n.lat, n.lon, n.height, *n.position_sigma_enu),
            *(x for name in _VECTORS for x in getattr(n, name)),
            *(HEALTHS.index(n.health), n.latency_s, cpu_s, newest_s),
            *(n.protection_m, n.protection_up_m),
        )
        self._count += 1

    def column(self, name: str) -> Array:
        """Return a column (N,), (N, 2) or (N, 3); ``protection`` is horizontal and up, m."""
        found = self._rows[: self._count, _SLICES[name]]
        return found[:, 0] if found.shape[1] == 1 else found

    def first_after_keyframe(self, *, begin_s: float) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Return which answers from ``begin_s`` on were the first after a keyframe was made."""
        is_first = np.diff(self.column("latency_s"), prepend=np.nan) != 0.0
        return np.flatnonzero(is_first & (self.column("time_s") > begin_s))

    def trajectory(self, rows: np.ndarray[tuple[int], np.dtype[np.intp]] | slice) -> Trajectory:
        """Return some answers as a trajectory whose position covariances are diagonal."""
        place = self.column("place")[rows]
        sigma = self.column("position_sigma_enu")[rows]
        nothing = np.full((len(place), 3), np.nan)
        own: dict[str, Any] = {name: self.column(name)[rows] for name in _VECTORS}
        return Trajectory(
            time_s=self.column("time_s")[rows],
            lat=place[:, 0],
            lon=place[:, 1],
            height=place[:, 2],
            gyro_bias=nothing,
            accel_bias=nothing,
            position_cov_enu=sigma[:, :, None] ** 2 * np.eye(3),
            n_beams=np.zeros(len(place)),
            **own,
        )


class Stream(NamedTuple):
    """What came of a stream."""

    answers: Answers
    delayed: Trajectory | None
    events: tuple[Event, ...]
    refused: dict[str, int]
    rss_s: Array
    """(M,) times at which the resident size was read, s"""
    rss_mb: Array
    """(M,)"""
    wall_s: float

    @property
    def told(self) -> str:
        """Events by kind, as text."""
        counts = Counter(event.kind for event in self.events)
        return ", ".join(f"{kind} {n}" for kind, n in sorted(counts.items())) or "none"


def run_stream(
    smoother: FixedLagSmoother,
    messages: Iterable[Message],
    *,
    every_s: float,
    duration_s: float,
    keeps_delayed: bool = True,
    on_minute: Callable[[float], None] | None = None,
) -> Stream:
    """Push all messages, and ask for the newest state after an inertial sample ``every_s``."""
    answers = Answers(int(duration_s / every_s) + 2)
    delayed: list[Delayed] = []
    events: list[Event] = []
    sizes: list[tuple[float, float]] = []
    next_s, take_s = -np.inf, -np.inf
    begin = time.perf_counter()
    cpu_s = 0.0
    for message in messages:
        pushed = time.process_time()
        smoother.push(message)
        cpu_s = max(cpu_s, time.process_time() - pushed)
        if not isinstance(message, ImuSample) or message.time_s < next_s - 1e-6:
            continue
        next_s = every_s * np.floor(message.time_s / every_s + 1.0 + 1e-6)
        asked = time.perf_counter()
        navigation = smoother.newest()
        dearest_s, cpu_s = cpu_s, 0.0
        if navigation is not None:
            asking_s = time.perf_counter() - asked
            answers.add(navigation, cpu_s=dearest_s, newest_s=asking_s)
        if message.time_s >= take_s:
            take_s = message.time_s + TAKE_S
            taken = smoother.take_delayed()
            delayed += taken if keeps_delayed else []
            events += smoother.take_events()
            sizes.append((message.time_s, rss_mb()))
            if on_minute is not None:
                on_minute(message.time_s)
    wall_s = time.perf_counter() - begin
    last = smoother.finish()
    delayed += last if keeps_delayed else []
    events += smoother.take_events()
    rss = np.array(sizes).reshape(-1, 2)
    track = joined([part.trajectory for part in delayed]) if delayed else None
    return Stream(answers, track, tuple(events), smoother.counts, rss[:, 0], rss[:, 1], wall_s)


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Return successive trajectories as one."""
    names = [field.name for field in dataclasses.fields(Trajectory)]
    return Trajectory(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class Accuracy(NamedTuple):
    """Root mean square errors, and squares of errors in their own sigmas, 1 is expected."""

    velocity: float
    """mm/s, length of the error"""
    horizontal: float
    """m"""
    heading: float
    """deg"""
    nees_position: float
    """Mean over epochs, by axis, as the next two"""
    nees_velocity: float
    nees_heading: float


NOT_SCORED = Accuracy(*[np.nan] * 6)


def accuracy(trajectory: Trajectory, truth: Callable[[Array], Reference]) -> Accuracy:
    """Score a trajectory against the truth at its own times."""
    e = error_series(trajectory, truth(trajectory.time_s))
    with np.errstate(invalid="ignore", divide="ignore"):
        position = (e.position_enu / e.position_sigma_enu) ** 2
        velocity = (e.velocity_enu / e.velocity_sigma_enu) ** 2
        heading = (e.roll_pitch_heading[:, 2] / e.attitude_sigma[:, 2]) ** 2
    return Accuracy(
        velocity=1e3 * rms(np.linalg.norm(e.velocity_enu, axis=1)),
        horizontal=rms(e.horizontal),
        heading=float(np.degrees(rms(e.roll_pitch_heading[:, 2]))),
        nees_position=float(np.mean(position)),
        nees_velocity=float(np.mean(velocity)),
        nees_heading=float(np.mean(heading)),
    )
