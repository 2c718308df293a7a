"""ROS 2 bags become missions: written from a simulated mission, read back, compared with it."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError, MissingExtraError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.io.instruments.assumed import BEAM_SIGMA, NOISE
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.ros import log as rosbag_log
from ssm_graph.io.ros.beams import WATER_LINKED_BEAMS, proven_beams
from ssm_graph.io.ros.convert import convert_rosbag
from ssm_graph.io.ros.log import LAYOUTS, is_rosbag
from ssm_graph.io.ros.messages import BeamSign, RosOptions
from ssm_graph.io.ros.topics import WATER_LATER_S
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.dvl import DvlMount
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation import GnssSettings
from tests.helpers import simulated

pytest.importorskip("rosbags", reason="needs the extra 'ros'")

from rosbags.rosbag2 import StoragePlugin, Writer

from tests.rosbag_fixture import (
    EPOCH_S,
    IMU,
    MARINE,
    PRESSURE,
    WATER_LINKED,
    Ros,
    Sent,
    aid_messages,
    assert_same,
    assert_times,
    forget_definitions,
    imu_messages,
    marine_bag,
    marine_messages,
    velocities,
    write_bag,
)

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("SSM_GRAPH_DATA", ROOT / "../shared/data"))
A50_LOG = DATA / "waterlinked_a50" / "20211217-152655dvl_data_time.csv"
ON_ELLIPSOID = RosOptions(surface_height=0.0)
"""Depth as simulated, minus the ellipsoidal height."""


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


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_is_the_mission_it_was_made_of(
    mission: Mission, ros: Ros, tmp_path: Path, plugin: StoragePlugin
) -> None:
    """Both storages: every table comes back, with the vehicle's constants, and can be read."""
    bag = write_bag(tmp_path / "run7", ros, marine_bag(mission, ros), plugin)
    got = convert_rosbag(bag, vehicle=vehicle_of(mission), options=ON_ELLIPSOID)
    assert_same(got, mission)
    assert got.name == "run7"
    assert got.imu.noise == mission.imu.noise
    np.testing.assert_array_equal(got.dvl.mount.beams_d, mission.dvl.mount.beams_d)
    np.testing.assert_array_equal(got.dvl.sigma, mission.dvl.sigma)
    assert got.dvl.range_m is not None
    np.testing.assert_array_equal(np.isnan(got.dvl.range_m), np.isnan(mission.dvl.speed))
    assert got.depth is not None
    assert mission.depth is not None
    assert got.depth.sigma == mission.depth.sigma
    assert not any("--vehicle" in note for note in got.notes)
    write_mission(tmp_path / "mission", got)
    np.testing.assert_allclose(read_mission(tmp_path / "mission").dvl.speed, got.dvl.speed)


def test_a_bag_keeps_the_water_track(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """Marked by its mode; where both tracks have one stamp, the water's is put a little later."""
    both = [m._replace(message=deepcopy(m.message)) for m in marine_messages(mission, ros)[::10]]
    for sent in both:
        sent.message.velocity_mode = 2
    bag = write_bag(tmp_path / "run", ros, marine_bag(mission, ros) + both)
    got = convert_rosbag(bag, vehicle=vehicle_of(mission), options=ON_ELLIPSOID)
    water = got.dvl.is_water
    assert water.sum() == len(both)
    assert_times(got.dvl.time_s[~water], mission.dvl.time_s)
    assert_times(got.dvl.time_s[water], mission.dvl.time_s[::10] + WATER_LATER_S)
    np.testing.assert_allclose(got.dvl.speed[water], mission.dvl.speed[::10], rtol=6e-8)
    assert any(f"{len(both)} off the water put 1 ms behind" in note for note in got.notes)


def test_a_vehicle_says_how_good_pings_off_the_water_are(
    mission: Mission, ros: Ros, tmp_path: Path
) -> None:
    """Its sigma off the water, where the message states none, and its current."""
    sent = marine_bag(mission, ros)
    pings = [one for one in sent if one.type_name == MARINE]
    for ping in pings[1::2]:
        ping.message.velocity_mode = 2
    pings[3].message.beam_velocity_covar = np.full(4, 0.03**2, dtype=np.float32)
    vehicle = replace(
        vehicle_of(mission), beam_sigma=0.01, water_sigma=0.08, current=CurrentModel(sigma=0.2)
    )
    bag = write_bag(tmp_path / "run", ros, sent)
    got = convert_rosbag(bag, vehicle=vehicle, options=ON_ELLIPSOID)
    expected = np.where(got.dvl.is_water, 0.08, 0.01)
    expected[3] = 0.03
    np.testing.assert_allclose(got.dvl.sigma, np.tile(expected[:, None], 4), rtol=1e-6)
    assert got.current == vehicle.current
    alike = convert_rosbag(bag, vehicle=replace(vehicle, water_sigma=None), options=ON_ELLIPSOID)
    np.testing.assert_allclose(np.delete(alike.dvl.sigma, 3, axis=0), 0.01)


def test_a_single_file_is_a_bag_too(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """The folder's metadata are not needed."""
    bag = write_bag(tmp_path / "run", ros, marine_bag(mission, ros))
    assert is_rosbag(bag)
    assert is_rosbag(bag / "run.mcap")
    assert_same(convert_rosbag(bag / "run.mcap", options=ON_ELLIPSOID), mission)


@pytest.mark.parametrize("layout", range(len(LAYOUTS[WATER_LINKED])))
@pytest.mark.parametrize("embedded", [True, False])
def test_water_linked_in_every_layout(
    mission: Mission, tmp_path: Path, layout: int, embedded: bool
) -> None:
    """The definition is the bag's own, or the known one that makes sense of the bytes."""
    ros = Ros(layout)
    body_v = velocities(mission, mission.dvl.mount.beams_d)
    speed = body_v @ WATER_LINKED_BEAMS.T
    speed[::7, 2] = np.nan
    rows = zip(mission.dvl.time_s, speed, body_v, strict=True)
    sent = [ros.water_linked(t, speed=s, velocity=v) for t, s, v in rows]
    sent += imu_messages(mission, ros)[:200] + aid_messages(mission, ros)
    bag = write_bag(tmp_path / "wl", ros, sent, StoragePlugin.SQLITE3)
    got = convert_rosbag(bag if embedded else forget_definitions(bag), options=ON_ELLIPSOID)
    is_zero = np.asarray(~body_v.any(axis=1))  # a driver's word for no lock
    np.testing.assert_array_equal(got.dvl.speed, np.where(is_zero[:, None], np.nan, speed))
    np.testing.assert_array_equal(got.dvl.mount.beams_d, WATER_LINKED_BEAMS)
    assert got.imu.noise == NOISE
    assert np.all(got.dvl.sigma == BEAM_SIGMA)
    assert any("No --vehicle" in note for note in got.notes)


def test_marine_definition_is_known_too(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """A db3 bag of Humble carries none."""
    bag = write_bag(tmp_path / "old", ros, marine_bag(mission, ros), StoragePlugin.SQLITE3)
    assert_same(convert_rosbag(forget_definitions(bag), options=ON_ELLIPSOID), mission)


@pytest.mark.parametrize("axes", list(BodyAxes))
def test_body_axes(mission: Mission, ros: Ros, tmp_path: Path, axes: BodyAxes) -> None:
    """Each of the three comes to forward-right-down; the wrong one of two is refused."""
    sent = imu_messages(mission, ros, axes=axes) + marine_messages(mission, ros)
    bag = write_bag(tmp_path / "axes", ros, sent + aid_messages(mission, ros))
    got = convert_rosbag(bag, options=RosOptions(body=axes, surface_height=0.0))
    assert_same(got, mission)
    wrong = BodyAxes.FLU if axes is BodyAxes.FRD else BodyAxes.FRD
    with pytest.raises(DataError, match="--body"):
        convert_rosbag(bag, options=RosOptions(body=wrong))


def test_the_published_velocity_shows_the_sign(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """Speeds counted against the beam are turned, and it is said; stated so, they are anyway."""
    sent = imu_messages(mission, ros) + marine_messages(mission, ros, sign=-1.0)
    bag = write_bag(tmp_path / "against", ros, sent + aid_messages(mission, ros))
    for vehicle in (None, vehicle_of(mission)):
        got = convert_rosbag(bag, vehicle=vehicle, options=ON_ELLIPSOID)
        assert_same(got, mission)
        assert any("their sign is turned" in note for note in got.notes)
    stated = replace(ON_ELLIPSOID, beam_sign=BeamSign.AGAINST)
    got = convert_rosbag(bag, options=stated)
    assert_same(got, mission)
    assert not any("their sign is turned" in note for note in got.notes)


def test_beam_vectors_counted_from_the_horizontal(
    mission: Mission, ros: Ros, tmp_path: Path
) -> None:
    """A known slip of drivers is found by the velocity, mended and said."""
    beams_d = mission.dvl.mount.beams_d
    level = np.linalg.norm(beams_d[:, :2], axis=1)[:, None]
    slip = np.hstack([beams_d[:, :2] / level * beams_d[:, 2:], level])
    sent = imu_messages(mission, ros) + marine_messages(mission, ros, beams_d=slip)
    bag = write_bag(tmp_path / "slip", ros, sent + aid_messages(mission, ros))
    got = convert_rosbag(bag, options=ON_ELLIPSOID)
    np.testing.assert_allclose(got.dvl.mount.beams_d, beams_d, atol=1e-12)
    assert any("from the horizontal" in note for note in got.notes)


def test_beams_that_cannot_be_known_ask_for_a_vehicle(
    mission: Mission, ros: Ros, tmp_path: Path
) -> None:
    """Zero vectors, and directions that contradict the velocity."""
    for name, beams_d in (("zero", np.zeros((4, 3))), ("wrong", WATER_LINKED_BEAMS[[1, 0, 2, 3]])):
        sent = imu_messages(mission, ros) + marine_messages(mission, ros, beams_d=beams_d)
        bag = write_bag(tmp_path / name, ros, sent + aid_messages(mission, ros))
        with pytest.raises(DataError, match=r"/dvl: .*--vehicle"):
            convert_rosbag(bag)
        assert_same(convert_rosbag(bag, vehicle=vehicle_of(mission), options=ON_ELLIPSOID), mission)


def test_water_linked_mounting_rotation() -> None:
    """The velocity shows the quarter turn; with little motion nothing is claimed."""
    rng = np.random.default_rng(0)
    velocity = rng.normal(0.0, [0.5, 0.2, 0.05], (50, 3))
    turned = np.column_stack([-velocity[:, :2], velocity[:, 2]])
    speed = velocity @ WATER_LINKED_BEAMS.T + rng.normal(0.0, 0.01, (50, 4))
    found = proven_beams(None, water_linked=True, may_turn=True, speed=speed, velocity_d=turned)
    np.testing.assert_allclose(turned @ found.beams_d.T, velocity @ WATER_LINKED_BEAMS.T)
    assert "180 degrees" in found.notes[0]
    still = proven_beams(
        None, water_linked=True, may_turn=True, speed=0.01 * speed, velocity_d=0.01 * turned
    )
    np.testing.assert_array_equal(still.beams_d, WATER_LINKED_BEAMS)
    assert "too little motion" in still.notes[0]


def test_three_beams_and_an_altimeter() -> None:
    """Three are enough to prove directions by; a vertical fourth stays what it is."""
    azimuth = np.radians([0.0, 120.0, -120.0])
    slip = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(3)]) * np.cos(np.radians(20))
    slip[:, 2] = np.sin(np.radians(20))
    true = np.column_stack(
        [slip[:, :2] * np.tan(np.radians(20.0)), np.full(3, np.cos(np.radians(20.0)))]
    )
    velocity = np.random.default_rng(1).normal(0.0, [0.5, 0.2, 0.05], (50, 3))
    speed = np.column_stack([velocity @ true.T, np.full(50, np.nan)])
    stated = np.vstack([slip, [0.0, 0.0, 1.0]])
    found = proven_beams(
        stated, water_linked=False, may_turn=True, speed=speed, velocity_d=velocity
    )
    np.testing.assert_allclose(found.beams_d, np.vstack([true, [0.0, 0.0, 1.0]]), atol=1e-12)
    assert "from the horizontal" in found.notes[0]


@pytest.mark.skipif(not A50_LOG.is_file(), reason=f"there is no {A50_LOG}")
def test_water_linked_beams_against_a_real_log() -> None:
    """Order, directions and sign: residuals of millimetres per second."""
    with A50_LOG.open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["velocity_valid"] == "True"]
    velocity = np.array([[float(row[name]) for name in ("vx", "vy", "vz")] for row in rows])
    names = [f"transducers_{i}" for i in range(4)]
    speed = np.array(
        [
            [
                float(row[f"{name}_velocity"]) if row[f"{name}_beam_valid"] == "True" else np.nan
                for name in names
            ]
            for row in rows
        ]
    )
    found = proven_beams(None, water_linked=True, may_turn=True, speed=speed, velocity_d=velocity)
    np.testing.assert_array_equal(found.beams_d, WATER_LINKED_BEAMS)
    assert found.notes == ()
    assert np.sqrt(np.nanmean((speed - velocity @ found.beams_d.T) ** 2)) < 2e-3


def test_disorder_repeats_gaps_and_refusals_are_said(
    mission: Mission, ros: Ros, tmp_path: Path
) -> None:
    """The mission is whole again, and its notes count what was done."""
    imu = imu_messages(mission, ros)
    imu[3] = imu[3]._replace(nanoseconds=imu[5].nanoseconds + 1)
    imu += imu[10:12]
    nan = ros.imu(1.01, (0, 0, np.nan), (0, 0, 9.8))
    rival = ros.imu(mission.imu.time_s[20], (9, 9, 9), (0, 0, 9.8))
    no_fix = ros.fix(2.0, (0.5, 0.5, 0.0), (1, 1, 1), status=-1)
    sent = [*imu, nan, rival, no_fix, *marine_messages(mission, ros)]
    bag = write_bag(tmp_path / "messy", ros, sent + aid_messages(mission, ros))
    got = convert_rosbag(bag, options=ON_ELLIPSOID)
    assert_same(got, mission)
    notes = " ".join(got.notes)
    assert "1 refused (Imu: " in notes.replace("sensor_msgs__msg__", "")
    for said in (
        "1 out of order",
        "2 exact repeats",
        "1 dropped that differ",
        "/gps/fix: of",
    ):
        assert said in notes
    gap = [
        item for item in imu_messages(mission, ros) if not 5 < item.nanoseconds / 1e9 - EPOCH_S < 7
    ]
    bag = write_bag(tmp_path / "gap", ros, gap + sent[len(imu) + 2 :] + aid_messages(mission, ros))
    assert any("1 gaps in time, the longest 2.0" in note for note in convert_rosbag(bag).notes)


def test_stamp_of_zero_is_receipt(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """A driver without a clock."""
    imu = imu_messages(mission, ros)
    for item in imu:
        item.message.header.stamp.sec = item.message.header.stamp.nanosec = 0
    sent = [*imu, *marine_messages(mission, ros), *aid_messages(mission, ros)]
    bag = write_bag(tmp_path / "zero", ros, sent)
    assert_same(convert_rosbag(bag, options=ON_ELLIPSOID), mission)


def test_surface_height_by_the_fixes(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """Depth becomes minus the ellipsoidal height, for GNSS says where the surface is."""
    raised = replace(mission, gnss=replace(mission.gnss, height=mission.gnss.height + 30.0))  # type: ignore[union-attr,type-var]
    sent = imu_messages(mission, ros) + marine_messages(mission, ros)
    bag = write_bag(tmp_path / "geoid", ros, sent + aid_messages(raised, ros))
    got = convert_rosbag(bag)
    assert got.depth is not None
    assert mission.depth is not None
    np.testing.assert_allclose(got.depth.depth, mission.depth.depth - 30.0, atol=3.0)
    assert any("above the ellipsoid, by" in note for note in got.notes)


def test_several_topics_are_a_choice(mission: Mission, ros: Ros, tmp_path: Path) -> None:
    """The message names the candidates; the choice is by sensor."""
    second = [ros.imu(1.0 + 0.1 * i, (0, 0, 0), (0, 0, 9.8), "/imu2") for i in range(9)]
    bag = write_bag(tmp_path / "two", ros, second + marine_bag(mission, ros))
    with pytest.raises(ConfigError, match=r"/imu, /imu2; choose one with  --topic imu=/imu"):
        convert_rosbag(bag)
    got = convert_rosbag(bag, topics={"imu": "/imu"}, options=ON_ELLIPSOID)
    assert_same(got, mission)
    for topics, said in (
        ({"imu": "/imu3"}, "there is no topic /imu3; did you mean '/imu"),
        ({"imu": "/dvl"}, "/dvl holds marine_acoustic_msgs/msg/Dvl; for the imu expected"),
        ({"sonar": "/dvl"}, "unknown sensor"),
    ):
        with pytest.raises(ConfigError, match=said):
            convert_rosbag(bag, topics=topics)


Spoil = Callable[[Mission, Ros, Path], Path]


def no_dvl(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write a bag without DVL."""
    return write_bag(path, ros, imu_messages(mission, ros) + aid_messages(mission, ros))


def no_beam_speeds(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write what drivers send that know derived velocities only."""
    dvl = marine_messages(mission, ros, beam_velocities_valid=False)
    return write_bag(path, ros, imu_messages(mission, ros) + dvl)


def all_nan(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write an IMU that never measured."""
    imu = [ros.imu(time_s, [np.nan] * 3, (0, 0, 9.8)) for time_s in mission.imu.time_s[:9]]
    return write_bag(path, ros, imu + marine_messages(mission, ros))


def in_g(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write accelerations in g."""
    imu = [ros.imu(time_s, (0, 0, 0), (0, 0, 1.0)) for time_s in mission.imu.time_s[:9]]
    return write_bag(path, ros, imu + marine_messages(mission, ros))


def no_place(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write nothing that tells a place."""
    return write_bag(path, ros, imu_messages(mission, ros) + marine_messages(mission, ros))


def gauge(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write pressures relative to the atmosphere."""
    aids = aid_messages(mission, ros)
    for item in aids:
        if item.type_name == PRESSURE:
            item.message.fluid_pressure = 1e4
    return write_bag(path, ros, no_aids(mission, ros) + aids)


def other_clock(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write a DVL stamped by its own clock."""
    dvl = marine_messages(mission, ros)
    for item in dvl:
        item.message.header.stamp.sec -= EPOCH_S - 100
    return write_bag(path, ros, imu_messages(mission, ros) + dvl + aid_messages(mission, ros))


def truncated(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write a bag whose recording was cut off."""
    file = write_bag(path, ros, marine_bag(mission, ros)) / f"{path.name}.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return file


def truncated_db3(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write a database whose recording was cut off."""
    bag = write_bag(path, ros, marine_bag(mission, ros), StoragePlugin.SQLITE3)
    file = bag / f"{path.name}.db3"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return bag


def no_files(mission: Mission, ros: Ros, path: Path) -> Path:
    """Leave the metadata alone in their folder."""
    bag = write_bag(path, ros, no_aids(mission, ros)[:9])
    (bag / f"{path.name}.mcap").unlink()
    return bag


def bad_metadata(_: Mission, ros: Ros, path: Path) -> Path:
    """Write no metadata at all."""
    path.mkdir()
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [1, 2")
    assert ros
    return path


def other_bytes(mission: Mission, ros: Ros, path: Path) -> Path:
    """Write bytes under the name of a type that they are not."""
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        imu = writer.add_connection("/imu", IMU, typestore=ros.store)
        dvl = writer.add_connection("/dvl", WATER_LINKED, typestore=ros.store)
        for item in imu_messages(mission, ros)[:5]:
            writer.write(imu, item.nanoseconds, ros.store.serialize_cdr(item.message, IMU))
        for item in marine_messages(mission, ros)[:5]:
            writer.write(dvl, item.nanoseconds, ros.store.serialize_cdr(item.message, MARINE))
    return forget_definitions(path)


def other_definition(mission: Mission, ros: Ros, path: Path) -> Path:
    """Damage the recording's own definition of a type: it has a field of another name."""
    sent = imu_messages(mission, ros)[:9] + marine_messages(mission, ros)[:9]
    bag = write_bag(path, ros, sent)
    file = bag / f"{path.name}.mcap"
    own, other = b"Vector3 angular_velocity", b"Vector3 angular_velocitx"
    file.write_bytes(file.read_bytes().replace(own, other))
    return bag


def no_aids(mission: Mission, ros: Ros) -> list[Sent]:
    """Return IMU and DVL messages."""
    return imu_messages(mission, ros) + marine_messages(mission, ros)


@pytest.mark.parametrize(
    ("spoil", "error", "said"),
    [
        (no_dvl, DataError, r"no topic for the dvl; expected one of type .*; found .*/imu \("),
        (no_beam_speeds, DataError, "not one beam speed"),
        (all_nan, DataError, r"two messages for the imu, got 9, 9 refused: .*not finite"),
        (in_g, DataError, "the readings are in g"),
        (no_place, ConfigError, r"\[origin\]"),
        (gauge, DataError, "--atmosphere 0"),
        (other_clock, DataError, "expected one clock"),
        (truncated, DataError, "mcap recover"),
        (truncated_db3, DataError, "not a complete recording of ROS 2"),
        (no_files, DataError, "missing"),
        (bad_metadata, DataError, "YAML"),
        (other_bytes, DataError, "fit no known definition"),
        (other_definition, DataError, "no sensor_msgs/msg/Imu as it is known"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_malformed_bags(
    mission: Mission,
    ros: Ros,
    tmp_path: Path,
    spoil: Spoil,
    error: type[Exception],
    said: str,
) -> None:
    """Every defect ends in a message that says where, what was expected, and what to try."""
    bag = spoil(mission, ros, tmp_path / "bag")
    with pytest.raises(error, match=said) as caught:
        convert_rosbag(bag)
    assert str(bag) in str(caught.value)


def test_missing_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without rosbags the message says what to install."""

    def absent(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(rosbag_log, "import_module", absent)
    with pytest.raises(MissingExtraError, match=r"ssm-graph\[ros\]"):
        convert_rosbag(tmp_path)


def test_what_is_a_bag(tmp_path: Path) -> None:
    """A folder needs its metadata, MCAP the profile of ROS 2; a Blueye log has none."""
    assert not is_rosbag(tmp_path)
    assert not is_rosbag(tmp_path / "nothing.mcap")
    assert is_rosbag(tmp_path / "any.db3")
    for profile, expected in ((b"ros2", True), (b"ros1", False), (b"", False)):
        file = tmp_path / "file.mcap"
        header = bytes([len(profile), 0, 0, 0]) + profile + bytes(4)
        file.write_bytes(b"\x89MCAP0\r\n\x01" + bytes([len(header), *bytes(7)]) + header)
        assert is_rosbag(file) is expected


@pytest.fixture
def bag(mission: Mission, ros: Ros, tmp_path: Path) -> Path:
    """Write a bag for the command line."""
    return write_bag(tmp_path / "dive", ros, marine_bag(mission, ros))


def test_command_line(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One command makes a folder that reads; what was assumed is said."""
    words = ["convert", str(bag), "--out", str(tmp_path / "m"), "--surface-height", "0"]
    assert main([*words, "--topic", "imu=/imu", "--body", "FLU"]) == ExitCode.GOOD
    shown = capsys.readouterr().out
    assert "inertial samples" in shown
    assert "note: No --vehicle" in shown.replace("\n", " ")
    assert read_mission(tmp_path / "m").name == "dive"


def test_command_line_with_a_vehicle(mission: Mission, bag: Path, tmp_path: Path) -> None:
    """The constants come from a mission.toml without tables, and the mission is whole."""
    write_mission(tmp_path / "whole", mission)
    text = (tmp_path / "whole" / "mission.toml").read_text()
    (tmp_path / "vehicle.toml").write_text(text)
    words = ["convert", str(bag), "--out", str(tmp_path / "m"), "--surface-height", "0"]
    assert main([*words, "--vehicle", str(tmp_path / "vehicle.toml")]) == ExitCode.GOOD
    got = read_mission(tmp_path / "m")
    assert got.imu.noise.gyro_density == pytest.approx(mission.imu.noise.gyro_density)
    assert got.frame == mission.frame
    np.testing.assert_allclose(got.dvl.mount.lever_arm_b, mission.dvl.mount.lever_arm_b)
    np.testing.assert_allclose(got.dvl.mount.beams_d, mission.dvl.mount.beams_d)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--vehicle", "nowhere.toml"], ExitCode.USAGE, "nowhere.toml"),
        (["--topic", "imu=/imu3"], ExitCode.USAGE, "no topic /imu3"),
        (["--topic", "imu=/imu", "--topic", "imu=/imu"], ExitCode.USAGE, "each sensor once"),
        (["--water-density", "0"], ExitCode.USAGE, "--water-density"),
        (["--body", "FRD"], ExitCode.DATA, "--body FRD"),
    ],
)
def test_command_line_refuses(
    bag: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    code: ExitCode,
    said: str,
) -> None:
    """Wrong choices end before anything is written."""
    assert main(["convert", str(bag), "--out", str(tmp_path / "m"), *words]) == code
    assert said in capsys.readouterr().err
    assert not (tmp_path / "m").exists()


def test_options_of_bags_are_for_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A Blueye log knows its own axes."""
    words = ["convert", str(tmp_path / "x.mcap"), "--out", str(tmp_path / "m"), "--body", "FRD"]
    assert main(words) == ExitCode.USAGE
    assert "--body is for ROS bags" in capsys.readouterr().err


def test_defaults_are_plausible() -> None:
    """The assumed IMU is the one that the note names."""
    assert isinstance(NOISE, ImuNoise)
    assert np.degrees(NOISE.gyro_bias_sigma) * 3600.0 == pytest.approx(100.0, rel=0.02)
    assert np.degrees(NOISE.gyro_density) * 60.0 == pytest.approx(0.4, rel=0.05)
    assert NOISE.accel_bias_sigma / 9.80665e-3 == pytest.approx(5.0, rel=0.03)
    assert DvlMount(WATER_LINKED_BEAMS, np.eye(3), np.zeros(3)).beams_b[0, 2] > 0.9
