"""Routes and trajectories: derivatives that belong together, and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ssm_graph.base.earth import (
    EARTH_RATE,
    R_el_from_lat_lon,
    ecef_from_geodetic,
    normal_gravity,
    radii_of_curvature,
)
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.simulation import (
    CALM,
    DepthProfile,
    DiveRoute,
    HoverRoute,
    Route,
    SpiralRoute,
    SurveyRoute,
    Trajectory,
    TransitRoute,
    Waves,
)
from ssm_graph.simulation.trajectory import stacked

LAT, LON = math.radians(45.7), math.radians(126.6)
DIP = DepthProfile(0.3, 30.0, mid_s=200.0)
ROUTES: dict[str, Route] = {
    "survey": SurveyRoute(depth=DIP),
    "spiral": SpiralRoute(),
    "dive": DiveRoute(),
    "hover": HoverRoute(),
    "transit": TransitRoute(depth=DIP),
}
TIMES = np.linspace(1.0, 1500.0, 97)


def central_difference(values: Array, step: float) -> Array:
    """Return the derivative from values (4, ...) at -2, -1, 1, 2 steps; error ``step^4``."""
    return np.asarray((values[0] - 8.0 * values[1] + 8.0 * values[2] - values[3]) / (12.0 * step))


def around(step: float) -> Array:
    """Return times (4, N) about TIMES."""
    return TIMES + step * np.array([[-2.0], [-1.0], [1.0], [2.0]])


def trajectory_of(route: Route, *, waves: Waves | None = None, lat: float = LAT) -> Trajectory:
    """Return a route at our place, by default in the default waves."""
    return Trajectory(route, Waves() if waves is None else waves, lat, LON)


@pytest.mark.parametrize("name", ROUTES)
def test_velocity_is_the_derivative_of_position(name: str) -> None:
    """Earth-fixed coordinates resolve a nanometre, which bounds the difference quotient."""
    trajectory, step = trajectory_of(ROUTES[name]), 0.02
    p_e = stacked(trajectory.at(around(step)).p_e)
    v_e = stacked(trajectory.at(TIMES).p_e, derivative=1)
    np.testing.assert_allclose(central_difference(p_e, step), v_e, atol=3e-7)


@pytest.mark.parametrize("name", ROUTES)
def test_acceleration_is_the_derivative_of_velocity(name: str) -> None:
    """Velocities are small numbers: here the difference is sharp."""
    trajectory, step = trajectory_of(ROUTES[name]), 0.01
    v_e = stacked(trajectory.at(around(step)).p_e, derivative=1)
    a_e = 2.0 * stacked(trajectory.at(TIMES).p_e, derivative=2)
    np.testing.assert_allclose(central_difference(v_e, step), a_e, atol=2e-10)


@pytest.mark.parametrize("name", ROUTES)
def test_body_rate_is_the_derivative_of_attitude(name: str) -> None:
    """Small rotations of SciPy between neighbouring attitudes, plus the Earth's own turn."""
    trajectory, step = trajectory_of(ROUTES[name]), 0.01
    R_eb = trajectory.R_eb(TIMES)
    inner, outer = (
        (trajectory.R_eb(TIMES - h).inv() * trajectory.R_eb(TIMES + h)).as_rotvec() / (2.0 * h)
        for h in (step, 2.0 * step)
    )
    omega_ie_b = R_eb.inv().apply([0.0, 0.0, EARTH_RATE])
    omega_ib_b = trajectory.at(TIMES).omega_ib_b()
    np.testing.assert_allclose(omega_ib_b, (4.0 * inner - outer) / 3.0 + omega_ie_b, atol=5e-10)


@pytest.mark.parametrize("name", ROUTES)
def test_truth_agrees_with_earth_and_frames(name: str) -> None:
    """Geodetic truth, Earth-fixed motion and the package's own conversions tell one story."""
    trajectory = trajectory_of(ROUTES[name], lat=math.radians(-79.5))
    truth, motion = trajectory.truth(TIMES), trajectory.at(TIMES)
    p_e = ecef_from_geodetic(truth.lat, truth.lon, truth.height)
    np.testing.assert_allclose(stacked(motion.p_e), p_e, atol=5e-9)
    R_el = R_el_from_lat_lon(truth.lat, truth.lon)
    v_e = np.einsum("kij,kj->ki", R_el, truth.velocity_enu)
    np.testing.assert_allclose(stacked(motion.p_e, derivative=1), v_e, atol=1e-14)
    roll, pitch, heading = truth.roll_pitch_heading.T
    R_eb = R_el @ R_lb_from_roll_pitch_heading(roll, pitch, heading)
    np.testing.assert_allclose(trajectory.R_eb(TIMES).as_matrix(), R_eb, atol=1e-13)


def test_rest_feels_gravity_and_the_turning_earth() -> None:
    """At rest: specific force is gravity upwards, body rate is the Earth's."""
    route = HoverRoute(sway_m=0.0, yaw=0.0, depth_m=15.0)
    motion = trajectory_of(route, waves=CALM).at(TIMES)
    gravity = float(normal_gravity(LAT, -15.0))
    expected = np.broadcast_to([0.0, 0.0, -gravity], (len(TIMES), 3))
    np.testing.assert_allclose(motion.specific_force_b(), expected, atol=5e-15)
    level_to_north = EARTH_RATE * math.cos(LAT)
    heading = route.mean_heading
    omega = [
        level_to_north * math.cos(heading),
        -level_to_north * math.sin(heading),
        -EARTH_RATE * math.sin(LAT),
    ]
    np.testing.assert_allclose(
        motion.omega_ib_b(), np.broadcast_to(omega, expected.shape), atol=1e-18
    )


def test_transit_along_a_parallel_has_coriolis_and_transport_rate() -> None:
    """Due east at constant speed: the textbook's terms, body x to the east and y to the south."""
    route = TransitRoute(speed=3.0, course=0.5 * math.pi)
    motion = trajectory_of(route, waves=CALM).at(TIMES)
    radius = float(radii_of_curvature(LAT)[1])
    turn = 3.0 / radius  # of longitude, times cos(lat)
    v = turn * (radius - 40.0)
    north = (2.0 * EARTH_RATE * math.sin(LAT) + turn * math.tan(LAT)) * v
    down = (2.0 * EARTH_RATE * math.cos(LAT) + turn) * v - float(normal_gravity(LAT, -40.0))
    np.testing.assert_allclose(
        motion.specific_force_b(),
        np.broadcast_to([0.0, -north, down], (len(TIMES), 3)),
        atol=2e-15,
    )
    spin = EARTH_RATE + turn / math.cos(LAT)
    omega = [0.0, -spin * math.cos(LAT), -spin * math.sin(LAT)]
    np.testing.assert_allclose(
        motion.omega_ib_b(), np.broadcast_to(omega, (len(TIMES), 3)), atol=1e-18
    )


def test_survey_sails_lines_at_constant_speed() -> None:
    """Speed is constant to the map's distortion; courses are the lines' two, but for turns."""
    route = SurveyRoute(course=0.0)
    truth = trajectory_of(route, waves=CALM).truth(np.arange(0.0, 1200.0, 0.5))
    speed = np.hypot(truth.velocity_enu[:, 0], truth.velocity_enu[:, 1])
    np.testing.assert_allclose(speed, route.speed, rtol=2e-4)
    heading = np.degrees(truth.roll_pitch_heading[:, 2])
    on_lines = (np.abs(heading - 6.0) < 15.0) | (np.abs(heading - 174.0) < 15.0)
    assert 0.7 < on_lines.mean() < 0.95
    north_m = (truth.lat - LAT) * radii_of_curvature(LAT)[0]
    assert 120.0 < np.ptp(north_m) / 2.0 < 150.0


def test_heading_follows_the_course_and_pitch_the_path() -> None:
    """Without waves the vehicle moves along its own x axis."""
    trajectory = trajectory_of(DiveRoute(), waves=CALM)
    motion = trajectory.at(TIMES)
    v_b = trajectory.R_eb(TIMES).inv().apply(stacked(motion.p_e, derivative=1))
    np.testing.assert_allclose(v_b[:, 1:], 0.0, atol=1e-14)
    assert np.all(v_b[:, 0] > 1.0)


def test_spiral_and_dive_go_where_they_say() -> None:
    """The spiral's radius grows by its rate; the dive reaches its depths."""
    spiral, dive = trajectory_of(SpiralRoute(), waves=CALM), DiveRoute()
    truth = spiral.truth(np.array([0.0, 1000.0]))
    meridian, prime_vertical = radii_of_curvature(LAT)
    east = (truth.lon - LON) * prime_vertical * math.cos(LAT)
    north = (truth.lat - LAT) * meridian + 15.0
    np.testing.assert_allclose(np.hypot(east, north), [15.0, 65.0], atol=1e-6)
    depth = trajectory_of(dive).path_depth(np.array([0.0, 600.0, 1200.0]))
    np.testing.assert_allclose(depth, [0.3, 60.0, 0.3], atol=1e-9)


def test_waves_have_the_amplitudes_asked_for() -> None:
    """Roll, pitch and heave swing by exactly that much about the path."""
    truth = trajectory_of(HoverRoute(yaw=0.0), waves=Waves(yaw=0.0)).truth(
        np.linspace(0.0, 600.0, 60001)
    )
    roll, pitch, heading = truth.roll_pitch_heading.T
    np.testing.assert_allclose(
        [np.ptp(roll) / 2, np.ptp(pitch) / 2, np.ptp(truth.height) / 2, np.ptp(heading)],
        [math.radians(4.0), math.radians(3.0), 0.3, 0.0],
        atol=1e-5,
    )


@pytest.mark.parametrize("lat", [math.radians(81.0), math.nan, 45.7])
def test_latitudes_near_the_poles_and_degrees_are_refused(lat: float) -> None:
    """Degrees in place of radians are the likeliest mistake."""
    with pytest.raises(ConfigError, match=r"lat: expected .* got .*; convert degrees"):
        Trajectory(HoverRoute(), CALM, lat, LON)


def test_impossible_routes_are_refused() -> None:
    """No speed, no course."""
    with pytest.raises(ConfigError, match=r"SurveyRoute\.speed"):
        SurveyRoute(speed=0.0)
    with pytest.raises(ConfigError, match=r"DiveRoute\.drift"):
        DiveRoute(speed=0.5, drift=-0.5)
    with pytest.raises(ConfigError, match=r"Waves\.roll_period_s"):
        Waves(roll_period_s=0.0)
    with pytest.raises(ConfigError, match=r"DepthProfile\.tau_s"):
        DepthProfile(tau_s=-1.0)
