"""DVLs of one to eight beams in any directions, velocities with a covariance, zeros."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import rotation_zyx
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.assembly import mission_from
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of, write_vehicle
from ssm_graph.io.raw_log.log import RawLog, replay
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator.intake import Intake
from ssm_graph.live.protocols.json_messages import decode_message, encode_message
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import build_problem
from ssm_graph.mission.start.measured import body_velocities
from ssm_graph.sensors.dvl import DvlLog, Ping
from tests.mission_damage import lines, new_column, toml
from tests.mission_fixture import make_mission, write_example
from tests.unit.test_mission_roundtrip import assert_same

VELOCITY = np.array([0.8, 0.1, 0.05])


def directions(n_beams: int) -> Array:
    """Return unit vectors that look down, no two alike."""
    azimuth = 0.3 + 2.0 * np.pi * np.arange(n_beams) / n_beams
    level = np.linspace(0.3, 0.6, n_beams)
    down = np.sqrt(1.0 - level**2)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), down])


def with_beams(beams_d: Array, *, covariance: Array | None = None, seed: int = 0) -> Mission:
    """Return the example with a DVL that looks in these directions (B, 3)."""
    mission = make_mission()
    dvl = mission.dvl
    true_d = dvl.speed @ np.linalg.pinv(dvl.mount.beams_d).T
    true_d = np.where(np.isnan(true_d), VELOCITY, true_d)
    noise = 1e-3 * np.random.default_rng(seed).standard_normal((len(true_d), len(beams_d)))
    speed = true_d @ beams_d.T + noise
    sigma = np.full(speed.shape, 0.005)
    if covariance is not None:
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    log = DvlLog(
        mount=replace(dvl.mount, beams_d=beams_d, beam_scale_error=None),
        time_s=dvl.time_s,
        speed=speed,
        sigma=sigma,
        range_m=np.full(speed.shape, 20.0),
        covariance=covariance,
    )
    return replace(mission, dvl=log)


def covariances(count: int, *, seed: int = 1) -> Array:
    """Return covariances (count, 3, 3), m^2/s^2, whose axes lie anywhere."""
    roots = 0.01 * np.random.default_rng(seed).standard_normal((count, 3, 3))
    return np.asarray(roots @ np.swapaxes(roots, 1, 2) + 1e-6 * np.eye(3))


@pytest.mark.parametrize("n_beams", [1, 2, 3, 5, 8])
def test_every_way_takes_as_many_beams_as_the_mount_has(tmp_path: Path, n_beams: int) -> None:
    """Folder, vehicle file, JSON, raw log and intake; fewer than three are noted."""
    mission = with_beams(directions(n_beams))
    write_mission(tmp_path / "mission", mission)
    got = read_mission(tmp_path / "mission")
    assert_same(got, mission)
    words = "of three components of the velocity; the others come from the inertial sensors"
    assert [words in note for note in got.notes] == [True] * (n_beams < 3)
    vehicle = vehicle_of(mission)
    (tmp_path / "vehicle").mkdir()
    write_vehicle(tmp_path / "vehicle", vehicle)
    assert_same(read_vehicle(tmp_path / "vehicle").mount, vehicle.mount)
    pings = [message for message in messages_of(mission) if isinstance(message, Ping)]
    assert [decode_message(encode_message(ping).decode()) for ping in pings] == pings
    intake = Intake(vehicle, EventLog())
    with RawLog(tmp_path / "log", vehicle) as raw:
        for message in messages_of(mission):
            raw.append(message)
            intake.accept(message)
    assert [m for m in replay(tmp_path / "log", vehicle) if isinstance(m, Ping)] == pings
    assert_same(intake.buffers.mission(mission.frame).dvl.speed, mission.dvl.speed)
    other = Ping(pings[-1].time_s, (0.1,) * (n_beams + 1))
    assert intake.accept(other) is None
    assert intake.counts["dvl implausible"] == 1


def test_directions_have_to_measure_a_velocity(tmp_path: Path) -> None:
    """Three beams in a plane do not; a number of scale errors is that of the beams."""
    write_example(tmp_path)
    azimuths = "beam_azimuth_deg = [45, 135, 225, 315]"
    toml(azimuths, "beam_azimuth_deg = [45, 45, 225]")(tmp_path)
    with pytest.raises(ConfigError, match=r"in one plane .* expected three different directions"):
        read_mission(tmp_path)
    write_example(tmp_path)
    toml(azimuths, azimuths + "\nbeam_scale_error = [0.01, 0.0, 0.0]")(tmp_path)
    with pytest.raises(ConfigError, match="beam_scale_error: expected 4 numbers, one of each"):
        read_mission(tmp_path)
    write_example(tmp_path)
    toml(azimuths, "beam_azimuth_deg = [0, 120, 240]")(tmp_path)
    with pytest.raises(DataError, match="unknown column 'beam4_m_per_s'"):
        read_mission(tmp_path)


def test_a_velocity_counts_along_the_axes_of_its_covariance(tmp_path: Path) -> None:
    """As much as all of it tells together; a ping that lacks an axis by the marginal sigmas."""
    count = len(make_mission().dvl.time_s)
    mission = with_beams(np.eye(3), covariance=covariances(count))
    mission.dvl.speed.setflags(write=True)
    mission.dvl.speed[4, 1] = np.nan
    mission.dvl.speed.setflags(write=False)
    write_mission(tmp_path, mission)
    got = read_mission(tmp_path).dvl
    np.testing.assert_array_equal(got.covariance, mission.dvl.covariance)
    speed, sigma, beams_b = got.independent()
    rows = build_problem(mission).beams
    read = got.mount.beams_b
    for ping in (0, 7, count - 2):
        weighted = beams_b[ping] / sigma[ping][:, None]
        assert got.covariance is not None
        information = np.linalg.inv(got.covariance[ping])
        np.testing.assert_allclose(weighted.T @ weighted, read.T @ information @ read, rtol=1e-9)
        np.testing.assert_allclose(
            weighted.T @ (speed[ping] / sigma[ping]), read.T @ information @ got.speed[ping]
        )
        np.testing.assert_array_equal(rows.beam_b[rows.ping == ping], beams_b[ping])
        np.testing.assert_array_equal(rows.sigma[rows.ping == ping], sigma[ping])
    np.testing.assert_array_equal(sigma[4], got.sigma[4])
    np.testing.assert_array_equal(beams_b[4], read)


def test_ranges_tell_the_altitude() -> None:
    """Over a level bottom 12 m below, in any attitude, and of a beam alone; none of water."""
    mission = with_beams(directions(4))
    log = mission.dvl
    k = np.arange(len(log.time_s), dtype=np.float64)
    pitch, roll = np.asarray(0.2 * np.sin(k)), np.asarray(0.3 * np.cos(k))
    R_nb = rotation_zyx(0.1 * k, pitch, roll)
    beams_n = R_nb @ (log.mount.R_bd @ log.mount.beams_d.T)
    ranges = 12.0 / beams_n[:, 2]
    ranges[1, 1:] = np.nan
    ranges[2] = np.nan
    water = np.where(k == 3, 1.0, 0.0)
    found = replace(log, range_m=ranges, water_track=water).altitude(R_nb)
    np.testing.assert_allclose(found, np.where((k == 2) | (k == 3), np.nan, 12.0))
    assert np.isnan(replace(log, range_m=None).altitude()).all()


def test_what_is_no_covariance_is_refused(tmp_path: Path) -> None:
    """A correlation above one, and sigmas beside it."""
    count = len(make_mission().dvl.time_s)
    write_mission(tmp_path, with_beams(np.eye(3), covariance=covariances(count)))
    lines("dvl.csv", lambda rows: [*rows[:3], _beyond(rows[0], rows[3]), *rows[4:]])(tmp_path)
    with pytest.raises(DataError, match=r"dvl.csv:4: columns 'cov11_m2_per_s2'.*below 1"):
        read_mission(tmp_path)
    write_mission(tmp_path, with_beams(np.eye(3), covariance=covariances(count)))
    new_column("dvl.csv", "beam1_sigma_m_per_s", lambda _: "0.01")(tmp_path)
    with pytest.raises(DataError, match="'cov11_m2_per_s2' stand together"):
        read_mission(tmp_path)


def _beyond(header: str, row: str) -> str:
    cells = row.rstrip("\n").split(",")
    cells[header.rstrip("\n").split(",").index("cov12_m2_per_s2")] = "1.0"
    return ",".join(cells) + "\n"


def test_zeros_in_all_beams_are_no_lock_everywhere() -> None:
    """In a folder as in a log that was converted and in live pings; one zero is a reading."""
    mission = make_mission()
    speed = mission.dvl.speed.copy()
    speed[20:30], speed[40, 2] = 0.0, 0.0
    lost = replace(mission, dvl=replace(mission.dvl, speed=speed))
    labels = {name: name for name in ("imu", "dvl", "depth", "gnss")}
    logs = (lost.imu, lost.dvl, lost.depth, lost.gnss)
    made = mission_from(logs, None, source=Path("x.bag"), labels=labels)
    assert np.isnan(made.dvl.speed[20:30]).all()
    assert made.dvl.speed[40, 2] == 0.0
    assert any("10 of 60 pings hold exactly 0 in all beams" in note for note in made.notes)
    intake = Intake(vehicle_of(mission), EventLog())
    for message in messages_of(lost):
        intake.accept(message)
    assert intake.counts["dvl no_lock"] == 10
    kept = intake.buffers.mission(mission.frame).dvl.speed
    np.testing.assert_array_equal(np.isnan(kept), np.isnan(made.dvl.speed)[: len(kept)])


@pytest.mark.parametrize("n_beams", [3, 5])
def test_alignment_takes_any_beams_that_agree(n_beams: int) -> None:
    """Body velocities come of every ping, but for one that contradicts itself, if it can."""
    mission = with_beams(directions(n_beams))
    speed = mission.dvl.speed.copy()
    speed[5, 0] += 0.5
    mission = replace(mission, dvl=replace(mission.dvl, speed=speed))
    found = body_velocities(mission)
    kept = np.ones(len(speed), bool)
    kept[5] = n_beams == 3
    np.testing.assert_array_equal(found.time_s, mission.dvl.valid_s[kept])
