"""Ways to damage a valid mission folder, one small function each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ssm_graph.base.frozen import Array
from tests.mission_fixture import write_example

Damage = Callable[[Path], None]

GYRO = [f"gyro_{axis}_rad_per_s" for axis in "xyz"]
ACCEL = [f"accel_{axis}_m_per_s2" for axis in "xyz"]
BEAMS = [f"beam{beam}_m_per_s" for beam in (1, 2, 3, 4)]
POSITION = ["lat_deg", "lon_deg"]


def toml(old: str, new: str) -> Damage:
    """Replace text in ``mission.toml``."""

    def damage(folder: Path) -> None:
        path = folder / "mission.toml"
        text = path.read_text(encoding="utf-8")
        assert old in text, old
        path.write_text(text.replace(old, new, 1), encoding="utf-8")

    return damage


def drop_section(name: str) -> Damage:
    """Remove a whole section from ``mission.toml``."""

    def damage(folder: Path) -> None:
        path = folder / "mission.toml"
        blocks = path.read_text(encoding="utf-8").split("\n\n")
        kept = [block for block in blocks if not block.startswith(f"[{name}]")]
        assert len(kept) == len(blocks) - 1, name
        path.write_text("\n\n".join(kept), encoding="utf-8")

    return damage


def raw(file: str, change: Callable[[bytes], bytes]) -> Damage:
    """Change the bytes of a file."""

    def damage(folder: Path) -> None:
        (folder / file).write_bytes(change((folder / file).read_bytes()))

    return damage


def lines(file: str, change: Callable[[list[str]], list[str]]) -> Damage:
    """Change the list of a table's lines; index 0 is the header."""

    def change_bytes(content: bytes) -> bytes:
        return ("\n".join(change(content.decode().splitlines())) + "\n").encode()

    return raw(file, change_bytes)


def cell(file: str, line: int, column: str, text: str) -> Damage:
    """Replace one cell; ``line`` is the physical line, counted from 1."""

    def change(rows: list[str]) -> list[str]:
        cells = rows[line - 1].split(",")
        cells[rows[0].split(",").index(column)] = text
        return [*rows[: line - 1], ",".join(cells), *rows[line:]]

    return lines(file, change)


def columns(file: str, names: list[str], change: Callable[[Array], Array]) -> Damage:
    """Change columns of a table as one array (rows, columns)."""

    def change_lines(rows: list[str]) -> list[str]:
        header = rows[0].split(",")
        where = [header.index(name) for name in names]
        values = np.array([[float(text or "nan") for text in row.split(",")] for row in rows[1:]])
        values[:, where] = change(values[:, where])
        return [rows[0], *(",".join(map(repr, row)) for row in values.tolist())]

    return lines(file, change_lines)


def new_column(file: str, name: str, text: Callable[[int], str]) -> Damage:
    """Add a column; ``text`` is asked for the cell of each row, counted from 0."""

    def change(rows: list[str]) -> list[str]:
        body = [f"{row},{text(k)}" for k, row in enumerate(rows[1:])]
        return [f"{rows[0]},{name}", *body]

    return lines(file, change)


def both(*damages: Damage) -> Damage:
    """Apply several damages."""

    def damage(folder: Path) -> None:
        for one in damages:
            one(folder)

    return damage


def remove(file: str) -> Damage:
    """Delete a file."""

    def damage(folder: Path) -> None:
        (folder / file).unlink()

    return damage


def rename(old: str, new: str) -> Damage:
    """Give a file another name."""

    def damage(folder: Path) -> None:
        (folder / old).rename(folder / new)

    return damage


AIDS_TOML = """
[usbl]
file = "usbl.csv"
lever_arm_m = [0.0, 0.0, 0.0]

[ranges]
file = "ranges.csv"
noise_m = 0.3
lever_arm_m = [0.0, 0.0, 0.0]

[[beacon]]
number = 4
lat_deg = 45.701
lon_deg = 126.601
height_m = -40.0

[[beacon]]
number = 5
lat_deg = 45.699
lon_deg = 126.602
height_m = -40.0
position_sigma_m = [50.0, 50.0, 5.0]

[heading]
file = "heading.csv"
noise_deg = 1.0

[[standstill]]
begin_s = 0.0
end_s = 5.0
"""
AIDS_TABLES = {
    "usbl.csv": """\
time_s,lat_deg,lon_deg,height_m,sigma_east_m,sigma_north_m,sigma_up_m,delay_s
10.0,45.70006,126.60018,-20.0,2.0,2.0,2.0,1.5
20.0,45.70012,126.60035,-20.0,2.0,2.0,2.0,1.5
""",
    "ranges.csv": "time_s,beacon,range_m\n8.0,4,130.0\n8.0,5,170.0\n16.0,4,120.0\n",
    "heading.csv": "time_s,heading_deg\n1.0,63.4\n2.0,63.6\n3.0,63.2\n",
}


def aided(change: Damage) -> Damage:
    """Give the mission further aids, then damage it."""

    def damage(folder: Path) -> None:
        for name, text in AIDS_TABLES.items():
            (folder / name).write_text(text, encoding="utf-8")
        with (folder / "mission.toml").open("a", encoding="utf-8") as stream:
            stream.write(AIDS_TOML)
        change(folder)

    return damage


def parquet(change: Damage) -> Damage:
    """Write the mission with Parquet tables, then damage it."""

    def damage(folder: Path) -> None:
        write_example(folder, suffix=".parquet")
        change(folder)

    return damage


def every_second_code(speed: Array, code: float) -> Array:
    """Write a driver's code into every seventh cell."""
    speed = speed.copy()
    speed.ravel()[::7] = code
    return speed


def republish(speed: Array) -> Array:
    """Repeat every other ping."""
    return speed[(np.arange(len(speed)) // 2) * 2]


def rolling(gyro_factor: float) -> Damage:
    """Let the vehicle roll, and the gyros see it multiplied by a factor."""

    def change(values: Array) -> Array:
        rate = 2.0 * np.pi / 8.0
        roll = 0.1 * np.sin(rate * values[:, 0])
        values[:, 1] += gyro_factor * 0.1 * rate * np.cos(rate * values[:, 0])
        values[:, 2:] += 9.8 * np.column_stack([-np.sin(roll), 1.0 - np.cos(roll)])
        return values

    return columns("imu.csv", ["time_s", GYRO[0], *ACCEL[1:]], change)


def beams_against_depth(folder: Path) -> None:
    """Let depth rise and fall, and the beams see the opposite."""
    rate = 2.0 * np.pi / 30.0

    def depth(values: Array) -> Array:
        return np.column_stack([values[:, 0], 20.0 + 2.0 * np.sin(rate * values[:, 0])])

    def beams(values: Array) -> Array:
        down = 2.0 * rate * np.cos(rate * values[:, :1])
        return np.column_stack([values[:, 0], values[:, 1:] - 0.866 * down])

    columns("depth.csv", ["time_s", "depth_m"], depth)(folder)
    columns("dvl.csv", ["time_s", *BEAMS], beams)(folder)
