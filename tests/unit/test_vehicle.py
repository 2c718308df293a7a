"""A vehicle read before its first message, and a mission played to whoever listens."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, SsmGraphError
from ssm_graph.base.tables import Order
from ssm_graph.imu.preintegration import GAP_GYRO_RATE
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of, write_vehicle
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator.buffers import Buffers
from ssm_graph.live.estimator.keyframes import KeyframeMaker
from ssm_graph.mission.mission import LocalStart, Mission
from ssm_graph.mission.problem import ProblemConfig
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.imu_calibration import ImuCalibration
from tests.malformed_cases import TOML_CASES, Malformed
from tests.mission_fixture import TOML, make_mission, write_example
from tests.unit.test_mission_roundtrip import assert_same

ABOUT_TABLES = (
    "No mission.toml",
    "A stamp that is not known",
    "The initial state far from the origin",
    "The initial state at a time without data",
    "A table that does not exist",
    "The name of an optional table misspelt",
    "A table of another format",
)
"""What only someone who looks at the tables can find, and two that have tests of their own."""


def write(folder: Path, text: str) -> Path:
    """Write a vehicle file of its own name."""
    path = folder / "auv-7.toml"
    path.write_text(text, encoding="utf-8")
    return path


def without(text: str, *sections: str) -> str:
    """Return TOML without whole sections."""
    blocks = text.split("\n\n")
    return "\n\n".join(b for b in blocks if not b.startswith(tuple(f"[{s}]" for s in sections)))


def test_vehicle_of_a_folder_is_that_of_its_mission(tmp_path: Path) -> None:
    """File and recording tell of the same vehicle, tables or not."""
    mission = read_mission(write_example(tmp_path))
    for table in tmp_path.glob("*.csv"):
        table.unlink()
    vehicle = read_vehicle(tmp_path)
    assert vehicle.beam_sigma == 0.005
    assert_same(replace(vehicle, beam_sigma=vehicle_of(mission).beam_sigma), vehicle_of(mission))


def test_a_vehicle_file_needs_no_tables(tmp_path: Path) -> None:
    """Neither their names nor their stamps; what is given is checked all the same."""
    bare = [line for line in TOML.splitlines() if not line.startswith(("file", "stamp"))]
    path = write(tmp_path, "\n".join(bare))
    assert_same(read_vehicle(path), read_vehicle(write(tmp_path, TOML)))
    with pytest.raises(ConfigError, match=r"auv-7.toml \[imu\] stamp: expected one of start"):
        read_vehicle(write(tmp_path, TOML.replace('"end"', '"begin"')))


def test_lever_arms_turn_to_forward_right_down(tmp_path: Path) -> None:
    """In FLU axes y and z have the other sign."""
    text = TOML.replace('"FRD"', '"FLU"').replace("[0.0, 0.0, 0.0]", "[1.0, 2.0, 3.0]")
    vehicle = read_vehicle(write(tmp_path, text))
    np.testing.assert_array_equal(vehicle.mount.lever_arm_b, [0.2, 0.0, -0.1])
    assert vehicle.depth is not None
    np.testing.assert_array_equal(vehicle.depth.lever_arm_b, [1.0, -2.0, -3.0])
    np.testing.assert_array_equal(vehicle.gnss.lever_arm_b, [1.0, -2.0, -3.0])


def test_frame_is_that_of_the_origin_then_of_the_initial_state(tmp_path: Path) -> None:
    """And that of the first fix where neither is stated, which only messages bring."""
    heights = []
    for missing in ([], ["origin"], ["origin", "initial"]):
        frame = read_vehicle(write(tmp_path, without(TOML, *missing))).frame
        heights.append(None if frame is None else frame.height)
    assert heights == [0.0, -20.0, None]


def test_a_vehicle_that_could_be_anywhere_is_refused(tmp_path: Path) -> None:
    """No receiver will ever bring a fix."""
    text = without(TOML, "origin", "initial", "gnss")
    with pytest.raises(ConfigError, match=r"auv-7.toml \[origin\]: nothing says where"):
        read_vehicle(write(tmp_path, text))


def test_optional_sensors_may_be_missing(tmp_path: Path) -> None:
    """A vehicle without depth sensor says so."""
    vehicle = read_vehicle(write(tmp_path, without(TOML, "depth", "gnss", "initial")))
    assert vehicle.depth is None
    assert vehicle.initial is None
    np.testing.assert_array_equal(vehicle.gnss.lever_arm_b, np.zeros(3))


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    """The message says what was expected."""
    with pytest.raises(ConfigError, match=r"none.toml: there is none in .* describes a vehicle"):
        read_vehicle(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match=r"mission.toml: there is none in"):
        read_vehicle(tmp_path)


@pytest.mark.parametrize(
    "case", [c for c in TOML_CASES if c.title not in ABOUT_TABLES], ids=lambda case: case.title
)
def test_the_reader_of_missions_checks_it(case: Malformed, tmp_path: Path) -> None:
    """Every malformed file of the catalogue is refused in the same words."""
    write_example(tmp_path)
    case.damage(tmp_path)
    with pytest.raises(case.error) as from_vehicle:
        read_vehicle(tmp_path)
    with pytest.raises(SsmGraphError) as from_mission:
        read_mission(tmp_path)
    assert str(from_vehicle.value) == str(from_mission.value)


@pytest.mark.parametrize("dropped", [(), ("frame",), ("initial",), ("depth",)])
def test_written_and_read_again(tmp_path: Path, dropped: tuple[str, ...]) -> None:
    """All values come back to rounding, whatever is missing."""
    changes: dict[str, None] = {name: None for name in dropped}
    vehicle = replace(vehicle_of(make_mission()), **changes)  # type: ignore[arg-type]
    write_vehicle(tmp_path, vehicle, order=Order.ARRIVAL)
    got = read_vehicle(tmp_path)
    if "frame" in dropped:
        assert got.frame is not None
        got = replace(got, frame=None)
    assert_same(got, vehicle)
    assert 'order = "arrival"' in (tmp_path / "mission.toml").read_text()


def test_every_field_is_written(tmp_path: Path) -> None:
    """A field that a vehicle is given one day has to find its key."""
    vehicle = replace(
        vehicle_of(make_mission()),
        water_sigma=0.02,
        current=CurrentModel(0.3, 7200.0, 0.01),
        imu_calibration=ImuCalibration(gyro_scale_error=np.full(3, 1e-3), accel_scale_sigma=2e-3),
    )
    write_vehicle(tmp_path, vehicle)
    got = read_vehicle(tmp_path)
    assert len(fields(Vehicle)) == 13
    others = [spec.name for spec in fields(Vehicle) if spec.name != "local"]  # in place of a place
    assert all(getattr(got, name) is not None for name in others)
    nowhere = replace(
        vehicle, frame=LocalStart().frame, initial=None, local=LocalStart(heading=1.0)
    )
    write_vehicle(tmp_path, nowhere)
    assert read_vehicle(tmp_path).local == nowhere.local
    assert (got.water_sigma, got.current) == (vehicle.water_sigma, vehicle.current)
    assert got.imu_calibration.gyro_scale_error is not None
    np.testing.assert_allclose(got.imu_calibration.gyro_scale_error, 1e-3)
    assert got.imu_calibration.accel_scale_sigma == pytest.approx(2e-3)


def test_live_pings_count_with_the_sigma_of_what_they_are_off() -> None:
    """Off the ground or off the water, unless they state their own."""
    buffers = Buffers(replace(vehicle_of(make_mission()), beam_sigma=0.01, water_sigma=0.08))
    own = (0.5, float("nan"), 0.5, 0.5)
    buffers.add(Ping(1.0, (1.0,) * 4))
    buffers.add(Ping(2.0, (1.0,) * 4, is_water=True))
    buffers.add(Ping(3.0, (1.0,) * 4, own, is_water=True))
    np.testing.assert_array_equal(
        buffers.pings.all[:, buffers.sigmas], [[0.01] * 4, [0.08] * 4, [0.5, 0.08, 0.5, 0.5]]
    )


@pytest.mark.parametrize("gap_s", [0.0, 0.2])
def test_where_many_samples_are_missing_turns_are_unseen(gap_s: float) -> None:
    """By the longest step, and whether or not there is a gap before; a fifth may be missing."""
    turn = {}
    for every in (1, 5, 3):
        buffers = Buffers(vehicle_of(make_mission()))
        for k in range(1, 500):
            is_there = k <= 300 or (k % every == 0 if every == 3 else k % every > 0 or every == 1)
            if is_there and not 3.98 - gap_s < 0.01 * k < 3.98:
                buffers.add(ImuSample(0.01 * k, (0.0,) * 3, (0.0, 0.0, -9.8)))
                assert buffers.period_s > 0.0
        maker = KeyframeMaker(buffers, LocalFrame(0.1, 0.1, 0.0), ProblemConfig(), begin_s=0.0)
        turn[every] = float(np.sqrt(maker.inertial(4.0, 4.5).covariance[0, 0, 0]))
    assert turn[5] == pytest.approx(turn[1], rel=0.01)
    assert turn[3] == pytest.approx(0.02 * GAP_GYRO_RATE, rel=0.01)


def test_messages_come_in_order_of_time() -> None:
    """All of them, the IMU first where times are equal."""
    mission = make_mission()
    messages = list(messages_of(mission))
    rank = {ImuSample: 0, Ping: 1, DepthReading: 2, Fix: 3}
    keys = [(m.time_s, rank[type(m)]) for m in messages]
    assert all(a < b for a, b in pairwise(keys))
    counts = [sum(isinstance(m, kind) for m in messages) for kind in rank]
    assert counts == [1200, 60, 61, 7]


def test_messages_hold_the_rows_of_the_mission() -> None:
    """Bit for bit, missing beams included."""
    mission = make_mission()
    samples = [m for m in messages_of(mission) if isinstance(m, ImuSample)]
    pings = [m for m in messages_of(mission) if isinstance(m, Ping)]
    fixes = [m for m in messages_of(mission) if isinstance(m, Fix)]
    np.testing.assert_array_equal([m.accel_b for m in samples], mission.imu.accel_b)
    np.testing.assert_array_equal([m.gyro_b for m in samples], mission.imu.gyro_b)
    np.testing.assert_array_equal([m.speed for m in pings], mission.dvl.speed)
    np.testing.assert_array_equal([m.sigma or () for m in pings], mission.dvl.sigma)
    assert mission.gnss is not None
    np.testing.assert_array_equal([m.lat for m in fixes], mission.gnss.lat)
    np.testing.assert_array_equal([m.sigma_enu for m in fixes], mission.gnss.sigma_enu)
    assert type(samples[0].time_s) is float


def test_messages_of_the_smallest_mission() -> None:
    """Optional sensors may be missing."""
    mission: Mission = replace(make_mission(), depth=None, gnss=None)
    assert {type(m) for m in messages_of(mission)} == {ImuSample, Ping}
