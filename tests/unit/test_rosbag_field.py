"""Bags as recorders, drivers and clocks leave them: read, or refused by their cause."""

from __future__ import annotations

import contextlib
import random
import shutil
import sqlite3
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.ros.beams import WATER_LINKED_BEAMS, known_beams, proven_beams
from ssm_graph.io.ros.convert import convert_rosbag
from ssm_graph.io.ros.messages import RosOptions
from ssm_graph.mission.mission import Mission
from ssm_graph.simulation import GnssSettings
from tests.helpers import simulated

pytest.importorskip("rosbags", reason="needs the extra 'ros'")

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from ssm_graph.io.ros.mcap import McapFile, is_ros2_mcap
from tests.rosbag_fixture import (
    EPOCH_S,
    FIX,
    IMU,
    MARINE,
    PRESSURE,
    Ros,
    Sent,
    aid_messages,
    assert_same,
    imu_messages,
    marine_bag,
    marine_messages,
    ros1_bag,
    write_bag,
)

ON_ELLIPSOID = RosOptions(surface_height=0.0)
WATER_TOPIC = "/dvl_driver/velocity_water_report"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"


@pytest.fixture(scope="module")
def mission() -> Mission:
    """Return half a minute at 20 Hz with beams missing here and there."""
    settings = GnssSettings(lever_arm_b=(0.0, 0.0, 0.0), windows=((0.0, 1e9),))
    made: Mission = simulated(dropout_rate=0.1, gnss=settings, seed=2).mission
    return made


@pytest.fixture(scope="module")
def ros() -> Ros:
    """Return a maker of messages."""
    return Ros()


def shifted(sent: list[Sent], by_s: float, *, since_s: float = -1.0, of: str = "") -> list[Sent]:
    """Return messages with other stamps: those of a type, recorded since a time."""
    found = []
    for item in sent:
        if item.nanoseconds >= (EPOCH_S + since_s) * 1e9 and of in ("", item.type_name):
            message = deepcopy(item.message)
            stamp = item.nanoseconds + round(by_s * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            found.append(item._replace(message=message))
        else:
            found.append(item)
    return found


def with_water(mission: Mission, ros: Ros) -> list[Sent]:
    """Return a mission whose pings off the water have a topic of their own."""
    water = [
        item._replace(topic=WATER_TOPIC)
        for item in shifted(marine_messages(mission, ros, velocity_mode=2), 0.2)
    ]
    return [*marine_bag(mission, ros), *water]


def test_two_tracks_on_two_topics(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """Both are read, found by themselves or named; two topics of one track remain a choice."""
    bag = write_bag(tmp_path / "tracks", ros, with_water(mission, ros))
    for topics in ({}, {"dvl": ["/dvl", WATER_TOPIC]}):
        got = convert_rosbag(bag, vehicle=vehicle_of(mission), topics=topics)
        water = np.asarray(got.dvl.water_track) > 0.0
        n_pings = len(mission.dvl.time_s)
        assert (len(water), int(water.sum())) == (2 * n_pings, n_pings)
        np.testing.assert_allclose(got.dvl.speed[~water], mission.dvl.speed, rtol=6e-8)
    got = convert_rosbag(bag, vehicle=vehicle_of(mission), topics={"dvl": "/dvl"})
    assert got.dvl.water_track is None
    for topics in ({"dvl": ["/dvl", WATER_TOPIC, "/dvl2"]}, {"imu": ["/imu", "/imu"]}):
        with pytest.raises(ConfigError, match=r"there is no topic|expected each sensor once"):
            convert_rosbag(bag, topics=topics)
    second = [item._replace(topic="/dvl2") for item in marine_messages(mission, ros)]
    bag = write_bag(tmp_path / "same", ros, [*marine_bag(mission, ros), *second])
    with pytest.raises(ConfigError, match=r"2 topics could be the dvl: /dvl, /dvl2"):
        convert_rosbag(bag)


@pytest.mark.parametrize(("by_s", "way"), [(-2.0037, "back by 2.004"), (1.5, "forward by 1.5")])
def test_a_clock_that_was_set(
    mission: Mission, ros: Ros, tmp_path: Path, by_s: float, way: str
) -> None:
    """The rows of both clocks are not put together."""
    bag = write_bag(tmp_path / "set", ros, shifted(marine_bag(mission, ros), by_s, since_s=15.0))
    with pytest.raises(DataError, match=rf"/imu: .* set {way} s at 1700000015\.0.*split"):
        convert_rosbag(bag)


def test_late_messages_are_no_set_clock(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """A network that stalls for five seconds and gives all it held at once; a longer way."""
    held = (EPOCH_S + 10.0) * 1e9, (EPOCH_S + 15.0) * 1e9
    sent = [
        item._replace(nanoseconds=int(held[1]) + k)
        if held[0] < item.nanoseconds < held[1]
        else item
        for k, item in enumerate(marine_bag(mission, ros))
    ]
    bag = write_bag(tmp_path / "stall", ros, sent)
    assert_same(convert_rosbag(bag, options=ON_ELLIPSOID), mission)
    slower = [
        item._replace(nanoseconds=item.nanoseconds + 8 * 10**8)
        if item.type_name == IMU and item.nanoseconds > held[1]
        else item
        for item in marine_bag(mission, ros)
    ]
    bag = write_bag(tmp_path / "slower", ros, slower)
    assert_same(convert_rosbag(bag, options=ON_ELLIPSOID), mission)


def test_fixes_on_another_clock(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """GPS time is known and mended; another one is refused until the vehicle's file states it."""
    sent = marine_bag(mission, ros)
    bag = write_bag(tmp_path / "gps", ros, shifted(sent, 18.0, of=FIX))
    got = convert_rosbag(bag, options=ON_ELLIPSOID)
    assert_same(got, mission)
    assert any("taken for GPS time, 18 s are taken off" in note for note in got.notes)
    bag = write_bag(tmp_path / "late", ros, shifted(sent, 1.0, of=FIX))
    with pytest.raises(DataError, match=r"/gps/fix: the stamps are 1 s ahead .*time_offset_s = 1 "):
        convert_rosbag(bag)
    vehicle = vehicle_of(mission)
    known = replace(vehicle.gnss.calibration, time_offset_s=1.0)
    vehicle = replace(vehicle, gnss=replace(vehicle.gnss, calibration=known))
    got = convert_rosbag(bag, vehicle=vehicle, options=ON_ELLIPSOID)
    assert got.gnss is not None
    assert mission.gnss is not None
    np.testing.assert_allclose(got.gnss.valid_s - EPOCH_S, mission.gnss.time_s, atol=1e-6)
    bag = write_bag(tmp_path / "behind", ros, shifted(sent, -4.0, of=FIX))
    notes = convert_rosbag(bag, options=ON_ELLIPSOID).notes
    assert any("/gps/fix: recorded 4 s later" in note for note in notes)
    bag = write_bag(tmp_path / "depth", ros, shifted(sent, 1.0, of=PRESSURE))
    with pytest.raises(DataError, match=r"/pressure: the stamps are 1 s ahead .*set the clocks"):
        convert_rosbag(bag)


def without_profile(data: bytes) -> bytes:
    """Return an MCAP whose header says nothing of who wrote it."""
    size = int.from_bytes(data[9:17], "little")
    header = bytes(8)
    return data[:9] + len(header).to_bytes(8, "little") + header + data[17 + size :]


def test_mcap_without_profile(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """Alone and in its folder: an export of a platform."""
    bag = write_bag(tmp_path / "run", ros, marine_bag(mission, ros))
    file = bag / "run.mcap"
    file.write_bytes(without_profile(file.read_bytes()))
    assert is_ros2_mcap(file)
    for path in (file, bag):
        assert_same(convert_rosbag(path, options=ON_ELLIPSOID), mission)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE])
def test_compressed_bags(
    mission: Mission, ros: Ros, tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    """Zstd by message and by file."""
    path = tmp_path / "zstd"
    writer = Writer(path, version=8, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for item in sorted(marine_bag(mission, ros), key=lambda one: one.nanoseconds):
            if item.topic not in connections:
                connections[item.topic] = writer.add_connection(
                    item.topic, item.type_name, typestore=ros.store
                )
            raw = ros.store.serialize_cdr(item.message, item.type_name)
            writer.write(connections[item.topic], item.nanoseconds, raw)
    assert_same(convert_rosbag(path, options=ON_ELLIPSOID), mission)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_recorder_that_was_killed(
    mission: Mission, ros: Ros, tmp_path: Path, plugin: StoragePlugin
) -> None:
    """No metadata: the files of the folder are read in the order of their numbers."""
    sent = sorted(marine_bag(mission, ros), key=lambda item: item.nanoseconds)
    half, suffix = len(sent) // 2, "mcap" if plugin is StoragePlugin.MCAP else "db3"
    folder = tmp_path / "killed"
    folder.mkdir()
    for name, part in (("run_9", sent[:half]), ("run_10", sent[half:])):
        bag = write_bag(tmp_path / name, ros, part, plugin)
        (bag / f"{name}.{suffix}").rename(folder / f"{name}.{suffix}")
    got = convert_rosbag(folder, options=ON_ELLIPSOID)
    assert_same(got, mission)
    assert f"run_9.{suffix}, run_10.{suffix} read in this order" in got.notes[0]
    if plugin is StoragePlugin.MCAP:
        (folder / "metadata.yaml").write_text("  - run_9.mcap\n  - run_10.mcap\n  - run_11.mcap\n")
        with pytest.raises(DataError, match=r"run_11\.mcap is missing"):
            convert_rosbag(folder)


@pytest.mark.parametrize("shape", ["killed", "with metadata", "file"])
def test_messages_that_a_killed_recorder_left_in_a_journal(
    mission: Mission, ros: Ros, tmp_path: Path, shape: str
) -> None:
    """Half of them are in the log beside the database alone; the recording stays as it is."""
    bag = write_bag(tmp_path / "run", ros, marine_bag(mission, ros), StoragePlugin.SQLITE3)
    killed = tmp_path / "killed"
    with contextlib.closing(sqlite3.connect(bag / "run.db3")) as database:
        rows = database.execute("SELECT * FROM messages").fetchall()
        database.execute("DELETE FROM messages")
        database.commit()
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("PRAGMA wal_autocheckpoint=0")
        for part in (rows[: len(rows) // 2], rows[len(rows) // 2 :]):
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", part)
            database.commit()
        shutil.copytree(bag, killed)
    if shape == "killed":
        (killed / "metadata.yaml").unlink()
    before = {path.name: path.read_bytes() for path in killed.iterdir()}
    got = convert_rosbag(killed / "run.db3" if shape == "file" else killed, options=ON_ELLIPSOID)
    assert_same(got, mission)
    assert any("run.db3-wal: what a recorder" in note for note in got.notes)
    assert {path.name: path.read_bytes() for path in killed.iterdir()} == before


def test_no_pressure_is_no_reading(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """A sensor that is not ready says 0 Pa, which is nowhere on Earth."""
    sent = deepcopy(marine_bag(mission, ros))
    pressures = [item.message for item in sent if item.type_name == PRESSURE]
    for message in pressures[:4]:
        message.fluid_pressure = 0.0
    got = convert_rosbag(write_bag(tmp_path / "bag", ros, sent), options=ON_ELLIPSOID)
    assert got.depth is not None
    assert len(got.depth.time_s) == len(pressures) - 4
    assert any("4 refused (FluidPressure" in note for note in got.notes)


def test_a_file_that_was_cut_off(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """What is whole of it is read, and the note says where it ends."""
    sent = sorted(marine_bag(mission, ros), key=lambda item: item.nanoseconds)
    first = write_bag(tmp_path / "first", ros, sent[: len(sent) // 2]) / "first.mcap"
    whole = first.read_bytes()
    footer = whole.rindex(b"\x0f\x04\0\0\0\0\0\0\0")
    second = (
        write_bag(tmp_path / "second", ros, sent[len(sent) // 2 :]) / "second.mcap"
    ).read_bytes()
    start = 17 + int.from_bytes(second[9:17], "little")
    file = tmp_path / "cut.mcap"
    file.write_bytes(whole[:footer] + second[start : start + 5000])
    got = convert_rosbag(file, options=ON_ELLIPSOID)
    assert 0.4 < len(got.imu.time_s) / len(mission.imu.time_s) < 0.6
    assert any(f"cut off: it ends amid a record at byte {footer}" in note for note in got.notes)


def test_ros_1(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """The same messages in another wrapping; one that was cut off says what to try."""
    bag = ros1_bag(tmp_path / "old.bag", mission, ros)
    assert_same(convert_rosbag(bag, options=ON_ELLIPSOID), mission)
    bag.write_bytes(bag.read_bytes()[:4000])
    with pytest.raises(DataError, match=r"ROS 1 .*rosbag reindex"):
        convert_rosbag(bag)


def twists(mission: Mission, ros: Ros, turn: Any) -> list[Sent]:
    """Return the pings as velocities, forward-left-up, sigmas of 1, 2 and 3 cm/s."""
    velocity = mission.dvl.speed @ np.linalg.pinv(mission.dvl.mount.beams_d).T
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([1e-4, 4e-4, 9e-4])
    found = []
    for time_s, v in zip(mission.dvl.time_s, velocity, strict=True):
        if np.isfinite(v).all():
            twist = ros.new(
                "geometry_msgs/msg/Twist",
                linear=ros.vector(turn @ v),
                angular=ros.vector((0, 0, 0)),
            )
            with_covariance = ros.new(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance.ravel()
            )
            found.append(ros.sent("/twist", TWIST, time_s, twist=with_covariance))
    return found


def test_a_velocity_alone(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """Turned to forward-right-down, with its covariance; beams go before where there are any."""
    turn = np.diag([1.0, -1.0, -1.0])
    sent = twists(mission, ros, turn)
    rest = imu_messages(mission, ros) + aid_messages(mission, ros)
    got = convert_rosbag(write_bag(tmp_path / "twist", ros, sent + rest), options=ON_ELLIPSOID)
    assert got.dvl.mount.n_beams == 3
    linear = [item.message.twist.twist.linear for item in sent]
    np.testing.assert_allclose(got.dvl.speed, [[v.x, -v.y, -v.z] for v in linear])
    np.testing.assert_allclose(got.dvl.sigma[0], [0.01, 0.02, 0.03])
    bag = write_bag(tmp_path / "both", ros, sent + rest + marine_messages(mission, ros))
    assert_same(convert_rosbag(bag, options=ON_ELLIPSOID), mission)
    with pytest.raises(DataError, match="not one beam speed"):
        convert_rosbag(tmp_path / "twist", vehicle=vehicle_of(mission))


def transform(ros: Ros, parent: str, child: str, place: Any, quaternion_wxyz: Any) -> Any:
    """Return one transform."""
    w, x, y, z = (float(value) for value in quaternion_wxyz)
    header = ros.header(EPOCH_S * 10**9)
    header.frame_id = parent
    turn = ros.new("geometry_msgs/msg/Quaternion", w=w, x=x, y=y, z=z)
    pose = ros.new("geometry_msgs/msg/Transform", translation=ros.vector(place), rotation=turn)
    kind = "geometry_msgs/msg/TransformStamped"
    return ros.new(kind, header=header, child_frame_id=child, transform=pose)


def test_lever_arms_of_tf_static(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """Through a common base, forward-left-up; a vehicle's file goes before."""
    sent = deepcopy(marine_bag(mission, ros))
    frames = {IMU: "imu", MARINE: "dvl", FIX: "antenna", PRESSURE: "lost"}
    for item in sent:
        item.message.header.frame_id = frames[item.type_name]
    quarter = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # about z, to the left
    tree = [
        transform(ros, "base", "imu", (0.1, 0.2, 0.3), (1, 0, 0, 0)),
        transform(ros, "base", "dvl", (1.1, 0.5, -0.1), quarter),
        transform(ros, "/dvl", "antenna", (1.0, 0.0, 2.0), (1, 0, 0, 0)),
        transform(ros, "elsewhere", "lost", (9.0, 9.0, 9.0), (1, 0, 0, 0)),
    ]
    tf = "tf2_msgs/msg/TFMessage"
    message = ros.new(tf, transforms=tree)
    sent.append(Sent("/tf_static", tf, EPOCH_S * 10**9, message))
    bag = write_bag(tmp_path / "tf", ros, sent)
    got = convert_rosbag(bag, options=ON_ELLIPSOID)
    np.testing.assert_allclose(got.dvl.mount.lever_arm_b, [1.0, -0.3, 0.4], atol=1e-12)
    to_left = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(got.dvl.mount.R_bd, to_left, atol=1e-12)
    assert got.gnss is not None
    assert got.depth is not None
    np.testing.assert_allclose(got.gnss.lever_arm_b, [1.0, -1.3, -1.6], atol=1e-12)
    np.testing.assert_array_equal(got.depth.lever_arm_b, np.zeros(3))
    assert any("0.00, 0.00, -90.00 deg (roll, pitch, yaw)" in note for note in got.notes)
    stated = convert_rosbag(bag, vehicle=vehicle_of(mission), options=ON_ELLIPSOID)
    np.testing.assert_array_equal(stated.dvl.mount.R_bd, mission.dvl.mount.R_bd)


Slip = Callable[[Any], Any]


def packed(speed: Any) -> Any:
    """Move the speeds that are there to the front."""
    return np.array([np.r_[row[~np.isnan(row)], row[np.isnan(row)]] for row in speed])


@pytest.mark.parametrize(
    ("slip", "said"), [(packed, "packed to the front"), (np.abs, "have no sign")]
)
def test_slips_of_drivers_are_refused(slip: Slip, said: str) -> None:
    """With directions of messages and vehicle; sound ones pass, missing beams as well."""
    rng = np.random.default_rng(0)
    velocity = rng.normal(0.0, [0.5, 0.2, 0.05], (80, 3))
    speed = velocity @ WATER_LINKED_BEAMS.T + rng.normal(0.0, 0.005, (80, 4))
    speed[np.arange(40), rng.integers(0, 4, 40)] = np.nan
    data = {"speed": slip(speed), "velocity_d": velocity}
    with pytest.raises(DataError, match=said):
        known_beams(WATER_LINKED_BEAMS, **data)
    with pytest.raises(DataError, match=said):
        proven_beams(WATER_LINKED_BEAMS, water_linked=False, may_turn=True, **data)
    assert known_beams(WATER_LINKED_BEAMS, speed=speed, velocity_d=velocity).notes == ()
    last_missing = speed.copy()
    last_missing[:40] = np.where(np.arange(4) == 3, np.nan, velocity[:40] @ WATER_LINKED_BEAMS.T)
    assert known_beams(WATER_LINKED_BEAMS, speed=last_missing, velocity_d=velocity).notes == ()


def test_pressure_in_another_unit(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """Every unit that fits is named, not one that does not."""
    sent = deepcopy(marine_bag(mission, ros))
    for item in sent:
        if item.type_name == PRESSURE:
            item.message.fluid_pressure *= 0.01
    bag = write_bag(tmp_path / "hpa", ros, sent)
    with pytest.raises(DataError, match=r"they would be \d+\.\d m in hPa or mbar, .*mend"):
        convert_rosbag(bag)


def test_damaged_mcap_does_no_harm(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """Flipped bits, lost pieces, other numbers: an error of data, or messages, and nothing else."""
    sent = sorted(marine_bag(mission, ros), key=lambda item: item.nanoseconds)[:200]
    whole = (write_bag(tmp_path / "run", ros, sent) / "run.mcap").read_bytes()
    rng = random.Random(5)
    file = tmp_path / "damaged.mcap"
    n_read = 0
    for _ in range(200):
        data = bytearray(whole)
        for _ in range(rng.randrange(1, 6)):
            at = rng.randrange(8, len(data))
            if rng.random() < 0.5:
                data[at] ^= 1 << rng.randrange(8)
            elif rng.random() < 0.5:
                del data[at : at + rng.randrange(1, 200)]
            else:
                data[at : at + 8] = rng.randbytes(8)
        file.write_bytes(data)
        is_ros2_mcap(file)
        with McapFile(file) as reader:
            n_read += sum(1 for _ in reader.messages(reader.connections))
    assert n_read > 1000
