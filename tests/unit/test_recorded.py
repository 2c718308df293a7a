"""Recorded output of instruments becomes tables; what is of another kind is named."""

from __future__ import annotations

import json
import math
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.io.file_kind import kind_of
from ssm_graph.io.nmea_sentences import checksum
from ssm_graph.live.recorded.log import Recorded, read_recorded, write_tables
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.messages import bad_number
from tests.damaged_traffic import block_of, damaged, targets

DATA = Path(os.environ.get("SSM_GRAPH_DATA", Path(__file__).parents[2] / "../shared/data"))
DAY_S = 1_750_809_600.0
"""25 June 2025."""


def reports(n: int, form: str = "json_v1", n_beams: int = 4) -> list[dict[str, Any]]:
    """Return reports 0.1 s and more apart, each with a speed of its own."""
    found = []
    for k in range(n):
        beams = [
            {"id": i, "velocity": 0.1 * i + 0.001 * k, "distance": 1.6, "beam_valid": True}
            for i in range(n_beams)
        ]
        fields: dict[str, Any] = {
            "time": 100.0 + k,
            "vx": 0.1,
            "altitude": 1.5,
            "velocity_valid": True,
        }
        fields |= {"transducers": beams, "status": 0, "format": form}
        if form != "json_v1":
            fields |= {"type": "velocity"}
        if form == "json_v3":
            fields |= {"time_of_validity": int((DAY_S + 0.5 * k) * 1e6)}
        found.append(fields)
    return found


def read(path: Path, data: bytes) -> Recorded:
    """Return what a file with these bytes holds."""
    path.write_bytes(data)
    found = read_recorded(path)
    assert found is not None
    return found


def nmea(*bodies: str) -> bytes:
    """Return sentences with their checksums."""
    return "".join(f"${body}*{checksum(body)}\r\n" for body in bodies).encode()


def test_pings_of_another_number_of_beams_are_left_out(tmp_path: Path) -> None:
    """One table has one number of columns."""
    three = [{**one, "transducers": one["transducers"][:3]} for one in reports(9, "json_v3")[6:]]
    lines = [json.dumps(one) for one in [*reports(6, "json_v3"), *three]]
    found = read(tmp_path / "dvl.json", "\n".join(lines).encode())
    assert {len(one.speed) for one in found.messages if isinstance(one, Ping)} == {4}
    assert "6 pings are of 4 beams; 3 of 3 were left out: of another instrument?" in found.notes


def test_reports_without_a_clock_are_timed_by_their_sum(tmp_path: Path) -> None:
    """Format json_v1: repeats add nothing, and the note says what the times are."""
    lines = [json.dumps(one) for one in reports(5)]
    lines.insert(2, lines[1])
    found = read(tmp_path / "dvl.txt", "\n".join(lines).encode())
    times = [one.time_s for one in found.messages]
    np.testing.assert_allclose(times, np.cumsum([0.100, 0.101, 0.102, 0.103, 0.104]))
    assert found.about == "Water Linked JSON, 5 pings"
    reckoned = {"type": "position_local", "ts": DAY_S + 0.35, "x": 0.0, "y": 0.0, "z": 0.0}
    lines.insert(4, json.dumps({**reckoned, "std": 0.0, "roll": 0, "pitch": 0, "yaw": 0}))
    stamped = read(tmp_path / "dvl.txt", "\n".join(lines).encode())
    own = [one.time_s for one in stamped.messages if isinstance(one, Ping)]
    np.testing.assert_allclose(np.diff(own), np.diff(times), atol=1e-6)  # one clock for all
    assert own[0] > DAY_S
    assert "1 reports came again" in found.notes[0]
    assert "no clock" in found.notes[1]


@pytest.mark.parametrize("written", ["utf-16", "utf-8-sig", "repr", "log", "comment", "array"])
def test_reports_as_people_record_them(tmp_path: Path, written: str) -> None:
    """By a shell of Windows, by print() of Python, after times and words of a logger."""
    found = reports(5, "json_v3")
    lines = [json.dumps(one) for one in found]
    texts = {
        "repr": "".join(f"{one!r}\n" for one in found),
        "log": "".join(f"2021-05-28 12:00:00,123 INFO dvl {line}\n" for line in lines),
        "comment": "# basin, 28 May\n" + "\n".join(lines),
        "array": f"[{','.join(lines)}]",
    }
    coding = written if written.startswith("utf") else "utf-8"
    data = texts.get(written, "\r\n".join(lines)).encode(coding)
    expected = read(tmp_path / "plain", "\n".join(lines).encode()).messages
    assert read(tmp_path / "dvl", data).messages == expected
    assert len(expected) == 5


def test_a_receiver_recorded_on_windows(tmp_path: Path) -> None:
    """Sixteen bits a letter, as a shell of Windows writes them."""
    text = nmea(*(f"GPGGA,12000{k}.00,6326.0,N,01024.0,E,1,8,1.0,20,M,40,M,," for k in range(5)))
    found = read(tmp_path / "gnss", text.decode().encode("utf-16"))
    assert found.messages == read(tmp_path / "plain", text).messages
    assert len(found.messages) == 5


def test_reports_with_a_clock_keep_it(tmp_path: Path) -> None:
    """The centre of the ping; the yaw of the dead reckoning beside it; a torn report is told."""
    lines = [json.dumps(one) for one in reports(4, "json_v3")]
    yaw = {"type": "position_local", "ts": DAY_S + 0.7, "yaw": 45.0, "status": 0}
    text = "\n".join([lines[0], json.dumps(yaw), lines[1][:90], *lines[2:]])
    found = read(tmp_path / "dvl.json", text.encode())
    assert [one.time_s - DAY_S for one in found.messages] == pytest.approx([0.0, 0.7, 1.0, 1.5])
    assert isinstance(found.messages[1], HeadingReading)
    assert any("begin of the next" in note for note in found.notes)
    back = "\n".join([lines[3], lines[0]])
    with pytest.raises(DataError, match=r"set back by 1\.5 s"):
        read(tmp_path / "back.json", back.encode())


def test_a_clock_that_is_set_amid_a_recording(tmp_path: Path) -> None:
    """As by NTP, a while after the start: what came before is timed back, and it is said."""
    found = reports(40, "json_v3")
    for k, one in enumerate(found):
        one["time"] = 500.0
        if k < 30:
            one["time_of_validity"] -= int((DAY_S - 7.0) * 1e6)  # since the start
        if k % 2:
            one["fom"] = math.nan
    got = read(tmp_path / "dvl.json", "\n".join(map(json.dumps, found)).encode())
    times_s = [one.time_s for one in got.messages]
    np.testing.assert_allclose(times_s, DAY_S + 0.5 * np.arange(40), atol=1e-5)
    assert [note[:10] for note in got.notes] == ["30 reports"]


def as_table(rows: list[dict[str, Any]]) -> bytes:
    """Return reports as a recorder writes them into a table, half a second apart."""
    lines = []
    for k, one in enumerate(rows):
        cells: dict[str, Any] = {"timestamp": DAY_S + 0.5 * k}
        cells |= {key: value for key, value in one.items() if key != "transducers"}
        for i, beam in enumerate(one["transducers"]):
            cells |= {f"transducers_{i}_{key}": value for key, value in beam.items()}
        lines += [",".join(cells)] * (k == 0) + [",".join(map(str, cells.values()))]
    return "\n".join(lines).encode()


def test_reports_in_a_table(tmp_path: Path) -> None:
    """Timed by their arrival; a torn row and one of another kind are told, the others stay."""
    rows = reports(5, "json_v2")
    found = read(tmp_path / "dvl.csv", as_table(rows))
    pings = [one for one in found.messages if isinstance(one, Ping)]
    assert [one.time_s - DAY_S for one in pings] == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert pings[2].speed == pytest.approx((0.002, 0.102, 0.202, 0.302))
    assert found.notes == ()
    data = as_table(rows).splitlines()
    data[2] = data[2][:60]
    data[4] = data[4].replace(b"True", b"perhaps")
    found = read(tmp_path / "torn.csv", b"\n".join(data))
    assert len(found.messages) == 3
    assert any("beam_valid" in note or "velocity_valid" in note for note in found.notes)
    with pytest.raises(DataError, match="not one report that is read"):
        read(tmp_path / "none.csv", as_table(rows).replace(b"True", b"-"))


def test_reports_out_of_order_are_sorted(tmp_path: Path) -> None:
    """By less than a second: a receiver that goes over to another clock; none is lost."""
    times = (10, 30, 20, 30)
    one, *_ = reports(1, "json_v3")
    lines = [json.dumps(one | {"time_of_validity": int((DAY_S + t / 100) * 1e6)}) for t in times]
    found = read(tmp_path / "dvl.json", "\n".join(lines).encode())
    assert [m.time_s - DAY_S for m in found.messages] == pytest.approx([0.1, 0.2, 0.3])
    assert any("1 reports out of order" in note for note in found.notes)
    assert any("1 reports of a time that an earlier one has" in note for note in found.notes)


@pytest.mark.parametrize("n_beams", [3, 4])
def test_tables_of_a_recording(tmp_path: Path, n_beams: int) -> None:
    """One for each kind of message, as a mission folder has them."""
    data = "\n".join(json.dumps(one) for one in reports(3, "json_v3", n_beams)).encode()
    found = read(tmp_path / "dvl.json", data)
    assert write_tables(tmp_path / "out", found.messages) == {"dvl.csv": 3}
    head, first, *_ = (tmp_path / "out" / "dvl.csv").read_text().splitlines()
    assert head.split(",")[: 1 + n_beams][-1] == f"beam{n_beams}_m_per_s"
    assert float(first.split(",")[2]) == 0.1


def test_a_receiver_is_dated_by_its_own_sentences(tmp_path: Path) -> None:
    """RMC's date, midnight passed; comments and binary between; the best sentence alone is read."""
    place = "6326.0000,N,01024.0000,E"
    data = b"# Name: a receiver\n"
    for utc, date in (("235959.00", "240625"), ("000000.00", "250625"), ("000001.00", "250625")):
        data += b"\xb5\x62\x01\x07$*\r" + nmea(
            f"GNRMC,{utc},A,{place},0.5,54.7,{date},,,A",
            f"GNGGA,{utc},{place},1,10,0.8,20.50,M,40.25,M,,",
            "HEHDT,45.0,T",
        )
    found = read(tmp_path / "gnss.log", data)
    fixes = [one for one in found.messages if isinstance(one, Fix)]
    assert [one.time_s - DAY_S for one in fixes] == [-1.0, 0.0, 1.0]
    assert {one.height for one in fixes} == {60.75}
    turns = [one for one in found.messages if isinstance(one, HeadingReading)]
    assert [one.time_s - DAY_S for one in turns] == [-1.0, 0.0, 1.0]
    assert {"GGA read, RMC where none of that came for 5 s.", "HDT read."} <= set(found.notes)


def test_a_second_receiver_in_one_file(tmp_path: Path) -> None:
    """One that knows less is read where the first one is silent, as live."""
    place = "6326.0000,N,01024.0000,E"
    data = b""
    for k in range(40):
        data += nmea(f"GNRMC,1200{k:02d}.00,A,{place},0.5,54.7,240625,,,A")
        if 10 <= k < 20:
            data += nmea(f"GPGGA,1200{k:02d}.00,{place},1,10,0.8,20.5,M,40.2,M,,")
    found = read(tmp_path / "two.log", data)
    begin_s = found.messages[0].time_s
    assert [one.time_s - begin_s for one in found.messages] == [float(k) for k in range(40)]
    heights = [one.height for one in found.messages if isinstance(one, Fix)]
    assert heights[11:20] == [pytest.approx(60.7)] * 9  # the first came after another was read


def test_a_receiver_without_dates(tmp_path: Path) -> None:
    """Times are of the day, which is said; a depth alone has none."""
    data = nmea(*(f"ECGLL,5119.881,N,00125.169,E,1643{k:02d},A,D" for k in range(9)))
    found = read(tmp_path / "gll.log", data)
    assert [one.time_s for one in found.messages] == [60_180.0 + k for k in range(9)]
    assert "No sentence states a date: time_s is UTC of the day." in found.notes
    with pytest.raises(DataError, match="no sentence states a time"):
        read(tmp_path / "depth.log", nmea("PIPS,0020.00,M") * 3)
    with pytest.raises(DataError, match=r"not one report.*its sentences are DPT, VTG"):
        read(tmp_path / "none.log", nmea("GPVTG,,T,,M,0.0,N,0.0,K,A", "SDDPT,12.5,0.0"))


def test_what_is_no_recording(tmp_path: Path) -> None:
    """Its kind is named, with what to do."""
    for data, said in (
        (b"\x28\xb5\x2f\xfd" + bytes(40), "zstd -d"),
        (b"\xa3\x95\x80" * 40, "DataFlash"),
        (b"\x7f\x7f" * 50, "PD0"),
        (b"\xfe" * 100, "MAVLink"),
        (b"", "empty"),
        (b"hello world, this is text", "no known kind"),
        (b"\x89MCAP0\r\n" + bytes(40), "without messages of ROS 2"),
    ):
        file = tmp_path / "file"
        file.write_bytes(data)
        assert read_recorded(file) is None
        assert said in kind_of(file)
    assert "a folder" in kind_of(tmp_path)


def test_convert_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Counts and notes; a file that is not there, of no kind, and of another one."""
    log = tmp_path / "dvl.txt"
    log.write_text("\n".join(json.dumps(one) for one in reports(5)))
    words = ["convert", str(log), "--out", str(tmp_path / "m"), "--overwrite"]
    assert main(words) == ExitCode.GOOD
    shown = capsys.readouterr().out
    assert "dvl.csv with 5 rows" in shown
    assert "note: Reports before format json_v3" in shown
    log.write_bytes(b"\x7f\x7f" * 50)
    assert main(words) == ExitCode.DATA
    assert "PD0" in capsys.readouterr().err
    log.unlink()
    assert main(words) == ExitCode.DATA
    assert "no such file" in capsys.readouterr().err


def test_pings_are_pings(tmp_path: Path) -> None:
    """A list of reports over several lines, as a recorder may write it."""
    found = read(tmp_path / "list.json", json.dumps(reports(6, "json_v2"), indent=2).encode())
    assert [type(one) for one in found.messages] == [Ping] * 6


def test_damaged_recordings_do_no_harm(tmp_path: Path) -> None:
    """A refusal by its cause, or finite numbers in increasing times; `fuzz.md` has the decoders."""
    rng = random.Random(11)
    others, n_read = targets(), 0
    for k in range(60):
        data = damaged(block_of(others[1 + k % 3], others, rng, DAY_S), rng)
        (tmp_path / "log").write_bytes(data)
        try:
            found = read_recorded(tmp_path / "log")
        except DataError:
            continue
        for message in found.messages if found is not None else ():
            assert bad_number(message) is None
            n_read += 1
    assert n_read > 100
