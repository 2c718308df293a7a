"""Random damage to a mission folder: it loads to sound values or raises an error of ours."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssm_graph.base.errors import SsmGraphError
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.acoustic import RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingLog
from tests.mission_damage import AIDS_TABLES, aided
from tests.mission_fixture import write_example

Files = dict[str, bytes]
Damage = Callable[[Files], None]

TABLES = ("imu.csv", "dvl.csv", "depth.csv", "gnss.csv", "reference.csv", *AIDS_TABLES)
CELLS = st.one_of(
    st.sampled_from(
        ["", " ", "nan", "inf", "-inf", "1e999", "1e300", "-1e300", "1e-320", "0", "-1"]
    ),
    st.sampled_from(
        ["-32768", "1_0", "0x10", '"1"', "'", "#", "1;2", "٣", "\0", "\r", "1,2", "--1"]
    ),
    st.text(max_size=5),
    st.floats().map(repr),
)
TOML_VALUES = st.one_of(
    st.sampled_from(["", '""', "true", "nan", "-inf", "[]", "{}", "[[1]]", "1979-05-27", '"x"']),
    st.sampled_from(['"FLU"', '"start"', '"dvl.csv"', '"../x.csv"', '"\\u0000"', "[0,0,0]"]),
    st.sampled_from(["[45,45,45,45]", "0x" + "f" * 5000, "9" * 5000, '"' + "a" * 300 + '"']),
    st.floats().map(repr),
    st.integers().map(str),
    st.text(max_size=5),
)


@cache
def sound_files() -> Files:
    """Return a valid folder as bytes, with a shorter IMU table than usual."""
    with tempfile.TemporaryDirectory() as name:
        folder = write_example(Path(name))
        aided(lambda _: None)(folder)
        return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@st.composite
def byte_damage(draw: st.DrawFn) -> Damage:
    """Delete, insert or cut bytes anywhere."""
    name = draw(st.sampled_from([*TABLES, "mission.toml"]))
    place, length = draw(st.floats(0.0, 1.0)), draw(st.integers(0, 60))
    inserted = draw(st.binary(max_size=8))
    is_cut = draw(st.booleans())

    def damage(files: Files) -> None:
        content = files[name]
        start = round(place * len(content))
        end = len(content) if is_cut else start + length
        files[name] = content[:start] + inserted + content[end:]

    return damage


@st.composite
def line_damage(draw: st.DrawFn) -> Damage:
    """Swap, repeat or delete lines of a table, or delete a column."""
    name = draw(st.sampled_from(TABLES))
    kind = draw(st.sampled_from(["swap", "repeat", "delete", "column"]))
    first, second = draw(st.integers(0, 1300)), draw(st.integers(0, 1300))

    def damage(files: Files) -> None:
        lines = files[name].split(b"\n")
        i, j = sorted((first % len(lines), second % len(lines)))
        if kind == "swap":
            lines[i], lines[j] = lines[j], lines[i]
        elif kind == "repeat":
            lines.insert(j, lines[i])
        elif kind == "delete":
            del lines[i:j]
        else:
            column = first % (lines[0].count(b",") + 1)
            parts = [line.split(b",") for line in lines]
            lines = [b",".join(part[:column] + part[column + 1 :]) for part in parts]
        files[name] = b"\n".join(lines)

    return damage


@st.composite
def cell_damage(draw: st.DrawFn) -> Damage:
    """Replace one cell, or a column from one line on."""
    name, text = draw(st.sampled_from(TABLES)), draw(CELLS)
    row, column = draw(st.integers(0, 1300)), draw(st.integers(0, 12))
    count = draw(st.sampled_from([1, 1, 30, 2000]))

    def damage(files: Files) -> None:
        lines = files[name].split(b"\n")
        for index in range(row % len(lines), min(row % len(lines) + count, len(lines))):
            cells = lines[index].split(b",")
            cells[column % len(cells)] = text.encode("utf-8", "replace")
            lines[index] = b",".join(cells)
        files[name] = b"\n".join(lines)

    return damage


@st.composite
def scale_damage(draw: st.DrawFn) -> Damage:
    """Multiply a column by a factor: a wrong unit or sign."""
    name, column = draw(st.sampled_from(TABLES)), draw(st.integers(0, 12))
    factor = draw(st.sampled_from([-1.0, 0.0, 1e-3, 1e3, 1e9, 1e200, 57.3, 1e-300]))

    def damage(files: Files) -> None:
        lines = files[name].split(b"\n")
        for index, line in enumerate(lines):
            cells = line.split(b",")
            try:
                cells[column % len(cells)] = repr(
                    factor * float(cells[column % len(cells)])
                ).encode()
            except ValueError:
                continue
            lines[index] = b",".join(cells)
        files[name] = b"\n".join(lines)

    return damage


@st.composite
def toml_damage(draw: st.DrawFn) -> Damage:
    """Replace the value of a key, or delete or repeat its line."""
    line, value = draw(st.integers(0, 110)), draw(TOML_VALUES)
    kind = draw(st.sampled_from(["value", "value", "value", "delete", "repeat"]))

    def damage(files: Files) -> None:
        lines = files["mission.toml"].split(b"\n")
        index = line % len(lines)
        if kind == "delete":
            del lines[index]
        elif kind == "repeat":
            lines.insert(index, lines[index])
        else:
            lines[index] = lines[index].split(b"=")[0] + b"=" + value.encode("utf-8", "replace")
        files["mission.toml"] = b"\n".join(lines)

    return damage


def assert_sound(mission: Mission) -> None:
    """Check that every array an estimator needs is finite and every sigma above zero."""
    imu, dvl = mission.imu, mission.dvl
    needed = [imu.time_s, imu.gyro_b, imu.accel_b, dvl.time_s, dvl.sigma]
    needed += [dvl.mount.beams_d, dvl.mount.R_bd, dvl.mount.lever_arm_b, mission.frame.origin_e]
    sigmas = [dvl.sigma]
    if mission.depth is not None:
        needed += [mission.depth.time_s, mission.depth.depth, mission.depth.lever_arm_b]
    if mission.gnss is not None:
        gnss = mission.gnss
        needed += [gnss.time_s, gnss.lat, gnss.lon, gnss.height, gnss.lever_arm_b]
        sigmas.append(gnss.sigma_enu)
    aids = mission.aids
    if aids.get(UsblLog):
        needed += [
            aids[UsblLog].valid_s,
            aids[UsblLog].lat,
            aids[UsblLog].lon,
            aids[UsblLog].height,
        ]
        sigmas.append(aids[UsblLog].sigma_enu)
    if aids.get(RangeLog):
        needed += [aids[RangeLog].time_s, aids[RangeLog].range_m, aids[RangeLog].lever_arm_b]
        sigmas.append(aids[RangeLog].sigma)
    if aids.get(HeadingLog):
        needed += [aids[HeadingLog].time_s, aids[HeadingLog].heading]
        sigmas.append(np.array([aids[HeadingLog].sigma, aids[HeadingLog].errors.correlation_s]))
    if mission.initial is not None:
        needed.append(mission.initial.velocity_enu)
        sigmas.append(mission.initial.attitude_sigma)
    assert all(np.isfinite(array).all() for array in [*needed, *sigmas])
    assert all((array > 0.0).all() for array in sigmas)
    assert not np.isinf(dvl.speed).any()
    assert np.isfinite(imu.start_s)
    assert imu.start_s < imu.time_s[0]
    assert np.all(np.diff(imu.time_s) > 0.0)


def assert_refused_or_sound(files: Mapping[str, bytes]) -> None:
    """Read a folder of such files: that gives an error of ours, or a sound mission."""
    with tempfile.TemporaryDirectory() as name:
        for file, content in files.items():
            (Path(name) / file).write_bytes(content)
        try:
            mission = read_mission(name)
        except SsmGraphError:
            return
    assert_sound(mission)


@settings(max_examples=100, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(
        st.one_of(byte_damage(), line_damage(), cell_damage(), scale_damage(), toml_damage()),
        min_size=1,
        max_size=3,
    )
)
def test_damage_is_refused_or_harmless(damages: list[Damage]) -> None:
    """No damage leads to a foreign exception, a warning or numbers that are none."""
    files = dict(sound_files())
    for damage in damages:
        damage(files)
    assert_refused_or_sound(files)
