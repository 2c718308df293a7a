"""The simulated current and the pings off the water: true, of the stated size, off by default."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.simulation import (
    CALM,
    Current,
    CurrentSettings,
    DvlSettings,
    Loss,
    SurveyRoute,
    WaterTrack,
    simulate,
    with_dvl_errors,
)
from ssm_graph.simulation.config import SimulationConfig
from tests.helpers import simulated
from tests.water_fixture import in_current

LOSS = Loss(10.0, 20.0)


def drawn(seed: int = 0, *, end_s: float = 200_000.0, **settings: Any) -> Current:
    """Return a current of two days."""
    return Current(CurrentSettings(**settings), end_s=end_s, rng=np.random.default_rng(seed))


def test_water_speeds_are_those_of_the_motion_through_the_water() -> None:
    """The difference to the ground is the current, turned into the beams by the true attitude."""
    sim = in_current(duration_s=40.0, current=CurrentSettings(steady_enu=(0.4, -0.3, 0.1)))
    time_s = sim.ping_time_s
    R_eb = sim.trajectory.R_eb(time_s).as_matrix()
    truth = sim.truth_at(time_s)
    sin, cos = np.sin, np.cos
    up = np.column_stack(
        [cos(truth.lat) * cos(truth.lon), cos(truth.lat) * sin(truth.lon), sin(truth.lat)]
    )
    east = np.column_stack([-sin(truth.lon), cos(truth.lon), np.zeros(len(time_s))])
    current_e = 0.4 * east - 0.3 * np.cross(up, east) + 0.1 * up
    current_b = np.einsum("nij,ni->nj", R_eb, current_e)
    expected = current_b @ sim.mission.dvl.mount.beams_b.T
    np.testing.assert_allclose(sim.true_speed - sim.water_speed, expected, atol=1e-12)


def test_random_part_has_its_sigma_and_correlation() -> None:
    """Over many seeds, at the begin and 600 s later."""
    pairs = np.array(
        [
            drawn(seed, sigma=0.4, vertical_sigma=0.02, correlation_s=600.0, end_s=700.0).at(
                np.array([0.0, 600.0])
            )
            for seed in range(400)
        ]
    )
    sigma = np.array([0.4, 0.4, 0.02])
    np.testing.assert_allclose(pairs.std(axis=0), np.tile(sigma, (2, 1)), rtol=0.1)
    correlation = np.mean(pairs[:, 0] * pairs[:, 1], axis=0) / sigma**2
    np.testing.assert_allclose(correlation, np.exp(-1.0), atol=0.15)


def test_tide_turns_clockwise_at_its_speed() -> None:
    """Half a period later it runs the other way."""
    current = drawn(tide=0.5, tide_period_s=40_000.0)
    now, quarter, half = current.at(np.array([0.0, 10_000.0, 20_000.0]))
    assert np.linalg.norm(now) == pytest.approx(0.5)
    np.testing.assert_allclose(half, -now, atol=1e-12)
    assert np.cross(now, quarter)[2] == pytest.approx(-0.25)


def test_off_by_default_and_the_same_seeds_as_ever() -> None:
    """A current without water track, or water track without a loss, changes no digit."""
    plain = simulated(losses=(Loss(10.0, 20.0, (0, 1)),), dropout_rate=0.1)
    for changes in ({"current": CurrentSettings(sigma=0.5)}, {"water_track": WaterTrack()}):
        other = simulate(replace(plain.config, **changes)).mission
        assert other.dvl.water_track is None
        np.testing.assert_array_equal(other.dvl.speed, plain.mission.dvl.speed)
        np.testing.assert_array_equal(other.dvl.sigma, plain.mission.dvl.sigma)
        np.testing.assert_array_equal(other.imu.gyro_b, plain.mission.imu.gyro_b)
    assert plain.mission.current is None


def test_water_is_tracked_where_the_ground_is_lost() -> None:
    """All beams lost, or every so many pings; with its own noise, beams and no ranges."""
    sim = in_current(
        duration_s=30.0,
        losses=(LOSS, Loss(25.0, 28.0, (0,))),
        water_track=WaterTrack(noise=0.02, beams=(1, 2), every=4),
        dvl=DvlSettings(seabed_depth_m=60.0),
    )
    dvl = sim.mission.dvl
    expected = (dvl.time_s >= 10.0) & (dvl.time_s < 20.0) | (np.arange(1, 31) % 4 == 0)
    np.testing.assert_array_equal(dvl.is_water, expected)
    np.testing.assert_array_equal(np.unique(dvl.sigma[expected]), [0.02])
    np.testing.assert_array_equal(np.unique(dvl.sigma[~expected]), [0.005])
    has_speed = np.isfinite(dvl.speed)
    np.testing.assert_array_equal(has_speed[expected], np.tile([False, True, True, False], (15, 1)))
    assert dvl.range_m is not None
    assert np.isnan(dvl.range_m[expected]).all()
    np.testing.assert_array_equal(has_speed[26], [False, True, True, True])
    error = np.where(dvl.is_water[:, None], sim.water_speed, sim.true_speed) - dvl.speed
    assert np.nanmax(np.abs(error[expected])) < 0.08
    assert np.nanmax(np.abs(error[~expected])) < 0.02


def test_who_is_told_the_current_has_the_ground() -> None:
    """The oracle's pings are off the ground, with the noise that they had."""
    sim = in_current(duration_s=30.0, losses=(LOSS,))
    known = sim.with_known_current().dvl
    assert known.water_track is None
    read = np.where(sim.mission.dvl.is_water[:, None], sim.water_speed, sim.true_speed)
    np.testing.assert_allclose(
        known.speed - sim.true_speed, sim.mission.dvl.speed - read, rtol=0.0, atol=1e-14
    )


def test_other_dvl_errors_on_the_same_run() -> None:
    """Bit by bit what a simulation with these losses makes."""
    clean = in_current(duration_s=30.0, losses=())
    expected = in_current(duration_s=30.0, losses=(LOSS,), dropout_rate=0.1)
    found = with_dvl_errors(clean, losses=(LOSS,), dropout_rate=0.1)
    np.testing.assert_array_equal(found.mission.dvl.speed, expected.mission.dvl.speed)
    np.testing.assert_array_equal(found.mission.dvl.is_water, expected.mission.dvl.is_water)


def test_what_is_stated_of_the_current() -> None:
    """The variance of all parts, east and north alike."""
    settings = CurrentSettings(steady_enu=(0.3, 0.4, 0.0), sigma=0.2, vertical_sigma=0.01)
    assert settings.model.sigma == pytest.approx(np.hypot(0.2, 0.5 / np.sqrt(2.0)))
    assert settings.model.vertical_sigma == 0.01
    assert CurrentSettings().model.sigma == 0.5
    config = SimulationConfig(route=SurveyRoute(), waves=CALM, duration_s=10.0, current=settings)
    assert simulate(config).mission.current == settings.model


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: CurrentSettings(tide=-1.0), "CurrentSettings.tide"),
        (lambda: CurrentSettings(correlation_s=0.0), "CurrentSettings.correlation_s"),
        (lambda: CurrentSettings(steady_enu=(0.0, np.nan, 0.0)), "three finite numbers"),
        (lambda: WaterTrack(noise=0.0), "WaterTrack.noise"),
        (lambda: WaterTrack(every=1), "WaterTrack.every"),
        (lambda: SimulationConfig(water_track=WaterTrack(beams=(4,))), "WaterTrack.beams"),
        (lambda: WaterTrack(beams=(1, 1)), "WaterTrack.beams"),
    ],
)
def test_settings_that_make_no_sense_are_refused(make: Any, words: str) -> None:
    """With the name of the setting."""
    with pytest.raises(ConfigError, match=words):
        make()
