"""Whole simulated missions: repeatable, paired, complete; and made without the estimators."""

from __future__ import annotations

import ast
import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

import ssm_graph.simulation
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.simulation import (
    SCENARIOS,
    DvlSettings,
    Fault,
    GnssSettings,
    Grade,
    Loss,
    OutlierKind,
    Outliers,
    SimulationConfig,
    scenario_config,
    simulate,
)

SHORT = SimulationConfig(duration_s=30.0, seed=5, gnss=GnssSettings(windows=((0.0, 10.0),)))
ALLOWED = {"base", "sensors", "simulation"}


def arrays(value: Any, prefix: str = "") -> dict[str, Array]:
    """Return all arrays inside nested dataclasses by their path."""
    if isinstance(value, np.ndarray):
        return {prefix: value}
    if not dataclasses.is_dataclass(value):
        return {}
    found: dict[str, Array] = {}
    for spec in dataclasses.fields(value):
        found |= arrays(getattr(value, spec.name), f"{prefix}.{spec.name}")
    return found


def test_simulator_shares_nothing_with_the_estimators() -> None:
    """Only the foundation, NumPy, SciPy and the standard library are imported."""
    folder = Path(ssm_graph.simulation.__file__).parent
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, path
                names = [node.module or ""]
            for name in names:
                parts = name.split(".")
                assert parts[0] not in {"factors", "gtsam"}, path
                is_value = name == "ssm_graph.mission.mission"
                assert parts[0] != "ssm_graph" or parts[1] in ALLOWED or is_value, path


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_runs(name: str) -> None:
    """A minute of each, complete and finite."""
    simulated = simulate(scenario_config(name, duration_s=60.0))
    mission = simulated.mission
    assert mission.name == name
    assert mission.imu.time_s[-1] == 60.0
    assert mission.dvl.speed.shape == simulated.is_outlier.shape
    assert mission.depth is not None
    assert mission.reference is not None
    assert mission.initial is not None
    for path, array in arrays(mission).items():
        assert np.isfinite(array).all() or path == ".dvl.speed" or path == ".dvl.range_m", path
    assert (mission.gnss is not None) == (name in {"dive", "demo"})
    assert SCENARIOS[name].description


def test_the_demo_holds_what_it_promises() -> None:
    """GNSS only at the start, outliers, one burst, dropouts, one bottom loss."""
    config = dataclasses.replace(SCENARIOS["demo"].config, imu_rate_hz=10.0)
    simulated = simulate(config)
    mission = simulated.mission
    assert mission.gnss is not None
    assert 30 <= len(mission.gnss.time_s) <= 70
    assert mission.gnss.time_s[-1] < 70.0
    assert simulated.is_outlier.any(axis=1).mean() == pytest.approx(0.1, abs=0.02)
    lost = np.isnan(mission.dvl.speed)
    inside = (simulated.ping_time_s >= 800.0) & (simulated.ping_time_s < 840.0)
    assert lost[inside].all()
    assert lost[~inside].mean() == pytest.approx(0.03, abs=0.01)
    burst = (simulated.ping_time_s >= 600.0) & (simulated.ping_time_s < 615.0)
    assert simulated.is_outlier[burst, 1].mean() > 0.8


def test_same_seed_same_mission() -> None:
    """Bit by bit; another seed changes every sensor."""
    first, again, other = (
        arrays(simulate(dataclasses.replace(SHORT, seed=seed))) for seed in (5, 5, 6)
    )
    for path, array in first.items():
        np.testing.assert_array_equal(array, again[path], err_msg=path)
    for path in (
        ".mission.imu.gyro_b",
        ".mission.imu.accel_b",
        ".mission.dvl.speed",
        ".mission.depth.depth",
        ".mission.gnss.lat",
        ".mission.initial.velocity_enu",
        ".gyro_bias",
        ".accel_bias",
    ):
        assert (first[path] != other[path]).all(), path


@pytest.mark.parametrize(
    "change",
    [
        {"outliers": Outliers(OutlierKind.TWO_BEAMS, rate=0.5)},
        {"dropout_rate": 0.5},
        {"losses": (Loss(5.0, 9.0),)},
        {"faults": (Fault((0,), 3.0, 9.0, 1.0),)},
    ],
)
def test_missions_are_paired(change: dict[str, Any]) -> None:
    """Changing what happens to the beams leaves all noise as it was, that of good beams too."""
    base, changed = simulate(SHORT), simulate(dataclasses.replace(SHORT, **change))
    before, after = arrays(base.mission), arrays(changed.mission)
    for path in before:
        if path != ".dvl.speed":
            np.testing.assert_array_equal(before[path], after[path], err_msg=path)
    speed = changed.mission.dvl.speed
    kept = np.isfinite(speed)
    np.testing.assert_allclose(
        (speed - changed.beam_offset)[kept], base.mission.dvl.speed[kept], atol=1e-14
    )
    assert (speed[kept] != base.mission.dvl.speed[kept]).any() or not kept.all()


def test_perfect_sensors_read_the_truth() -> None:
    """No error anywhere, but noise is stated and asked-for faults stay."""
    config = dataclasses.replace(
        SHORT, perfect_sensors=True, faults=(Fault((2,), 10.0, 20.0, 0.25),)
    )
    simulated = simulate(config)
    mission = simulated.mission
    assert not simulated.gyro_bias.any()
    assert mission.imu.noise.gyro_density > 0.0
    error = mission.dvl.speed - simulated.true_speed
    np.testing.assert_allclose(error[simulated.is_outlier], 0.25, atol=1e-12)
    np.testing.assert_array_equal(error[~simulated.is_outlier], 0.0)


def test_imu_readings_are_truth_and_bias_and_noise() -> None:
    """What is left after truth and bias is white and as large as stated."""
    simulated = simulate(dataclasses.replace(SHORT, grade=Grade.MEMS))
    perfect = simulate(dataclasses.replace(SHORT, perfect_sensors=True)).mission.imu
    imu = simulated.mission.imu
    noise = imu.gyro_b - simulated.gyro_bias - perfect.gyro_b
    sigma = imu.noise.gyro_density * math.sqrt(100.0)
    assert noise.std() == pytest.approx(sigma, rel=0.03)
    noise = imu.accel_b - simulated.accel_bias - perfect.accel_b
    assert noise.std() == pytest.approx(imu.noise.accel_density * math.sqrt(100.0), rel=0.03)


def test_beam_noise_is_white_and_as_stated() -> None:
    """Over 500 s of pings at 8 Hz."""
    config = dataclasses.replace(
        SHORT, duration_s=500.0, imu_rate_hz=10.0, dvl=DvlSettings(rate_hz=8.0, noise=0.01)
    )
    simulated = simulate(config)
    error = simulated.mission.dvl.speed - simulated.true_speed
    assert error.std() == pytest.approx(0.01, rel=0.03)
    np.testing.assert_allclose(np.corrcoef(error.T), np.eye(4), atol=0.06)


def test_the_oracle_does_not_see_bad_beams() -> None:
    """Bad beams are missing, good ones untouched; missing beams are never called bad."""
    config = dataclasses.replace(
        SHORT, outliers=Outliers(OutlierKind.SPARSE, rate=0.5), dropout_rate=0.3
    )
    simulated = simulate(config)
    speed, oracle = simulated.mission.dvl.speed, simulated.without_outliers().dvl.speed
    assert not (simulated.is_outlier & np.isnan(speed)).any()
    assert np.isnan(oracle[simulated.is_outlier]).all()
    np.testing.assert_array_equal(oracle[~simulated.is_outlier], speed[~simulated.is_outlier])


def test_late_stamps_are_late() -> None:
    """The ping happens at its true time and is stamped later."""
    late = simulate(dataclasses.replace(SHORT, dvl=DvlSettings(late_s=0.12)))
    base = simulate(SHORT)
    np.testing.assert_array_equal(late.mission.dvl.speed, base.mission.dvl.speed)
    np.testing.assert_allclose(late.mission.dvl.time_s - late.ping_time_s, 0.12)


def test_reference_interpolates_to_well_below_a_millimetre() -> None:
    """The default rate of 10 Hz serves the evaluation; the end is always included."""
    simulated = simulate(dataclasses.replace(SHORT, duration_s=30.05))
    reference = simulated.mission.reference
    assert reference is not None
    assert reference.time_s[-1] == pytest.approx(30.05)
    frame: LocalFrame = simulated.mission.frame
    times = np.linspace(1.0, 30.0, 777)
    p_n = frame.p_n_from_geodetic(reference.lat, reference.lon, reference.height)
    spline = CubicHermiteSpline(reference.time_s, p_n, reference.velocity_enu)
    truth = simulated.truth_at(times)
    exact = frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
    np.testing.assert_allclose(spline(times), exact, atol=1e-4)


def test_high_imu_rates_and_odd_durations() -> None:
    """The last sample ends within the duration."""
    imu = simulate(scenario_config("hover", duration_s=1.003, imu_rate_hz=200.0)).mission.imu
    assert len(imu.time_s) == 200
    assert imu.time_s[-1] == 1.0
    assert imu.start_s == 0.0


@pytest.mark.parametrize(
    ("setting", "value", "match"),
    [
        ("duration_s", 0.0, "duration_s: expected a finite number above 0"),
        ("duration_s", 0.001, "duration_s: expected at least one IMU sample"),
        ("imu_rate_hz", 1.0, "imu_rate_hz: expected 10 to 10000 Hz"),
        ("dropout_rate", 3.0, "dropout_rate: expected a fraction"),
        ("seed", -1, "seed: expected a whole number"),
        ("lat", 45.7, "lat: expected .* convert degrees"),
        ("reference_rate_hz", math.inf, "reference_rate_hz"),
    ],
)
def test_impossible_settings_are_refused(setting: str, value: Any, match: str) -> None:
    """Where, what was expected, what came, what to try."""
    with pytest.raises(ConfigError, match=match):
        dataclasses.replace(SHORT, **{setting: value})


def test_unknown_names_are_refused_with_the_nearest() -> None:
    """Scenarios and settings."""
    with pytest.raises(ConfigError, match="did you mean 'survey'"):
        scenario_config("suvrey")
    with pytest.raises(ConfigError, match="did you mean 'duration_s'"):
        scenario_config("survey", duration=3.0)
