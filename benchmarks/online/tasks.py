"""What `online.py` runs, each in a process of its own: streams, lags, settings, real logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import ssm_graph as sg
from benchmarks.missions import survey
from benchmarks.online.stream import HEALTHS, NOT_SCORED, Accuracy, accuracy, rss_mb, run_stream
from benchmarks.online.theirs import TheirConfig, run_theirs
from benchmarks.report import rms
from ssm_graph.base.frozen import Array
from ssm_graph.cli.online_run import pass_over_imports
from ssm_graph.evaluation.errors import error_series, withhold_gnss
from ssm_graph.io.blueye.convert import convert_blueye
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE
from ssm_graph.mission.estimate import since_first_ping
from ssm_graph.mission.navigation import Health
from ssm_graph.simulation import DvlSettings, Grade, SimulatedMission
from ssm_graph.study.trials import with_initial

ASK_HZ = 20.0
"""How often control asks for the newest state"""
GNSS_UNTIL_S = 70.0
CONFIGS = {
    "online": ONLINE,
    "online, first estimates": replace(ONLINE, first_estimates=True),
    "settled": sg.FixedLagConfig(lag_s=30.0),
    "settled, first estimates": sg.FixedLagConfig(lag_s=30.0, first_estimates=True),
}


class StreamRun(NamedTuple):
    """One estimator on a stream; NaN or empty for what it does not tell."""

    name: str
    keyframe_s: Array
    """(K,) s, when an answer came"""
    latency_s: Array
    """(K,) s, what a new keyframe cost, all in all"""
    cpu_s: Array
    """(K,) s, processor time of the same: others on the machine do not stretch it"""
    parts_s: dict[str, Array]
    """What else was timed, (K,) or as many as there were"""
    newest: Accuracy
    delayed: Accuracy
    rss_mb: tuple[float, float]
    """With the window just filled, and at the end"""
    wall_s: float
    remark: str


def stream(
    duration_s: float, *, dvl_hz: float, seed: int, grade: Grade = Grade.NAVIGATION
) -> SimulatedMission:
    """Return the stream of this benchmark."""
    dvl = DvlSettings(rate_hz=dvl_hz)
    return survey(duration_s, grade, seed=seed, outliers=0.2, dvl=dvl, reference_rate_hz=1.0)


def stream_ours(
    duration_s: float, seed: int, dvl_hz: float, config: sg.FixedLagConfig
) -> StreamRun:
    """Push a stream through the live estimator."""
    sim = stream(duration_s, dvl_hz=dvl_hz, seed=seed)
    smoother = sg.FixedLagSmoother(vehicle_of(sim.mission), config)
    pass_over_imports()
    run = run_stream(
        smoother, messages_of(sim.mission), every_s=1.0 / ASK_HZ, duration_s=duration_s
    )
    first_s = float(sim.mission.dvl.valid_s[0])
    rows = run.answers.first_after_keyframe(begin_s=first_s)
    assert run.delayed is not None
    delayed = since_first_ping(run.delayed)
    is_full = run.rss_s > config.lag_s + 60.0
    sizes = run.rss_mb[is_full] if is_full.any() else run.rss_mb
    return StreamRun(
        f"ours, lag {config.lag_s:g} s",
        run.answers.column("time_s")[rows],
        run.answers.column("latency_s")[rows],
        run.answers.column("cpu_s")[rows],
        {"asking for the newest state": run.answers.column("newest_s")},
        accuracy(run.answers.trajectory(rows), sim.truth_at),
        accuracy(delayed, sim.truth_at),
        (float(sizes[0]), float(run.rss_mb[-1])),
        run.wall_s,
        f"events: {run.told}",
    )


def stream_theirs(
    duration_s: float, seed: int, dvl_hz: float, config: TheirConfig, most_wall_s: float
) -> StreamRun:
    """Feed the keyframes of a stream to one of GTSAM's smoothers."""
    sim = stream(duration_s, dvl_hz=dvl_hz, seed=seed)
    begin_mb = rss_mb()
    pass_over_imports()
    run = run_theirs(sim.mission, config, most_wall_s=most_wall_s)
    covariance_s = np.where(np.isfinite(run.covariance_s), run.covariance_s, 0.0)
    parts = {"keyframe made (ours)": run.front_s, "update": run.update_s}
    parts["reading the covariance"] = run.covariance_s
    scored = accuracy(run.trajectory, sim.truth_at) if len(run.update_s) else NOT_SCORED
    return StreamRun(
        str(config),
        run.trajectory.time_s,
        run.front_s + run.update_s + covariance_s,
        run.cpu_s,
        parts,
        scored,
        NOT_SCORED,
        (begin_mb, rss_mb()),
        run.wall_s,
        run.failure,
    )


def offline(duration_s: float, seed: int, dvl_hz: float) -> list[tuple[str, Accuracy]]:
    """Return the filters and the batch smoother on the same stream."""
    sim = stream(duration_s, dvl_hz=dvl_hz, seed=seed)
    problem = sg.build_problem(sim.mission)
    found = {name: sg.filter_problems([problem], name)[0] for name in ("ekf", "ssm-log")}
    found["batch"] = sg.SsmSmoother().solve(problem)
    return [
        (name, accuracy(since_first_ping(estimate.trajectory), sim.truth_at))
        for name, estimate in found.items()
    ]


class SettingRow(NamedTuple):
    """Newest states of one mission with one of `CONFIGS`."""

    grade: str
    seed: int
    name: str
    accuracy: Accuracy
    ms_per_keyframe: float


def settings_rows(grade: str, seed: int, duration_s: float) -> list[SettingRow]:
    """Go through one mission with each of `CONFIGS`."""
    sim = stream(duration_s, dvl_hz=1.0, seed=seed, grade=Grade[grade])
    problem = sg.build_problem(sim.mission)
    rows = []
    for name, config in CONFIGS.items():
        newest = sg.solve_fixed_lag(problem, config).newest
        scored = accuracy(since_first_ping(newest.trajectory), sim.truth_at)
        ms = 1e3 * newest.wall_s / problem.n_keyframes
        rows.append(SettingRow(grade, seed, name, scored, ms))
    return rows


class LogRow(NamedTuple):
    """One estimator on one real log, scored against withheld fixes."""

    log: str
    name: str
    horizontal: float
    """m, root mean square, as the next"""
    median: float
    """m"""
    n_fixes: int
    remark: str


def log_rows(path: Path, configs: Sequence[sg.FixedLagConfig]) -> list[LogRow]:
    """Run a real log live, with each of the settings, and offline; GNSS ends at `GNSS_UNTIL_S`."""
    mission, withheld = withhold_gnss(convert_blueye(path), GNSS_UNTIL_S)

    def reference(trajectory: sg.Trajectory) -> sg.Reference:
        return sg.reference_from_gnss(withheld, trajectory)

    rows = [r for config in configs for r in _live_rows(path.stem, mission, reference, config)]
    aligned = with_initial(mission)
    problem = sg.build_problem(aligned)
    for name in ("ekf", "ssm-log"):
        trajectory = sg.filter_problems([problem], name)[0].trajectory
        rows.append(_log_row(path.stem, name, trajectory, reference))
    batch = sg.smooth(mission)
    rows.append(_log_row(path.stem, "batch", batch.trajectory, reference, batch.status.name))
    return rows


def _live_rows(
    log: str,
    mission: sg.Mission,
    reference: Callable[[sg.Trajectory], sg.Reference],
    config: sg.FixedLagConfig,
) -> list[LogRow]:
    duration_s = float(mission.imu.time_s[-1] - mission.imu.start_s)
    smoother = sg.FixedLagSmoother(vehicle_of(mission), config)
    run = run_stream(smoother, messages_of(mission), every_s=1.0 / ASK_HZ, duration_s=duration_s)
    rows = run.answers.first_after_keyframe(begin_s=-np.inf)
    if len(rows) == 0 or run.delayed is None:
        return [LogRow(log, "live", np.nan, np.nan, 0, smoother.status()[1])]
    newest = run.answers.trajectory(rows)
    good = np.mean(run.answers.column("health") == HEALTHS.index(Health.GOOD))
    remark = f"begins at {newest.time_s[0] - mission.imu.start_s:.1f} s; good {100 * good:.0f} % "
    remark += f"of the time; events: {run.told}; refused: {run.refused or 'none'}"
    return [
        _log_row(log, f"live, lag {config.lag_s:g} s, newest", newest, reference, remark),
        _log_row(log, f"live, lag {config.lag_s:g} s, delayed", run.delayed, reference),
    ]


def _log_row(
    log: str,
    name: str,
    trajectory: sg.Trajectory,
    reference: Callable[[sg.Trajectory], sg.Reference],
    remark: str = "",
) -> LogRow:
    """Compare at the fixes: each is a row of the reference, the estimate is near enough."""
    series = error_series(trajectory, reference(trajectory))
    error = series.horizontal
    return LogRow(log, name, rms(error), float(np.median(error)), len(error), remark)
