"""Simulated missions with a miscalibrated DVL, calibrated and judged by the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factors.similarity import Kernel, LogKernel
from ssm_graph import SmootherConfig, SsmSmoother, build_problem, evaluate
from ssm_graph.base.frozen import Array
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.simulation import (
    CALM,
    DepthProfile,
    GnssSettings,
    Grade,
    OutlierKind,
    Outliers,
    SimulationConfig,
    StartSigmas,
    SurveyRoute,
    TransitRoute,
    simulate,
)
from tests.calibration_cases import DVL, asking, knowing_dvl, wrong_dvl

LABELS = (
    "dvl_scale_error",
    *(f"dvl_mounting_{axis}_deg" for axis in "xyz"),
    *(f"dvl_lever_arm_{axis}_m" for axis in "xyz"),
    "dvl_time_offset_s",
)
TRUTH: Array = np.concatenate(list(DVL.values()))
"""In the order of the labels, SI."""


@dataclass(frozen=True, slots=True)
class Run:
    """One mission, calibrated."""

    error: Array
    """(8,) in posterior sigmas"""
    ratio: Array
    """(8,) posterior over prior sigma"""
    nees: float
    """Of all eight together"""
    rms_m: float
    """Horizontal, against the truth"""
    rms_known_m: float
    """The same of the run that is told what is wrong; NaN where there was none"""
    status: str


def smoothed(mission: Mission, kernel: Kernel) -> Estimate:
    """Return the batch estimate."""
    return SsmSmoother(SmootherConfig(kernel=kernel)).solve(build_problem(mission))


def rms_each_second(estimate: Estimate, reference: Reference) -> float:
    """Return the horizontal rms error, m; each second counts the same wherever keyframes are."""
    errors = evaluate(estimate.trajectory, reference).errors
    at_s = np.arange(np.ceil(errors.time_s[0]), errors.time_s[-1])
    east, north = (np.interp(at_s, errors.time_s, axis) for axis in errors.position_enu.T[:2])
    return float(np.sqrt(np.mean(east**2 + north**2)))


def judged(estimate: Estimate, mission: Mission, *, known: Estimate | None) -> Run:
    """Compare a calibrated estimate with what is true."""
    calibration, reference = estimate.calibration, mission.reference
    assert calibration is not None
    assert reference is not None
    at = {value.label: i for i, value in enumerate(calibration.values)}
    order = [at[label] for label in LABELS]
    values = [calibration.values[i] for i in order]
    error = np.array([value.value for value in values]) - TRUTH
    covariance = calibration.covariance[np.ix_(order, order)]
    sigma = np.array([value.sigma for value in values])
    return Run(
        error=error / sigma,
        ratio=sigma / [value.prior_sigma for value in values],
        nees=float(error @ np.linalg.solve(covariance, error)),
        rms_m=rms_each_second(estimate, reference),
        rms_known_m=np.nan if known is None else rms_each_second(known, reference),
        status=estimate.status.name,
    )


def turns(seed: int, kernel: Kernel, outlier_rate: float, *, duration_s: float = 400.0) -> Run:
    """Calibrate on survey lines that begin at the surface with GNSS and go down to 15 m."""
    down = DepthProfile(0.3, 15.0, mid_s=0.6 * duration_s, tau_s=15.0)
    config = SimulationConfig(
        route=SurveyRoute(line_m=60.0, depth=down),
        duration_s=duration_s,
        imu_rate_hz=50.0,
        seed=seed,
        grade=Grade.TACTICAL,
        dvl=wrong_dvl(),
        gnss=GnssSettings(),
        outliers=Outliers(OutlierKind.SPARSE, rate=outlier_rate) if outlier_rate else Outliers(),
    )
    mission = simulate(config).mission
    known = smoothed(knowing_dvl(mission), kernel)
    return judged(smoothed(asking(mission, DVL), kernel), mission, known=known)


def transit(seed: int, *, with_gnss: bool, duration_s: float = 600.0) -> Run:
    """Calibrate on a straight run in a calm; its speed at the start is known to 0.5 m/s."""
    depth_m = 0.3 if with_gnss else 20.0
    config = SimulationConfig(
        route=TransitRoute(speed=1.5, depth=DepthProfile(depth_m, depth_m)),
        waves=CALM,
        duration_s=duration_s,
        imu_rate_hz=50.0,
        seed=seed,
        grade=Grade.TACTICAL,
        start_sigmas=StartSigmas(0.3, 0.5, np.radians(0.1), np.radians(0.5)),
        dvl=wrong_dvl(),
        gnss=GnssSettings() if with_gnss else None,
    )
    mission = simulate(config).mission
    return judged(smoothed(asking(mission, DVL), LogKernel()), mission, known=None)
