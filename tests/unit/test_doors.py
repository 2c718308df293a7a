"""What somebody does at every door with files that are none, and what is said about it."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from ssm_graph.cli.main import main
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.results.summary import input_fields
from ssm_graph.io.results.tables import write_results
from ssm_graph.smoothers.mission import smooth
from tests.mission_fixture import make_mission

Door = Callable[[Path], list[str | Path]]
"""Make files in a folder that has ``result`` and ``mission``; return the arguments."""
DEEP = b"[" * 100_000
DIGITS = b"a = " + b"9" * 5000 + b"\n"
NO_TEXT = b'name = "Stra\xdfe"\n'
TABLE = "time,gx,gy,gz,ax,ay,az,b1,b2,b3,b4\n" + "".join(
    f"{0.1 * k:.1f},0,0,0,0,0,-9.81,1,1,1,1\n" for k in range(50)
)
MAP = """\
format = 1
[imu]
time = { column = "time", unit = "s" }
stamp = "end"
gyro = { columns = ["gx", "gy", "gz"], unit = "UNIT", axes = "FRD" }
accel = { columns = ["ax", "ay", "az"], unit = "m/s^2", axes = "FRD" }
[dvl]
time = { column = "time", unit = "s" }
beam = { columns = ["b1", "b2", "b3", "b4"], unit = "m/s" }
"""


def put(path: Path, data: bytes | str) -> Path:
    """Write a file; return it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def pipe(path: Path) -> Path:
    """Return a pipe that nobody writes to."""
    os.mkfifo(path)
    return path


def export(*options: str, out: str = "out.csv", form: str = "csv") -> Door:
    """Export the result; options that name a file of the folder begin with an @."""

    def act(folder: Path) -> list[str | Path]:
        named = [folder / one[1:] if one.startswith("@") else one for one in options]
        return ["export", folder / "result", "--format", form, "--out", folder / out, *named]

    return act


def at(data: bytes | str) -> Door:
    """Ask for the times of a file."""

    def act(folder: Path) -> list[str | Path]:
        return [*export()(folder), "--at", put(folder / "at.csv", data)]

    return act


def damaged(name: str, data: bytes, verb: str = "report") -> Door:
    """Replace a file of the result."""

    def act(folder: Path) -> list[str | Path]:
        put(folder / "result" / name, data)
        return [verb, folder / "result", "--out", folder / "page.html"]

    return act


def opened(verb: str, name: str, data: bytes, *, within: bool = False) -> Door:
    """Give a file to a verb, or a folder that it is in."""

    def act(folder: Path) -> list[str | Path]:
        path = put(folder / "given" / name, data)
        return [verb, path.parent if within else path, "--out", folder / "out"]

    return act


def mapped(unit: str = "rad/s", table: str | bytes = TABLE) -> Door:
    """Convert a table by a map."""

    def act(folder: Path) -> list[str | Path]:
        text = MAP.replace("UNIT", unit)
        by_map, read = put(folder / "map.toml", text), put(folder / "table.csv", table)
        vehicle = folder / "mission" / "mission.toml"
        return ["convert", "--map", by_map, "--vehicle", vehicle, read, "--out", folder / "out"]

    return act


OPEN_QUOTE = TABLE.replace("\n2.0,", '\n"2.0,')
TAKEN = "is there already"
NO_UNIT = "map.toml [imu] gyro unit: "
DOORS: dict[str, tuple[str, Door]] = {
    "`export --out` over a table of the mission": (TAKEN, export(out="mission/imu.csv")),
    "`export --out` over a table of the result": (
        *("would lie in the result folder", export(out="result/trajectory.csv")),
    ),
    "`export --out` over the times it was asked for": (
        "at.csv is what is read",
        lambda f: [
            *("export", f / "result", "--format", "csv", "--mission", f / "mission"),
            *("--at", put(f / "at.csv", "2.5\n"), "--out", f / "at.csv"),
        ],
    ),
    "`report --out` over the trajectory": (
        TAKEN,
        lambda f: ["report", f / "result", "--out", f / "result" / "trajectory.csv"],
    ),
    "`inspect --draft-map` over the table": (
        TAKEN,
        lambda f: ["inspect", put(f / "t.csv", TABLE), "--draft-map", f / "t.csv"],
    ),
    "`inspect --figure` over a table": (
        ".png",
        lambda f: ["inspect", put(f / "t.csv", TABLE), "--figure", f / "t.csv"],
    ),
    "`template` over a map that was filled in": (
        TAKEN,
        lambda f: ["template", "--out", put(f / "x" / "map.toml", MAP).parent],
    ),
    "`export --epoch` of the year 9999": (
        *("expected times within", export("--epoch", "9999-12-31T23:59:59Z", form="gpx")),
    ),
    "`export --epoch nan`": ("got nan", export("--epoch", "nan", form="gpx")),
    "`export --epoch inf`": ("got inf", export("--epoch", "inf", form="sbet")),
    "`export --rate 1e-300`": ("1e-300", export("--rate", "1e-300")),
    "`export --rate inf`": ("got inf", export("--rate", "inf")),
    "`export --at` without a time": ("at.csv: expected", at("")),
    "`export --at` of NaN": ("at.csv", at("nan\n")),
    "`export --at` of 1e308 s": ("got 1e+308", at("1e308\n")),
    "`export --at` of bytes": ("at.csv", at(b"\xff\xfe\x00\x01")),
    "`export --at` a pipe": (
        "a pipe or a device",
        lambda f: [*export()(f), "--at", pipe(f / "at.csv")],
    ),
    "`export --at` a folder": ("mission: ", export("--at", "@mission")),
    "`summary.json` that nests 100 000 deep": ("too deep", damaged("summary.json", DEEP)),
    "`summary.json` a list": ("expected a JSON object", damaged("summary.json", b"[]")),
    "`summary.json` of wrong kinds": (
        *("'versions'", damaged("summary.json", b'{"versions": 7}')),
    ),
    "`summary.json` of bytes": ("summary.json: expected", damaged("summary.json", b"\xff\xfe")),
    "`trajectory.csv` empty": ("is empty", damaged("trajectory.csv", b"")),
    "`beams.csv` cut off": ("'beam' is missing", damaged("beams.csv", b"time_s,be")),
    **{
        f"{text} in `{verb}`": (says, opened(verb, name, data, within=within))
        for verb, name, within in (
            ("network", "study.toml", False),
            ("slam", "landmarks.toml", True),
            ("locate", "drive.toml", True),
            ("visual", "visual.toml", True),
            ("integrity", "mission.toml", True),
        )
        for text, says, data in (
            ("brackets without end", "recursion", b"a = " + DEEP),
            ("5000 digits", "4300 digits", DIGITS),
            ("Latin-1", "UTF-8", NO_TEXT),
        )
    },
    "a graph of bytes in `slam`": ("a text graph", opened("slam", "graph.txt", bytes(range(256)))),
    "`inspect` of a pipe": ("a pipe", lambda f: ["inspect", pipe(f / "log.csv")]),
    "`convert` of a pipe": (
        "a pipe",
        lambda f: ["convert", pipe(f / "log.nmea"), "--out", f / "out"],
    ),
    "`inspect /dev/zero`": ("a pipe or a device", lambda _: ["inspect", "/dev/zero"]),
    "`convert --map`: a unit that takes for ever": (NO_UNIT, mapped("9**9**9**9 rad/s")),
    "`convert --map`: a unit with spaces that does": (NO_UNIT, mapped("9 ** 9 ** 9 ** 9 rad/s")),
    "`convert --map`: a unit of powers in brackets": (
        *(NO_UNIT, mapped("(((((((((9**9)**9)**9)**9)**9)**9)**9)**9)**9)**9 rad/s")),
    ),
    "`convert --map`: a unit that is code": (NO_UNIT, mapped("__import__('os').getcwd()")),
    "`convert --map`: a unit of 2000 factors": (NO_UNIT, mapped("m*" * 2000 + "m")),
    "`convert --map`: a quotation mark that nothing ends": (
        *("table.csv:22: a quotation mark", mapped(table=OPEN_QUOTE)),
    ),
    "`convert --map`: the header once more": ("table.csv:52", mapped(table=TABLE + TABLE)),
    "`convert` of MCAP full of noise": (
        "not a complete MCAP file",
        lambda f: [
            *("convert", put(f / "a.mcap", b"\x89MCAP0\r\n" + b"\x07" * 4000)),
            *("--out", f / "out"),
        ],
    ),
    "`online --page` without a port": (
        "--page",
        lambda f: [
            *("online", "--replay", f / "mission", "--out", f / "run", "--page", "127.0.0.1")
        ],
    ),
    "a key of `mission.toml` that steers a terminal": (
        r"\x1b]0;x\x07\x1b[2J: unknown key",
        opened(
            "smooth",
            "mission.toml",
            b'format = 1\n"\\u001b]0;x\\u0007\\u001b[2J" = 1\n',
            within=True,
        ),
    ),
    "a report's key that steers a terminal": (
        r"known are: \x1b[2J",
        opened("convert", "dvl.json", b'{"\\u001b[2J": 1, "transducers": []}\n' * 9),
    ),
    "a column's name that steers a terminal": (
        r"known are: \x1b[2J",
        mapped(table=TABLE.replace("gx", "\x1b[2J", 1)),
    ),
}
"""What has to be said, and the act."""


@cache
def sound_files() -> Mapping[str, bytes]:
    """Return the files of a mission of 10 s and of its result, by their paths."""

    def cut(log: Any) -> Any:
        return log.rows(log.time_s <= 10.0)

    whole = make_mission()
    logs = {name: cut(getattr(whole, name)) for name in ("imu", "dvl", "depth", "gnss")}
    mission = replace(whole, **logs, reference=None)
    estimate = smooth(mission)
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "mission").mkdir()
        write_mission(folder / "mission", mission)
        write_results(
            *(folder / "result", estimate),
            mission=mission,
            metrics=None,
            settings={},
            inputs=input_fields(folder / "mission"),
        )
        return content(folder)


def content(folder: Path) -> dict[str, bytes]:
    """Return all regular files with what they hold."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def at_door(act: Door, folder: Path) -> tuple[str, str]:
    """Do it; return what is said and what is lost. Raises what is no refusal."""
    for name, data in sound_files().items():
        put(folder / name, data)
    arguments = [str(one) for one in act(folder)]
    before, out = content(folder), StringIO()
    with redirect_stdout(out), redirect_stderr(out):
        try:
            code = main(arguments)
        except SystemExit as error:  # of the parser of options
            code = int(error.code or 0)
    after = content(folder)
    lost = [name for name, data in before.items() if after.get(name) != data]
    words = " ".join(out.getvalue().split())
    said = re.search(r"(error: .*|verdict: .*)", words)
    assert code in {2, 3, 4}, words
    assert said is not None, words
    assert "\x1b" not in words
    return said[1], f"**changed** {lost}" if lost else "nothing, untouched"


@pytest.mark.parametrize("name", DOORS)
def test_a_door_refuses_and_loses_nothing(name: str, tmp_path: Path) -> None:
    """The cause is said in a sentence; no file that was there is another one after."""
    if "report" in name or "summary" in name:
        pytest.importorskip("plotly")
    says, act = DOORS[name]
    said, lost = at_door(act, tmp_path)
    assert says in said
    assert lost == "nothing, untouched"


def test_a_table_in_utf_16_is_read(tmp_path: Path) -> None:
    """As shells of Windows write it."""
    path = put(tmp_path / "t.csv", TABLE.encode("utf-16"))
    out = StringIO()
    with redirect_stdout(out):
        main(["inspect", str(path)])
    assert "gx: 0 to 0" in out.getvalue()
