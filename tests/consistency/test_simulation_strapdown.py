"""Perfect sensors must lead an independent strapdown integration back to the simulated truth.

The integration below works in inertial axes: it knows nothing of local levels, transport rate or
Coriolis terms, and nothing of how the simulator made its samples.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssm_graph.base.earth import (
    EARTH_RATE,
    R_el_from_lat_lon,
    ecef_from_geodetic,
    geodetic_from_ecef,
    normal_gravity,
)
from ssm_graph.base.frozen import Array
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.simulation import (
    CALM,
    DepthProfile,
    DiveRoute,
    HoverRoute,
    SimulationConfig,
    SpiralRoute,
    SurveyRoute,
    Trajectory,
    TransitRoute,
    simulate,
)

EARTH_AXIS = np.array([0.0, 0.0, EARTH_RATE])


def running_product(steps: Rotation) -> Rotation:
    """Return all products ``steps[0] * ... * steps[k]`` by doubling."""
    quat = steps.as_quat()
    shift = 1
    while shift < len(quat):
        product = Rotation.from_quat(quat[:-shift]) * Rotation.from_quat(quat[shift:])
        quat = np.concatenate([quat[:shift], product.as_quat()])
        shift *= 2
    return Rotation.from_quat(quat)


def previous(increments: Array) -> Array:
    """Return the increment before each one; the first stands in for its own."""
    return np.concatenate([increments[:1], increments[:-1]])


def inertial_steps(imu: ImuLog, R_ib_start: Rotation) -> tuple[Array, Rotation]:
    """Return velocity increments in inertial axes and the attitude after every sample.

    Two-sample coning and sculling: the increments' direction within a sample is taken as linear
    in time.
    """
    dt = np.diff(imu.time_s, prepend=imu.start_s)[:, None]
    angle, speed = imu.gyro_b * dt, imu.accel_b * dt
    turn = angle + np.cross(previous(angle), angle) / 12.0
    push = speed + 0.5 * np.cross(angle, speed)
    push += (np.cross(previous(angle), speed) + np.cross(previous(speed), angle)) / 12.0
    push += np.cross(angle, np.cross(angle, speed)) / 6.0
    R_ib = R_ib_start * running_product(Rotation.from_rotvec(turn))
    before = Rotation.concatenate([R_ib_start, R_ib[:-1]])
    return np.asarray(before.apply(push)), R_ib


def gravitation_i(p_i: Array, R_ie: Array) -> Array:
    """Return the attraction of the Earth alone, inertial axes, m/s^2; its axis is the third."""
    lat, lon, height = geodetic_from_ecef(R_ie.T @ p_i)
    up_i = R_ie @ R_el_from_lat_lon(lat, lon)[:, 2]
    centrifugal = EARTH_RATE**2 * p_i * [1.0, 1.0, 0.0]
    return np.asarray(-normal_gravity(lat, height) * up_i - centrifugal)


def gains_per_stretch(push_i: Array, *, dt: float, every: int) -> tuple[Array, Array]:
    """Return what velocity and position gain within each stretch of ``every`` samples.

    Each push acts from the middle of its own sample on; the slope of the specific force within a
    sample shifts the position by a twelfth of its change.
    """
    blocks = push_i.reshape(-1, every, 3)
    slopes = np.gradient(push_i, axis=0).reshape(-1, every, 3)
    lever = (every - 0.5 - np.arange(every))[:, None] * dt
    return blocks.sum(axis=1), (blocks * lever - slopes * dt / 12.0).sum(axis=1)


def navigate(imu: ImuLog, trajectory: Trajectory, *, every: int) -> tuple[Array, Rotation]:
    """Return the Earth-fixed position and the attitude (b to i) at the end.

    Gravitation is evaluated once for ``every`` samples, at the middle of that stretch, and taken
    as linear in time within it.
    """
    start = trajectory.truth(0.0)
    R_el = R_el_from_lat_lon(start.lat[0], start.lon[0])
    p_i = ecef_from_geodetic(start.lat, start.lon, start.height)[0]
    v_i = R_el @ start.velocity_enu[0] + np.cross(EARTH_AXIS, p_i)
    push_i, R_ib = inertial_steps(imu, trajectory.R_eb(0.0)[0])
    dt = float(imu.time_s[0] - imu.start_s)
    span = every * dt
    pushes, shifts = gains_per_stretch(push_i, dt=dt, every=every)
    middles_s = (np.arange(len(pushes) + 1) - 0.5) * span
    R_ie = Rotation.from_rotvec(EARTH_AXIS * middles_s[:, None]).as_matrix()
    gravity = gravitation_i(p_i - 0.5 * span * v_i, R_ie[0])
    for push, shift, turned in zip(pushes, shifts, R_ie[1:], strict=True):
        middle_i = p_i + 0.5 * span * v_i + 0.25 * shift + 0.125 * gravity * span**2
        before, gravity = gravity, gravitation_i(middle_i, turned)
        p_i = p_i + v_i * span + shift + (0.5 * gravity - (gravity - before) / 12.0) * span**2
        v_i = v_i + push + gravity * span
    at_end = Rotation.from_rotvec(EARTH_AXIS * float(imu.time_s[-1]))
    return np.asarray(at_end.inv().apply(p_i)), R_ib[-1]


def closing_error(config: SimulationConfig, *, every: int) -> tuple[float, float, float]:
    """Return horizontal and vertical error, m, and that of attitude, rad, at the end."""
    trajectory, imu = config.trajectory, simulate(config).mission.imu
    p_e, R_ib = navigate(imu, trajectory, every=every)
    end_s = float(imu.time_s[-1])
    truth = trajectory.truth(end_s)
    error_e = p_e - ecef_from_geodetic(truth.lat, truth.lon, truth.height)[0]
    east, north, up = R_el_from_lat_lon(truth.lat[0], truth.lon[0]).T @ error_e
    R_ie = Rotation.from_rotvec(EARTH_AXIS * end_s)
    tilt = (R_ie * trajectory.R_eb(end_s)[0]).inv() * R_ib
    return math.hypot(east, north), abs(float(up)), float(tilt.magnitude())


CALM_ROUTES = {
    "rest": HoverRoute(sway_m=0.0, yaw=0.0),
    "hover": HoverRoute(),
    "transit": TransitRoute(depth=DepthProfile(0.3, 40.0, mid_s=100.0)),
}
WAVY_ROUTES = {
    "hover": HoverRoute(),
    "survey": SurveyRoute(),
    "spiral": SpiralRoute(),
    "dive": DiveRoute(),
    "transit": TransitRoute(),
}


@pytest.mark.parametrize("name", ["hover", "survey", "transit"])
def test_half_a_minute_closes(name: str) -> None:
    """In waves, with turns: micrometres and nanoradians."""
    config = SimulationConfig(route=WAVY_ROUTES[name], duration_s=30.0, perfect_sensors=True)
    horizontal, vertical, tilt = closing_error(config, every=10)
    assert horizontal < 5e-6
    assert vertical < 5e-6
    assert tilt < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", CALM_ROUTES)
def test_ten_calm_minutes_close(name: str) -> None:
    """Without coning or sculling only the simulator's own error is left."""
    config = SimulationConfig(
        route=CALM_ROUTES[name], waves=CALM, duration_s=600.0, perfect_sensors=True
    )
    horizontal, vertical, tilt = closing_error(config, every=10)
    assert horizontal < 1e-5
    assert vertical < 1e-5
    assert tilt < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "lat_deg"),
    [*((name, 45.7) for name in WAVY_ROUTES), ("survey", -79.0), ("spiral", 0.0)],
)
def test_ten_wavy_minutes_close(name: str, lat_deg: float) -> None:
    """Everywhere on Earth, on every route."""
    config = SimulationConfig(
        route=WAVY_ROUTES[name],
        lat=math.radians(lat_deg),
        duration_s=600.0,
        imu_rate_hz=100.0,
        perfect_sensors=True,
    )
    horizontal, vertical, tilt = closing_error(config, every=10)
    assert horizontal < 5e-4
    assert vertical < 5e-5
    assert tilt < 1e-9


@pytest.mark.slow
def test_one_hour_closes() -> None:
    """The free vertical channel has amplified its error 270 times by then."""
    config = SimulationConfig(duration_s=3600.0, imu_rate_hz=200.0, perfect_sensors=True)
    horizontal, vertical, tilt = closing_error(config, every=20)
    assert horizontal < 1e-3
    assert vertical < 5e-3
    assert tilt < 1e-9
