"""Nortek's packets by their documented layout: beams, geometry, units, damage at every length."""

from __future__ import annotations

import re
import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.inspection.look import inspect_path
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.nortek.nortek import read_nortek
from ssm_graph.io.nortek.packets import checksum, find_packets, is_nortek
from ssm_graph.live.recorded.log import read_recorded
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping, beams_from_angles
from ssm_graph.sensors.imu import ImuSample

BEGIN = datetime(2026, 5, 1, 10, 0, 0, tzinfo=UTC).timestamp()
DATE = (126, 4, 1, 10)
"""Years since 1900, months from 0."""
BEAMS = beams_from_angles(np.radians([45.0, -45.0, -135.0, 135.0]), np.radians(25.0))
THREE = beams_from_angles(np.radians([0.0, 120.0, 240.0]), np.radians(20.0))


def packet(kind: int, family: int, data: bytes, *, is_long: bool = False) -> bytes:
    """Return a packet with both checksums."""
    size = struct.pack("<IH" if is_long else "<HH", len(data), checksum(data))
    head = bytes([0xA5, 12 if is_long else 10, kind, family]) + size
    return head + struct.pack("<H", checksum(head)) + data


def test_the_checksum_is_the_documented_one() -> None:
    """B58C plus words, the odd byte above: by hand."""
    assert checksum(b"") == 0xB58C
    assert checksum(b"\x01\x02\x03\x04") == (0xB58C + 0x0201 + 0x0403) & 0xFFFF
    assert checksum(b"\x01\x02\x03") == (0xB58C + 0x0201 + 0x0300) & 0xFFFF


def dvl(
    k: int, velocity: Array, *, valid: int = 0xFFFFF, kind: int = 0x1B, is_long: bool = False
) -> bytes:
    """Return the report of a DVL of four beams with the velocity it made of them."""
    beams = BEAMS @ velocity
    x, y, z = velocity
    head = struct.pack("<BBI6BH", 3, 36, 100200, *DATE, k // 60, k % 60, 2500)
    head += struct.pack("<HIIfff", 4, 0, valid, 1500.0, 10.0, 5.0)
    numbers = [*beams, *(12.0, 12.5, 13.0, 13.5), *(0.004, 0.004, 0.005, 0.006)]
    numbers += [0.0] * 12 + [x, y, z, z] + [0.003] * 4 + [0.0] * 12
    return packet(kind, 0x16, head + struct.pack("<44f", *numbers), is_long=is_long)


def velocities(n: int) -> Array:
    """Return velocities (n, 3) that tell all directions apart."""
    t = np.arange(n)
    return np.column_stack([1.0 + 0.3 * np.sin(t), 0.4 * np.cos(t), 0.1 * np.sin(2.0 * t)])


def _file(folder: Path, data: bytes, name: str = "log.ad2cp") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def test_beams_of_a_dvl(tmp_path: Path) -> None:
    """Speeds, figures of merit, times, water track; the geometry is that of its own velocities."""
    v = velocities(20)
    parts = [dvl(k, v[k], is_long=k % 2 == 0) for k in range(20)]
    parts.append(dvl(30, v[0], kind=0x1D))
    parts.append(dvl(31, v[1], valid=0xFFFFF & ~0b0010))
    path = _file(tmp_path, b"$PNOR,text*00\r\n".join(parts) + b"\xa5")
    assert is_nortek(path.read_bytes())
    found = read_nortek(path)
    assert found.about.startswith("Nortek AD2CP, 22 packets, 22 reports of 4 beams, speeds in 100")
    pings = [m for m in found.messages if isinstance(m, Ping)]
    np.testing.assert_allclose([p.speed for p in pings[:20]], v @ BEAMS.T, atol=1e-6)
    np.testing.assert_allclose(pings[3].sigma or (), [0.004, 0.004, 0.005, 0.006], atol=1e-8)
    assert pings[1].time_s == BEGIN + 1.25
    assert [p.is_water for p in pings[-2:]] == [True, False]
    assert np.isnan(pings[-1].speed[1])
    told = re.search(r"beam_vectors = (\[\[.*?\]\])", " ".join(found.notes))
    assert told is not None
    rows = [float(x) for x in re.findall(r"-?\d+\.\d+", told[1])]
    np.testing.assert_allclose(np.reshape(rows, (4, 3)), BEAMS, atol=1e-4)


def adcp(k: int, speed_mm: list[int], *, coordinates: int = 2, compass: bool = True) -> bytes:
    """Return bottom track of an ADCP of four beams."""
    config = 1 << 5 | 1 << 8 | compass << 2
    head = struct.pack("<BBHI6BH", 1, 78, config, 100300, *DATE, 0, k, 0)
    head += struct.pack("<HHIHhhH", 15000, 1000, 5000, 9000, 0, 0, 4 << 12 | coordinates << 10)
    head += struct.pack("<HHBBH6hIHHbbhhIII", *[0] * 5, *[0] * 6, 0, 0, 0, -3, 0, 0, 0, 0, 0, k)
    assert len(head) == 78
    data = head + struct.pack("<4i", *speed_mm) + struct.pack("<4i", 12000, 12500, 0, 13500)
    return packet(0x17, 0x10, data)


def test_bottom_track_of_an_adcp(tmp_path: Path) -> None:
    """Integers with a scale, the compass; other coordinates are no beams."""
    path = _file(tmp_path, b"".join(adcp(k, [100, -200, 300, -32768]) for k in range(3)))
    found = read_nortek(path)
    pings = [m for m in found.messages if isinstance(m, Ping)]
    np.testing.assert_allclose(pings[0].speed, [0.1, -0.2, 0.3, np.nan])
    headings = [m for m in found.messages if isinstance(m, HeadingReading)]
    assert np.degrees(headings[0].heading) == pytest.approx(90.0)
    with pytest.raises(DataError, match="2 times bottom track is in coordinates of the instrument"):
        read_nortek(_file(tmp_path, b"".join(adcp(k, [1] * 4, coordinates=1) for k in range(2))))
    other = packet(0x15, 0x10, bytes(80))
    with pytest.raises(DataError, match=r"1 sound packets and no bottom track.*1 of kind 10/15"):
        read_nortek(_file(tmp_path, other))


def nucleus(kind: int, micro: int, body: bytes, *, valid: int = 0x7FFF, offset: int = 36) -> bytes:
    """Return a packet of a Nucleus with the common head, on the Unix clock."""
    time_s, micro = divmod(micro, 1_000_000)
    head = struct.pack("<BBBBIII", 1, offset, 1, 0, int(BEGIN) + time_s, micro, valid)
    return packet(kind, 0x20, head.ljust(offset, b"\0") + body)


def nucleus_log(rate_unit: float = 1.0) -> bytes:
    """Return half a minute of a Nucleus that turns: beams, inertial unit, heading."""
    parts = []
    v = velocities(30)
    for k in range(30):
        numbers = [*(THREE @ v[k]), 3.0, 3.1, 3.2, 0.01, 0.01, 0.02, *[0.0] * 6, *v[k], *[0.0] * 5]
        parts.append(nucleus(0xB4, 1_000_000 * k, struct.pack("<23f", *numbers)))
        for i in range(10):
            t = k + 0.1 * i
            rate = 0.2 * np.sin(0.3 * t)
            body = struct.pack("<7f", 0.0, 0.0, -9.81, 0.0, 0.0, rate * rate_unit, 20.0)
            parts.append(nucleus(0x82, round(1e6 * t), body, offset=16))
            heading = 0.2 / 0.3 * (1.0 - np.cos(0.3 * t))
            body = struct.pack("<3f", 0.0, 0.0, np.degrees(heading))
            parts.append(nucleus(0xD2, round(1e6 * t), body, offset=40))
    return b"".join(parts)


@pytest.mark.parametrize("unit", [1.0, 180.0 / np.pi])
def test_a_nucleus_is_beams_inertial_data_and_heading(tmp_path: Path, unit: float) -> None:
    """The unit of its gyros is that of which its heading turns as much."""
    found = read_nortek(_file(tmp_path, nucleus_log(unit), "log.nucleus"))
    pings = [m for m in found.messages if isinstance(m, Ping)]
    np.testing.assert_allclose([p.speed for p in pings], velocities(30) @ THREE.T, atol=1e-6)
    samples = [m for m in found.messages if isinstance(m, ImuSample)]
    assert len(samples) == 300
    np.testing.assert_allclose(
        [s.gyro_b[2] for s in samples], 0.2 * np.sin(0.03 * np.arange(300)), atol=1e-6
    )
    np.testing.assert_allclose(samples[7].accel_b, [0.0, 0.0, -9.81], atol=1e-6)


def test_convert_writes_tables_and_turns_the_sign(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A Nucleus has inertial data as well."""
    path = _file(tmp_path, nucleus_log(), "log.nucleus")
    assert main(["convert", str(path), "--out", str(tmp_path / "a")]) == 0
    out = capsys.readouterr().out
    assert "dvl.csv with 30 rows" in out
    assert "imu.csv with 300 rows" in out
    assert main(["convert", str(path), "--out", str(tmp_path / "b"), "--beams-against"]) == 0
    a, b = (
        np.genfromtxt(tmp_path / name / "dvl.csv", delimiter=",", skip_header=1)[:, 1:4]
        for name in "ab"
    )
    np.testing.assert_array_equal(a, -b)


def test_inspect_says_what_a_nucleus_lacks(tmp_path: Path) -> None:
    """It has beams and inertial data; a DVL alone has no inertial data."""
    (missing,) = inspect_path(_file(tmp_path, nucleus_log())).missing
    assert "--vehicle  makes a mission of it" in missing
    pings = b"".join(dvl(k, velocity) for k, velocity in enumerate(velocities(3)))
    (missing,) = inspect_path(_file(tmp_path, pings)).missing
    assert "it holds no inertial data" in missing


def test_a_nucleus_alone_is_a_mission(tmp_path: Path) -> None:
    """With a vehicle that says where it is and how good; other instruments lack inertial data."""
    vectors = [[round(float(x), 6) for x in row] for row in THREE]
    (tmp_path / "vehicle.toml").write_text(
        'format = 1\nname = "n"\n[frames]\nbody = "FRD"\n'
        "[origin]\nlat_deg = 45.0\nlon_deg = 7.0\nheight_m = 0\n"
        '[imu]\ninstrument = "BMI088"\n[dvl]\nbeam_noise_m_per_s = 0.01\n'
        f"beam_vectors = {vectors}\nlever_arm_m = [0, 0, 0]\nmounting_rpy_deg = [0, 0, 0]\n"
        "[heading]\nnoise_deg = 1.0\n"
    )
    path = _file(tmp_path, nucleus_log(), "log.nucleus")
    words = ["--vehicle", str(tmp_path / "vehicle.toml"), "--out", str(tmp_path / "out")]
    assert main(["convert", str(path), *words]) == 0
    mission = read_mission(tmp_path / "out")
    assert (len(mission.imu.time_s), len(mission.dvl.time_s)) == (300, 30)
    other = _file(tmp_path, dvl(1, velocities(2)[0]))
    assert main(["convert", str(other), *words, "--overwrite"]) == 2


def test_every_truncation_and_random_damage() -> None:
    """The whole packets before the cut; a changed byte costs its own packet and no other."""
    packets = [dvl(k, velocities(6)[k]) for k in range(5)]
    data, size = b"".join(packets), len(packets[0])
    for end in range(len(data) + 1):
        assert len(find_packets(data[:end]).packets) == end // size
    rng = np.random.default_rng(3)
    for _ in range(300):
        broken = bytearray(data)
        at = int(rng.integers(len(data)))
        broken[at] ^= int(rng.integers(1, 256))
        found = find_packets(bytes(broken))
        assert [bytes(p.data) for p in found.packets] == [
            one[10:] for k, one in enumerate(packets) if k != at // size
        ]


def test_a_clock_that_goes_back_and_two_instruments(tmp_path: Path) -> None:
    """One file is one instrument on one clock."""
    v = velocities(2)
    with pytest.raises(DataError, match="the clock goes from"):
        read_nortek(_file(tmp_path, dvl(9, v[0]) + dvl(3, v[1])))
    with pytest.raises(DataError, match="reports of 3 and 4 beams"):
        read_nortek(_file(tmp_path, nucleus_log() + dvl(40, v[0])))
    torn = _file(tmp_path, dvl(1, v[0])[:-3] + dvl(2, v[1]))
    found = read_recorded(torn)
    assert found is not None
    assert "1 damaged packets left out" in found.notes


def test_begins_of_long_packets_cost_no_more_than_packets() -> None:
    """Each of twenty thousand sound headers names data up to the end of the file, and is torn."""
    head = struct.pack("<BBBBIH", 0xA5, 12, 0x1B, 0x16, 600_000, 1)
    found = find_packets((head + struct.pack("<H", checksum(head))) * 20_000 + b"\1" * 600_000)
    assert (len(found.packets), found.n_damaged) == (0, 20_000)
