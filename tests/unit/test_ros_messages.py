"""ROS 2 messages become ours: times, axes, signs, and what is refused.  No ROS is needed."""

from __future__ import annotations

import math
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import R_FRD, BodyAxes
from ssm_graph.io.ros.messages import (
    CONVERTERS,
    FIX_SIGMA,
    BeamSign,
    RosOptions,
    depth_reading,
    depth_sigma,
    dvl_report,
    fix,
    has_stated_sigma,
    imu_sample,
    ping,
)
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import bad_number

NAN = math.nan
RECEIVED_S = 99.5


def header(sec: int = 12, nanosec: int = 34) -> SimpleNamespace:
    """Return a header as drivers fill it."""
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id="link")


def vector(x: float, y: float, z: float) -> SimpleNamespace:
    """Return a ``geometry_msgs/Vector3``."""
    return SimpleNamespace(x=x, y=y, z=z)


def imu(**changes: Any) -> Any:
    """Return an IMU at rest in forward-left-up axes, turning to port."""
    fields = {
        "header": header(),
        "angular_velocity": vector(0.1, 0.2, 0.3),
        "angular_velocity_covariance": np.zeros(9),
        "linear_acceleration": vector(0.5, 0.6, 9.8),
        "linear_acceleration_covariance": np.zeros(9),
    }
    return SimpleNamespace(**fields | changes)


def marine(**changes: Any) -> Any:
    """Return a ``marine_acoustic_msgs/Dvl`` with four good beams."""
    fields = {
        "header": header(),
        "velocity_mode": 1,
        "velocity": vector(1.0, 0.5, -0.1),
        "num_good_beams": 4,
        "beam_ranges_valid": True,
        "beam_velocities_valid": True,
        "beam_unit_vec": [vector(0.5, 0.5, math.sqrt(0.5))] * 4,
        "range": np.array([10.0, 11.0, 12.0, 13.0]),
        "beam_velocity": np.array([1.0, -2.0, 3.0, -4.0], dtype=np.float32),
        "beam_velocity_covar": np.full(4, -1.0, dtype=np.float32),
    }
    return SimpleNamespace(**fields | changes)


def water_linked(**changes: Any) -> Any:
    """Return a ``dvl_msgs/DVL`` whose beams come in another order than their ids."""
    beams = [
        SimpleNamespace(id=i, velocity=0.1 * i + 0.1, distance=5.0 + i, valid=True)
        for i in (2, 0, 3, 1)
    ]
    fields = {
        "header": header(),
        "velocity": vector(1.0, 0.5, -0.1),
        "velocity_valid": True,
        "beams": beams,
    }
    return SimpleNamespace(**fields | changes)


def pressure(**changes: Any) -> Any:
    """Return a ``sensor_msgs/FluidPressure`` at 10 m below the surface."""
    fields = {"header": header(), "fluid_pressure": 101_325.0 + 1025.0 * 9.80665 * 10.0}
    return SimpleNamespace(**fields | {"variance": 0.0} | changes)


def nav_sat_fix(**changes: Any) -> Any:
    """Return a ``sensor_msgs/NavSatFix`` of known diagonal covariance."""
    fields = {
        "header": header(),
        "status": SimpleNamespace(status=0, service=1),
        "latitude": 45.0,
        "longitude": -120.0,
        "altitude": 12.5,
        "position_covariance": np.diag([1.0, 4.0, 9.0]).ravel(),
        "position_covariance_type": 2,
    }
    return SimpleNamespace(**fields | changes)


@pytest.mark.parametrize("nanosec", [0, 1, 123_456_789, 999_999_999])
@pytest.mark.parametrize("sec", [1, 1_700_000_000, 2_147_483_647])
def test_stamps_are_the_nearest_float(sec: int, nanosec: int) -> None:
    """No float arithmetic comes between the two whole numbers and the result."""
    sample = imu_sample(imu(header=header(sec, nanosec)), RECEIVED_S)
    assert sample.time_s == float(Fraction(sec * 10**9 + nanosec, 10**9))


def test_a_stamp_of_zero_is_receipt() -> None:
    """Drivers without a clock leave the header empty."""
    assert imu_sample(imu(header=header(0, 0)), RECEIVED_S).time_s == RECEIVED_S
    assert imu_sample(imu(header=header(0, 1)), RECEIVED_S).time_s == 1e-9


@pytest.mark.parametrize("axes", list(BodyAxes))
def test_imu_axes_agree_with_the_mission_folder(axes: BodyAxes) -> None:
    """The same turn as that of the tables."""
    sample = imu_sample(imu(), RECEIVED_S, RosOptions(body=axes))
    np.testing.assert_array_equal(sample.gyro_b, R_FRD[axes] @ [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(sample.accel_b, R_FRD[axes] @ [0.5, 0.6, 9.8])


def test_imu_at_rest_reads_upward_force() -> None:
    """REP 145 and REP 103: +9.8 on z in forward-left-up is -9.8 on our z."""
    assert imu_sample(imu(), RECEIVED_S).accel_b == (0.5, -0.6, -9.8)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"angular_velocity": vector(0.0, NAN, 0.0)}, "angular_velocity is not finite"),
        ({"linear_acceleration": vector(math.inf, 0.0, 0.0)}, "linear_acceleration is not finite"),
        ({"angular_velocity_covariance": [-1.0] + [0.0] * 8}, "has no angular_velocity"),
        ({"linear_acceleration_covariance": [-1.0] + [0.0] * 8}, "has no linear_acceleration"),
    ],
)
def test_imu_without_numbers_is_refused(changes: dict[str, Any], said: str) -> None:
    """NaN, and the agreed way of saying that there is nothing."""
    with pytest.raises(DataError, match=said):
        imu_sample(imu(**changes), RECEIVED_S)


def test_marine_dvl_as_it_stands() -> None:
    """Speeds keep sign and order; unknown variances leave the vehicle's nominal sigma."""
    report = dvl_report(marine(), RECEIVED_S)
    assert report.ping == Ping(12.000000034, (1.0, -2.0, 3.0, -4.0), None)
    assert report.range_m == (10.0, 11.0, 12.0, 13.0)
    assert report.beams_d == ((0.5, 0.5, math.sqrt(0.5)),) * 4
    assert report.velocity_d == (1.0, 0.5, -0.1)


def test_marine_sign_is_an_option() -> None:
    """The package leaves the sign open: drivers count one way or the other."""
    against = RosOptions(beam_sign=BeamSign.AGAINST)
    assert ping(marine(), RECEIVED_S, against).speed == (-1.0, 2.0, -3.0, 4.0)


def test_marine_variances_become_sigmas() -> None:
    """A variance of zero or -1 is unknown, beam by beam."""
    message = marine(beam_velocity_covar=np.array([1e-4, 0.0, -1.0, 4e-4]))
    np.testing.assert_allclose(ping(message, RECEIVED_S).sigma or (), [0.01, NAN, NAN, 0.02])


@pytest.mark.parametrize(
    ("changes", "good"),
    [
        ({"beam_velocities_valid": False}, [0, 0, 0, 0]),
        ({"beam_velocity": [1.0, NAN, 3.0, -4.0], "num_good_beams": 3}, [1, 0, 1, 1]),
        ({"range": [10.0, -1.0, 12.0, 13.0], "num_good_beams": 3}, [1, 0, 1, 1]),
        ({"range": [10.0, 0.0, 12.0, 13.0], "num_good_beams": 3}, [1, 0, 1, 1]),
        ({"range": [0.0] * 4, "beam_ranges_valid": False}, [1, 1, 1, 1]),
        (
            {"range": [9.0, -1.0, 9.0, 9.0], "beam_ranges_valid": False, "num_good_beams": 3},
            [1, 0, 1, 1],
        ),
        ({"beam_velocity": [1.0, 0.0, 3.0, -4.0], "num_good_beams": 3}, [1, 0, 1, 1]),
        ({"beam_velocity": [1.0, 0.0, 3.0, -4.0]}, [1, 1, 1, 1]),
        ({"num_good_beams": 3}, [0, 0, 0, 0]),
        ({"num_good_beams": 0}, [0, 0, 0, 0]),
        ({"num_good_beams": 200}, [1, 1, 1, 1]),
    ],
)
def test_marine_beams_without_bottom(changes: dict[str, Any], good: list[int]) -> None:
    """A beam counts only where nothing speaks against it; an open count spoils the ping."""
    speed = ping(marine(**changes), RECEIVED_S).speed
    assert [int(math.isfinite(value)) for value in speed] == good
    assert bad_number(ping(marine(**changes), RECEIVED_S)) is None


@pytest.mark.parametrize(("mode", "is_water"), [(0, False), (1, False), (2, True)])
def test_water_track_is_marked(mode: int, is_water: bool) -> None:
    """Speed through water is no speed over ground; a mode that was not set is bottom track."""
    found = ping(marine(velocity_mode=mode), RECEIVED_S)
    assert found.is_water is is_water
    assert found.speed[0] == 1.0


def test_water_linked_beams_go_by_their_ids() -> None:
    """Whatever their order in the message."""
    report = dvl_report(water_linked(), RECEIVED_S)
    np.testing.assert_allclose(report.ping.speed, [0.1, 0.2, 0.3, 0.4])
    assert report.range_m == (5.0, 6.0, 7.0, 8.0)
    assert report.beams_d is None
    assert report.velocity_d == (1.0, 0.5, -0.1)


def test_water_linked_beams_without_bottom() -> None:
    """Each beam has its own flag; without a valid velocity they may be false locks."""
    message = water_linked()
    message.beams[0].valid = False
    report = dvl_report(message, RECEIVED_S)
    np.testing.assert_allclose(report.ping.speed, [0.1, 0.2, NAN, 0.4])
    np.testing.assert_allclose(report.range_m, [5.0, 6.0, NAN, 8.0])
    for nothing in (water_linked(beams=[]), water_linked(velocity_valid=False)):
        assert np.isnan(ping(nothing, RECEIVED_S).speed).all()
    assert np.isnan(dvl_report(nothing, RECEIVED_S).velocity_d).all()


def test_water_linked_ids_out_of_range_are_refused() -> None:
    """Another numbering would mix up the beams."""
    message = water_linked()
    message.beams[0].id = 4
    with pytest.raises(DataError, match="ids 0 to 3"):
        ping(message, RECEIVED_S)


def test_pressure_becomes_depth() -> None:
    """Ten metres of sea water; the surface's height above the ellipsoid counts as well."""
    assert depth_reading(pressure(), RECEIVED_S).depth == pytest.approx(10.0)
    high = RosOptions(surface_height=30.0)
    assert depth_reading(pressure(), RECEIVED_S, high).depth == pytest.approx(-20.0)
    lake = RosOptions(water_density=1000.0, atmosphere=90_000.0)
    expected = (101_325.0 - 90_000.0 + 1025.0 * 9.80665 * 10.0) / 9806.65
    assert depth_reading(pressure(), RECEIVED_S, lake).depth == pytest.approx(expected)
    with pytest.raises(DataError, match="fluid_pressure is not finite"):
        depth_reading(pressure(fluid_pressure=NAN), RECEIVED_S)


def test_variance_of_pressure() -> None:
    """Pascal squared; zero is unknown."""
    assert depth_sigma(pressure(variance=(1025.0 * 9.80665 * 0.02) ** 2)) == pytest.approx(0.02)
    assert math.isnan(depth_sigma(pressure()))


def test_fix_in_radians_with_its_sigmas() -> None:
    """East, north, up are the diagonal."""
    assert fix(nav_sat_fix(), RECEIVED_S) == Fix(
        12.000000034, math.radians(45.0), math.radians(-120.0), 12.5, (1.0, 2.0, 3.0)
    )


@pytest.mark.parametrize("kind", [1, 2, 3])
def test_fix_of_unknown_quality_gets_the_stated_one(kind: int) -> None:
    """By its type, or where a variance is zero or NaN."""
    unknown = nav_sat_fix(position_covariance_type=0)
    assert fix(unknown, RECEIVED_S).sigma_enu == FIX_SIGMA
    assert not has_stated_sigma(unknown)
    covariance = [1.0, 0, 0, 0, 0.0, 0, 0, 0, NAN]
    partly = nav_sat_fix(position_covariance_type=kind, position_covariance=covariance)
    options = RosOptions(fix_sigma_enu=(7.0, 8.0, 9.0))
    assert fix(partly, RECEIVED_S, options).sigma_enu == (1.0, 8.0, 9.0)
    assert not has_stated_sigma(partly)
    assert has_stated_sigma(nav_sat_fix(position_covariance_type=kind))


def test_longitudes_may_go_once_around() -> None:
    """What is beyond half a turn is west of Greenwich."""
    assert fix(nav_sat_fix(longitude=240.0), RECEIVED_S).lon == pytest.approx(math.radians(-120.0))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"status": SimpleNamespace(status=-1)}, "no fix"),
        ({"latitude": NAN}, "latitude is not finite"),
        ({"latitude": 91.0}, "place on Earth"),
        ({"longitude": -181.0}, "place on Earth"),
        ({"longitude": 361.0}, "place on Earth"),
        ({"latitude": 0.0, "longitude": 0.0}, "place on Earth"),
        ({"altitude": NAN}, "altitude is not finite"),
    ],
)
def test_fix_that_is_none_is_refused(changes: dict[str, Any], said: str) -> None:
    """No fix, no number, no place."""
    with pytest.raises(DataError, match=said):
        fix(nav_sat_fix(**changes), RECEIVED_S)


def test_every_type_has_its_converter() -> None:
    """A live node needs nothing but this table."""
    messages = {
        "sensor_msgs/msg/Imu": (imu(), ImuSample),
        "marine_acoustic_msgs/msg/Dvl": (marine(), Ping),
        "dvl_msgs/msg/DVL": (water_linked(), Ping),
        "sensor_msgs/msg/FluidPressure": (pressure(), DepthReading),
        "sensor_msgs/msg/NavSatFix": (nav_sat_fix(), Fix),
    }
    assert set(CONVERTERS) == set(messages)
    for type_name, (message, kind) in messages.items():
        assert isinstance(CONVERTERS[type_name](message, RECEIVED_S, RosOptions()), kind)
