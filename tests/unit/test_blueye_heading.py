"""The heading of a Blueye's DVL as a directional gyro: clock, scale, jumps, and when it is none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.base.frozen import Array
from ssm_graph.io.blueye.convert import dvl_heading
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.imu import ImuLog, ImuNoise

SCALE, DELAY_S, ORIGIN = 0.989, 0.25, 2.5
"""Of the instrument; the origin is its own."""
TURN_RATE, PERIOD_S = 0.4, 20.0
"""Amplitude, rad/s, of a turn to and fro."""


def yaw(time_s: Array) -> Array:
    """Return what the vehicle has turned about down, rad."""
    return 0.1 * time_s + TURN_RATE * PERIOD_S / math.tau * np.sin(math.tau * time_s / PERIOD_S)


@pytest.fixture(scope="module")
def turning() -> ImuLog:
    """Return a minute and a half of a level vehicle that turns, at 37 Hz."""
    time_s = np.arange(1, 3330) / 37.0
    rate = np.diff(yaw(np.concatenate([[0.0], time_s]))) * 37.0
    gyro = np.column_stack([np.zeros_like(rate), np.zeros_like(rate), rate])
    accel = np.tile([0.0, 0.0, -9.8], (len(time_s), 1))
    return ImuLog(0.0, ImuNoise(1e-3, 0.05, 1e-3, 0.05), time_s, gyro, accel)


def readings(*, factor: float = 1.0, jumps_s: tuple[float, ...] = ()) -> Array:
    """Return arrivals at 10 Hz of a heading that is new at 3.3 Hz, wrapped."""
    count = np.arange(6.0, 880.0)
    arrival_s, taken_s = 0.1 * count, 0.3 * np.floor(count / 3.0) - DELAY_S
    heading = ORIGIN + factor * SCALE * yaw(taken_s)
    for at_s in jumps_s:
        heading = heading + 1.5 * (taken_s > at_s)
    return np.column_stack([arrival_s, wrap_to_pi(heading)])


def read(readings: Array, imu: ImuLog) -> tuple[HeadingLog, str]:
    """Return the log and its note."""
    log, (note,) = dvl_heading(readings, imu)
    assert log is not None
    return log, note


@pytest.mark.parametrize("jumps_s", [(), (20.0, 41.0)], ids=["steady", "reset twice"])
def test_turns_are_those_of_the_vehicle(turning: ImuLog, jumps_s: tuple[float, ...]) -> None:
    """Scale and delay are taken off, repeats left out, resets bridged by the gyros and said."""
    log, note = read(readings(jumps_s=jumps_s), turning)
    assert np.diff(log.time_s).min() > 0.2
    assert np.ptp(np.unwrap(log.heading - yaw(log.time_s))) < 2e-3
    assert f"{len(jumps_s)} jumps" in note
    assert log.errors.offset_sigma == pytest.approx(math.pi)
    assert log.errors.rate_sigma > 0.0


def test_long_silences_keep_count_of_the_turns(turning: ImuLog) -> None:
    """Between two readings the vehicle may turn by more than half a circle."""
    all_of_them = readings()
    silent = (all_of_them[:, 0] > 30.0) & (all_of_them[:, 0] < 75.0)
    log, note = read(all_of_them[~silent], turning)
    turned = np.ptp(np.unwrap(log.heading - yaw(log.time_s)))
    assert turned < 2e-3
    assert "0 jumps" in note


@pytest.mark.parametrize("factor", [-1.0, 57.3], ids=["other sign", "degrees"])
def test_what_does_not_turn_as_the_vehicle_is_left_out(turning: ImuLog, factor: float) -> None:
    """A heading of another sign or unit is none, and that is said."""
    log, (note,) = dvl_heading(readings(factor=factor), turning)
    assert log is None
    assert "left out" in note


def test_a_gyro_that_drifts_far_is_left_out(turning: ImuLog) -> None:
    """Beyond what its sigma, and that of the vehicle's gyros, could be."""
    drifting = readings()
    drifting[:, 1] = wrap_to_pi(drifting[:, 1] + np.deg2rad(0.2) * drifting[:, 0])
    log, (note,) = dvl_heading(drifting, turning)
    assert log is None
    assert 700.0 < float(note.split("drifts by ")[1].split()[0]) < 760.0


def test_logs_without_it_say_nothing(turning: ImuLog) -> None:
    """No reading, or one that never changes."""
    assert dvl_heading(np.zeros((0, 2)), turning) == (None, ())
    never = readings()
    never[:, 1] = 1.0
    assert dvl_heading(never, turning) == (None, ())
