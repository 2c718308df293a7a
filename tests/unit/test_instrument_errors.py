"""Real instruments' errors are as large as they say, and off unless they are asked for."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, t

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.simulation import (
    CALM,
    IMU_NOISE,
    INERTIAL_ERRORS,
    BeamNoise,
    DepthSettings,
    DvlSettings,
    GnssSettings,
    Grade,
    HoverRoute,
    InertialErrors,
    InstrumentErrors,
    SimulatedMission,
    SimulationConfig,
    SlowPart,
    SurveyRoute,
    Trajectory,
    Waves,
    simulate,
)
from ssm_graph.simulation.inertial import ImuErrors, averaged_imu
from ssm_graph.simulation.instruments import SIMPLE, ReadImu, read_imu
from ssm_graph.simulation.randomness import gauss_markov, regular_gauss_markov, spawn_streams

RATE_HZ = 100.0
FIXES = GnssSettings(windows=((0.0, math.inf),))


def read(
    errors: InertialErrors, *, seed: int = 0, true: tuple[Array, Array] | None = None, n: int = 100
) -> ReadImu:
    """Return what an IMU without bias and white noise reads, at rest unless ``true`` is given."""
    rest = (np.zeros((n, 3)), np.zeros((n, 3)))
    omega_b, f_b = rest if true is None else true
    none = ImuErrors(np.zeros_like(f_b), np.zeros_like(f_b))
    return read_imu(
        errors, (omega_b, f_b), (none, none), rate_hz=RATE_HZ, streams=spawn_streams(seed)
    )


def readings(mission: Mission) -> tuple[Array, ...]:
    """Return turn rates, forces, beam speeds, depths and latitudes."""
    assert mission.depth is not None
    assert mission.gnss is not None
    imu = mission.imu
    return imu.gyro_b, imu.accel_b, mission.dvl.speed, mission.depth.depth, mission.gnss.lat


def test_off_means_off() -> None:
    """Sizes of zero, no sizes and the default are one mission; its numbers are those of old."""
    config = SimulationConfig(duration_s=20.0, seed=3, gnss=FIXES)
    run = simulate(config)
    nothing = InstrumentErrors(InertialErrors(), None, SlowPart(0.0, 60.0), SlowPart(0.0, 60.0))
    for other in (SIMPLE, nothing):
        same = simulate(replace(config, instruments=other)).mission
        for one, another in zip(readings(same), readings(run.mission), strict=True):
            np.testing.assert_allclose(one, another, rtol=1e-14, atol=1e-16)
    gyro_b, accel_b, speed, depth, lat = readings(run.mission)
    last = [gyro_b[-1, 1], accel_b[-1, 0], speed[-1, 2], depth[-1], lat[-1]]
    before_there_were_any = [
        -0.02731450261262773,
        -0.4320778422338818,
        -0.673318762126288,
        29.730050629608954,
        0.7976193092573116,
    ]
    np.testing.assert_allclose(last, before_there_were_any, rtol=1e-13)
    assert not np.any(run.imu_calibration)
    perfect = replace(config, perfect_sensors=True)
    with_switch = simulate(replace(perfect, realistic=True)).mission
    np.testing.assert_array_equal(with_switch.imu.accel_b, simulate(perfect).mission.imu.accel_b)


@pytest.mark.parametrize("grade", list(Grade))
def test_one_switch_has_all_of_a_grade(grade: Grade) -> None:
    """Scale factors, beams, depth and fixes; what is stated and what is true stay."""
    config = SimulationConfig(duration_s=20.0, seed=3, gnss=FIXES, grade=grade)
    plain, real = simulate(config), simulate(replace(config, realistic=True))
    assert (plain.mission.imu.noise, plain.mission.dvl.sigma.max()) == (
        real.mission.imu.noise,
        real.mission.dvl.sigma.max(),
    )
    np.testing.assert_array_equal(plain.true_speed, real.true_speed)
    for one, other in zip(readings(plain.mission), readings(real.mission), strict=True):
        assert (one != other).mean() > 0.9
    off = real.mission.imu.gyro_b - plain.mission.imu.gyro_b
    assert np.abs(off).max() < 0.02
    again = simulate(replace(config, realistic=True))
    np.testing.assert_array_equal(again.mission.imu.gyro_b, real.mission.imu.gyro_b)


@pytest.mark.parametrize("grade", list(Grade))
def test_calibrations_have_their_sigmas(grade: Grade) -> None:
    """Nine numbers each for gyros, accelerometers and g-sensitivity, against chi-square bounds."""
    errors = INERTIAL_ERRORS[grade]
    drawn = [read(errors, seed=seed, n=1).calibration for seed in range(60)]
    on, off = np.eye(3, dtype=bool), ~np.eye(3, dtype=bool)
    everywhere = np.ones((3, 3), dtype=bool)
    for name, mask, sigma in (
        ("gyro", on, errors.gyro_scale),
        ("gyro", off, errors.gyro_misalignment),
        ("accel", on, errors.accel_scale),
        ("accel", off, errors.accel_misalignment),
        ("g_sensitivity", everywhere, errors.g_sensitivity),
    ):
        unit = np.array([getattr(calibration, name)[mask] for calibration in drawn]) / sigma
        low, high = chi2.ppf([5e-4, 1.0 - 5e-4], df=unit.size)
        assert low < np.sum(unit**2) < high


def test_readings_are_what_the_calibration_makes_of_the_truth() -> None:
    """``(1 + K) omega + G f`` and ``(1 + A) f``."""
    rng = np.random.default_rng(1)
    omega_b, f_b = rng.standard_normal((2, 50, 3))
    errors = InertialErrors(
        gyro_scale=0.01,
        accel_scale=0.02,
        gyro_misalignment=0.003,
        accel_misalignment=0.004,
        g_sensitivity=0.005,
    )
    done = read(errors, true=(omega_b, f_b))
    K, A, G = done.calibration
    for k in range(50):
        np.testing.assert_allclose(done.gyro_b[k], omega_b[k] + K @ omega_b[k] + G @ f_b[k])
        np.testing.assert_allclose(done.accel_b[k], f_b[k] + A @ f_b[k])


def allan_deviation(rate: Array, step_s: float, tau_s: float) -> float:
    """Return the overlapping Allan deviation of rates (N,) at ``tau_s``."""
    m = round(tau_s / step_s)
    angle = np.concatenate([[0.0], np.cumsum(rate) * step_s])
    second = angle[2 * m :] - 2.0 * angle[m:-m] + angle[: -2 * m]
    return math.sqrt(float(np.mean(second**2)) / (2.0 * tau_s**2))


@pytest.mark.slow
def test_bias_instability_is_the_floor_of_the_allan_deviation() -> None:
    """Flat at the number of the data sheet over two decades, for gyros and accelerometers."""
    errors = InertialErrors(gyro_instability=1e-6, accel_instability=1e-4)
    runs = [read(errors, seed=seed, n=400_000) for seed in range(3)]
    for floor, name in ((1e-6, "gyro"), (1e-4, "accel")):
        for tau_s in (3.0, 10.0, 30.0, 100.0):
            every = [
                allan_deviation(axis, 1.0 / RATE_HZ, tau_s)
                for run in runs
                for axis in getattr(run, f"{name}_bias").T
            ]
            mean = math.sqrt(np.mean(np.square(every)))
            assert mean == pytest.approx(floor, rel=0.15)
    np.testing.assert_array_equal(runs[0].gyro_b, runs[0].gyro_bias)


def test_fast_and_slow_recursions_agree() -> None:
    """The filter at regular times is the process at any times."""
    unit: Array = np.random.default_rng(0).standard_normal((500, 2))
    fast = regular_gauss_markov(unit, 0.01, 0.3)
    slow = gauss_markov(unit, np.linspace(0.0, 4.99, 500), 0.3)
    np.testing.assert_allclose(fast, slow, atol=1e-12)


def peak_hz(reading: Array) -> float:
    """Return the frequency of the strongest line."""
    power = np.abs(np.fft.rfft(reading * np.hanning(len(reading)))) ** 2
    return float(np.fft.rfftfreq(len(reading), 1.0 / RATE_HZ)[np.argmax(power)])


@pytest.mark.parametrize(("frequency_hz", "seen_hz"), [(37.0, 37.0), (143.0, 43.0)])
@pytest.mark.parametrize("is_averaging", [True, False])
def test_vibration_is_averaged_and_aliased(
    frequency_hz: float, seen_hz: float, is_averaging: bool
) -> None:
    """By ``sinc(f dt)``, or not at all; what is above half the rate comes folded."""
    errors = InertialErrors(
        gyro_vibration=1e-3,
        accel_vibration=0.1,
        vibration_hz=(frequency_hz,),
        is_averaging=is_averaging,
    )
    done = read(errors, n=20_000)
    left = abs(np.sinc(frequency_hz / RATE_HZ)) if is_averaging else 1.0
    for reading, size in ((done.gyro_b, 1e-3), (done.accel_b, 0.1)):
        rms = np.sqrt(np.mean(reading**2, axis=0))
        np.testing.assert_allclose(rms, size * left, rtol=0.05)
        assert peak_hz(reading[:, 0]) == pytest.approx(seen_hz, abs=0.05 * frequency_hz)


def test_steps_and_ends_of_the_range() -> None:
    """Pulses carry their rest on, so that the angle stays; converters round and lose it."""
    rng = np.random.default_rng(2)
    true = (rng.normal(3e-5, 2e-5, (2000, 3)), np.full((2000, 3), 50.0))
    sizes: dict[str, Any] = {
        "gyro_quantum": 1e-4,
        "accel_quantum": 1e-3,
        "gyro_range": 1e-4,
        "accel_range": 39.2,
    }
    counted = read(InertialErrors(**sizes), true=true)
    rounded = read(InertialErrors(**sizes, carries_rest=False), true=true)
    for done in (counted, rounded):
        steps = done.gyro_b / 1e-4
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
        np.testing.assert_allclose(done.accel_b, 39.2, atol=1e-9)
    clipped = np.minimum(true[0], 1e-4)
    lost = np.abs(np.cumsum(counted.gyro_b - clipped, axis=0)).max()
    assert lost <= 0.5e-4 + 1e-12
    assert np.abs(np.sum(rounded.gyro_b - clipped, axis=0)).min() > 20.0 * lost
    np.testing.assert_allclose(rounded.gyro_b, 1e-4 * np.round(clipped / 1e-4), atol=1e-15)


def test_filter_and_clock_make_an_imu_late() -> None:
    """The filter by 0.225 over its end, the clock by what is said; the truth is not."""
    trajectory = Trajectory(SurveyRoute(), Waves(), 0.8, 2.0)
    late = averaged_imu(trajectory, rate_hz=RATE_HZ, n_samples=500, late_s=0.02)
    now = averaged_imu(trajectory, rate_hz=RATE_HZ, n_samples=500)
    for one, other in zip(late, now, strict=True):
        np.testing.assert_allclose(one[2:], other[:-2], atol=1e-12)
    time_s = np.arange(4000) / RATE_HZ
    wave = np.tile(np.sin(2.0 * math.pi * 0.5 * time_s)[:, None], (1, 3))
    filtered = read(InertialErrors(low_pass_hz=10.0), true=(wave, wave)).gyro_b
    delayed = np.sin(2.0 * math.pi * 0.5 * (time_s - 0.225 / 10.0))
    np.testing.assert_allclose(filtered[400:, 0], delayed[400:], atol=0.005)
    plain = SimulationConfig(duration_s=5.0, seed=1)
    slow = replace(plain, instruments=InstrumentErrors(InertialErrors(late_s=0.02)))
    for name, one, other in zip(
        ("gyro_b", "accel_b"),
        averaged_imu(plain.trajectory, rate_hz=RATE_HZ, n_samples=500, late_s=0.02),
        averaged_imu(plain.trajectory, rate_hz=RATE_HZ, n_samples=500),
        strict=True,
    ):
        off = getattr(simulate(slow).mission.imu, name) - getattr(simulate(plain).mission.imu, name)
        np.testing.assert_allclose(off, one - other, atol=1e-12)


@cache
def hovering(beams: BeamNoise | None = None) -> SimulatedMission:
    """Return 20,000 pings and depths of a vehicle that hovers, with all the slow noises."""
    return simulate(
        SimulationConfig(
            route=HoverRoute(sway_m=0.0, yaw=0.0),
            waves=CALM,
            seed=5,
            duration_s=4000.0,
            imu_rate_hz=10.0,
            dvl=DvlSettings(rate_hz=5.0),
            depth=DepthSettings(rate_hz=5.0),
            gnss=replace(FIXES, rate_hz=5.0),
            instruments=InstrumentErrors(
                None, beams or BeamNoise(of_speed=0.0), SlowPart(0.25, 6.0), SlowPart(0.4, 10.0)
            ),
        )
    )


def correlation(noise: Array, lag: int) -> float:
    """Return the mean correlation of columns (N, d) with themselves ``lag`` rows later."""
    return float(np.mean(noise[lag:] * noise[:-lag]) / np.mean(noise**2))


def test_beam_noise_has_tails_memory_and_company() -> None:
    """Its variance is that stated; an eighth of it lasts; a tenth of the rest is in common."""
    run = hovering()
    noise = (run.mission.dvl.speed - run.true_speed) / run.mission.dvl.sigma
    assert np.var(noise) == pytest.approx(1.0, rel=0.05)
    slow = [correlation(noise, lag) for lag in (5, 50, 100)]
    np.testing.assert_allclose(slow, 0.125 * np.exp(-np.array([1.0, 10.0, 20.0]) / 20.0), atol=0.03)
    together = np.asarray(np.corrcoef(noise.T))[np.triu_indices(4, 1)]
    np.testing.assert_allclose(together, 0.875 * 0.1, atol=0.04)
    alone = BeamNoise(slow=None, correlation=0.0, of_speed=0.0)
    noise = (hovering(alone).mission.dvl.speed - hovering(alone).true_speed) / 0.005
    for level in (0.9, 0.99, 0.999):
        expected = t.ppf(level, 4.3) * math.sqrt(2.3 / 4.3)
        n_beyond = np.sum(np.abs(noise) > expected)
        n_expected = 2.0 * (1.0 - level) * noise.size
        assert abs(n_beyond - n_expected) < 4.0 * math.sqrt(n_expected)


def test_beam_noise_grows_with_speed_and_range() -> None:
    """Both parts add to the stated variance."""
    time_s, sigma = np.arange(40_000.0), np.full((40_000, 1), 0.005)
    noise = BeamNoise(dof=None, slow=None, correlation=0.0, of_speed=0.004, of_range=1e-4)
    speed = np.broadcast_to([0.0, 1.0, 0.0, 2.0], (40_000, 4))
    range_m = np.broadcast_to([0.0, 0.0, 50.0, np.nan], (40_000, 4))
    drawn = noise.draw(sigma, speed, range_m, time_s, spawn_streams(0))
    expected = np.sqrt(0.005**2 + np.array([0.0, 0.004, 0.005, 0.008]) ** 2)
    np.testing.assert_allclose(np.std(drawn, axis=0), expected, rtol=4.0 / math.sqrt(80_000))
    without = noise.draw(sigma, speed, None, time_s, spawn_streams(0))
    assert np.std(without[:, 2]) == pytest.approx(0.005, rel=4.0 / math.sqrt(80_000))


def test_depth_and_fixes_have_slow_noise() -> None:
    """A share of the stated variance, which stays."""
    run = hovering()
    depth, gnss = run.mission.depth, run.mission.gnss
    assert depth is not None
    assert gnss is not None
    noise = ((depth.depth - np.mean(depth.depth)) / depth.sigma)[:, None]
    assert np.var(noise) == pytest.approx(1.0, rel=0.06)
    assert correlation(noise, 30) == pytest.approx(0.25 / math.e, abs=0.03)
    p_n = run.mission.frame.p_n_from_geodetic(gnss.lat, gnss.lon, gnss.height)
    fixes = (p_n - p_n.mean(axis=0)) / gnss.sigma_enu
    assert np.var(fixes) == pytest.approx(1.0, rel=0.1)
    assert correlation(fixes, 50) == pytest.approx(0.4 / math.e, abs=0.05)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: InertialErrors(gyro_scale=-1e-4),
            r"InertialErrors\.gyro_scale: .*100 ppm as 1e-4",
        ),
        (lambda: InertialErrors(low_pass_hz=0.0), r"InertialErrors\.low_pass_hz: .*above 0"),
        (lambda: InertialErrors(vibration_hz=(37.0, 0.0)), "vibration_hz: expected frequencies"),
        (lambda: BeamNoise(dof=2.0), r"BeamNoise\.dof: expected degrees of freedom above 2, got 2"),
        (lambda: BeamNoise(correlation=1.5), r"BeamNoise\.correlation: expected a fraction"),
        (lambda: SlowPart(12.5, 20.0), r"SlowPart\.share: .*an eighth as 0\.125"),
        (lambda: SlowPart(0.1, 0.0), r"SlowPart\.correlation_s: expected a finite number above 0"),
    ],
)
def test_impossible_sizes_are_refused(make: Any, message: str) -> None:
    """The message says which field, what it may hold, what it held."""
    with pytest.raises(ConfigError, match=message):
        make()


def test_sizes_grow_from_grade_to_grade() -> None:
    """A better grade is better in every size that is drawn."""
    sizes = ("scale", "misalignment", "instability")
    for name in ("g_sensitivity", *(f"{s}_{size}" for s in ("gyro", "accel") for size in sizes)):
        values = [getattr(INERTIAL_ERRORS[grade], name) for grade in Grade]
        assert values == sorted(values)
        assert len(set(values)) == 4
    for grade in Grade:
        assert INERTIAL_ERRORS[grade].gyro_instability <= IMU_NOISE[grade].gyro_bias_sigma


@pytest.mark.parametrize("grade", list(Grade))
def test_a_preset_states_the_delay_of_its_data_sheet(grade: Grade) -> None:
    """Latency and filter, which the very unit keeps to a few per cent."""
    errors = INERTIAL_ERRORS[grade]
    filtered_s = {Grade.MEMS: 0.225 / 40.0}.get(grade, 0.0)
    assert errors.asked.time_offset_s == pytest.approx(errors.late_s + filtered_s, rel=1e-3)
    late_s = np.array([errors.drawn_late_s(spawn_streams(seed)) for seed in range(60)])
    unit = (late_s / errors.late_s - 1.0) / errors.late_tolerance
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], df=len(unit))
    assert low < np.sum(unit**2) < high


def test_slow_errors_of_fixes_are_stated_along_each_axis() -> None:
    """As they are drawn: half of each sigma, in height as of height."""
    config = SimulationConfig(duration_s=5.0, gnss=FIXES, realistic=True, calibrates=True)
    gnss = simulate(config).mission.gnss
    assert gnss is not None
    known = gnss.calibration
    stated = known.drift.sigma * np.array([1.0, 1.0, known.drift_up_share])
    np.testing.assert_allclose(stated, 0.5 * gnss.sigma_enu[0])
