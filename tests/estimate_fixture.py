"""A made-up estimate with everything that result files, tables and figures have to show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.mission.estimate import (
    BeamTable,
    CalibratedValue,
    Calibration,
    CurrentTrack,
    Estimate,
    Iteration,
    Status,
    Trajectory,
)
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.mission import InitialState, Mission, Reference
from ssm_graph.sensors.dvl import DvlLog, DvlMount
from ssm_graph.sensors.imu import ImuLog, ImuNoise

FRAME = LocalFrame(lat=np.deg2rad(63.44), lon=np.deg2rad(10.41), height=-20.0)
EPOCH = 1746622514.25
NOTES = ("two keyframes without a ping",)


def make_run(
    *, n: int = 300, seed: int = 0, outlier_share: float = 0.04, status: Status = Status.CONVERGED
) -> tuple[Estimate, Reference]:
    """Return an estimate of a lawn-mower run of ``n`` seconds at 1.5 m/s, and its truth."""
    rng = np.random.default_rng(seed)
    since = np.arange(float(n))
    leg = since // 60.0
    heading = np.deg2rad(np.where(leg % 2 == 0, 30.0, 210.0))
    velocity = 1.5 * np.column_stack([np.sin(heading), np.cos(heading), 0.02 * np.cos(since / 20)])
    velocity[:, :2] += 0.25 * np.array([np.cos(0.52), -np.sin(0.52)])
    p_n = np.vstack([np.zeros(3), np.cumsum(velocity[:-1], axis=0)])
    angles = np.column_stack([0.02 * np.sin(since / 7), 0.03 * np.cos(since / 9), heading])
    sigma = np.sqrt(0.05**2 + (0.01 * np.sqrt(since))[:, None] ** 2 * np.array([1.0, 0.8, 0.1]))
    drift = np.cumsum(rng.normal(size=(n, 3)), axis=0) * np.array([0.01, 0.009, 0.003])
    lat, lon, height = FRAME.geodetic_from_p_n(p_n)
    reference = Reference(EPOCH + since, lat, lon, height, velocity, angles)
    lat, lon, height = FRAME.geodetic_from_p_n(p_n + drift)
    trajectory = Trajectory(
        time_s=EPOCH + since,
        lat=lat,
        lon=lon,
        height=height,
        velocity_enu=velocity + rng.normal(0.0, 0.004, (n, 3)),
        roll_pitch_heading=angles + rng.normal(0.0, 1e-3, (n, 3)),
        gyro_bias=np.tile([1e-7, -2e-7, 3e-7], (n, 1)),
        accel_bias=np.tile([3e-4, -1e-4, 2e-4], (n, 1)),
        position_cov_enu=sigma[:, :, None] * np.eye(3) * sigma[:, None, :],
        velocity_sigma_enu=np.full((n, 3), 0.004),
        attitude_sigma=np.tile([5e-4, 5e-4, 2e-3], (n, 1)),
        n_beams=np.full(n, 4.0),
    )
    return _estimate(trajectory, status, rng, outlier_share), reference


def _estimate(
    trajectory: Trajectory, status: Status, rng: np.random.Generator, outlier_share: float
) -> Estimate:
    n = len(trajectory.time_s)
    innovation = rng.normal(0.0, 0.005, (n, 4))
    is_outlier = rng.uniform(size=(n, 4)) < outlier_share * np.array([0.2, 1.0, 0.2, 2.6])
    innovation[is_outlier] += rng.normal(0.0, 1.0, int(is_outlier.sum()))
    mahalanobis_sq = (innovation / 0.005) ** 2
    beams = BeamTable(
        time_s=np.repeat(trajectory.time_s, 4),
        beam=np.tile([1.0, 2.0, 3.0, 4.0], n),
        innovation=innovation.ravel(),
        mahalanobis_sq=mahalanobis_sq.ravel(),
        weight=np.minimum(1.0, 6.0 / (5.0 + mahalanobis_sq)).ravel(),
    )
    return Estimate(
        method="smoother",
        kernel="log(dof=5)",
        status=status,
        reason="largest update 0.0004 sigma, weights changed by 0.0009 at most",
        trajectory=trajectory,
        beams=beams,
        iterations=tuple(
            Iteration(
                update_sigmas=np.inf if k == 0 else 10.0**-k,
                weight_change=0.5**k,
                kernel="log(dof=5)",
            )
            for k in range(6)
        ),
        wall_s=1.25,
        cost=100.0,
        start=make_start(trajectory),
        notes=NOTES,
    )


def make_start(trajectory: Trajectory) -> InitialState:
    """Return the first keyframe as an initial state."""
    return InitialState(
        time_s=float(trajectory.time_s[0]),
        lat=float(trajectory.lat[0]),
        lon=float(trajectory.lon[0]),
        height=float(trajectory.height[0]),
        roll=0.0,
        pitch=0.0,
        heading=np.deg2rad(-10.0),
        velocity_enu=np.zeros(3),
        position_sigma_enu=np.full(3, 0.1),
        velocity_sigma_enu=np.full(3, 0.05),
        attitude_sigma=np.deg2rad([0.1, 0.1, 3.0]),
    )


def make_mission(estimate: Estimate, reference: Reference | None = None) -> Mission:
    """Return a mission with hardly any data that ``estimate`` could have come from."""
    time_s = estimate.trajectory.time_s[:2]
    mount = DvlMount(beams_d=np.eye(4, 3), R_bd=np.eye(3), lever_arm_b=np.zeros(3))
    return Mission(
        name="lawn-mower",
        frame=FRAME,
        imu=ImuLog(
            start_s=float(time_s[0]) - 1.0,
            noise=ImuNoise(1e-6, 1e-4, 1e-7, 1e-4),
            time_s=time_s,
            gyro_b=np.zeros((2, 3)),
            accel_b=np.zeros((2, 3)),
        ),
        dvl=DvlLog(mount=mount, time_s=time_s, speed=np.zeros((2, 4)), sigma=np.ones((2, 4))),
        reference=reference,
        notes=("made up",),
    )


def calibrated(estimate: Estimate, *, gnss_sigma: float) -> Estimate:
    """Return the estimate with a mounting, a scale and a lever arm that it found."""
    degree = np.radians(1.0)
    values = (
        CalibratedValue("dvl_scale", "dvl_scale_error", 1.0, -0.02, 0.001, 0.03),
        *(
            CalibratedValue("dvl_mounting", f"dvl_mounting_{axis}_deg", degree, x, 0.1 * degree, s)
            for axis, x, s in zip("xyz", (0.0, 0.0, 2.0 * degree), (2 * degree,) * 3, strict=True)
        ),
        *(
            CalibratedValue("gnss_lever_arm", f"gnss_lever_arm_{axis}_m", 1.0, 0.1, sigma, 0.4)
            for axis, sigma in zip("xyz", (gnss_sigma, gnss_sigma, 0.39), strict=True)
        ),
        CalibratedValue("gnss_time_offset", "gnss_time_offset_s", 1.0, 0.0, 0.29, 0.3),
    )
    calibration = Calibration(values, np.eye(len(values)), np.zeros((1, 0)))
    return replace(estimate, calibration=calibration)


def with_current(estimate: Estimate) -> Estimate:
    """Return the estimate with a current that turns slowly, known to 2 cm/s, level."""
    time_s = estimate.trajectory.time_s
    turned = 1e-3 * (time_s - time_s[0])
    velocity = 0.5 * np.column_stack([np.sin(turned), np.cos(turned), np.zeros(len(time_s))])
    covariance = np.tile(np.diag([4e-4, 4e-4, 0.0]), (len(time_s), 1, 1))
    return replace(estimate, current=CurrentTrack(time_s, velocity, covariance))


def with_faults(estimate: Estimate) -> Estimate:
    """Return the estimate with a beam that was left out, and fixes of which it is not sure."""
    begin_s = float(estimate.trajectory.time_s[0])
    left_out = DetectedFault(
        sensor="DVL beam 2",
        what="+0.050 m/s",
        begin_s=begin_s + 3.0,
        end_s=begin_s + 5.0,
        chi_sq=60.0,
        dof=1,
        treatment=Treatment.LEFT_OUT,
    )
    undecided = DetectedFault(
        sensor="GNSS",
        what="3.1 m to the east",
        begin_s=begin_s + 10.0,
        end_s=begin_s + 14.0,
        chi_sq=80.0,
        dof=3,
        treatment=Treatment.COVERED,
        rivals=("DVL, 0.20 m/s to the north",),
        cost_m=2.5,
        remedy="look at its datum",
    )
    return replace(estimate, faults=(left_out, undecided))
