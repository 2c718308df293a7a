"""A reference made of GNSS fixes that an estimator was not allowed to see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.evaluation.errors import interpolate_within
from ssm_graph.mission.estimate import Trajectory
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.sensors.gnss import GnssLog


def reference_from_gnss(gnss: GnssLog, trajectory: Trajectory) -> Reference:
    """Return positions of the body origin from fixes of the antenna.

    The lever arm is turned with the estimate's own attitude, at the fix (``l`` local level)::

        p_origin = p_antenna - R_lb lever_arm_b

    An error of the heading moves that by no more than the lever arm's length times the error.
    Fixes outside of the trajectory, or in its gaps, are left out; velocity and attitude are NaN.
    Errors contain the noise of the fixes; their sigmas count beside those of the estimate.
    """
    angles = interpolate_within(
        gnss.valid_s,
        known_s=trajectory.time_s,
        values=np.unwrap(trajectory.roll_pitch_heading, axis=0),
    )
    kept = np.isfinite(angles).all(axis=1)
    lat, lon, height = gnss.lat[kept], gnss.lon[kept], gnss.height[kept]
    if np.any(kept) and np.any(gnss.lever_arm_b != 0.0):
        frame = LocalFrame(float(lat[0]), float(lon[0]), float(height[0]))
        antenna_n = frame.p_n_from_geodetic(lat, lon, height)
        lever_l = R_lb_from_roll_pitch_heading(*angles[kept].T) @ gnss.lever_arm_b
        lever_n = np.einsum("nij,nj->ni", frame.R_nl_at(antenna_n), lever_l)
        lat, lon, height = frame.geodetic_from_p_n(antenna_n - lever_n)
    unknown = np.full((int(kept.sum()), 3), np.nan)
    return Reference(
        time_s=gnss.valid_s[kept],
        lat=lat,
        lon=lon,
        height=height,
        velocity_enu=unknown,
        roll_pitch_heading=unknown,
        position_sigma_enu=gnss.sigma_enu[kept],
    )


def withhold_gnss(mission: Mission, until_s: float) -> tuple[Mission, GnssLog]:
    """Return the mission with fixes up to ``until_s`` after its begin alone, and the other fixes.

    Raises
    ------
    ConfigError
        The mission has no GNSS, or all of its fixes are on one side of that time.
    """
    gnss = mission.gnss
    if gnss is None:
        raise ConfigError("expected a mission with GNSS, got one without")
    used = gnss.valid_s < mission.imu.start_s + until_s
    if not used.any() or used.all():
        first, last = gnss.valid_s[[0, -1]] - mission.imu.start_s
        raise ConfigError(
            f"expected a time between the first fix at {first:.1f} s and the last at "
            f"{last:.1f} s, got {until_s:g} s"
        )
    return replace(mission, gnss=gnss.rows(used)), gnss.rows(~used)
