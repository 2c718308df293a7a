"""Which stated bounds of a simulated mission are false: its errors over them, sensor by sensor."""

from __future__ import annotations

import numpy as np

from factors import so3
from ssm_graph import Mission
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.imu.increments import merge_samples
from ssm_graph.imu.ping_motion import mean_gyro
from ssm_graph.mission.mission import Reference
from ssm_graph.simulation import SimulatedMission
from ssm_graph.systems.sensor_network.track import MERGE_HZ
from ssm_graph.systems.sensor_network.witness import WitnessBounds

STEP_S = 0.1
"""Intervals over which inertial data are compared with the truth."""


def over_bounds(
    sim: SimulatedMission, mission: Mission, own: WitnessBounds, end_s: Array
) -> dict[str, float]:
    """Return the largest error over its bound of each sensor, 1 or less where the bound is true.

    Judged are raw readings, by themselves and on average over the witness's blocks, whose ends
    are ``end_s`` (M,); of inertial data what they make of attitude and velocity in a block.
    """
    assert mission.initial is not None
    begin_s = max(mission.initial.time_s, mission.imu.start_s)
    edges = np.append(begin_s, end_s)
    found = {"DVL": _beams(sim, mission, own, edges)}
    found["gyros"], found["accelerometers"] = _inertial(sim, mission, own, edges)
    gnss, depth = mission.gnss, mission.depth
    if gnss is not None:
        now = sim.truth_at(gnss.valid_s)
        fix = mission.frame.p_n_from_geodetic(gnss.lat, gnss.lon, gnss.height)
        off = (fix - _place(mission, now) - _attitude(now) @ gnss.lever_arm_b)[:, :2]
        bound = own.of("GNSS") * gnss.sigma_enu[:, :2]
        found["GNSS"] = _largest(off, bound, np.zeros_like(bound), gnss.valid_s, edges)
    if depth is not None:
        now = sim.truth_at(depth.time_s)
        off = -depth.true_depth - now.height - (_attitude(now) @ depth.lever_arm_b)[:, 2]
        bound = np.full((len(off), 1), own.of("depth") * depth.sigma)
        steady = np.full_like(bound, own.of("depth") * depth.calibration.offset_sigma)
        found["depth"] = _largest(off[:, None], bound, steady, depth.time_s, edges)
    return found


def wide_enough(over: dict[str, float], own: WitnessBounds) -> WitnessBounds:
    """Return bounds that are true: those of each sensor as much wider as its errors ask for."""
    times = {name: 1.01 * ratio for name, ratio in over.items() if ratio > 1.0}
    return WitnessBounds(sigmas=own.sigmas, block_s=own.block_s, times=times)


def _largest(off: Array, white: Array, steady: Array, time_s: Array, edges: Array) -> float:
    """Return the largest of errors (N, m) over their bounds, single and on average over blocks."""
    largest = float(np.nanmax(np.abs(off) / (white + steady)))
    block = np.searchsorted(edges, time_s, side="left")
    for one in np.unique(block):
        rows = np.flatnonzero(block == one)
        n = np.isfinite(off[rows]).sum(axis=0)
        if np.all(n > 0):
            mean = np.abs(np.nanmean(off[rows], axis=0))
            bound = white[rows].mean(axis=0) / np.sqrt(n) + steady[rows].mean(axis=0)
            largest = max(largest, float(np.max(mean / bound)))
    return largest


def _beams(sim: SimulatedMission, mission: Mission, own: WitnessBounds, edges: Array) -> float:
    dvl, wider = mission.dvl, own.times.get("DVL", 1.0)
    now = sim.truth_at(dvl.valid_s)
    R, v_n = _attitude(now), now.velocity_enu
    omega = mean_gyro(sim.mission.imu, dvl.valid_s)
    v_b = np.einsum("nji,nj->ni", R, v_n) + so3.cross(omega, dvl.mount.lever_arm_b[None])
    off = dvl.speed - v_b @ dvl.mount.beams_b.T
    # Shares are of the speed that is read: of zeros there is none.
    read = np.linalg.norm(np.where(np.isfinite(dvl.speed), dvl.speed, 0.0), axis=1)
    fit = read / np.linalg.norm(dvl.mount.beams_b, 2)
    share = own.speed_share * np.minimum(np.linalg.norm(v_b, axis=1), fit)
    steady = np.repeat(wider * (own.velocity_m_per_s + share)[:, None], off.shape[1], axis=1)
    k = own.of("DVL")
    largest = float(np.nanmax(np.abs(off) / (k * dvl.sigma + steady)))
    whole = np.flatnonzero(np.isfinite(off).all(axis=1))
    # Of a ping's velocity, all beams together: what a block's mean is taken of.
    B = dvl.mount.beams_b
    v_off = np.einsum("nij,nj->ni", R[whole], off[whole] @ np.linalg.pinv(B).T)
    sigma = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(B.T @ B))[-1]))
    block = np.searchsorted(edges, dvl.valid_s[whole], side="left")
    for one in np.unique(block):
        rows = np.flatnonzero(block == one)
        white = k * sigma * float(dvl.sigma[whole[rows]].max()) / np.sqrt(len(rows))
        mean = float(np.linalg.norm(v_off[rows].mean(axis=0)))
        largest = max(largest, mean / (white + float(steady[whole[rows]].mean())))
    return largest


def _inertial(
    sim: SimulatedMission, mission: Mission, own: WitnessBounds, edges: Array
) -> tuple[float, float]:
    """Return the largest error of gyros and of accelerometers over their bounds.

    Of the turn in each block and from the begin on, and of the velocity gained in each block.
    """
    noise, frame = mission.imu.noise, mission.frame
    time_s = np.unique(np.concatenate([np.arange(edges[0], edges[-1], STEP_S), edges]))
    merged = merge_samples(mission.imu.calibrated, time_s, rate_hz=MERGE_HZ)
    dt = np.diff(time_s)
    truth = sim.truth_at(time_s)
    p_n = _place(mission, truth)
    R_nl = np.array([frame.R_nl_at(p) for p in p_n])
    R = R_nl @ _attitude(truth)
    v_n = np.einsum("nij,nj->ni", R_nl, truth.velocity_enu)
    theta = merged.gyro_b * merged.dt[:, None]
    earth = so3.exp(-frame.omega_ie_n * dt[:, None])
    turned = earth @ R[:-1] @ so3.exp(theta)
    turn = np.einsum("nij,nj->ni", R[1:], so3.log(np.swapaxes(R[1:], 1, 2) @ turned))
    gain = so3.left_jacobian_times(theta, merged.accel_b * merged.dt[:, None])
    g_n = np.array([frame.g_n_at(p) for p in p_n[:-1]])
    coriolis = 2.0 * np.cross(frame.omega_ie_n, 0.5 * (v_n[1:] + v_n[:-1]))
    gained = np.einsum("nij,nj->ni", R[:-1], gain) + (g_n - coriolis) * dt[:, None]
    at = np.searchsorted(time_s, edges)
    turns = np.add.reduceat(turn, at[:-1], axis=0)
    gains = np.add.reduceat(gained - np.diff(v_n, axis=0), at[:-1], axis=0)
    T, since = np.diff(edges), edges[1:] - edges[0]
    span = edges[-1] - edges[0]
    steady = noise.gyro_bias_sigma + noise.gyro_bias_walk * np.sqrt(span)
    force = noise.accel_bias_sigma + noise.accel_bias_walk * np.sqrt(span)
    gyro = np.linalg.norm(turns, axis=1) / (steady * T + noise.gyro_density * np.sqrt(T))
    whole = np.abs(np.cumsum(turns[:, 2])) / (steady * since + noise.gyro_density * np.sqrt(since))
    accel = np.linalg.norm(gains, axis=1) / (force * T + noise.accel_density * np.sqrt(T))
    largest = max(float(gyro.max()), float(whole.max()))
    return largest / own.of("gyros"), float(accel.max()) / own.of("accelerometers")


def _attitude(now: Reference) -> Array:
    return R_lb_from_roll_pitch_heading(*now.roll_pitch_heading.T)


def _place(mission: Mission, now: Reference) -> Array:
    return mission.frame.p_n_from_geodetic(now.lat, now.lon, now.height)
