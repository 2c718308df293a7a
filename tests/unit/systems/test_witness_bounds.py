"""The inequalities of one vehicle's set, each where it is tightest, and all of them together."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.simulation import SimulatedMission
from ssm_graph.systems.sensor_network.block import Block
from ssm_graph.systems.sensor_network.integrity import holds_truth
from ssm_graph.systems.sensor_network.witness import WitnessBounds, witness
from tests.witness_fixture import a_survey

END_S = 80.0
EARTH_M = 6.37e6


@pytest.fixture(scope="module")
def simulated() -> SimulatedMission:
    """Return a survey with depth and, for its second half, fixes."""
    return a_survey(seed=41, end_s=END_S, imu_rate_hz=50.0, line_m=30.0, fixes_from_s=40.0)


def led(gains: Array, dt: float) -> Block:
    """Return a block that was led on from rest by gains (K,) of velocity to the east."""
    block = Block(np.zeros(3))
    for gain in gains:
        block.step(np.array([gain, 0.0, 0.0]), dt)
    return block


def test_a_way_between_two_known_velocities_is_off_by_force_t_squared_over_four() -> None:
    """An acceleration that is off by so much, first to one side, then to the other, reaches it."""
    rng, n, dt, force = np.random.default_rng(1), 40, 0.05, 0.02
    worst = np.sign(np.arange(n) - 0.5 * (n - 1))
    T, shares = n * dt, []
    for error in (worst, *np.sign(rng.standard_normal((200, n)))):
        block = led(force * dt * error, dt)
        block.close(np.zeros(3), np.zeros((3, 3)), force)
        assert block.bent == pytest.approx(0.25 * force * T**2)
        shares.append(np.linalg.norm(block.way) / block.bent)
    assert shares[0] == pytest.approx(1.0, abs=1e-9)
    assert max(shares) <= 1.0 + 1e-9


def test_a_change_of_the_acceleration_bends_the_way_within_its_bound() -> None:
    """Wherever within a step it begins, at the middle the bound is reached; and for ramps."""
    dt, fine, shares = 0.5, 400, []
    at = (np.arange(3 * fine) + 0.5) * dt / fine
    jumps = [np.where(at > tau, 0.15, 0.0) for tau in np.linspace(0.5, 1.0, 11)]
    for accel in (*jumps, 0.1 * at, np.clip(at - 0.6, 0.0, 0.5) ** 2):
        velocity = np.cumsum(accel) * dt / fine
        way = float(np.sum(velocity - 0.5 * accel * dt / fine) * dt / fine)
        block = led(np.diff(np.append(0.0, velocity[fine - 1 :: fine])), dt)
        shares.append(abs(block.way[0] - way) / (block.curved + 1e-12))
    assert max(shares) <= 1.0 + 1e-6
    assert shares[5] > 0.99


def corner(sim: SimulatedMission, signs: tuple[float, ...], share: float) -> Mission:
    """Return the mission with all that lasts at a corner of its bounds, 5 sigma times a share.

    Start and heading, and biases beside the two sigma that are left to what the simulator drew.
    """
    mission, noise = sim.mission, sim.mission.imu.noise
    east, head, gyro, accel = signs
    assert mission.initial is not None
    now = sim.truth_at(np.array([mission.initial.time_s]))
    k = 5.0 * share
    sigma = mission.initial.position_sigma_enu
    start = replace(
        mission.initial,
        lat=float(now.lat[0]) + east * k * sigma[1] / EARTH_M,
        lon=float(now.lon[0]) + east * k * sigma[0] / (EARTH_M * np.cos(float(now.lat[0]))),
        heading=float(now.roll_pitch_heading[0, 2]) + head * k * mission.initial.attitude_sigma[2],
    )
    axis = np.array([1.0, -1.0, 1.0]) / np.sqrt(3.0)
    imu = mission.imu
    return replace(
        mission,
        initial=start,
        imu=replace(
            imu,
            gyro_b=imu.gyro_b + gyro * (k - 2.0) * noise.gyro_bias_sigma * axis,
            accel_b=imu.accel_b + accel * (k - 2.0) * noise.accel_bias_sigma * axis[::-1],
        ),
    )


@pytest.mark.parametrize("signs", list(itertools.product((-1.0, 1.0), repeat=4))[::3])
def test_the_truth_is_inside_where_all_that_lasts_is_at_its_bound(
    simulated: SimulatedMission, signs: tuple[float, ...]
) -> None:
    """Start, heading, gyros and accelerometers at a corner; no alarm comes of it."""
    mission = corner(simulated, signs, 0.99)
    assert mission.initial is not None
    w = witness(mission, mission.initial)
    assert holds_truth(mission, w, simulated.truth_at(w.time_s)).all()
    assert not w.alarms


def test_beyond_the_corner_the_set_loses_it(simulated: SimulatedMission) -> None:
    """Three times as far: outside, or an alarm."""
    mission = corner(simulated, (1.0, 1.0, 1.0, 1.0), 3.0)
    assert mission.initial is not None
    w = witness(mission, mission.initial)
    assert w.alarms or not holds_truth(mission, w, simulated.truth_at(w.time_s)).all()


def test_wider_bounds_of_one_sensor_hold_its_lie(simulated: SimulatedMission) -> None:
    """Fixes 8 m off are an alarm at five sigma; stated as wide as they err, the truth is inside."""
    mission = simulated.mission
    gnss = mission.gnss
    assert gnss is not None
    assert mission.initial is not None
    aside = replace(mission, gnss=replace(gnss, lat=gnss.lat + 8.0 / EARTH_M))
    assert {alarm.sensor for alarm in witness(aside, mission.initial).alarms} == {"GNSS"}
    wide = witness(aside, mission.initial, WitnessBounds(times={"GNSS": 16.0}))
    assert not wide.alarms
    assert holds_truth(aside, wide, simulated.truth_at(wide.time_s)).all()
    with pytest.raises(ConfigError, match="times: expected one of DVL, GNSS"):
        WitnessBounds(times={"sonar": 2.0})
    with pytest.raises(ConfigError, match="times of DVL: expected above 0"):
        WitnessBounds(times={"DVL": 0.0})


def test_the_mean_of_a_block_cuts_more_than_its_last_fix(simulated: SimulatedMission) -> None:
    """Fixes of one a second: more narrowly than one that stands alone in its block."""
    mission = simulated.mission
    gnss = mission.gnss
    assert gnss is not None
    assert mission.initial is not None
    whole = witness(mission, mission.initial)
    last = np.array([np.flatnonzero(gnss.valid_s <= t)[-1] for t in whole.time_s if t > 40.5])
    few = replace(
        gnss,
        **{
            name: getattr(gnss, name)[np.unique(last)]
            for name in ("time_s", "lat", "lon", "height", "sigma_enu")
        },
    )
    single = witness(replace(mission, gnss=few), mission.initial)
    assert np.all(whole.half_widths[-1, :2] < 0.75 * single.half_widths[-1, :2])
