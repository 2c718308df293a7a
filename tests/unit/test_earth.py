"""The WGS-84 Earth: laws first, then published numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_graph.base.earth import (
    EARTH_RATE,
    ECCENTRICITY_SQ,
    FLATTENING,
    GRAVITY_RATIO,
    SEMI_MAJOR_AXIS,
    LocalFrame,
    R_el_from_lat_lon,
    ecef_from_geodetic,
    geodetic_from_ecef,
    normal_gravity,
    radii_of_curvature,
)
from tests.helpers import STEADY

GM = 3.986004418e14
SEMI_MINOR_AXIS = 6356752.3142

lats = st.floats(-0.5 * math.pi, 0.5 * math.pi)
lons = st.floats(-math.pi, math.pi)
heights = st.floats(-1e4, 1e5)
local = st.tuples(*[st.floats(-5e4, 5e4)] * 3).map(np.array)


@STEADY
@given(lat=lats, lon=lons, height=heights)
def test_geodetic_round_trip(lat: float, lon: float, height: float) -> None:
    """Back within 10 nm on the ground, poles and date line included."""
    p_e = ecef_from_geodetic(lat, lon, height)
    got_lat, got_lon, got_height = geodetic_from_ecef(p_e)
    assert abs(float(got_lat) - lat) < 2e-15
    assert abs(float(got_height) - height) < 1e-8
    np.testing.assert_allclose(
        ecef_from_geodetic(got_lat, got_lon, got_height), p_e, rtol=0.0, atol=1e-8
    )


@pytest.mark.parametrize("height", [3.6e7, 2.02e7, 4e5, 0.0, -1.1e4])
def test_geodetic_round_trip_up_to_satellites(height: float) -> None:
    """As promised, from the deepest trench to geostationary heights."""
    lat = np.radians(np.linspace(-90.0, 90.0, 181))
    got_lat, _, got_height = geodetic_from_ecef(ecef_from_geodetic(lat, 0.3, height))
    np.testing.assert_allclose(got_lat, lat, rtol=0.0, atol=2e-15)
    np.testing.assert_allclose(got_height, height, rtol=0.0, atol=3e-8)


def test_ellipsoid_contains_its_points() -> None:
    """At height zero the equation of the ellipsoid holds."""
    lat = np.linspace(-1.5, 1.5, 31)
    x, y, z = np.moveaxis(ecef_from_geodetic(lat, 2.0 * lat, 0.0), -1, 0)
    semi_minor = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
    on_it = (x**2 + y**2) / SEMI_MAJOR_AXIS**2 + z**2 / semi_minor**2
    np.testing.assert_allclose(on_it, 1.0, rtol=0.0, atol=1e-15)


def test_axes_and_radii_follow_from_the_ellipsoid() -> None:
    """Up is the ellipsoid's normal; a step east or north is radius plus height times the angle."""
    lat, lon, height = np.array([-1.2, 0.0, 0.7]), np.array([2.0, 0.1, -3.0]), 500.0
    step = 1e-6
    d_lat = ecef_from_geodetic(lat + step, lon, height) - ecef_from_geodetic(
        lat - step, lon, height
    )
    d_lon = ecef_from_geodetic(lat, lon + step, height) - ecef_from_geodetic(
        lat, lon - step, height
    )
    d_up = ecef_from_geodetic(lat, lon, height + 1.0) - ecef_from_geodetic(lat, lon, height)
    meridian, prime_vertical = radii_of_curvature(lat)
    R_el = R_el_from_lat_lon(lat, lon)
    expected = np.stack(
        [
            d_lon / (2.0 * step * (prime_vertical + height) * np.cos(lat))[:, None],
            d_lat / (2.0 * step * (meridian + height))[:, None],
            d_up,
        ],
        axis=-1,
    )
    np.testing.assert_allclose(R_el, expected, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(np.linalg.det(R_el), 1.0, rtol=1e-14)


def test_published_numbers() -> None:
    """NIMA TR8350.2: axes, eccentricity, gravity at equator and poles, and the ratio ``m``."""
    semi_minor = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
    assert semi_minor == pytest.approx(SEMI_MINOR_AXIS, abs=1e-4)
    assert pytest.approx(6.69437999014e-3, rel=1e-11) == ECCENTRICITY_SQ
    assert float(normal_gravity(0.0, 0.0)) == pytest.approx(9.7803253359, abs=1e-10)
    for pole in (-0.5 * math.pi, 0.5 * math.pi):
        assert float(normal_gravity(pole, 0.0)) == pytest.approx(9.8321849378, abs=2e-10)
    assert pytest.approx(0.00344978650684, rel=1e-11) == GRAVITY_RATIO
    expected = EARTH_RATE**2 * SEMI_MAJOR_AXIS**2 * SEMI_MINOR_AXIS / GM
    assert pytest.approx(expected, rel=1e-9) == GRAVITY_RATIO


@pytest.mark.parametrize("lat_deg", [0.0, 45.0, 80.0])
def test_gravity_falls_with_height_like_that_of_the_whole_earth(lat_deg: float) -> None:
    """Poisson's equation: the vertical gradient is that of mean curvature and rotation (Bruns).

    ``d gamma / dh = -gamma (1/M + 1/N) - 2 omega^2`` on the ellipsoid, exactly; the expansion in
    flattening is good to its second order, 1e-5.
    """
    lat = math.radians(lat_deg)
    meridian, prime_vertical = radii_of_curvature(lat)
    gamma = float(normal_gravity(lat, 0.0))
    bruns = -gamma * (1.0 / float(meridian) + 1.0 / float(prime_vertical)) - 2.0 * EARTH_RATE**2
    slope = (float(normal_gravity(lat, 10.0)) - float(normal_gravity(lat, -10.0))) / 20.0
    assert slope == pytest.approx(bruns, rel=5e-5)


@STEADY
@given(lat=st.floats(-1.55, 1.55), lon=lons, height=heights, p_n=local)
def test_local_frame_round_trip(lat: float, lon: float, height: float, p_n: np.ndarray) -> None:
    """Positions come back from geodetic terms within the rounding of Earth-fixed axes."""
    frame = LocalFrame(lat, lon, height)
    geodetic = frame.geodetic_from_p_n(p_n)
    np.testing.assert_allclose(frame.p_n_from_geodetic(*geodetic), p_n, rtol=0.0, atol=2e-8)


def test_local_frame_at_its_origin() -> None:
    """East, north, up at the origin; gravity straight down; the Earth turns about its axis."""
    frame = LocalFrame(0.8, -2.0, 30.0)
    np.testing.assert_allclose(frame.p_n_from_geodetic(0.8, -2.0, 30.0), 0.0, atol=1e-9)
    np.testing.assert_allclose(frame.R_nl_at(np.zeros(3)), np.eye(3), atol=1e-15)
    gravity = [0.0, 0.0, -float(normal_gravity(0.8, 30.0))]
    np.testing.assert_allclose(frame.g_n_at(np.zeros(3)), gravity, atol=1e-8)
    np.testing.assert_allclose(
        frame.R_en @ frame.omega_ie_n, [0.0, 0.0, EARTH_RATE], rtol=0.0, atol=1e-19
    )
    further = frame.p_n_from_geodetic(0.8 + 1e-5, -2.0 + 1e-5, 31.0)
    meridian, prime_vertical = radii_of_curvature(0.8)
    expected = [
        1e-5 * (float(prime_vertical) + 30.0) * math.cos(0.8),
        1e-5 * (float(meridian) + 30.0),
        1.0,
    ]
    np.testing.assert_allclose(further, expected, atol=2e-3)


def test_up_turns_with_the_curvature_of_the_earth() -> None:
    """10 km north of the origin gravity leans back by the angle of latitude travelled."""
    frame = LocalFrame(math.radians(45.7), 2.2, 0.0)
    p_n = np.array([0.0, 1e4, 0.0])
    lat, _, height = frame.geodetic_from_p_n(p_n)
    g_n = frame.g_n_at(p_n)
    lean = float(lat) - frame.lat
    assert lean == pytest.approx(1e4 / float(radii_of_curvature(frame.lat)[0]), rel=1e-4)
    assert float(np.linalg.norm(g_n)) == pytest.approx(float(normal_gravity(lat, height)))
    # North-leaning up means gravity pulls back to the south.
    assert float(g_n[1] / g_n[2]) == pytest.approx(math.tan(lean), rel=1e-9)
    assert abs(float(g_n[0])) < 1e-12
    assert float(height) == pytest.approx(0.5e8 / float(radii_of_curvature(frame.lat)[0]), rel=1e-5)


def test_many_places_at_once() -> None:
    """Leading axes broadcast, and each place is as if alone."""
    frame = LocalFrame(-1.0, 0.5, 0.0)
    p_n = np.random.default_rng(0).normal(scale=1e4, size=(2, 3, 3))
    many = frame.g_n_at(p_n), frame.R_nl_at(p_n)
    assert many[0].shape == (2, 3, 3)
    assert many[1].shape == (2, 3, 3, 3)
    np.testing.assert_allclose(many[0][1, 2], frame.g_n_at(p_n[1, 2]), rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(many[1][1, 2], frame.R_nl_at(p_n[1, 2]), rtol=0.0, atol=1e-15)
