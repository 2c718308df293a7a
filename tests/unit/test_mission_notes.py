"""What is odd and may yet be right loads, and leaves a note; a sound mission leaves none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.folder import read_mission
from tests.mission_damage import (
    ACCEL,
    BEAMS,
    GYRO,
    Damage,
    both,
    cell,
    columns,
    drop_section,
    lines,
    new_column,
    raw,
    remove,
    rolling,
    toml,
)
from tests.mission_fixture import write_example


def notes_after(folder: Path, *changes: Damage) -> tuple[str, ...]:
    """Write the example, change it, read it and return its notes."""
    write_example(folder)
    both(*changes)(folder)
    return read_mission(folder).notes


def hold(speed: Array) -> Array:
    """Let the third beam hold its value for 25 pings."""
    speed[20:45, 2] = speed[20, 2]
    return speed


def repeat_two(speed: Array) -> Array:
    """Repeat two of the pings."""
    speed[11], speed[31] = speed[10], speed[30]
    return speed


def turn(speed: Array) -> Array:
    """Turn the vehicle between forward and starboard motion, so that beams can be told apart."""
    angle = np.linspace(0.0, 2.0 * np.pi, len(speed))
    azimuth = np.radians([45.0, 135.0, 225.0, 315.0])
    noise = speed - speed[:1]
    return np.asarray(0.75 * np.cos(angle[:, None] - azimuth) + 0.01 * noise)


ODD: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "accelerometer 1 % low": (
        columns("imu.csv", ACCEL, lambda f: 0.99 * f),
        ("imu.csv", "1.0 % below gravity", "accel_bias_ug"),
    ),
    "vehicle on its side": (
        columns("imu.csv", ACCEL, lambda f: f[:, [0, 2, 1]]),
        ("imu.csv", "'accel_z_m_per_s2'", "another axis"),
    ),
    "short gap": (
        lines("imu.csv", lambda rows: rows[:400] + rows[420:]),
        (
            "imu.csv",
            "1 gaps",
            "longest 1.050 s after 19.950 s",
            "bridged by the mean of the readings on both sides",
        ),
    ),
    "readings repeated": (
        columns("imu.csv", [*GYRO, *ACCEL], lambda v: v[(np.arange(len(v)) // 2) * 2]),
        ("imu.csv", "50 % of the rows repeat"),
    ),
    "gyro bias": (
        columns("imu.csv", GYRO, lambda w: w + np.array([0.03, -0.02, 0.0])),
        ("imu.csv", "6192, -4135, -0 deg/h about x, y, z more than the vehicle tilts"),
    ),
    "stamped at arrival": (
        columns(
            "imu.csv", ["time_s"], lambda t: t + 0.03 * np.random.default_rng(0).random(t.shape)
        ),
        ("imu.csv", "scatter by", "times of arrival"),
    ),
    "no newline at the end": (
        raw("dvl.csv", lambda content: content.rstrip()),
        ("dvl.csv", "no newline"),
    ),
    "no pings": (lines("dvl.csv", lambda rows: rows[:1]), ("dvl.csv", "no rows")),
    "no bottom lock": (
        columns("dvl.csv", BEAMS, lambda v: np.full_like(v, np.nan)),
        ("dvl.csv", "no beam ever had bottom lock"),
    ),
    "few repeats": (
        columns("dvl.csv", BEAMS, repeat_two),
        ("dvl.csv:13", "2 of 60 pings (3 %) repeat"),
    ),
    "beam stuck": (columns("dvl.csv", BEAMS, hold), ("dvl.csv:22", "beam 3 holds", "25 pings")),
    "beams swapped": (
        both(
            columns("dvl.csv", BEAMS, turn), columns("dvl.csv", BEAMS, lambda v: v[:, [1, 0, 2, 3]])
        ),
        ("dvl.csv", "contradict each other", "they would fit in the order"),
    ),
    "current without water track": (
        toml("[depth]", "[current]\nsigma_m_per_s = 0.3\n\n[depth]"),
        ("mission.toml [current]", "no ping is off the water", "'water_track'"),
    ),
    "depth from the surface": (
        columns("depth.csv", ["depth_m"], lambda d: d - 15.0),
        ("depth.csv", "do not cancel: their sum is -15.0 m", "above the ellipsoid"),
    ),
    "zeros without lock": (
        columns("dvl.csv", BEAMS, lambda v: np.where((np.arange(60) % 9 == 8)[:, None], 0.0, v)),
        ("dvl.csv:10", "6 of 60 pings hold exactly 0 in all beams", "no bottom lock"),
    ),
    "one number in all beams now and then": (
        columns("dvl.csv", BEAMS, lambda v: np.where((np.arange(60) == 7)[:, None], 0.4, v)),
        ("dvl.csv:9", "in 1 pings all four beams are the same: left out"),
    ),
    "aid outlasts the IMU": (
        columns("depth.csv", ["time_s"], lambda t: 1.5 * t),
        ("depth.csv", "20 of 61 rows lie outside"),
    ),
    "optional table missing": (remove("depth.csv"), ("depth.csv", "going on without [depth]")),
    "optional table without rows": (
        lines("gnss.csv", lambda rows: rows[:1]),
        ("gnss.csv", "no rows", "going on without [gnss]"),
    ),
    "near 0 N 0 E": (
        both(
            drop_section("origin"),
            drop_section("initial"),
            drop_section("reference"),
            columns("gnss.csv", ["lat_deg", "lon_deg"], lambda p: p / 100.0),
        ),
        ("gnss.csv", "radians"),
    ),
}


@pytest.mark.parametrize("case", sorted(ODD))
def test_odd_mission_loads_with_a_note(tmp_path: Path, case: str) -> None:
    """One note, and it says what was seen."""
    damage, words = ODD[case]
    notes = notes_after(tmp_path, damage)
    assert len(notes) == 1
    for word in words:
        assert word in notes[0]


def test_a_short_part_of_a_log_is_no_clock_in_other_units(tmp_path: Path) -> None:
    """Two of sixty seconds: what lies around them is counted, not refused."""
    notes = notes_after(tmp_path, lines("imu.csv", lambda rows: rows[:41]))
    assert notes[0] == "dvl.csv: 57 of 60 rows lie outside the time of the IMU"
    assert all("lie outside the time of the IMU" in note for note in notes)


SOUND: dict[str, Damage] = {
    "all of it off the water": both(
        new_column("dvl.csv", "water_track", lambda _: "1"),
        columns("dvl.csv", BEAMS, lambda v: -v),
    ),
    "as it is": toml("format = 1", "format = 1"),
    "rolling vehicle": rolling(1.0),
    "short outliers": cell("dvl.csv", 20, "beam2_m_per_s", "-4.2"),
    "stationary and quantised": columns("dvl.csv", BEAMS, lambda v: np.round(v - v[:1], 1) + 0.0),
    "height above the ellipsoid": both(
        columns("depth.csv", ["depth_m"], lambda d: d - 140.0),
        columns("gnss.csv", ["height_m"], lambda h: h + 140.0),
        columns("reference.csv", ["height_m"], lambda h: h + 140.0),
        toml("height_m = -20.0", "height_m = 120.0"),
    ),
}


@pytest.mark.parametrize("case", sorted(SOUND))
def test_sound_mission_leaves_no_note_of_contradiction(tmp_path: Path, case: str) -> None:
    """Checks do not cry wolf; one that reads zero in all beams is told how to say it rests."""
    notes = notes_after(tmp_path, SOUND[case])
    assert [note for note in notes if "[[standstill]]" not in note] == []
