"""The real runs: which GNSS each protocol allows, faults, estimators and scores."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import ssm_graph as sg
from benchmarks.report import ROOT, rms
from factors.kernels import KERNELS
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.errors import ErrorSeries, error_series
from ssm_graph.io.blueye.convert import convert_blueye
from ssm_graph.io.blueye.vehicle import GYRO_BIAS
from ssm_graph.mission.mission import NO_AIDS
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.gnss import GnssLog

LOGS = Path(os.environ.get("SSM_GRAPH_DATA", ROOT.parent / "shared" / "data")) / "blueye_x3"
RUNS = {
    "square": "log_auto_square_2025-05-07_14_55_13",
    "grid": "log_grid_01_05_scaled",
    "dive": "log_dive_2min_2025-05-07_15_06_13",
}
SURFACE = ("square", "grid")
SMOOTHERS = ("log", "sqrt", "exp", "gaussian")
FILTER = "ssm-log filter"
ESTIMATED = "estimated"
IMU_ALONE = "estimated, IMU alone"
GNSS_END_S = 70.0
SILENCE_S = 10.0
"""A longer silence of GNSS is a dive: protocol A ends there if it comes before `GNSS_END_S`."""
BEGIN_S, END_S = 30.0, 20.0
"""Protocol B: GNSS in so many first and last seconds."""
SHARE = 0.1
BURST_S = 10.0
FAULT_SPEEDS = (0.5, 3.0)
"""m/s"""

Mask = NDArray[np.bool_]


class Protocol(Enum):
    """Which fixes an estimator sees; the text is for readers."""

    A = "GNSS until 70 s or the dive, scored after"
    B = "GNSS in the first 30 s and the last 20 s, scored between"
    C = "all GNSS, residuals"


class Faults(Enum):
    """What is added to the beam speeds; the text is for readers."""

    CLEAN = "as recorded"
    SPARSE = "10 % of the pings, one random beam, 0.5 to 3 m/s either way"
    BURST = "10 s on one beam, 0.5 to 3 m/s"


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """What one estimate is worth."""

    rms_m: float
    """Horizontal, at the keyframes between fixes that were withheld (all fixes in C), m."""
    end_m: float
    """Horizontal, at the last of them, m."""
    path_m: float
    """Horizontal way over ground from the last fix before the scored ones to the last scored one,
    by the estimate's positions a second apart, m."""
    heading_sigma: float
    """Posterior, when GNSS ends; for C at the end, rad."""
    ratio: float
    """rms of the error over rms of its own sigma; 1 if the sigmas are right."""
    status: str
    estimate: sg.Estimate | None
    errors: ErrorSeries | None

    @property
    def percent(self) -> float:
        """Of the path, for ``rms_m``."""
        return 100.0 * self.rms_m / self.path_m


class Case(NamedTuple):
    """One cell of the benchmark."""

    run: str
    protocol: Protocol
    method: str
    calibration: str
    """a key of `MODES`"""
    faults: Faults
    seed: int


def load(run: str) -> sg.Mission:
    """Convert a log."""
    return convert_blueye(LOGS / f"{RUNS[run]}.mcap")


def exact(mission: sg.Mission) -> sg.Mission:
    """Return the mission with nothing to calibrate: what is known of instruments is exact."""
    gnss = _gnss(mission)
    mount = replace(mission.dvl.mount, scale_sigma=0.0, time_offset_sigma_s=0.0)
    known = replace(gnss.calibration, time_offset_sigma_s=0.0)
    return replace(
        mission, dvl=replace(mission.dvl, mount=mount), gnss=replace(gnss, calibration=known)
    )


def imu_alone(mission: sg.Mission) -> sg.Mission:
    """Return the mission without the heading of the DVL."""
    return replace(mission, aids=NO_AIDS)


def unknown(mission: sg.Mission) -> sg.Mission:
    """Return the mission of a user who knows neither scale nor gyro biases, and asks for nothing.

    Gyro biases come back, with a prior that covers them; speeds are taken as they are read, slow
    errors of DVL and GNSS are left to the noise stated, and the DVL's heading is not used.
    """
    plain = imu_alone(exact(mission))
    noise = replace(plain.imu.noise, gyro_bias_sigma=1e-3)
    imu = replace(plain.imu, gyro_b=plain.imu.gyro_b + GYRO_BIAS, noise=noise)
    mount = replace(plain.dvl.mount, scale_error=0.0, drift=Drift())
    gnss = _gnss(plain)
    known = replace(gnss.calibration, drift=Drift())
    return replace(
        plain, imu=imu, dvl=replace(plain.dvl, mount=mount), gnss=replace(gnss, calibration=known)
    )


MODES: Mapping[str, Callable[[sg.Mission], sg.Mission]] = {
    "none": unknown,
    "vehicle": exact,
    IMU_ALONE: imu_alone,
    ESTIMATED: lambda mission: mission,
}
"""What is done to an imported mission, by the name of what is calibrated."""


def used_fixes(mission: sg.Mission, protocol: Protocol, until_s: float = GNSS_END_S) -> Mask:
    """Return which fixes (N,) an estimator sees; ``until_s`` is for protocol A."""
    gnss = _gnss(mission)
    elapsed = gnss.valid_s - mission.imu.start_s
    if protocol is Protocol.C:
        return np.ones(len(elapsed), dtype=bool)
    if protocol is Protocol.B:
        span = mission.imu.time_s[-1] - mission.imu.start_s
        return np.asarray((elapsed < BEGIN_S) | (elapsed > span - END_S))
    silent = np.flatnonzero(np.diff(elapsed) > SILENCE_S)
    dives_s = float(elapsed[silent[0]]) if len(silent) else np.inf
    return np.asarray(elapsed <= min(until_s, dives_s))


def with_faults(mission: sg.Mission, faults: Faults, seed: int) -> sg.Mission:
    """Return the mission with faults of one beam, all of it drawn from the seed."""
    rng = np.random.default_rng([seed, list(Faults).index(faults)])
    dvl = mission.dvl
    speed = np.array(dvl.speed)
    n = len(speed)
    if faults is Faults.SPARSE:
        hit = rng.random(n) < SHARE
        beam = rng.integers(speed.shape[1], size=n)
        offset = rng.uniform(*FAULT_SPEEDS, n) * rng.choice([-1.0, 1.0], n)
        speed[hit, beam[hit]] += offset[hit]
    elif faults is Faults.BURST:
        elapsed = dvl.time_s - dvl.time_s[0]
        # After GNSS has ended, where it hurts: nothing but the inertial data contradicts it.
        begin = rng.uniform(GNSS_END_S, elapsed[-1] - 2.0 * BURST_S)
        hit = (elapsed >= begin) & (elapsed < begin + BURST_S)
        offset = rng.uniform(*FAULT_SPEEDS) * rng.choice([-1.0, 1.0])
        speed[hit, rng.integers(speed.shape[1])] += offset
    return replace(mission, dvl=replace(dvl, speed=speed))


def solve(mission: sg.Mission, method: str) -> sg.Estimate:
    """Estimate a mission by a smoother's kernel, or by the filter from the same alignment."""
    if method != FILTER:
        return sg.smooth(mission, sg.SmootherConfig(KERNELS[method].kernel()))
    start = sg.align(mission).candidates[0]
    (estimate,) = sg.filter_problems([sg.build_problem(mission, start=start)], "ssm-log")
    return estimate


def evaluate_case(mission: sg.Mission, case: Case, until_s: float = GNSS_END_S) -> Score:
    """Withhold, spoil, estimate and score; ``mission`` is of the case's mode."""
    gnss = _gnss(mission)
    used = used_fixes(mission, case.protocol, until_s)
    scored = used if case.protocol is Protocol.C else ~used
    if case.protocol is Protocol.A:
        scored = scored & (gnss.valid_s > gnss.valid_s[used][-1])
    seen = replace(mission, gnss=gnss.rows(used))
    spoilt = with_faults(seen, case.faults, case.seed)
    nothing = Score(np.nan, np.nan, np.nan, np.nan, np.nan, "-", None, None)
    if scored.sum() < 2:
        return nothing
    try:
        estimate = solve(spoilt, case.method)
    except sg.SsmGraphError as error:
        return replace(nothing, status=f"failed: {error}")
    return _score(estimate, mission, scored, used)


def _score(estimate: sg.Estimate, mission: sg.Mission, scored: Mask, used: Mask) -> Score:
    gnss = _gnss(mission)
    reference = sg.reference_from_gnss(gnss.rows(scored), estimate.trajectory)
    errors = error_series(estimate.trajectory, reference)
    is_open = scored.all()
    before = used & (gnss.valid_s < gnss.valid_s[scored][0])
    begin_s = float(gnss.valid_s[0] if is_open else gnss.valid_s[before][-1])
    sigma_at = float(gnss.valid_s[-1]) if is_open else begin_s
    trajectory = estimate.trajectory
    sigma = errors.position_sigma_enu[:, :2]
    rms_m = rms(errors.horizontal)
    return Score(
        rms_m=rms_m,
        end_m=float(errors.horizontal[-1]),
        path_m=_path(estimate, mission, begin_s, float(errors.time_s[-1])),
        heading_sigma=float(
            np.interp(sigma_at, trajectory.time_s, trajectory.attitude_sigma[:, 2])
        ),
        ratio=rms_m / rms(np.linalg.norm(sigma, axis=1)),
        status=estimate.status.name,
        estimate=estimate,
        errors=errors,
    )


def _path(estimate: sg.Estimate, mission: sg.Mission, begin_s: float, end_s: float) -> float:
    """Return the horizontal way; waves, which a keyframe a ping would count, mostly left out."""
    track = track_of(estimate, mission)
    time_s = np.arange(begin_s, end_s, 1.0)
    places = np.column_stack([np.interp(time_s, estimate.trajectory.time_s, x) for x in track.T])
    return float(np.sum(np.linalg.norm(np.diff(places, axis=0), axis=1)))


def track_of(estimate: sg.Estimate, mission: sg.Mission) -> Array:
    """Return east and north (N, 2) of the estimate in the mission's frame, m."""
    trajectory = estimate.trajectory
    p_n = mission.frame.p_n_from_geodetic(trajectory.lat, trajectory.lon, trajectory.height)
    return np.asarray(p_n[:, :2])


def _gnss(mission: sg.Mission) -> GnssLog:
    assert mission.gnss is not None
    return mission.gnss
