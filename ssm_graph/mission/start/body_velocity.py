"""Velocity of the body from whole pings, for the start only; the graph uses beams one by one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.imu.ping_motion import mean_gyro
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.standstill import Standstill

PARITY_GATE = 5.0
"""Sigmas of the array's parity above which a ping is not used."""
REST_STEP_S = 1.0
"""Between the velocities of a standstill."""
REACH_S = 3.0
"""How far from a ping its velocity is believed."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyVelocities:
    """Velocity over ground of the body origin at the usable pings, body axes."""

    time_s: Array
    """(N,) s"""
    v_b: Array
    """(N, 3) m/s"""

    def at(self, time_s: Array) -> Array:
        """Return velocities (M, 3) at any times, held at the ends; zero without any ping."""
        if len(self.time_s) == 0:
            return np.zeros((len(time_s), 3))
        return np.stack([np.interp(time_s, self.time_s, axis) for axis in self.v_b.T], axis=-1)

    def covers(self, time_s: float) -> bool:
        """Return whether a ping is near."""
        return bool(np.any(np.abs(self.time_s - time_s) < REACH_S))


def body_velocities(mission: Mission) -> BodyVelocities:
    """Return the velocities of the pings, and zero while the mission stands still."""
    velocities = _of_pings(mission)
    for still in mission.aids.all(Standstill):
        velocities = _at_rest(velocities, still)
    return velocities


def _at_rest(velocities: BodyVelocities, still: Standstill) -> BodyVelocities:
    """Return velocities with those of a standstill in the place of its pings."""
    count = int((still.end_s - still.begin_s) / REST_STEP_S) + 2
    rest_s = np.linspace(still.begin_s, still.end_s, count)
    before = velocities.time_s < still.begin_s
    after = velocities.time_s > still.end_s
    return BodyVelocities(
        np.concatenate([velocities.time_s[before], rest_s, velocities.time_s[after]]),
        np.concatenate([velocities.v_b[before], np.zeros((count, 3)), velocities.v_b[after]]),
    )


def _of_pings(mission: Mission) -> BodyVelocities:
    """Solve pings of agreeing beams, or of three, for the velocity of the body origin.

    Parities are blind to some faults, so what passes here is no more than a start. Pings off the
    water are left out.
    """
    dvl = mission.dvl.of_ground()
    beams_b = dvl.mount.beams_b
    valid = np.isfinite(dvl.speed)
    # Three beams agree with anything: they count only where pings of all beams are rare.
    n_needed = max(3, dvl.mount.n_beams if np.mean(valid.all(axis=1)) > 0.5 else 3)
    contradicts = dvl.mount.parity(dvl.speed, dvl.sigma) >= PARITY_GATE
    usable = np.flatnonzero((valid.sum(axis=1) >= n_needed) & ~contradicts)
    time_s = dvl.valid_s[usable]
    if len(usable) == 0:
        return BodyVelocities(time_s, np.zeros((0, 3)))
    v_b = np.array([np.linalg.lstsq(beams_b[valid[i]], dvl.speed[i, valid[i]])[0] for i in usable])
    gyro_b = mean_gyro(mission.imu, time_s)
    return BodyVelocities(time_s, v_b - np.cross(gyro_b, dvl.mount.lever_arm_b))
