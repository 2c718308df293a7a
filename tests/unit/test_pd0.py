"""PD0: beams of every coordinate system, signs by a real track, damage of every kind."""

from __future__ import annotations

import os
import re
import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.io.teledyne.ensembles import find_ensembles, is_pd0
from ssm_graph.io.teledyne.pd0 import read_pd0
from ssm_graph.live.recorded.log import read_recorded
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping

REAL = Path(os.environ.get("SSM_GRAPH_DATA", "../shared/data")) / "pd0"
BEGIN = datetime(2026, 5, 1, 10, 0, 0, tzinfo=UTC).timestamp()
ANGLE = np.radians(30.0)
BEAMS = np.column_stack(
    [np.sin(ANGLE) * np.array([[0, -1], [0, 1], [1, 0], [-1, 0]]), np.full(4, np.cos(ANGLE))]
)
"""Forward, right, down of beams 1 to 4 of a unit that looks down, beam 3 forward."""


def ensemble(
    number: int,
    bottom_m_per_s: Array,
    *,
    coordinates: int = 0,
    attitude_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    alignment_deg: float = 0.0,
    is_up: bool = False,
    with_bottom: bool = True,
) -> bytes:
    """Return a sound ensemble as an instrument writes it; attitude is heading, pitch, roll."""
    fixed = bytearray(59)
    fixed[4] = 0x08 | (0x80 if is_up else 0)
    fixed[5], fixed[8], fixed[25], fixed[31], fixed[58] = 0x42, 4, coordinates << 3 | 4, 0x3D, 30
    struct.pack_into("<h", fixed, 26, round(100 * alignment_deg))
    variable = bytearray(65)
    struct.pack_into("<HH", variable, 0, 0x0080, number)
    variable[4:11] = bytes([26, 5, 1, 10, number // 60, number % 60, 25])
    heading, pitch, roll = attitude_deg
    struct.pack_into(
        "<Hhh", variable, 18, round(100 * heading), round(100 * pitch), round(100 * roll)
    )
    variable[57:65] = bytes([20, 26, 5, 1, 10, number // 60, number % 60, 25])
    bottom = bytearray(81)
    struct.pack_into("<H", bottom, 0, 0x0600)
    struct.pack_into("<4H", bottom, 16, 1000, 1100, 1200, 0)
    known = [-32768 if np.isnan(v) else round(1000 * v) for v in bottom_m_per_s]
    struct.pack_into("<4h", bottom, 24, *known)
    bottom[77] = 1
    parts = [bytes(fixed), bytes(variable), *([bytes(bottom)] if with_bottom else [])]
    offsets, at = [], 6 + 2 * len(parts)
    for part in parts:
        offsets.append(at)
        at += len(part)
    head = struct.pack("<2sHBB", b"\x7f\x7f", at, 0, len(parts))
    data = head + struct.pack(f"<{len(parts)}H", *offsets) + b"".join(parts)
    return data + struct.pack("<H", sum(data) & 0xFFFF)


def written(tmp_path: Path, *ensembles: bytes, between: bytes = b"") -> Path:
    """Return a file of ensembles."""
    path = tmp_path / "log.pd0"
    path.write_bytes(between + between.join(ensembles))
    return path


def pings_of(path: Path) -> list[Ping]:
    """Return the pings of a file."""
    return [message for message in read_pd0(path).messages if isinstance(message, Ping)]


def test_beam_coordinates_are_taken_as_they_are(tmp_path: Path) -> None:
    """Speeds, times and headings; NMEA between the ensembles is skipped."""
    speeds = np.array([0.1, -0.2, 0.3, np.nan])
    all_of = [ensemble(k, speeds, attitude_deg=(37.25, 0.0, 0.0)) for k in range(3)]
    path = written(tmp_path, *all_of, between=b"$GPGGA,1*00\r\n\x7f\x7f")
    assert is_pd0(path.read_bytes())
    found = read_pd0(path)
    assert found.about == "Teledyne PD0, 3 ensembles, beam coordinates, bottom track in 100 %"
    ping, heading = found.messages[2:4]
    assert isinstance(ping, Ping)
    assert isinstance(heading, HeadingReading)
    np.testing.assert_array_equal(ping.speed, speeds)
    assert ping.time_s == BEGIN + 1.25
    assert np.degrees(heading.heading) == pytest.approx(37.25)
    e = find_ensembles(path.read_bytes()).ensembles[0]
    # The fourth range is only in its most significant byte's neighbour: none; the first has 2^16.
    np.testing.assert_array_equal(e.bottom_range_m, [665.36, 11.0, 12.0, np.nan])


@pytest.mark.parametrize("coordinates", [1, 2, 3])
def test_beams_are_restored_from_other_coordinates(tmp_path: Path, coordinates: int) -> None:
    """A vehicle that moves and is tilted: the speeds along the beams are those of its velocity.

    The velocity of the bottom in ship and earth axes is made here by rotations of its own.
    """
    from scipy.spatial.transform import Rotation

    heading, pitch, roll, alignment = 250.0, 4.0, -7.0, 45.0 if coordinates == 2 else 0.0
    velocity = np.array([1.2, -0.3, 0.1])  # forward, right, down of the instrument
    # The gimbal's pitch, which the instrument measures, from that of the rotation.
    gimbal = np.degrees(np.arctan(np.tan(np.radians(pitch)) / np.cos(np.radians(roll))))
    turn = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True)
    north_east_down = turn.apply(velocity)
    level = Rotation.from_euler("ZYX", [alignment, pitch, roll], degrees=True).apply(velocity)
    bottom = {
        1: -np.array([velocity[1], velocity[0], -velocity[2]]),
        2: -np.array([level[1], level[0], -level[2]]),
        3: -np.array([north_east_down[1], north_east_down[0], -north_east_down[2]]),
    }[coordinates]
    data = ensemble(
        1,
        np.append(bottom, 0.0),
        coordinates=coordinates,
        attitude_deg=(heading, gimbal, roll),
        alignment_deg=alignment,
    )
    (ping,) = pings_of(written(tmp_path, data))
    np.testing.assert_allclose(ping.speed, BEAMS @ velocity, atol=2e-3)


def test_what_cannot_be_restored_is_counted(tmp_path: Path) -> None:
    """Three beams make no error velocity: the ping has no speed, and a note says how many."""
    lacking = ensemble(1, np.array([0.1, 0.2, 0.3, np.nan]), coordinates=3)
    found = read_pd0(written(tmp_path, lacking, ensemble(2, np.full(4, 0.1), coordinates=3)))
    assert any(note.startswith("1 pings without an error velocity") for note in found.notes)
    assert np.isnan(pings_of(tmp_path / "log.pd0")[0].speed).all()


def test_files_of_no_use_are_refused_with_the_cause(tmp_path: Path) -> None:
    """Up, without bottom track, of two settings, of a clock that falls, of nothing."""
    v = np.full(4, 0.1)
    cases = {
        "looks up": (ensemble(1, v, is_up=True),),
        "without bottom track": (ensemble(1, v, with_bottom=False),),
        "2 different settings": (ensemble(1, v), ensemble(2, v, coordinates=3)),
        "expected increasing times": (ensemble(2, v), ensemble(1, v)),
        "no sound PD0 ensemble": (ensemble(1, v)[:-1] + b"\x00",),
    }
    for cause, ensembles in cases.items():
        with pytest.raises(DataError, match=cause):
            read_pd0(written(tmp_path, *ensembles))
    mixed = (ensemble(1, v), ensemble(2, v, is_up=True), ensemble(3, v))
    assert "1 ensembles that look up are left out" in read_pd0(written(tmp_path, *mixed)).notes
    with pytest.raises(DataError, match="cannot be read"):
        read_pd0(tmp_path)


def changed(whole: bytes, part: int, offset: int, *values: int, kind: str = "B") -> bytes:
    """Return an ensemble with other bytes in one of its parts, and the checksum of those."""
    data = bytearray(whole)
    (size,) = struct.unpack_from("<H", data, 2)
    (begin,) = struct.unpack_from("<H", data, 6 + 2 * part)
    struct.pack_into(f"<{len(values)}{kind}", data, begin + offset, *values)
    struct.pack_into("<H", data, size, sum(data[:size]) & 0xFFFF)
    return bytes(data)


def test_instruments_that_are_set_otherwise(tmp_path: Path) -> None:
    """Three beams, no angle, no date, nothing seen: read as far as that is right, or the cause."""
    sound = [ensemble(k, np.array([0.1, -0.2, 0.3, 0.4])) for k in range(4)]
    three = [changed(one, 0, 8, 3) for one in sound]
    assert [len(ping.speed) for ping in pings_of(written(tmp_path, *three))] == [3] * 4
    assert "azimuths are not told" in read_pd0(written(tmp_path, *three)).notes[0]
    twice = read_pd0(written(tmp_path, *sound, sound[-1]))
    assert "1 pings of a time that an earlier one has were left out" in twice.notes
    assert twice.about.endswith("in 100 %")
    undated = changed(changed(sound[0], 1, 4, *[0] * 7), 1, 57, *[0] * 8)
    assert "1 ensembles whose clock has no date" in "".join(
        read_pd0(written(tmp_path, undated, *sound)).notes
    )
    no_angle = [changed(changed(one, 0, 5, 0x43), 0, 58, 0) for one in sound]
    cases = {
        "the angle of the beams is not told": no_angle,
        "the instrument's clock is not set": [undated],
        "3 beams in earth coordinates": [
            changed(ensemble(1, np.full(4, 0.1), coordinates=3), 0, 8, 3)
        ],
        "beam angle 30.0 and 25.0, from ensemble 3 on": [*sound[:3], changed(sound[3], 0, 58, 25)],
    }
    for cause, ensembles in cases.items():
        with pytest.raises(DataError, match=re.escape(cause)):
            read_pd0(written(tmp_path, *ensembles))


def test_a_recording_that_never_saw_the_bottom_says_so(tmp_path: Path) -> None:
    """Of any maker: its pings stay, for what else they hold, and the first note says it."""
    blind = [changed(ensemble(k, np.ones(4)), 2, 24, *[-32768] * 4, kind="h") for k in range(4)]
    restored = [ensemble(k, np.array([0.1, 0.2, 0.3, np.nan]), coordinates=1) for k in range(4)]
    notes: dict[str, tuple[str, ...]] = {}
    for name, ensembles in {"blind": blind, "restored": restored}.items():
        found = read_recorded(written(tmp_path, *ensembles))
        assert found is not None
        notes[name] = found.notes
        assert found.notes[0].startswith("4 pings and not one speed along a beam")
    assert any("made of three beams" in note for note in notes["restored"])


def test_every_truncation_and_any_damage_leaves_the_sound_ensembles(tmp_path: Path) -> None:
    """Cut at every length, or with bytes changed: what is whole is found, the rest is counted."""
    of = [ensemble(k, np.full(4, 0.01 * k)) for k in range(4)]
    data = b"".join(of)
    size = len(of[0])
    for length in range(len(data) + 1):
        found = find_ensembles(data[:length])
        assert len(found.ensembles) == length // size
    rng = np.random.default_rng(11)
    for _ in range(300):
        damaged = bytearray(data)
        at = rng.integers(len(data), size=rng.integers(1, 4))
        for place in at:
            damaged[place] ^= int(rng.integers(1, 256))
        hit = len({int(place) // size for place in at})
        found = find_ensembles(bytes(damaged))
        # Two changes of one ensemble may cancel in its sum; what was not hit is always found.
        assert len(found.ensembles) >= len(of) - hit
        assert all(e.number < 65536 * 256 for e in found.ensembles)
    path = written(tmp_path, of[0], of[1][:-7], of[2])
    assert "1 damaged ensembles left out" in read_pd0(path).notes


def test_begins_of_long_ensembles_cost_no_more_than_ensembles() -> None:
    """Each of twenty thousand plausible headers names 64 kB that have another checksum."""
    head = b"\x7f\x7f" + struct.pack("<HBBHH", 65_000, 0, 2, 10, 40)
    found = find_ensembles(head * 20_000)
    assert (found.ensembles, found.n_damaged) == ((), 20_000)


@pytest.mark.skipif(not REAL.is_dir(), reason="no real PD0 files: set SSM_GRAPH_DATA")
def test_the_signs_are_those_of_a_real_track() -> None:
    """A RiverPro's own GNSS: dead reckoning by beams and compass stays within 2 m rms of it.

    One number is found by the track: what the compass reads beside the boat's heading.
    """
    data = (REAL / "RiverPro_test01.PD0").read_bytes()
    messages = read_pd0(REAL / "RiverPro_test01.PD0").messages
    pings = [m for m in messages if isinstance(m, Ping)]
    headings = np.array([m.heading for m in messages if isinstance(m, HeadingReading)])
    starts, at = [], 0
    while at < len(data):
        starts.append(at)
        at += struct.unpack_from("<H", data, at + 2)[0] + 2
    sound = find_ensembles(data).ensembles
    assert len(sound) == len(pings) == 273
    place = {}
    for found in re.finditer(rb"\$GPGGA\0[\d.]{9}\0(.{8})N(.{8})W", data, flags=re.DOTALL):
        row = sum(start < found.start() for start in starts) - 1
        lat_deg, west_deg = struct.unpack("<dd", found[1] + found[2])
        place[row] = np.radians([lat_deg, -west_deg])
    rows = np.array([row for row in place if row < len(pings)])
    lat, lon = np.array([place[row] for row in rows]).T
    track = 6371e3 * np.column_stack([np.cos(lat[0]) * (lon - lon[0]), lat - lat[0]])
    angle = np.radians(20.0)
    beams = np.column_stack(
        [np.sin(angle) * np.array([[0, -1], [0, 1], [1, 0], [-1, 0]]), np.full(4, np.cos(angle))]
    )
    speed = np.array([ping.speed for ping in pings])
    good = np.isfinite(speed).all(axis=1)
    good[good] &= np.abs(speed[good] @ [1.0, 1.0, -1.0, -1.0]) < 0.2
    time_s = np.array([ping.time_s for ping in pings])
    body = speed[good] @ np.linalg.pinv(beams).T
    body = np.column_stack([np.interp(time_s, time_s[good], body[:, i]) for i in range(2)])

    def rms_m(offset: float) -> float:
        h = headings + offset
        east = body[:, 0] * np.sin(h) + body[:, 1] * np.cos(h)
        north = body[:, 0] * np.cos(h) - body[:, 1] * np.sin(h)
        steps = np.column_stack([east, north]) * np.diff(time_s, prepend=time_s[0])[:, None]
        off = np.cumsum(steps, axis=0)[rows] - track
        return float(np.sqrt(np.mean(np.sum((off - off.mean(axis=0)) ** 2, axis=1))))

    assert min(rms_m(float(np.radians(k))) for k in range(-180, 180)) < 2.0


def test_a_recording_becomes_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the command, with what mission.toml has to say; inspect names it by its content."""
    speeds = np.array([0.1, -0.2, 0.3, np.nan])
    log = written(tmp_path, *(ensemble(k, speeds) for k in range(5)))
    assert main(["convert", str(log), "--out", str(tmp_path / "m")]) == 0
    shown = capsys.readouterr().out
    assert "dvl.csv with 5 rows, heading.csv with 5 rows" in shown
    assert "beam_vectors = [[0.00000, -0.50000, 0.86603]" in shown
    row = (tmp_path / "m" / "dvl.csv").read_text().splitlines()[1].split(",")
    assert [float(cell) for cell in row[1:4]] == [0.1, -0.2, 0.3]
    assert main(["inspect", str(log)]) == 4
    assert "Teledyne PD0, 5 ensembles, beam coordinates" in capsys.readouterr().out


@pytest.mark.skipif(not REAL.is_dir(), reason="no real PD0 files: set SSM_GRAPH_DATA")
def test_a_ship_moves_along_its_forward_beam() -> None:
    """Speeds are positive along the beam: of a ship under way beam 3 reads ahead, beam 4 astern."""
    speed = np.array([ping.speed for ping in pings_of(REAL / "vmdas02_os.ENR")])
    forward = (speed[:, 2] - speed[:, 3]) / (2.0 * np.sin(ANGLE))
    assert np.nanmedian(forward) > 4.0


@pytest.mark.skipif(not REAL.is_dir(), reason="no real PD0 files: set SSM_GRAPH_DATA")
def test_a_published_decode_says_the_same() -> None:
    """Bottom track, attitude and times of an AUV's file beside the values published with it."""
    text = (REAL / "adcp_auv_51.yml").read_text()
    found = find_ensembles((REAL / "adcp_auv_51.pd0").read_bytes()).ensembles
    down = [e for e in found if not e.setup.is_up]
    assert len(down) == 26
    assert {(e.setup.beam_angle_deg, e.setup.coordinates) for e in found} == {(30.0, "ship")}
    by_number = {e.number: e for e in found}
    blocks = text.split("- _index:")
    seen, bottoms = 0, []
    for block in blocks:
        told = {
            name: float(value)
            for name, value in re.findall(r"^    (\w+): (-?[\d.]+)\s*$", block, flags=re.MULTILINE)
        }
        if "bt_starboard_velocity" in told:
            # The decode calls the file's first forward; the vehicle's way is along the second.
            names = [f"{way}_velocity" for way in ("forward", "starboard", "vertical", "error")]
            ranges = [told[f"bt_beam{beam}_range"] / 100.0 for beam in (1, 2, 3, 4)]
            bottoms.append(([told[f"bt_{name}"] / 1000.0 for name in names], ranges))
        e = by_number.get(int(told.get("ensemble_number", -1)))
        if e is None or "heading" not in told:
            continue
        assert e.heading_deg == pytest.approx(told["heading"] / 100.0)
        assert e.pitch_deg == pytest.approx(told["pitch"] / 100.0)
        # Seconds since 1900 there, since 1970 here.
        unix_s = told["internal_timestamp"] - 2208988800.0
        assert unix_s == pytest.approx(e.unix_s, abs=0.006)
        seen += 1
    assert seen > 0
    ours = [e for e in found if e.bottom is not None]
    assert len(bottoms) == len(ours)
    for (velocity, ranges), e in zip(bottoms, ours, strict=True):
        assert e.bottom is not None
        np.testing.assert_allclose(np.nan_to_num(e.bottom, nan=-32.768), velocity, atol=1e-9)
        np.testing.assert_allclose(np.nan_to_num(e.bottom_range_m), ranges, atol=1e-9)
