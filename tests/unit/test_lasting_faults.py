"""Faults that last are where they say, as large as they say, and in the truth record."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.acoustic import UsblLog
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.simulation import (
    BrokenMission,
    DvlSettings,
    Fault,
    FaultShape,
    GnssSettings,
    Grade,
    Sensor,
    SimulatedMission,
    SimulationConfig,
    TransitRoute,
    scenario_config,
    simulate,
    with_dvl_errors,
    with_faults,
)
from ssm_graph.simulation.dvl_model import true_beam_speeds
from ssm_graph.simulation.faults import SENSORS
from ssm_graph.simulation.lasting_faults import log_of

BEGIN_S, END_S = 60.0, 100.0
FIXES = GnssSettings(windows=((0.0, math.inf),), lever_arm_b=(0.0, 0.0, 0.0))
SIZES: dict[FaultShape, Any] = {
    FaultShape.SCALE: 1.5,
    FaultShape.NOISE: 10.0,
    FaultShape.SPIKES: (2.0, 5.0),
    FaultShape.LATE: 2.0,
    FaultShape.MOVING_BOTTOM: (0.2, -0.1, 0.05),
    FaultShape.SLIP: (0.0, 0.02, 0.08),
    FaultShape.CLIPPED: 0.01,
    FaultShape.LOW_PASS: 1.0,
    FaultShape.CLOCK: 0.5,
}
OFFSETS = (FaultShape.CONSTANT, FaultShape.DRIFT, FaultShape.RAMP)
EVERY = [(sensor, shape) for shape, on in SENSORS.items() for sensor in Sensor if sensor in on]


def config(**changes: Any) -> SimulationConfig:
    """Return settings of a mission with every sensor, 150 s long."""
    given = {"grade": Grade.TACTICAL, "seed": 4, "duration_s": 150.0, "gnss": FIXES, **changes}
    return scenario_config("aided", **given)


@cache
def clean(*, perfect: bool = True) -> SimulatedMission:
    """Return the mission without faults, without noise unless asked for."""
    return simulate(config(perfect_sensors=perfect))


def fault(sensor: Sensor, shape: FaultShape, **changes: Any) -> Fault:
    """Return a fault of a size that can be seen, for 40 s."""
    given: dict[str, Any] = {"start_s": BEGIN_S, "end_s": END_S, "sensor": sensor, "shape": shape}
    if shape in OFFSETS and sensor is Sensor.DVL:
        given["offset_m_per_s"] = 0.3
    elif shape in OFFSETS:
        given["size"] = (3.0, 2.0, 1.0) if sensor in (Sensor.GNSS, Sensor.USBL) else 0.1
    elif shape in (FaultShape.COVERED, FaultShape.SPIKES):
        given["share"] = 0.3
    if shape is FaultShape.CLOCK:
        given["end_s"] = math.inf
    if shape in SIZES:
        given["size"] = SIZES[shape]
    return Fault(**(given | changes))


def broken(*faults: Fault, perfect: bool = True) -> BrokenMission:
    """Return the mission with faults."""
    run = clean(perfect=perfect)
    return with_faults(run.mission, faults, truth=run.truth_at)


def arrays(log: Any) -> list[Array]:
    """Return all that a log has read, by row."""
    read = [getattr(log, name) for name in type(log).__dataclass_fields__]
    rows = [a for a in read if isinstance(a, np.ndarray) and len(a) == len(log.time_s)]
    return [a[:, None] if a.ndim == 1 else a for a in rows]


@pytest.mark.parametrize(("sensor", "shape"), EVERY, ids=lambda member: member.name)
def test_a_fault_touches_its_sensor_in_its_time_alone(sensor: Sensor, shape: FaultShape) -> None:
    """Bad are the readings that differ, and the record says so; all others stay bit by bit."""
    done = broken(fault(sensor, shape), perfect=False)
    before = clean(perfect=False).mission
    name = "imu" if sensor.is_inertial else sensor.value
    assert list(done.is_bad) == [name]
    for other in Sensor:
        if other is not sensor and not (other.is_inertial and sensor.is_inertial):
            assert log_of(done.mission, other) is log_of(before, other)
    log, old = log_of(done.mission, sensor), log_of(before, sensor)
    bad = done.is_bad[name]
    differs = [
        (new != was) & (np.isfinite(new) | np.isfinite(was))
        for new, was in zip(arrays(log), arrays(old), strict=True)
    ]
    changed = np.any(np.hstack(differs), axis=1)
    bad_rows = np.any(bad.reshape(len(bad), -1), axis=1)
    assert changed.any()
    assert not changed[~bad_rows].any()
    end_s = math.inf if shape is FaultShape.CLOCK else END_S
    assert not bad_rows[(old.time_s < BEGIN_S) | (old.time_s >= end_s)].any()
    if shape not in (FaultShape.SPIKES, FaultShape.CLIPPED):
        assert bad_rows[(old.time_s >= BEGIN_S) & (old.time_s < end_s)].all()


def off_enu(done: Mission, log: type | None = None) -> Array:
    """Return by how much fixes moved, (N, 3) east, north, up, m."""
    pair = []
    for mission in (done, clean().mission):
        fixes = mission.gnss if log is None else mission.aids.get(log)
        assert fixes is not None
        pair.append((fixes.lat, fixes.lon, fixes.height))
    frame = LocalFrame(float(pair[1][0][0]), float(pair[1][1][0]), 0.0)
    return np.asarray(frame.p_n_from_geodetic(*pair[0]) - frame.p_n_from_geodetic(*pair[1]))


def test_fixes_are_off_by_what_is_said() -> None:
    """An offset, one that grows to it, one that grows by so much a second."""
    time_s = clean().mission.gnss.time_s  # type: ignore[union-attr]
    inside = (time_s >= BEGIN_S) & (time_s < END_S)
    age_s = (time_s[inside] - BEGIN_S)[:, None]
    size = np.array([3.0, 2.0, 1.0])
    for shape, factor in (
        (FaultShape.CONSTANT, 1.0),
        (FaultShape.DRIFT, age_s / 40.0),
        (FaultShape.RAMP, age_s),
    ):
        off = off_enu(broken(fault(Sensor.GNSS, shape)).mission)
        np.testing.assert_allclose(off[inside] - size * factor, 0.0, atol=0.01)
        assert not off[~inside].any()
    off = off_enu(broken(fault(Sensor.USBL, FaultShape.CONSTANT)).mission, UsblLog)
    touched = off.any(axis=1)
    np.testing.assert_allclose(off[touched] - size, 0.0, atol=0.01)


def test_fixes_stay_coast_and_come_late() -> None:
    """The last one again; straight on from it; the place of 18 s before."""
    gnss, run = clean().mission.gnss, clean()
    assert gnss is not None
    frame = run.mission.frame
    inside = np.flatnonzero((gnss.time_s >= BEGIN_S) & (gnss.time_s < END_S))
    time_s = gnss.time_s[inside]
    truth = run.truth_at(time_s)
    true_n = frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)

    def read(shape: FaultShape, **changes: Any) -> Array:
        log = broken(fault(Sensor.GNSS, shape, **changes)).mission.gnss
        assert log is not None
        return frame.p_n_from_geodetic(log.lat, log.lon, log.height)[inside]

    stuck = read(FaultShape.STUCK)
    np.testing.assert_allclose(stuck, np.broadcast_to(true_n[0], stuck.shape), atol=1e-6)
    coasted = true_n[0] + (time_s - time_s[0])[:, None] * truth.velocity_enu[0]
    np.testing.assert_allclose(read(FaultShape.COASTING), coasted, atol=0.01)
    before = run.truth_at(time_s - 18.0)
    np.testing.assert_allclose(
        read(FaultShape.LATE, size=18.0),
        frame.p_n_from_geodetic(before.lat, before.lon, before.height),
        atol=1e-6,
    )


def test_spikes_and_noise_of_fixes_and_depth() -> None:
    """Lengths are within the sigmas asked for; ten times the noise has ten times the sigma."""
    assert clean().mission.gnss is not None
    spikes = off_enu(broken(fault(Sensor.GNSS, FaultShape.SPIKES, start_s=0.0)).mission)
    sigmas = np.linalg.norm(spikes / clean().mission.gnss.sigma_enu, axis=1)  # type: ignore[union-attr]
    touched = sigmas > 0.0
    assert 0.15 < touched[: int(END_S)].mean() < 0.45
    assert 2.0 - 0.01 < sigmas[touched].min() < sigmas[touched].max() < 5.0 + 0.01
    noisy = broken(fault(Sensor.DEPTH, FaultShape.NOISE, start_s=0.0)).mission.depth
    quiet = clean().mission.depth
    assert noisy is not None
    assert quiet is not None
    error = (noisy.depth - quiet.depth)[quiet.time_s < END_S] / quiet.sigma
    assert np.std(error) == pytest.approx(math.sqrt(99.0), rel=4.0 / math.sqrt(2 * len(error)))


def test_depths() -> None:
    """Wrong units multiply; a pull grows; a clock is late by the rise since."""
    quiet, run = clean().mission.depth, clean()
    assert quiet is not None
    inside = (quiet.time_s >= BEGIN_S) & (quiet.time_s < END_S)
    age_s = quiet.time_s[inside] - BEGIN_S
    late_s = quiet.time_s[inside] - 2.0
    rise = run.truth_at(quiet.time_s[inside]).height - run.truth_at(late_s).height
    for shape, expected in (
        (FaultShape.SCALE, 1.5 * quiet.depth[inside]),
        (FaultShape.RAMP, quiet.depth[inside] + 0.1 * age_s),
        (FaultShape.STUCK, np.full(len(age_s), quiet.depth[inside][0])),
        (FaultShape.LATE, quiet.depth[inside] + rise),
    ):
        log = broken(fault(Sensor.DEPTH, shape)).mission.depth
        assert log is not None
        np.testing.assert_allclose(log.depth[inside], expected, atol=1e-9)


def test_a_flat_plane_leaves_the_earth() -> None:
    """By ``d^2 / 2 R``: 7.8 m after 10 km, and it seems deeper there."""
    run = simulate(
        SimulationConfig(
            route=TransitRoute(), duration_s=5100.0, imu_rate_hz=10.0, perfect_sensors=True
        )
    )
    flat = with_faults(run.mission, [Fault(sensor=Sensor.DEPTH, shape=FaultShape.FLAT)])
    assert flat.mission.depth is not None
    assert run.mission.depth is not None
    truth = run.truth_at(run.mission.depth.time_s)
    p_n = run.mission.frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
    distance = np.linalg.norm(p_n[:, :2], axis=1)
    assert distance[-1] > 10_000.0
    deeper = flat.mission.depth.depth - run.mission.depth.depth
    np.testing.assert_allclose(deeper, distance**2 / (2.0 * 6.371e6), rtol=0.01, atol=0.01)


def test_a_compass_wraps() -> None:
    """Offsets go round; a late one says what was before."""
    before = clean().mission.aids[HeadingLog]
    inside = (before.time_s >= BEGIN_S) & (before.time_s < END_S)
    done = broken(fault(Sensor.COMPASS, FaultShape.CONSTANT, size=6.0)).mission.aids[HeadingLog]
    assert (done.heading >= 0.0).all()
    assert (done.heading < 2.0 * math.pi).all()
    turned = np.remainder(done.heading - before.heading, 2.0 * math.pi)[inside]
    np.testing.assert_allclose(turned, 6.0, atol=1e-9)


def velocity(speed: Array) -> Array:
    """Return velocities (N, 3) in body axes by beam speeds (N, 4)."""
    return np.asarray(speed @ np.linalg.pinv(clean().mission.dvl.mount.beams_b).T)


def test_beams_off_a_moving_bottom() -> None:
    """What reflects moves with one velocity along east, north and up, whatever the attitude."""
    done = broken(fault(Sensor.DVL, FaultShape.MOVING_BOTTOM)).mission.dvl
    dvl, run = clean().mission.dvl, clean()
    inside = (dvl.time_s >= BEGIN_S) & (dvl.time_s < END_S)
    off_b = velocity(done.speed - dvl.speed)[inside]
    R_eb = run.trajectory.R_eb(dvl.time_s[inside])
    truth = run.truth_at(dvl.time_s[inside])
    off_e = R_eb.apply(off_b)
    frame = LocalFrame(float(truth.lat[0]), float(truth.lon[0]), 0.0)
    np.testing.assert_allclose(
        off_e @ frame.R_en,
        -np.broadcast_to(SIZES[FaultShape.MOVING_BOTTOM], off_e.shape),
        atol=1e-4,
    )


@pytest.mark.parametrize("shape", [FaultShape.SLIP, FaultShape.LATE])
def test_a_slip_and_a_late_clock_are_those_of_the_instrument(shape: FaultShape) -> None:
    """As the simulator has them from the start, by the path of the instrument itself."""
    done, run = broken(fault(Sensor.DVL, shape)).mission.dvl, clean()
    inside = (done.time_s >= BEGIN_S) & (done.time_s < END_S)
    time_s, settings = done.time_s[inside], run.config.dvl
    if shape is FaultShape.SLIP:
        settings = DvlSettings(misalignment=SIZES[shape])
    else:
        time_s = time_s - SIZES[shape]
    expected = true_beam_speeds(run.trajectory, settings, time_s)
    assert np.abs(expected - run.mission.dvl.speed[inside]).max() > 0.02
    np.testing.assert_allclose(done.speed[inside], expected, atol=5e-4)


def test_beams_spike_scale_and_grow_noisy() -> None:
    """In those beams alone, at the share and the sigmas asked for."""
    dvl, start = clean().mission.dvl, {"start_s": 0.0, "end_s": math.inf}
    done = broken(fault(Sensor.DVL, FaultShape.SPIKES, beams=(1, 3), **start))
    sigmas = (done.mission.dvl.speed - dvl.speed) / dvl.sigma
    bad = done.is_bad["dvl"]
    assert not bad[:, [0, 2]].any()
    assert not sigmas[~bad].any()
    assert bad[:, [1, 3]].mean() == pytest.approx(0.3, abs=4.0 * math.sqrt(0.21 / 300))
    assert sigmas[bad].min() >= 2.0 - 1e-9
    assert sigmas[bad].max() <= 5.0 + 1e-9
    noisy = broken(fault(Sensor.DVL, FaultShape.NOISE, **start)).mission.dvl
    error = ((noisy.speed - dvl.speed) / dvl.sigma).ravel()
    assert np.std(error) == pytest.approx(math.sqrt(99.0), rel=4.0 / math.sqrt(2 * len(error)))
    scaled = broken(fault(Sensor.DVL, FaultShape.SCALE, beams=(2,), **start)).mission.dvl
    np.testing.assert_allclose(scaled.speed, dvl.speed * [1.0, 1.0, 1.5, 1.0], atol=1e-12)
    zero = broken(fault(Sensor.DVL, FaultShape.ZERO, **start)).mission.dvl
    assert not zero.speed.any()


def test_inertial_data() -> None:
    """Equal rows, one axis at zero, a factor, clipped, late, stamps that jump."""
    imu = clean(perfect=False).mission.imu
    inside = np.flatnonzero((imu.time_s >= BEGIN_S) & (imu.time_s < END_S))

    def read(sensor: Sensor, shape: FaultShape, **changes: Any) -> Any:
        return broken(fault(sensor, shape, **changes), perfect=False).mission.imu

    frozen = read(Sensor.IMU, FaultShape.STUCK)
    assert (np.diff(np.hstack([frozen.gyro_b, frozen.accel_b])[inside], axis=0) == 0.0).all()
    stuck = read(Sensor.GYROS, FaultShape.ZERO, axes=(2,))
    np.testing.assert_array_equal(stuck.gyro_b[inside], imu.gyro_b[inside] * [1.0, 1.0, 0.0])
    scaled = read(Sensor.GYROS, FaultShape.SCALE, size=0.6)
    np.testing.assert_allclose(scaled.gyro_b[inside], 0.6 * imu.gyro_b[inside], atol=1e-15)
    jumped = read(Sensor.ACCELEROMETERS, FaultShape.CONSTANT, size=(0.2, 0.3), axes=(0, 2))
    np.testing.assert_allclose(
        (jumped.accel_b - imu.accel_b)[inside], [[0.2, 0, 0.3]] * len(inside)
    )
    clipped = read(Sensor.GYROS, FaultShape.CLIPPED)
    np.testing.assert_array_equal(clipped.gyro_b[inside], np.clip(imu.gyro_b[inside], -0.01, 0.01))
    late = read(Sensor.IMU, FaultShape.LATE, size=0.03)
    np.testing.assert_array_equal(late.accel_b[inside], imu.accel_b[inside - 3])
    late = read(Sensor.GYROS, FaultShape.LATE, size=-0.03)
    np.testing.assert_array_equal(late.gyro_b[inside], imu.gyro_b[inside + 3])
    clock = read(Sensor.IMU, FaultShape.CLOCK)
    np.testing.assert_allclose(clock.time_s - imu.time_s, np.where(imu.time_s < BEGIN_S, 0.0, 0.5))
    noisy = read(Sensor.ACCELEROMETERS, FaultShape.NOISE)
    error = (noisy.accel_b - imu.accel_b)[inside] / (imu.noise.accel_density * 10.0)
    assert np.std(error) == pytest.approx(math.sqrt(99.0), rel=4.0 / math.sqrt(2 * error.size))


@pytest.mark.parametrize("frequency_hz", [0.1, 1.0, 10.0])
def test_a_low_pass_ends_at_its_frequency(frequency_hz: float) -> None:
    """Half of the power at its end, about a hundredth of the amplitude ten times above."""
    imu = clean().mission.imu
    wave = np.sin(2.0 * math.pi * frequency_hz * imu.time_s)
    mission = replace(clean().mission, imu=replace(imu, gyro_b=np.tile(wave[:, None], (1, 3))))
    low = Fault(sensor=Sensor.GYROS, shape=FaultShape.LOW_PASS, size=1.0)
    done = with_faults(mission, [low]).mission.imu.gyro_b[5000:]
    ratio = math.tan(math.pi * frequency_hz / 100.0) / math.tan(math.pi / 100.0)
    left = 1.0 / math.sqrt(1.0 + ratio**4)  # Butterworth, two poles
    assert np.std(done) * math.sqrt(2.0) == pytest.approx(left, rel=0.01)


def test_faults_add_up_and_keep_their_order() -> None:
    """Depth in the wrong unit with the atmosphere in it."""
    atmosphere = fault(Sensor.DEPTH, FaultShape.CONSTANT, size=10.13)
    unit = fault(Sensor.DEPTH, FaultShape.SCALE, size=0.1)
    depth = clean().mission.depth
    done = broken(atmosphere, unit).mission.depth
    assert depth is not None
    assert done is not None
    inside = (depth.time_s >= BEGIN_S) & (depth.time_s < END_S)
    np.testing.assert_allclose(done.depth[inside], 0.1 * (depth.depth[inside] + 10.13))


def test_a_recorded_mission_is_broken_by_its_reference() -> None:
    """Where the truth is asked for, the reference between its rows is as good; it must know."""
    run = clean()
    for sensor, shape in (
        (Sensor.DVL, FaultShape.MOVING_BOTTOM),
        (Sensor.DVL, FaultShape.SLIP),
        (Sensor.GNSS, FaultShape.COASTING),
        (Sensor.DEPTH, FaultShape.LATE),
        (Sensor.COMPASS, FaultShape.LATE),
    ):
        by_truth = broken(fault(sensor, shape)).mission
        by_reference = with_faults(run.mission, [fault(sensor, shape)]).mission
        pairs = zip(
            arrays(log_of(by_truth, sensor)), arrays(log_of(by_reference, sensor)), strict=True
        )
        for one, other in pairs:
            np.testing.assert_allclose(one, other, atol=2e-3)
    bare = replace(run.mission, reference=None)
    with pytest.raises(DataError, match=r"expected a mission with a reference.*hand in truth"):
        with_faults(bare, [fault(Sensor.DVL, FaultShape.SLIP)])
    assert run.mission.reference is not None
    unknown = np.full_like(run.mission.reference.velocity_enu, np.nan)
    without = replace(run.mission, reference=replace(run.mission.reference, velocity_enu=unknown))
    with pytest.raises(DataError, match="expected a reference with velocities"):
        with_faults(without, [fault(Sensor.DVL, FaultShape.SLIP)])


def test_simulated_faults_are_those_of_a_finished_mission() -> None:
    """All but those of single beams come when all is read; the oracle is told all of them."""
    faults = (
        fault(Sensor.GNSS, FaultShape.CONSTANT),
        fault(Sensor.DEPTH, FaultShape.RAMP),
        fault(Sensor.IMU, FaultShape.STUCK),
        fault(Sensor.COMPASS, FaultShape.CONSTANT),
        fault(Sensor.DVL, FaultShape.MOVING_BOTTOM),
        Fault((1,), 110.0, 120.0, 0.4),
    )
    before, run = clean(perfect=False), simulate(config(faults=faults))
    by_hand = with_faults(before.mission, faults[:-1], truth=before.truth_at, seed=4)
    for sensor in (Sensor.GNSS, Sensor.DEPTH, Sensor.COMPASS, Sensor.IMU):
        pairs = zip(
            arrays(log_of(run.mission, sensor)),
            arrays(log_of(by_hand.mission, sensor)),
            strict=True,
        )
        for one, other in pairs:
            np.testing.assert_array_equal(one, other)
    assert run.is_outlier.sum(axis=0).tolist() == [40, 50, 40, 40]
    assert {name: int(bad.sum()) for name, bad in run.is_bad.items()} == {
        "gnss": 40,
        "depth": 80,
        "imu": 4000,
        "heading": 160,
        "dvl": 170,
    }
    told = run.without_outliers()
    assert told.gnss is not None
    assert told.depth is not None
    assert (len(told.gnss.time_s), len(told.depth.time_s)) == (110, 220)
    assert len(told.aids[HeadingLog].time_s) == 440
    assert np.isnan(told.dvl.speed).sum() == 170
    np.testing.assert_array_equal(told.imu.gyro_b, before.mission.imu.gyro_b)
    offset = run.mission.dvl.speed - before.mission.dvl.speed
    np.testing.assert_allclose(run.beam_offset, offset, atol=1e-12)
    again = with_dvl_errors(before, faults=faults)
    np.testing.assert_array_equal(again.mission.dvl.speed, run.mission.dvl.speed)
    np.testing.assert_array_equal(again.mission.imu.gyro_b, run.mission.imu.gyro_b)
    cured = with_dvl_errors(run)
    assert cured.mission.imu is run.intact.imu
    assert list(cured.is_bad) == ["dvl"]


def test_without_a_good_reading_a_sensor_is_gone() -> None:
    """The oracle does without it."""
    always = {"start_s": 0.0, "end_s": math.inf}
    run = simulate(
        config(
            faults=(
                fault(Sensor.GNSS, FaultShape.CONSTANT, **always),
                fault(Sensor.COMPASS, FaultShape.STUCK, **always),
            )
        )
    )
    told = run.without_outliers()
    assert told.gnss is None
    assert told.aids.get(HeadingLog) is None
    assert told.aids.get(UsblLog) is not None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sensor": Sensor.DEPTH, "shape": FaultShape.SLIP}, r"Fault\.sensor: expected with SLIP"),
        ({"sensor": Sensor.GNSS, "size": 3.0}, r"Fault\.size: expected 3 finite numbers with CON"),
        ({"sensor": Sensor.GNSS, "size": (3.0, 0.0, math.nan)}, r"Fault\.size: expected 3 finite"),
        ({"sensor": Sensor.DEPTH, "shape": FaultShape.STUCK, "size": 1.0}, "expected 0 finite num"),
        ({"sensor": Sensor.DEPTH, "size": 1.0, "beams": (1,)}, r"Fault\.beams: expected none with"),
        (
            {"shape": FaultShape.SLIP, "size": (0, 0, 1), "beams": (1,)},
            r"Fault\.beams: expected none with SLIP of",
        ),
        ({"sensor": Sensor.DEPTH, "size": 1.0, "axes": (1,)}, r"Fault\.axes: expected none with"),
        ({"sensor": Sensor.GYROS, "size": 1.0, "axes": (3,)}, r"Fault\.axes: expected different"),
        ({"sensor": Sensor.GYROS, "size": (1.0, 2.0)}, "expected 1 or 3 finite numbers"),
        ({"shape": FaultShape.NOISE, "size": 0.5}, r"Fault\.size: expected more than 1 with NOISE"),
        ({"sensor": Sensor.IMU, "shape": FaultShape.LOW_PASS, "size": 0.0}, "expected more than 0"),
        (
            {"sensor": Sensor.DEPTH, "shape": FaultShape.DRIFT, "size": 1.0},
            "expected a time with D",
        ),
        (
            {"sensor": Sensor.IMU, "shape": FaultShape.CLOCK, "size": 1.0, "end_s": 9.0},
            r"Fault\.end_s: expected none with CLOCK",
        ),
        ({"shape": FaultShape.SPIKES, "size": (2.0, 5.0)}, r"Fault\.share: expected above 0"),
    ],
)
def test_impossible_faults_are_refused(given: dict[str, Any], message: str) -> None:
    """The message says which field, what it may hold, what it held."""
    with pytest.raises(ConfigError, match=message):
        Fault(**given)


def test_a_fault_needs_its_sensor() -> None:
    """A mission without fixes cannot have bad ones, nor an array of four a fifth beam."""
    with pytest.raises(ConfigError, match="expected a sensor of the mission, got GNSS"):
        simulate(config(gnss=None, faults=(fault(Sensor.GNSS, FaultShape.STUCK),)))
    with pytest.raises(ConfigError, match=r"Fault\.beams: expected different beams out of 0\.\.3"):
        with_faults(clean().mission, [Fault((4,), 0.0, 9.0, 1.0)])
