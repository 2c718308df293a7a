"""Two IMUs on one vehicle: biases, signs and units of either are said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.io.blueye.convert import compare_imus
from ssm_graph.sensors.imu import ImuLog, ImuNoise

OFFSET = np.array([0.037, -0.040, -0.085])


@pytest.fixture(scope="module")
def turning() -> ImuLog:
    """Return a minute of a vehicle that turns about all axes, at 37 Hz."""
    time_s = np.arange(1, 2200) / 37.0
    rates = [0.1 * np.sin(0.3 * time_s + phase) for phase in (0.0, 1.0, 2.0)]
    accel = np.tile([0.0, 0.0, -9.8], (len(time_s), 1))
    return ImuLog(0.0, ImuNoise(1e-3, 0.05, 1e-3, 0.05), time_s, np.column_stack(rates), accel)


def other(imu: ImuLog, *, accel_z: float = 1.0, factor: Array | float = 1.0) -> Array:
    """Return the other IMU at its own times, late by 20 ms and with biases."""
    time_s = np.arange(0.1, 59.0, 0.011)
    gyro = np.column_stack([np.interp(time_s - 0.02, imu.time_s, x) for x in imu.gyro_b.T])
    accel = np.tile([0.0, 0.0, accel_z], (len(time_s), 1))
    return np.column_stack([time_s, factor * gyro + OFFSET, accel])


def test_bias_and_sign_of_the_other_are_said(turning: ImuLog) -> None:
    """One sentence with both, as for Imu1Tel; nothing more where they turn alike."""
    (note,) = compare_imus(turning, other(turning))
    said = note.split("(")[1].split(")")[0].split(", ")
    np.testing.assert_allclose([float(x) for x in said], OFFSET, atol=5e-4)
    assert ") rad/s more than those of Imu2Tel" in note
    assert "opposite sign" in note
    (note,) = compare_imus(turning, other(turning, accel_z=-1.0))
    assert "opposite sign" not in note


@pytest.mark.parametrize(
    ("factor", "axis", "said"),
    [
        (np.array([1.0, -1.0, 1.0]), "y", "-1.00 times"),
        (np.array([1.0, 1.0, 57.3]), "z", "57.3"),
    ],
)
def test_a_wrong_sign_or_unit_is_said(turning: ImuLog, factor: Array, axis: str, said: str) -> None:
    """The axis is named; which of the two is wrong the two cannot tell."""
    _, doubt = compare_imus(turning, other(turning, factor=factor))
    assert doubt.startswith(f"About {axis} ")
    assert said in doubt


def test_no_witness_and_no_turn_say_nothing_of_scales(turning: ImuLog) -> None:
    """Without the other IMU there is no note, and a vehicle that does not turn has no scale."""
    assert compare_imus(turning, np.zeros((0, 7))) == ()
    still = replace(turning, gyro_b=np.zeros_like(turning.gyro_b))
    assert len(compare_imus(still, other(still, factor=-1.0))) == 1
