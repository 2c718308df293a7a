"""ArduPilot: a dataflash log by its documented layout, a .tlog by pymavlink, damage, the border."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.io.ardupilot.convert import convert_ardupilot, is_ardupilot
from ssm_graph.io.ardupilot.dataflash import read_dataflash
from ssm_graph.io.ardupilot.telemetry import read_telemetry
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.mission_folder.vehicle import vehicle_of, write_vehicle
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.dvl import DvlMount
from ssm_graph.simulation import scenario_config, simulate
from ssm_graph.smoothers.mission import smooth
from tests.water_linked_fixture import velocity_report

BOOT_US = 12_000_000
"""The mission's zero on the vehicle's clock."""
WEEK, WEEK_MS = 2400, 100_000_000
"""GPS time of the mission's zero."""
UNIX = 315_964_800.0 + 604_800.0 * WEEK + 1e-3 * WEEK_MS - 18.0
FORMATS = {
    "PARM": (65, "QNf", "TimeUS,Name,Value"),
    "IMU": (66, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "BARO": (67, "QBffcf", "TimeUS,I,Alt,Press,Temp,CRt"),
    "GPS": (68, "QBBIHBcLLe", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt"),
    "GPA": (69, "QBCCC", "TimeUS,I,VDop,HAcc,VAcc"),
    "VISO": (70, "Qffffffff", "TimeUS,dt,AngDX,AngDY,AngDZ,PosDX,PosDY,PosDZ,conf"),
}
PACKED = {"Q": "Q", "N": "16s", "f": "f", "B": "B", "c": "h", "C": "H", "I": "I", "H": "H"}
PACKED |= {"L": "i", "e": "i"}


def record(name: str, *fields: object) -> bytes:
    """Return one message, integers of scaled fields as they are stored."""
    kind, codes, _ = FORMATS[name]
    return b"\xa3\x95" + struct.pack("<B" + "".join(PACKED[c] for c in codes), kind, *fields)


def formats() -> bytes:
    """Return the records that say what the others are."""
    found = [b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type")]
    for name, (kind, codes, labels) in FORMATS.items():
        size = 3 + struct.calcsize("<" + "".join(PACKED[c] for c in codes))
        head = struct.pack(
            "<BB4s16s64s", kind, size, name.encode(), codes.encode(), labels.encode()
        )
        found.append(b"\xa3\x95\x80" + head)
    return b"".join(found)


@pytest.fixture(scope="module")
def mission() -> Mission:
    """Return a minute of the demo whose DVL is a velocity at the IMU."""
    return simulate(replace(scenario_config("demo"), duration_s=60.0)).mission


def velocities(m: Mission) -> tuple[Array, Array]:
    """Return times and velocities in body axes of whole pings whose beams agree."""
    whole = np.isfinite(m.dvl.speed).all(axis=1) & (
        m.dvl.mount.parity(m.dvl.speed, m.dvl.sigma) < 5
    )
    v_b = np.linalg.lstsq(m.dvl.mount.beams_b, m.dvl.speed[whole].T)[0].T
    return m.dvl.time_s[whole], np.asarray(v_b, np.float64)


def dataflash(m: Mission) -> bytes:
    """Return a mission as ArduPilot would have logged it, in order of time."""
    assert m.depth is not None
    assert m.gnss is not None
    rows: list[tuple[float, bytes]] = []

    def us(t: float) -> int:
        return round(1e6 * t) + BOOT_US

    for t, w, f in zip(m.imu.time_s, m.imu.gyro_b, m.imu.accel_b, strict=True):
        rows.append((t, record("IMU", us(t), 0, *w, *f)))
        rows.append((t, record("IMU", us(t), 1, *(-w), *f)))
    for t, z in zip(m.depth.time_s, m.depth.depth, strict=True):
        water = 100_000.0 + (z + 12.0) * 1000.0 * 9.80665  # the surface is 12 m above the ellipsoid
        rows.append((t, record("BARO", us(t), 0, 0.0, 101_000.0 + 500.0 * t, 2000, 0.0)))
        rows.append((t, record("BARO", us(t), 1, -z, water, 1500, 0.0)))
    g = m.gnss
    places = zip(g.time_s, np.degrees(g.lat), np.degrees(g.lon), g.height, strict=True)
    for t, lat, lon, height in places:
        ms = WEEK_MS + round(1e3 * t)
        place = (round(1e7 * lat), round(1e7 * lon), round(100 * height))
        rows.append((t, record("GPS", us(t), 0, 3, ms, WEEK, 12, 90, *place)))
        rows.append((t, record("GPA", us(t), 0, 100, 200, 300)))
    for t, v in zip(*velocities(m), strict=True):
        end = us(t + 0.05)
        rows.append((t + 0.05, record("VISO", end, 0.1, 0, 0, 0, *(0.1 * v), 80.0)))
        rows.append((t + 0.06, record("VISO", end + 9, 0.1, 0, 0, 0, 9.0, 9.0, 9.0, 0.0)))
    settings = {
        "BARO_PRIMARY": 1.0,
        "BARO_SPEC_GRAV": 1.0,
        "BARO2_GND_PRESS": 100_000.0,
        "VISO_POS_X": 0.3,
        "INS_POS1_X": 0.1,
    }
    head = b"".join(record("PARM", 0, name.encode(), value) for name, value in settings.items())
    rows.sort(key=lambda row: row[0])
    return formats() + head + b"".join(row for _, row in rows)


@pytest.fixture(scope="module")
def log(mission: Mission) -> bytes:
    """Return the bytes of the log."""
    return dataflash(mission)


def _file(folder: Path, data: bytes, name: str = "00000001.BIN") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def test_a_dataflash_log_becomes_its_mission(mission: Mission, log: bytes, tmp_path: Path) -> None:
    """UTC, IMU, depths of the barometer in the water, accuracy, velocities, lever arm."""
    path = _file(tmp_path, log)
    assert is_ardupilot(path)
    out = tmp_path / "out"
    mount = DvlMount(np.eye(3), np.eye(3), mission.dvl.mount.lever_arm_b)
    write_vehicle(tmp_path, replace(vehicle_of(mission), mount=mount, initial=None))
    words = ["convert", str(path), "--out", str(out), "--surface-height", "12"]
    words += ["--vehicle", str(tmp_path / "mission.toml")]
    assert main(words) == 0
    found = read_mission(out)
    np.testing.assert_allclose(found.imu.time_s - UNIX, mission.imu.time_s, atol=2e-6)
    np.testing.assert_allclose(found.imu.gyro_b, mission.imu.gyro_b, atol=1e-7)
    np.testing.assert_allclose(found.imu.accel_b, mission.imu.accel_b, atol=2e-6)
    time_s, v_b = velocities(mission)
    np.testing.assert_allclose(found.dvl.time_s - UNIX, time_s, atol=2e-6)
    np.testing.assert_allclose(found.dvl.speed, v_b, atol=1e-6)
    assert mission.depth is not None
    assert found.depth is not None
    assert found.gnss is not None
    np.testing.assert_allclose(found.depth.depth, mission.depth.depth, atol=2e-3)
    np.testing.assert_allclose(found.gnss.sigma_enu[:, 0], 2.0 / np.sqrt(2.0))
    estimate = smooth(found)
    assert estimate.status.is_good, estimate.reason
    alone = convert_ardupilot(path)
    np.testing.assert_allclose(alone.dvl.mount.lever_arm_b, [0.2, 0.0, 0.0], atol=1e-6)
    assert any("consumer MEMS unit" in note for note in alone.notes)


def test_beams_of_a_recording_beside_it(
    mission: Mission, log: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The DVL's own pings count and no movements; depths and fixes are those of the vehicle."""
    write_vehicle(tmp_path, replace(vehicle_of(mission), initial=None))
    pings = zip(mission.dvl.time_s + UNIX, mission.dvl.speed, strict=True)
    recording = tmp_path / "dvl.json"
    recording.write_text("".join(f"{velocity_report(*one)}\n" for one in pings))
    logs = [str(_file(tmp_path, log)), str(recording)]
    words = ["--vehicle", str(tmp_path / "mission.toml"), "--out", str(tmp_path / "out")]
    assert main(["convert", *logs, *words, "--surface-height", "12"]) == 0, capsys.readouterr().err
    assert "VISO: movements left out" in " ".join(capsys.readouterr().out.split())
    found = read_mission(tmp_path / "out")
    np.testing.assert_array_equal(found.dvl.speed, mission.dvl.speed)
    np.testing.assert_allclose(found.imu.time_s - UNIX, mission.imu.time_s, atol=2e-6)
    assert mission.depth is not None
    assert mission.gnss is not None
    assert found.depth is not None
    assert found.gnss is not None
    np.testing.assert_allclose(found.depth.depth, mission.depth.depth, atol=2e-3)
    assert len(found.gnss.time_s) == len(mission.gnss.time_s)
    assert main(["convert", logs[1], logs[1], *words, "--overwrite"]) != 0
    assert "or one log of ArduPilot, among the files, got 0" in capsys.readouterr().err


def test_a_log_of_a_vehicle_with_beams_is_refused(
    log: bytes, tmp_path: Path, mission: Mission
) -> None:
    """Movements are no beams; without movements there is nothing to aid with."""
    with pytest.raises(ConfigError, match="movements and no beams: expected"):
        convert_ardupilot(_file(tmp_path, log), vehicle=vehicle_of(mission))
    others = formats() + record("IMU", 1, 0, 0, 0, 0, 0, 0, -9.8)
    with pytest.raises(DataError, match="no message VISO, movements of a DVL; it has IMU"):
        convert_ardupilot(_file(tmp_path, others))


def test_damage_costs_the_damaged_records_alone() -> None:
    """Every truncation, and bytes that are lost or changed, leave the others as they were."""
    rows = [record("IMU", k, 0, 0.5 * k, 0, 0, 0, 0, -9.8) for k in range(12)]
    head, body = formats(), b"".join(rows)
    size = len(rows[0])
    for end in range(len(body) + 1):
        found = read_dataflash(head + body[:end], ["IMU"])
        times = found.messages.get("IMU", {"TimeUS": np.zeros(0)})["TimeUS"]
        np.testing.assert_array_equal(times, np.arange(end // size))
        assert found.n_skipped == end % size
    rng = np.random.default_rng(5)
    for _ in range(50):
        broken = bytearray(body)
        at = int(rng.integers(len(broken)))
        del broken[at : at + int(rng.integers(1, 60))]
        columns = read_dataflash(head + bytes(broken), ["IMU"]).messages["IMU"]
        kept = columns["TimeUS"] * 0.5 == columns["GyrX"]
        assert kept.sum() >= 12 - 4
        assert (~kept).sum() <= 1  # bytes without a checksum: one record may be of two


def tlog(m: Mission) -> bytes:
    """Return a mission as a ground station records it, by pymavlink."""
    dialect = import_module("pymavlink.dialects.v20.ardupilotmega")
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    rows: list[tuple[float, bytes]] = []
    rng = np.random.default_rng(1)

    def put(t: float, message: object, *, clock: object = sender) -> None:
        late = 0.02 + abs(rng.normal(scale=0.01))
        frame = message.pack(clock)  # type: ignore[attr-defined]
        rows.append((t + late, struct.pack(">Q", round(1e6 * (UNIX + t + late))) + bytes(frame)))

    for t, w, f in zip(m.imu.time_s[::5], m.imu.gyro_b[::5], m.imu.accel_b[::5], strict=True):
        us = round(1e6 * t) + BOOT_US
        put(t, dialect.MAVLink_highres_imu_message(us, *f, *w, 0, 0, 0, 0, 0, 0, 0, 0))
    assert m.gnss is not None
    for t, lat, lon in zip(m.gnss.time_s, m.gnss.lat, m.gnss.lon, strict=True):
        us = round(1e6 * t) + BOOT_US
        place = (round(1e7 * np.degrees(lat)), round(1e7 * np.degrees(lon)), 12_000)
        put(t, dialect.MAVLink_gps_raw_int_message(us, 3, *place, 90, 90, 0, 0, 12))
    for t, v in zip(*velocities(m), strict=True):
        moved = [float(0.1 * x) for x in v]
        put(
            t + 0.05,
            dialect.MAVLink_vision_position_delta_message(0, 100_000, [0, 0, 0], moved, 80.0),
        )
    return b"".join(row for _, row in sorted(rows, key=lambda row: row[0]))


def test_a_telemetry_log_by_the_makers_library(mission: Mission, tmp_path: Path) -> None:
    """Times without the jitter of the radio, the same readings; garbage between is skipped."""
    pytest.importorskip("pymavlink")
    data = tlog(mission)
    path = _file(tmp_path, data + b"\x00\x05garbage", "flight.tlog")
    found = convert_ardupilot(path)
    np.testing.assert_allclose(np.diff(found.imu.time_s), 0.05, atol=1e-4)
    assert abs(found.imu.time_s[0] - UNIX - mission.imu.time_s[0]) < 0.025
    np.testing.assert_allclose(found.imu.accel_b, mission.imu.accel_b[::5], atol=2e-6)
    np.testing.assert_allclose(found.dvl.speed, velocities(mission)[1], atol=1e-6)
    assert any("bytes of no sound record" in note for note in found.notes)


def test_damage_of_telemetry_costs_the_damaged_frames_alone(mission: Mission) -> None:
    """Frames have a checksum: cut at every length or with bytes changed, what is left is sound."""
    pytest.importorskip("pymavlink")
    data = tlog(mission)
    first = 20 + data[9]  # eight bytes of time, twelve around a frame
    ends = [first, first + 20 + data[first + 9]]
    whole, _ = read_telemetry(data)
    for end in range(ends[1] + 1):
        found, n_skipped = read_telemetry(data[:end])
        n_rows = sum(len(columns["TimeUS"]) for columns in found.values())
        assert n_rows == sum(end >= of for of in ends)
        assert n_skipped == end - max([0, *(of for of in ends if of <= end)])
    rng = np.random.default_rng(6)
    for _ in range(10):
        broken = bytearray(data)
        for at in rng.integers(len(broken), size=40):
            broken[at] ^= 1 + int(rng.integers(255))
        found, n_skipped = read_telemetry(bytes(broken))
        assert n_skipped > 0
        readings = np.stack([found["IMU"][name] for name in ("GyrX", "AccZ")], axis=1)
        known = np.stack([whole["IMU"][name] for name in ("GyrX", "AccZ")], axis=1)
        assert len(known) - 40 <= len(readings) < len(known)
        assert {tuple(row) for row in readings} <= {tuple(row) for row in known}


def test_other_bytes_are_none(tmp_path: Path) -> None:
    """Neither text nor a bare frame."""
    heads: Iterable[bytes] = (b"time_s,x\n", b"\xfd\x00\x00" + bytes(20), b"")
    for head in heads:
        assert not is_ardupilot(_file(tmp_path, head))


def test_formats_that_are_not_those_of_ardupilot(tmp_path: Path) -> None:
    """Fields under other names are said; a format without names, and one of formats, count not."""
    size = 3 + struct.calcsize("<If")
    old = struct.pack("<BB4s16s64s", 66, size, b"IMU", b"If", b"TimeMS,GyrX")
    rows = b"".join(b"\xa3\x95\x42" + struct.pack("<If", k, 0.0) for k in range(3))
    visual = record("VISO", 1, *[0.1] * 8)
    log = _file(tmp_path, formats() + b"\xa3\x95\x80" + old + rows + visual)
    with pytest.raises(DataError, match="message IMU has no number 'TimeUS', it has TimeMS, GyrX"):
        convert_ardupilot(log)
    for kind, labels in ((66, b"A,"), (128, b"A,B")):
        strange = struct.pack("<BB4s16s64s", kind, size, b"IMU", b"If", labels)
        found = read_dataflash(formats() + b"\xa3\x95\x80" + strange + visual, ["IMU", "VISO"])
        assert found.n_records == len(FORMATS) + 3
        assert len(found.messages["VISO"]["dt"]) == 1
