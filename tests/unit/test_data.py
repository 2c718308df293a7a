"""Frozen values: copied in, checked, read-only."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import DataError, SsmGraphError, nearest_hint
from ssm_graph.base.frozen import FrozenArrays, read_only
from ssm_graph.mission.mission import Reference
from ssm_graph.sensors.dvl import DvlLog, DvlMount, counted_sigma
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.simulation import IMU_NOISE, Grade, default_mount
from tests.helpers import simulated
from tests.mission_fixture import make_mission


def imu_log(**changes: Any) -> ImuLog:
    """Return two samples, with changes."""
    fields: dict[str, Any] = {
        "start_s": 0.0,
        "noise": IMU_NOISE[Grade.NAVIGATION],
        "time_s": [0.1, 0.2],
        "gyro_b": np.zeros((2, 3)),
        "accel_b": np.zeros((2, 3)),
    }
    return ImuLog(**(fields | changes))


def test_arrays_are_copied_in_and_read_only() -> None:
    """Neither the caller's array nor the value can change the other."""
    gyro_b = np.ones((2, 3))
    log = imu_log(gyro_b=gyro_b)
    gyro_b[0, 0] = 9.0
    assert log.gyro_b[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        log.gyro_b[0, 0] = 2.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        log.start_s = 1.0  # type: ignore[misc]


def test_lists_become_float_arrays() -> None:
    """Anything array-like is taken."""
    log = imu_log(time_s=[1, 2])
    assert log.time_s.dtype == np.float64


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"gyro_b": np.zeros((3, 3))},
            "ImuLog.gyro_b: expected an array of shape (2, 3), got (3, 3)",
        ),
        ({"accel_b": np.zeros(3)}, "ImuLog.accel_b: expected an array of shape (2, 3), got (3,)"),
        (
            {"time_s": np.zeros((2, 1))},
            "ImuLog.time_s: expected an array of shape ('N',), got (2, 1)",
        ),
    ],
)
def test_wrong_shapes_are_named(changes: dict[str, Any], message: str) -> None:
    """The message says which array of what, expected and got."""
    with pytest.raises(DataError, match=re.escape(message)):
        imu_log(**changes)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (np.array(["2026-05-01T10:00:00"], "datetime64[ns]"), r"got datetime64\[ns\]"),
        (np.array([1.0 + 2.0j]), "got complex128"),
        (["ten"], "could not convert string to float"),
        ([[1.0], [1.0, 2.0]], "rows of one length"),
    ],
)
def test_what_is_no_number_is_named(given: Any, told: str) -> None:
    """A date counted in nanoseconds is no time in seconds."""
    with pytest.raises(DataError, match=f"^log.time_s: expected numbers.*{told}"):
        read_only("log.time_s", given, (None,))


def test_fixed_shapes_do_not_follow_the_time() -> None:
    """A mount has no time; its shapes are its own."""
    mount = default_mount()
    with pytest.raises(DataError, match=r"DvlMount\.beams_d: expected an array of shape"):
        dataclasses.replace(mount, beams_d=np.zeros((4, 2)))
    with pytest.raises(DataError, match=r"lever_arm_b"):
        dataclasses.replace(mount, lever_arm_b=np.zeros(2))


@pytest.mark.parametrize("n_beams", [0, 9])
def test_an_instrument_has_one_to_eight_beams(n_beams: int) -> None:
    """As many as any maker builds."""
    with pytest.raises(DataError, match=f"expected 1 to 8 beams, got {n_beams}"):
        dataclasses.replace(default_mount(), beams_d=np.zeros((n_beams, 3)))


def test_a_log_has_the_beams_of_its_mount() -> None:
    """Three beams and four speeds are two instruments."""
    mount = dataclasses.replace(default_mount(), beams_d=np.eye(3))
    with pytest.raises(DataError, match="for each of the mount's 3 beams, got 4"):
        DvlLog(mount=mount, time_s=np.zeros(1), speed=np.zeros((1, 4)), sigma=np.ones((1, 4)))
    log = DvlLog(mount=mount, time_s=np.zeros(1), speed=np.zeros((1, 3)), sigma=np.ones((1, 3)))
    assert log.mount.beam_scale_errors.shape == (3,)


def test_missing_ranges_are_allowed_and_present_ones_checked() -> None:
    """An optional array is None or of the right shape."""
    log = DvlLog(
        mount=default_mount(), time_s=np.array([1.0]), speed=np.zeros((1, 4)), sigma=np.ones((1, 4))
    )
    assert log.range_m is None
    with pytest.raises(DataError, match=r"DvlLog\.range_m"):
        dataclasses.replace(log, range_m=np.zeros((2, 4)))


def test_read_only_takes_any_length_where_none_is_said() -> None:
    """None in a shape matches anything, other sizes must be met."""
    assert read_only("x", np.zeros((5, 2)), (None, 2)).shape == (5, 2)
    with pytest.raises(DataError, match=r"x: expected an array of shape \('N', 2\), got \(5, 3\)"):
        read_only("x", np.zeros((5, 3)), (None, 2))


def test_beams_turn_with_the_mounting() -> None:
    """Rows are directions: ``u_b = R_bd u_d`` for each."""
    R_bd = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    beams_d = np.vstack([np.eye(3), [0.6, 0.0, 0.8]])
    mount = DvlMount(beams_d=beams_d, R_bd=R_bd, lever_arm_b=np.zeros(3))
    for u_b, u_d in zip(mount.beams_b, beams_d, strict=True):
        np.testing.assert_allclose(u_b, R_bd @ u_d, atol=1e-15)


def test_every_array_of_a_mission_is_read_only() -> None:
    """Both from the fixture and from the simulator."""
    for mission in (make_mission(), simulated().mission):
        parts: list[object] = [mission.imu, mission.dvl, mission.dvl.mount, mission.depth]
        parts += [mission.gnss, mission.initial, mission.reference]
        for part in parts:
            if part is None:
                continue
            assert isinstance(part, FrozenArrays)
            names = [spec.name for spec in dataclasses.fields(part)]  # type: ignore[arg-type]
            arrays = [getattr(part, name) for name in names]
            assert not any(a.flags.writeable for a in arrays if isinstance(a, np.ndarray))


def test_errors_have_one_base_and_hints_name_the_nearest() -> None:
    """A caller can catch everything of ours at once."""
    assert issubclass(DataError, SsmGraphError)
    assert nearest_hint("heigth", ["height", "lat"]) == "did you mean 'height'?"
    assert nearest_hint("zzz", ["lon", "lat"]) == "known are: lat, lon"
    with pytest.raises(SsmGraphError):
        Reference([0.0], [0.0, 1.0], [0.0], [0.0], np.zeros((1, 3)), np.zeros((1, 3)))  # type: ignore[arg-type]


def test_a_sigma_that_is_not_stated_is_that_of_ground_or_water() -> None:
    """NaN, zero and less state none; one nominal sigma may stand for both."""
    stated = np.array([[0.5, np.nan, 0.0, -1.0], [np.nan, 0.3, np.inf, np.nan]])
    water = np.array([False, True])
    np.testing.assert_array_equal(
        counted_sigma(stated, water, ground_sigma=0.01, water_sigma=0.08),
        [[0.5, 0.01, 0.01, 0.01], [0.08, 0.3, np.inf, 0.08]],
    )
    for none in (None, 0.0):
        alike = counted_sigma(np.full(4, np.nan), True, ground_sigma=0.01, water_sigma=none)
        np.testing.assert_array_equal(alike, np.full(4, 0.01))
