"""Mission folders in order of arrival: late, repeated and torn rows are put right and counted."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.tables import Table
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.tables.files import read_arrival_table, read_table
from ssm_graph.sensors.depth import DEPTH
from ssm_graph.sensors.dvl_instrument import DVL
from tests.mission_damage import Damage as FolderDamage
from tests.mission_damage import cell, columns, lines, toml
from tests.mission_fixture import make_mission, write_example
from tests.unit.test_mission_damage import (
    Damage,
    assert_refused_or_sound,
    byte_damage,
    cell_damage,
    line_damage,
    scale_damage,
    sound_files,
)
from tests.unit.test_mission_roundtrip import assert_same

ARRIVAL = toml('name = "straight-run"', 'name = "straight-run"\norder = "arrival"')
DVL_LOG = make_mission().dvl
HEADER = "time_s,beam1_m_per_s,beam2_m_per_s,beam3_m_per_s,beam4_m_per_s\n"
ROWS = [f"{k}.5,{k}.25,-1.0,,{k}e-3\n" for k in range(1, 9)]


def arrival_example(folder: Path) -> Path:
    """Write the example with its rows declared to be in order of arrival."""
    ARRIVAL(write_example(folder))
    return folder


def read_dvl(text: str | bytes) -> Table:
    """Read the text of a DVL table in order of arrival."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "dvl.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_arrival_table(path, "dvl.csv", DVL.spec(DVL_LOG))


def assert_same_rows(got: Table, want: Table) -> None:
    """Compare the columns of two tables bit for bit."""
    assert list(got.columns) == list(want.columns)
    for name in want.columns:
        np.testing.assert_array_equal(got[name], want[name])


def test_sound_tables_read_alike_in_both_orders(tmp_path: Path) -> None:
    """Without anything to put right the same mission comes out, and no note."""
    (tmp_path / "time").mkdir()
    (tmp_path / "arrival").mkdir()
    by_time = read_mission(write_example(tmp_path / "time"))
    by_arrival = read_mission(arrival_example(tmp_path / "arrival"))
    assert_same(by_arrival, by_time)
    assert by_arrival.notes == by_time.notes


def test_order_time_is_the_default_and_can_be_said(tmp_path: Path) -> None:
    """And refuses what it always refused."""
    toml('name = "straight-run"', 'name = "straight-run"\norder = "time"')(write_example(tmp_path))
    read_mission(tmp_path)
    lines("imu.csv", lambda rows: [*rows[:50], rows[51], rows[50], *rows[52:]])(tmp_path)
    with pytest.raises(DataError, match="goes back"):
        read_mission(tmp_path)


@pytest.mark.parametrize("value", ['"Arrival"', "1", "true", '""'])
def test_an_order_that_is_not_known(tmp_path: Path, value: str) -> None:
    """The known ones are named."""
    toml("format = 1", f"format = 1\norder = {value}")(write_example(tmp_path))
    with pytest.raises(ConfigError, match=r"mission.toml order: expected one of time, arrival"):
        read_mission(tmp_path)


def test_the_key_misspelt(tmp_path: Path) -> None:
    """The nearest name is that of the key, not of a section."""
    toml("format = 1", 'format = 1\nordr = "arrival"')(write_example(tmp_path))
    with pytest.raises(ConfigError, match="did you mean 'order'"):
        read_mission(tmp_path)


def test_a_mission_put_right(tmp_path: Path) -> None:
    """Every table may have every fault at once; one note each gives the counts."""
    want = read_mission(arrival_example(tmp_path))
    lines("imu.csv", lambda r: [*r[:50], r[51], r[50], "2.5,0.1", *r[52:], r[9]])(tmp_path)
    lines("dvl.csv", lambda r: [r[0], *r[:0:-1], r[5], "nan" + r[6][3:]])(tmp_path)
    lines("gnss.csv", lambda r: [*r, r[3][:-2] + "7"])(tmp_path)
    with (tmp_path / "depth.csv").open("a") as stream:
        stream.write("61.0,20.1")
    got = read_mission(tmp_path)
    assert_same(got, want)
    assert set(got.notes) - set(want.notes) == {
        "imu.csv: 2 rows came late and went to their time; left out: 1 row repeated exactly, "
        "1 torn line",
        "dvl.csv: 60 rows came late and went to their time; left out: 1 row repeated exactly, "
        "1 row of impossible numbers",
        "gnss.csv: 1 row came late and went to their time; left out: 1 row whose time an earlier "
        "row has with other numbers",
        "depth.csv: left out: the last line, which has no end",
    }


def test_faults_are_told_by_their_line_in_the_file(tmp_path: Path) -> None:
    """Sorting does not hide where a row came from."""
    arrival_example(tmp_path)
    lines("gnss.csv", lambda r: [r[0], "", *r[:3:-1], *r[1:4]])(tmp_path)
    cell("gnss.csv", 7, "lat_deg", "55.7")(tmp_path)
    with pytest.raises(DataError, match=r"gnss.csv:7: the position 55.7"):
        read_mission(tmp_path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (columns("dvl.csv", ["beam1_m_per_s"], lambda v: 1e3 * v), "mm/s"),
        (columns("depth.csv", ["depth_m"], lambda v: 1e5 * v), "is it a pressure"),
        (lines("depth.csv", lambda r: [r[0], *(row + ",1" for row in r[1:])]), "depth.csv:2: .*3"),
        (lines("imu.csv", lambda r: [r[0], *(row[:30] for row in r[1:])]), "imu.csv:2: .* cells"),
        (columns("imu.csv", ["accel_x_m_per_s2"], lambda v: v + np.nan), "imu.csv:2: .*finite"),
    ],
)
def test_tables_of_another_kind_are_refused(
    tmp_path: Path, damage: FolderDamage, message: str
) -> None:
    """Where most rows are wrong, it was no accident."""
    damage(arrival_example(tmp_path))
    with pytest.raises(DataError, match=message):
        read_mission(tmp_path)


def test_tables_without_rows_and_without_file(tmp_path: Path) -> None:
    """The same sentences as in order of time."""
    messages = []
    for order in ("time", "arrival"):
        folder = tmp_path / order
        folder.mkdir()
        toml("format = 1", f'format = 1\norder = "{order}"')(write_example(folder))
        lines("dvl.csv", lambda rows: rows[:1])(folder)
        lines("depth.csv", lambda rows: rows[:1])(folder)
        (folder / "gnss.csv").unlink()
        messages.append(list(read_mission(folder).notes))
        (folder / "dvl.csv").rename(folder / "kept")
        with pytest.raises(ConfigError) as no_dvl:
            read_mission(folder)
        (folder / "kept").rename(folder / "dvl.csv")
        lines("imu.csv", lambda rows: rows[:1])(folder)
        with pytest.raises(DataError) as no_rows:
            read_mission(folder)
        (folder / "imu.csv").write_bytes(b"")
        with pytest.raises(DataError) as empty:
            read_mission(folder)
        messages[-1] += [str(error.value) for error in (no_dvl, no_rows, empty)]
    assert messages[0] == messages[1]
    assert len(messages[0]) == 6


def test_a_table_that_ends_in_its_header() -> None:
    """No row has come yet."""
    assert len(read_dvl(HEADER)) == 0
    assert len(read_dvl(HEADER.rstrip())) == 0
    assert len(read_dvl(HEADER + "1.5,0.3")) == 0


def test_zero_bytes_after_a_power_failure() -> None:
    """They are a torn line, even near the start of a short table."""
    text = HEADER + "".join(ROWS[:3]) + "\0" * 100 + ",torn\n" + "".join(ROWS[3:])
    got = read_dvl(text)
    assert_same_rows(got, read_dvl(HEADER + "".join(ROWS)))
    assert got.notes == ("dvl.csv: left out: 1 torn line",)
    with pytest.raises(DataError, match=r"dvl.csv:1: .* zero bytes"):
        read_dvl("\0" * 100 + text)


def test_cut_off_at_every_byte() -> None:
    """Rows before the cut stay, the cut one goes, with or without a writer that went on."""
    text, later = HEADER + "".join(ROWS), "20.5,1.0,1.0,1.0,1.0\n"
    for n_lost in range(len(ROWS[-1]) + len(ROWS[-2]) + 1):
        cut = text[: len(text) - n_lost].encode()
        n_whole = cut.count(b"\n") - 1
        got = read_dvl(cut)
        assert_same_rows(got, read_dvl(HEADER + "".join(ROWS[:n_whole])))
        is_torn = not cut.endswith(b"\n")
        assert got.notes == (("dvl.csv: left out: the last line, which has no end",) * is_torn)
        went_on = read_dvl(cut + b",torn\n" * is_torn + later.encode())
        assert_same_rows(went_on, read_dvl(HEADER + "".join(ROWS[:n_whole]) + later))
        assert went_on.notes == (("dvl.csv: left out: 1 torn line",) * is_torn)


@given(
    order=st.permutations(range(len(ROWS))),
    repeats=st.lists(st.integers(0, len(ROWS) - 1), max_size=6),
    torn=st.lists(st.tuples(st.integers(0, 14), st.sampled_from(["", "1", "2.5,3", "x,,,,"]))),
)
def test_any_order_with_repeats_and_torn_lines(
    order: list[int], repeats: list[int], torn: list[tuple[int, str]]
) -> None:
    """The sorted table comes out, and the note counts."""
    rows = [ROWS[k] for k in (*order, *repeats)]
    torn = [(place, text) for place, text in torn if text][:8]
    for place, text in torn:
        rows.insert(place, text + "\n")
    got = read_dvl(HEADER + "".join(rows))
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "dvl.csv"
        path.write_text(HEADER + "".join(ROWS))
        assert_same_rows(got, read_table(path, "dvl.csv", DVL.spec(DVL_LOG)))
    note = "".join(got.notes)
    assert len(got.notes) <= 1
    assert (f"{len(repeats)} row" in note) == bool(repeats)
    assert (f"{len(torn)} torn line" in note) == bool(torn)
    assert ("came late" in note) == ([*order, *repeats] != sorted([*order, *repeats]))


def test_parquet_in_order_of_arrival(tmp_path: Path) -> None:
    """The same rules; there are no torn lines."""
    pytest.importorskip("pyarrow")
    import pyarrow as pa
    import pyarrow.parquet

    path = tmp_path / "depth.parquet"
    times, depths = [3.0, 1.0, 2.0, 1.0, 4.0], [0.3, 0.1, 0.2, 0.1, np.nan]
    pa.parquet.write_table(pa.table({"time_s": times, "depth_m": depths}), path)
    got = read_arrival_table(path, "depth.parquet", DEPTH.spec(None))
    np.testing.assert_array_equal(got["depth_m"], [0.1, 0.2, 0.3])
    assert got.file.place(2) == "depth.parquet: row 1"
    assert got.file.cell(2, "depth_m") == "0.3"


@pytest.mark.slow
@settings(max_examples=300, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(
        st.one_of(byte_damage(), line_damage(), cell_damage(), scale_damage()),
        min_size=1,
        max_size=3,
    )
)
def test_damage_is_refused_or_harmless(damages: list[Damage]) -> None:
    """No damage leads to a foreign exception, a warning or numbers that are none."""
    files = dict(sound_files())
    toml_text = files["mission.toml"]
    files["mission.toml"] = b'order = "arrival"\n' + toml_text
    for damage in damages:
        damage(files)
    assert_refused_or_sound(files)
