"""Clocks, units and axes are named one by one, with the line that mends them; healthy logs never.

Thresholds were chosen on seeds 0 to 3; seeds 100 to 129 gave the rates in
``docs/method-details.md``. Here are others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import ssm_graph as sg
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.suspects.find import find_suspects, with_suspects
from ssm_graph.mission.suspects.hypothesis import Delay
from ssm_graph.mission.suspects.motion import Inertial
from ssm_graph.mission.suspects.regression import robust_residual, walk_covariance, whitener
from ssm_graph.mission.suspects.search import vertex
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.dvl import beams_from_angles, rpy_from_R_bd
from ssm_graph.sensors.imu_calibration import ImuCalibration
from ssm_graph.simulation.aids import AidSettings, CompassSettings, GnssSettings
from ssm_graph.simulation.beam_faults import OutlierKind, Outliers
from ssm_graph.simulation.config import SimulationConfig
from ssm_graph.simulation.faults import Fault, FaultShape, Sensor
from ssm_graph.simulation.inertial import Grade
from ssm_graph.simulation.mission import simulate
from ssm_graph.simulation.routes import (
    DepthProfile,
    DiveRoute,
    HoverRoute,
    Route,
    SpiralRoute,
    SurveyRoute,
    TransitRoute,
)
from tests.blueye_fixture import DIVE, GRID, SQUARE, converted, needs_logs
from tests.helpers import simulated

DURATION_S, SMOOTHED_S = 300.0, 150.0
SURFACE = DepthProfile(0.5, 0.5)
ROUTES: dict[str, Route] = {
    "survey": SurveyRoute(line_m=120.0, depth=SURFACE),
    "diving survey": SurveyRoute(line_m=120.0, depth=DepthProfile(0.5, 20.0, 150.0, 25.0)),
    "dive": DiveRoute(period_s=300.0, depth_m=30.0),
    "hover": HoverRoute(),
    "spiral": SpiralRoute(),
    "transit": TransitRoute(depth=SURFACE),
}


@cache
def healthy(route: str, grade: Grade, seed: int, *faults: Fault, **changes: Any) -> Mission:
    """Return a mission with realistic instruments and fixes throughout."""
    settings: dict[str, Any] = {
        "duration_s": DURATION_S,
        "gnss": GnssSettings(windows=((0.0, DURATION_S),)),
        "aids": AidSettings(compass=CompassSettings()),
        "lat": 0.5,
        "lon": 0.4,
        "realistic": True,
    }
    return simulate(
        SimulationConfig(
            name=route,
            route=ROUTES[route],
            grade=grade,
            seed=seed,
            faults=faults,
            **(settings | changes),
        )
    ).mission


def with_imu(mission: Mission, **changes: Any) -> Mission:
    """Return a mission with other inertial data."""
    return replace(mission, imu=replace(mission.imu, **changes))


def with_dvl(mission: Mission, **changes: Any) -> Mission:
    """Return a mission with another DVL."""
    return replace(mission, dvl=replace(mission.dvl, **changes))


def with_mount(mission: Mission, **changes: Any) -> Mission:
    """Return a mission with its DVL stated otherwise."""
    return with_dvl(mission, mount=replace(mission.dvl.mount, **changes))


def with_depth(mission: Mission, change: Callable[[Array], Array]) -> Mission:
    """Return a mission with other depths."""
    assert mission.depth is not None
    return replace(mission, depth=replace(mission.depth, depth=change(mission.depth.depth)))


def only(mission: Mission) -> DetectedFault:
    """Return the one suspect of a mission."""
    suspects = find_suspects(mission)
    assert len(suspects) == 1, [suspect.sentence for suspect in suspects]
    assert suspects[0].treatment is Treatment.SAID
    assert not suspects[0].rivals
    return suspects[0]


def number(text: str) -> float:
    """Return the last number of a line."""
    words = "".join(c if c in "+-.0123456789" else " " for c in text).split()
    return float([word for word in words if any(c.isdigit() for c in word)][-1])


@pytest.mark.parametrize(
    ("route", "grade"),
    list(zip(ROUTES, 2 * [Grade.NAVIGATION, Grade.TACTICAL, Grade.MEMS], strict=True)),
)
def test_nobody_is_accused_without_a_fault(route: str, grade: Grade) -> None:
    """With realistic instruments and waves; a straight run has no turn and says nothing."""
    suspects = find_suspects(healthy(route, grade, 41))
    assert not suspects, [suspect.sentence for suspect in suspects]


@pytest.mark.parametrize("seed", [42, 43])
def test_outliers_accuse_no_clock(seed: int) -> None:
    """Single bad beams and missing ones are another matter."""
    outliers = Outliers(OutlierKind.SPARSE, rate=0.2)
    mission = healthy("survey", Grade.TACTICAL, seed, outliers=outliers, dropout_rate=0.1)
    assert not find_suspects(mission)


def test_a_gap_of_the_inertial_data_accuses_nobody() -> None:
    """Turns that nobody saw are no clock's fault; what is wrong beside the gap is still told."""
    fixes = GnssSettings(windows=((0.0, 120.0),))
    mission = simulated(duration_s=120.0, seed=4, gnss=fixes).mission
    imu = mission.imu
    kept = (imu.time_s < 12.0) | (imu.time_s > 20.0)
    rows = {name: getattr(imu, name)[kept] for name in ("time_s", "gyro_b", "accel_b")}
    assert not find_suspects(with_imu(mission, **rows))
    rows["gyro_b"] = 0.6 * rows["gyro_b"]
    assert {found.sensor for found in find_suspects(with_imu(mission, **rows))} == {"gyros"}


def test_pings_beyond_the_inertial_data_say_nothing() -> None:
    """Half of the pings have none to be compared with, as after a clock set by a minute."""
    mission = simulated(duration_s=120.0, seed=4).mission
    later = replace(mission.dvl, time_s=mission.dvl.time_s + 60.0)
    assert any(one.sensor == "DVL" for one in find_suspects(replace(mission, dvl=later)))


@pytest.mark.slow
def test_other_lies_accuse_no_clock() -> None:
    """A position that jumps, a bottom that moves: no clock, no unit explains them."""
    for fault in (
        Fault(sensor=Sensor.GNSS, start_s=100.0, end_s=200.0, size=(3.0, 0.0, 0.0)),
        Fault(shape=FaultShape.MOVING_BOTTOM, start_s=100.0, end_s=160.0, size=(0.2, 0.0, 0.0)),
        Fault(beams=(0,), start_s=50.0, end_s=250.0, offset_m_per_s=0.05),
    ):
        assert not find_suspects(healthy("survey", Grade.TACTICAL, 44, fault))


@pytest.mark.parametrize(("grade", "late_s"), [(Grade.MEMS, 0.3), (Grade.TACTICAL, 3.0)])
def test_a_late_dvl(grade: Grade, late_s: float) -> None:
    """Waves make it plain to a hundredth of a second, and three seconds are half a wave's."""
    mission = healthy("diving survey", grade, 45)
    found = only(with_dvl(mission, time_s=mission.dvl.time_s + late_s))
    assert found.sensor == "DVL"
    assert found.what.startswith(f"stamps {late_s:.2f} s late")
    assert found.remedy == f"[dvl] time_offset_s = {late_s:.2f}"


def test_a_calibration_takes_care_of_a_clock() -> None:
    """What the mission asks to be estimated, within four prior sigmas, is no suspect."""
    mission = healthy("diving survey", Grade.TACTICAL, 45)
    late = with_dvl(mission, time_s=mission.dvl.time_s + 0.3)
    assert not find_suspects(with_mount(late, time_offset_sigma_s=0.1))


@pytest.mark.parametrize("late_s", [1.0, 18.0, -18.0])
def test_late_fixes(late_s: float) -> None:
    """One second late throughout; leap seconds are named."""
    mission = healthy("survey", Grade.TACTICAL, 46)
    assert mission.gnss is not None
    gnss = replace(mission.gnss, time_s=mission.gnss.time_s + late_s)
    found = only(replace(mission, gnss=gnss))
    assert found.sensor == "GNSS"
    assert found.remedy.startswith("[gnss] time_offset_s = ")
    assert number(found.remedy) == pytest.approx(late_s, abs=0.15)
    assert ("GPS time" in found.what) == (abs(late_s) == 18.0)


def test_fixes_by_gps_time_in_the_first_minute() -> None:
    """Until the receiver knew of leap seconds."""
    fault = Fault(sensor=Sensor.GNSS, shape=FaultShape.LATE, end_s=60.0, size=18.0)
    found = only(healthy("survey", Grade.MEMS, 47, fault))
    assert found.sensor == "GNSS"
    assert "GPS time where UTC was expected" in found.what
    assert found.end_s == pytest.approx(60.0, abs=4.0)
    assert found.remedy.startswith("take 18.0 s off time_s of the rows before ")


@pytest.mark.parametrize(
    ("fault", "sensor"),
    [
        (Fault(sensor=Sensor.GNSS, shape=FaultShape.LATE, start_s=150.0, size=1.0), "GNSS"),
        (Fault(sensor=Sensor.DEPTH, shape=FaultShape.LATE, start_s=150.0, size=1.0), "depth"),
        (Fault(shape=FaultShape.LATE, start_s=150.0, size=1.0), "DVL"),
        (Fault(sensor=Sensor.IMU, shape=FaultShape.CLOCK, start_s=150.0, size=1.0), "IMU"),
    ],
)
def test_a_clock_that_is_set_in_mid_run(fault: Fault, sensor: str) -> None:
    """By one second at half time: who, when and by how much."""
    found = only(healthy("diving survey", Grade.TACTICAL, 48, fault))
    assert found.sensor == sensor
    assert "the clock was set by +1.0 s" in found.what
    assert found.begin_s == pytest.approx(150.0, abs=15.0)


@pytest.mark.slow
def test_late_depths_and_early_inertial_data() -> None:
    """Depths alone; and inertial data against everybody else."""
    late_s = 0.5
    mission = healthy("diving survey", Grade.TACTICAL, 45)
    assert mission.depth is not None
    depth = replace(mission.depth, time_s=mission.depth.time_s + late_s)
    found = only(replace(mission, depth=depth))
    assert found.sensor == "depth"
    assert float(found.remedy.split()[1]) == pytest.approx(late_s, abs=0.1)
    imu, late_s = mission.imu, -0.5
    early = with_imu(mission, time_s=imu.time_s + late_s, start_s=imu.start_s + late_s)
    found = only(early)
    assert found.sensor == "IMU"
    assert found.remedy.startswith("[imu] time_offset_s = ")
    assert number(found.remedy) == pytest.approx(late_s, abs=0.02)
    assert not find_suspects(with_imu(early, calibration=ImuCalibration(time_offset_s=late_s)))


def test_a_late_compass() -> None:
    """Against the turns of the gyros."""
    mission = healthy("survey", Grade.TACTICAL, 46)
    log = mission.aids[HeadingLog]
    late = replace(mission, aids=mission.aids.having(replace(log, time_s=log.time_s + 1.0)))
    assert only(late).sensor == "compass"


@pytest.mark.parametrize(
    ("grade", "scale", "says"),
    [
        (Grade.MEMS, 0.6, "read 0.60 of the turn"),
        (Grade.TACTICAL, 180.0 / math.pi, "read degrees"),
    ],
)
def test_gyros_of_another_scale(grade: Grade, scale: float, says: str) -> None:
    """The factor, from accelerometers against DVL and the course of the fixes."""
    mission = healthy("survey", grade, 51)
    found = only(with_imu(mission, gyro_b=mission.imu.gyro_b * scale))
    assert found.sensor == "gyros"
    assert found.what.startswith(says)
    assert "fixes and track" in found.what
    assert number(found.remedy) == pytest.approx(1.0 / scale, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    "known",
    [ImuCalibration(gyro_scale_sigma=0.5), ImuCalibration(gyro_scale_error=np.full(3, -0.4))],
    ids=["asked for", "stated"],
)
def test_a_calibration_takes_care_of_the_gyros(known: ImuCalibration) -> None:
    """A factor within four of the prior sigmas that the mission states for it, or that it knows."""
    mission = healthy("survey", Grade.MEMS, 51)
    assert not find_suspects(with_imu(mission, gyro_b=0.6 * mission.imu.gyro_b, calibration=known))


def test_a_gyro_of_the_other_sign() -> None:
    """About one axis."""
    mission = healthy("survey", Grade.TACTICAL, 46)
    found = only(with_imu(mission, gyro_b=mission.imu.gyro_b * [1.0, 1.0, -1.0]))
    assert found.what.startswith("turn the wrong way about z")


@pytest.mark.parametrize(
    ("factor", "unit"), [(1000.0, "mm/s"), (1.0 / 0.514444, "knots"), (0.8, "")]
)
def test_speeds_of_another_unit(factor: float, unit: str) -> None:
    """Named where it is one; else it is the scale that ``mission.toml`` has a key for."""
    mission = healthy("survey", Grade.TACTICAL, 46)
    found = only(with_dvl(mission, speed=mission.dvl.speed * factor))
    assert found.sensor == "DVL"
    assert unit in found.what
    wanted = 1.0 / factor if unit else factor - 1.0
    assert number(found.remedy) == pytest.approx(wanted, rel=0.05)
    assert found.remedy.startswith("multiply the beam" if unit else "[dvl] scale_error = -0.2")


@pytest.mark.parametrize(
    ("factor", "unit"), [(0.1, "bar"), (1.0 / 0.6895, "psi"), (1.0 / 0.3048, "feet")]
)
def test_depths_of_another_unit(factor: float, unit: str) -> None:
    """Against the vertical speed of the DVL."""
    found = only(with_depth(healthy("diving survey", Grade.MEMS, 54), lambda d: d * factor))
    assert found.sensor == "depth"
    assert f"they are in {unit}" in found.what


def test_the_atmosphere_in_the_depth() -> None:
    """10.13 m more than the heights of the fixes say."""
    found = only(with_depth(healthy("survey", Grade.TACTICAL, 46), lambda d: d + 10.13))
    assert "atmosphere" in found.what
    assert number(found.remedy) == pytest.approx(10.13, abs=0.7)


@pytest.mark.slow
def test_a_mounting_by_quarters_and_another_janus_angle() -> None:
    """The line of ``mission.toml`` is the true one."""
    mission = healthy("survey", Grade.TACTICAL, 46)
    mount = mission.dvl.mount
    for degrees in (90.0, 180.0):
        a = math.radians(degrees)
        turn = np.array(
            [[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]]
        )
        found = only(with_mount(mission, R_bd=mount.R_bd @ turn))
        stated = np.array([float(x) for x in found.remedy.split("[")[-1].strip("]").split(",")])
        np.testing.assert_allclose(stated, np.degrees(rpy_from_R_bd(mount.R_bd)), atol=0.01)
    azimuth = np.arctan2(mount.beams_d[:, 1], mount.beams_d[:, 0])
    true = math.degrees(math.acos(mount.beams_d[0, 2]))
    found = only(with_mount(mission, beams_d=beams_from_angles(azimuth, math.radians(true - 10.0))))
    assert found.remedy.startswith("[dvl] beam_janus_deg = ")
    assert number(found.remedy) == pytest.approx(true, abs=0.3)


@pytest.mark.parametrize("order", [(0, 3, 2, 1), (1, 0, 2, 3)])
def test_beams_in_another_order(order: tuple[int, ...]) -> None:
    """Mirrored, which only motion shows, or mixed up, which the parity of the array shows."""
    mission = healthy("survey", Grade.TACTICAL, 46)
    found = only(with_dvl(mission, speed=mission.dvl.speed[:, list(order)]))
    columns = [int(c) - 1 for c in found.remedy.split("columns")[1].split(",")]
    assert [order[c] for c in columns] == [0, 1, 2, 3]


def test_all_beams_of_the_other_sign() -> None:
    """As Teledyne counts them."""
    mission = healthy("survey", Grade.MEMS, 51)
    assert "wrong sign" in only(with_dvl(mission, speed=-mission.dvl.speed)).what


def test_longitude_and_latitude_exchanged() -> None:
    """The track is mirrored."""
    mission = healthy("survey", Grade.TACTICAL, 46)
    gnss = mission.gnss
    assert gnss is not None
    frame = LocalFrame(float(gnss.lon[0]), float(gnss.lat[0]), float(gnss.height[0]))
    found = only(replace(mission, frame=frame, gnss=replace(gnss, lat=gnss.lon, lon=gnss.lat)))
    assert found.sensor == "GNSS"
    assert "changed places" in found.what


def test_accelerometers_in_g_and_z_up() -> None:
    """Gravity says so, without any motion."""
    mission = healthy("hover", Grade.TACTICAL, 60)
    imu = mission.imu
    found = only(with_imu(mission, accel_b=imu.accel_b / 9.80665))
    assert found.sensor == "accelerometers"
    assert found.what.endswith(": g")
    flipped = [1.0, -1.0, -1.0]
    found = only(with_imu(mission, accel_b=imu.accel_b * flipped, gyro_b=imu.gyro_b * flipped))
    assert "z points up" in found.what


def test_who_is_late_where_only_two_can_tell() -> None:
    """DVL and inertial data alone: either may be, and both are said."""
    mission = replace(
        healthy("survey", Grade.TACTICAL, 61, gnss=None, depth=None, aids=AidSettings()),
    )
    suspects = find_suspects(with_dvl(mission, time_s=mission.dvl.time_s + 0.3))
    assert len(suspects) == 1
    named = {suspects[0].sensor, *(rival.split(",")[0] for rival in suspects[0].rivals)}
    assert named == {"DVL", "IMU"}


@pytest.mark.slow
def test_the_answer_says_it_first() -> None:
    """The status is SUSPECT, the sentence stands first, the fault is among the estimate's."""
    mission = healthy("survey", Grade.TACTICAL, 46, duration_s=SMOOTHED_S)
    assert mission.gnss is not None
    late = replace(mission, gnss=replace(mission.gnss, time_s=mission.gnss.time_s + 5.0))
    estimate = sg.smooth(late)
    assert estimate.status is sg.Status.SUSPECT
    assert estimate.reason.startswith(estimate.faults[0].sentence)
    assert estimate.faults[0].sensor == "GNSS"


@pytest.mark.slow
def test_a_clock_that_is_taken_off_is_said_once() -> None:
    """Fixes a second late: the line that mends it, of an answer that is right."""
    mission = healthy("survey", Grade.TACTICAL, 46, duration_s=SMOOTHED_S)
    assert mission.gnss is not None
    late = replace(mission, gnss=replace(mission.gnss, time_s=mission.gnss.time_s + 1.0))
    estimate = sg.smooth(late)
    assert estimate.status is sg.Status.CONVERGED
    (found,) = (one for one in estimate.faults if one.late_s is not None)
    assert (found.sensor, found.treatment) == ("GNSS", Treatment.FREED)
    assert found.remedy.startswith("[gnss] time_offset_s = ")


def test_a_solver_that_fails_says_it_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """That is when it is needed."""
    mission = healthy("survey", Grade.MEMS, 51, duration_s=SMOOTHED_S)

    def fail(*_: Any, **__: Any) -> Any:
        raise sg.SolverError("no finite solution")
        yield

    monkeypatch.setattr("ssm_graph.smoothers.mission.smooth_steps", fail)
    with pytest.raises(sg.SolverError, match=r"^gyros, .* read 0\.60 of the turn.*no finite"):
        sg.smooth(with_imu(mission, gyro_b=mission.imu.gyro_b * 0.6))
    with pytest.raises(sg.SolverError, match=r"^no finite"):
        sg.smooth(mission)


def test_an_answer_without_suspects_is_left_alone() -> None:
    """To the same object."""
    mission = healthy("hover", Grade.NAVIGATION, 41, duration_s=SMOOTHED_S)
    estimate = sg.smooth(mission)
    assert with_suspects(estimate, (), mission) is estimate


def test_what_lies_for_a_while_makes_no_suspect_of_another() -> None:
    """Two beams that are off for 80 s make a scale of the depths: not of an answer without them."""
    mission = healthy(
        *("diving survey", Grade.TACTICAL, 80, Fault((0, 3), 110.0, 190.0, 0.1)),
        gnss=None,
        duration_s=200.0,
    )
    suspects = find_suspects(mission)
    assert [one.sensor for one in suspects] == ["depth"]
    found = DetectedFault("DVL beams 1 and 4", "+0.1 m/s", 110.0, 190.0, 1e3, 1, Treatment.FREED)
    estimate = replace(sg.smooth(simulated().mission), faults=(found,))
    assert with_suspects(estimate, suspects, mission) is estimate
    blind = with_suspects(replace(estimate, faults=()), suspects, mission)
    assert blind.status is sg.Status.SUSPECT


@needs_logs
@pytest.mark.parametrize("name", [SQUARE, DIVE, GRID])
def test_real_logs(name: str) -> None:
    """As recorded nobody is accused; gyros that read 0.60 of the turn are."""
    mission = converted(name)
    assert not find_suspects(mission)
    if name == GRID:
        found = only(with_imu(mission, gyro_b=0.6 * mission.imu.gyro_b))
        assert found.what.startswith("read 0.60 of the turn")
        assert number(found.remedy) == pytest.approx(1.0 / 0.6, rel=0.01)


def test_whitened_walks_are_white() -> None:
    """The whitener of a random walk with white noise makes unit variances of its samples."""
    rng, time_s = np.random.default_rng(5), np.linspace(0.0, 30.0, 61)
    covariance = 0.04 * np.eye(61) + 0.5 * walk_covariance(time_s)
    W = whitener(covariance)
    np.testing.assert_allclose(W @ covariance @ W.T, np.eye(61), atol=1e-9)
    steps = rng.standard_normal((4000, 61)) * np.sqrt(np.r_[0.0, 0.5 * np.diff(time_s)])
    walks = np.cumsum(steps, axis=1) + 0.2 * rng.standard_normal((4000, 61))
    np.testing.assert_allclose(np.var(walks @ W.T, axis=0), 1.0, atol=0.12)


def test_rows_outside_all_logs_say_nothing() -> None:
    """They change neither the coefficients nor the loss of the others: NaN would show."""
    rng = np.random.default_rng(6)
    X, known = np.stack([np.ones(50), np.arange(50.0)], axis=1), np.arange(50) > 9
    y = X @ [2.0, 0.5] + 0.01 * rng.standard_normal(50)
    far = np.where(known, y, 1e6)
    residual, c = robust_residual(far, X, known)
    np.testing.assert_allclose(c, robust_residual(y, X, known)[1])
    assert np.ptp(residual[~known]) == 0.0


def test_the_vertex_of_a_parabola() -> None:
    """Uneven values; blocks that disagree make the sigma."""
    values = np.array([0.0, 1.0, 3.0])
    one = ((values - 1.7) ** 2)[:, None]
    at, sigma = vertex(values, np.hstack([one] * 8))
    assert at == pytest.approx(1.7)
    assert sigma == pytest.approx(1.0 / math.sqrt(2.0 * 8.0))
    other = ((values - 0.7) ** 2)[:, None]
    at, sigma = vertex(values, 100.0 * np.hstack([one, other] * 4))
    assert at == pytest.approx(1.2)
    assert sigma == pytest.approx(0.5 / math.sqrt(7.0), rel=1e-6)


def test_attitude_is_that_of_one_rotation_after_the_other() -> None:
    """Products by doubling against a loop, and gravity that is up."""
    imu = healthy("dive", Grade.NAVIGATION, 41).imu
    inertial = Inertial.of(imu)
    R = np.eye(3)
    for k, rate in enumerate(imu.gyro_b[:5000]):
        span = imu.time_s[k] - (imu.time_s[k - 1] if k else imu.start_s)
        angle = np.linalg.norm(rate) * span
        K = np.cross(np.eye(3), rate / np.linalg.norm(rate))
        R = R @ (np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K)
    at = inertial.at(inertial.R_ib, imu.time_s[4999:5000])[0]
    np.testing.assert_allclose(at, R, atol=1e-4)
    up_b = np.einsum("nij,ni->nj", inertial.R_ib, inertial.up_i)
    assert np.all(up_b[:, 2] < -0.9)


def test_delays() -> None:
    """Before, after and longer throughout."""
    delay = Delay(1.0, 2.0, 10.0).later(0.5)
    np.testing.assert_allclose(delay.at(np.array([9.0, 10.0, 11.0])), [1.5, 2.5, 2.5])
