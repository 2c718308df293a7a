"""Columns of anyone: three conventions end to end, units, signs, dates, and what is refused."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.inspection.look import inspect_path
from ssm_graph.io.columns.convert import convert_columns, times
from ssm_graph.io.columns.draft import draft_map
from ssm_graph.io.columns.map_file import ColumnMap, Times, read_map
from ssm_graph.io.columns.sources import Source, read_source
from ssm_graph.io.columns.units import factor_to
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of, write_vehicle
from ssm_graph.io.tables.files import write_table
from ssm_graph.mission.estimate import Trajectory
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.simulation import scenario_config, simulate
from ssm_graph.smoothers.mission import smooth

GRAVITY = 9.80665
UNIX = 1_777_629_600.0


@pytest.fixture(scope="module")
def mission() -> Mission:
    """Return forty seconds of the demo whose pings are whole or empty, and fixes of 2 m."""
    found = simulate(replace(scenario_config("demo"), duration_s=40.0)).mission
    assert found.gnss is not None
    even = replace(found.gnss, sigma_enu=np.full_like(found.gnss.sigma_enu, 2.0))
    whole = np.asarray(np.isfinite(found.dvl.speed).all(axis=1))
    speed = np.where(whole[:, None], found.dvl.speed, np.nan)
    dvl = replace(found.dvl, speed=speed)
    return replace(found, reference=None, gnss=even, dvl=dvl)


@pytest.fixture(scope="module")
def smoothed(mission: Mission) -> Trajectory:
    """Return the track of the mission as it is."""
    return smooth(mission).trajectory


def _csv(path: Path, columns: dict[str, Any], *, between: str = ",", above: str = "") -> None:
    rows = zip(*columns.values(), strict=True)
    text = [between.join(columns), *(between.join(map(str, row)) for row in rows)]
    path.write_text(above + "\n".join(text) + "\n", encoding="utf-8")


def _beams(values: Array) -> list[list[Any]]:
    return [["" if np.isnan(v) else v for v in column.tolist()] for column in values.T]


def forward_left_up(folder: Path, m: Mission) -> tuple[list[Path], str]:
    """Write one file an instrument: ms, FLU, deg/s, g, mm/s with codes, mbar, 1e-7 deg."""
    assert m.depth is not None
    assert m.gnss is not None
    gyro, accel = m.imu.gyro_b * [1, -1, -1], m.imu.accel_b * [1, -1, -1]
    _csv(
        folder / "imu.csv",
        {
            "Time [ms]": 1e3 * m.imu.time_s,
            **{f"W{a} [deg/s]": v for a, v in zip("XYZ", np.degrees(gyro).T, strict=True)},
            **{f"Acc {a} [g]": v for a, v in zip("XYZ", accel.T / GRAVITY, strict=True)},
        },
        above="# made by a logger\n",
    )
    speed = np.where(np.isnan(m.dvl.speed), -32768.0, 1e3 * m.dvl.speed)
    _csv(
        folder / "dvl.csv",
        {"t_ms": 1e3 * m.dvl.time_s, **{f"beam{i + 1}": v for i, v in enumerate(-speed.T)}},
    )
    _csv(
        folder / "depth.csv",
        {
            "t_ms": 1e3 * m.depth.time_s,
            "p": (m.depth.depth * 1025.0 * GRAVITY + 101_325.0) / 100.0,
        },
    )
    _csv(
        folder / "gps.csv",
        {
            "t_ms": 1e3 * m.gnss.time_s,
            "lat": 1e7 * np.degrees(m.gnss.lat),
            "lon": 1e7 * np.degrees(m.gnss.lon),
            "h_mm": 1e3 * m.gnss.height,
            **{n: m.gnss.sigma_enu[:, i] for i, n in enumerate(("se", "sn", "su"))},
        },
    )
    text = """
[imu]
file = "imu.csv"
time = { column = "Time [ms]", unit = "ms" }
gyro = { columns = ["WX [deg/s]", "WY [deg/s]", "WZ [deg/s]"], unit = "deg/s", axes = "FLU" }
accel = { columns = ["Acc X [g]", "Acc Y [g]", "Acc Z [g]"], unit = "g", axes = "FLU" }
[dvl]
file = "dvl.csv"
time = { column = "t_ms", unit = "ms" }
beam = { columns = ["-beam1", "-beam2", "-beam3", "-beam4"], unit = "mm/s", missing = 32768 }
[depth]
file = "dep*"
time = { column = "t_ms", unit = "ms" }
pressure = { column = "p", unit = "mbar" }
[gnss]
file = "gps.csv"
time = { column = "t_ms", unit = "ms" }
lat = { column = "lat", unit = "1e-7 deg" }
lon = { column = "lon", unit = "1e-7 deg" }
height = { column = "h_mm", unit = "mm" }
sigma = ["se", "sn", "su"]
"""
    return sorted(folder.glob("*.csv")), text


def one_file_of_dates(folder: Path, m: Mission) -> tuple[list[Path], str]:
    """Write all in one table with semicolons, decimal commas, dates and blanks between."""
    assert m.depth is not None
    assert m.gnss is not None
    names = ["Date", "wx", "wy", "wz", "fx", "fy", "fz", "v1", "v2", "v3", "v4", "z"]
    names += ["lat", "lon", "alt", "s", "ok"]
    rows: dict[float, dict[str, Any]] = {}

    def put(t: float, **cells: Any) -> None:
        rows.setdefault(t, {}).update(cells)

    # Forward is their -y, right their x, down their z.
    for t, w, f in zip(m.imu.time_s, m.imu.gyro_b, m.imu.accel_b, strict=True):
        wx, wy, wz = np.degrees(w[[1, 0, 2]]) * 3600.0 * [1, -1, 1]
        fx, fy, fz = f[[1, 0, 2]] * 1e3 / GRAVITY * [1, -1, 1]
        put(t, wx=wx, wy=wy, wz=wz, fx=fx, fy=fy, fz=fz)
    for t, v in zip(m.dvl.time_s, m.dvl.speed, strict=True):
        known = np.nan_to_num(v, nan=99.0) / 0.3048
        ok = int(np.isfinite(v).all())
        put(t, v1=known[0], v2=known[1], v3=known[2], v4=known[3], ok=ok)
    for t, z in zip(m.depth.time_s, m.depth.depth, strict=True):
        put(t, z=100.0 * z)
    g = m.gnss
    for t, lat, lon, h in zip(g.time_s, g.lat, g.lon, g.height, strict=True):
        put(t, lat=lat, lon=lon, alt=h, s=2.0)
    lines = [";".join(names)]
    for t, cells in sorted(rows.items()):
        date = datetime.fromtimestamp(UNIX + t, UTC).isoformat(timespec="microseconds")
        cells["Date"] = date.replace("+00:00", "Z")
        lines.append(";".join(str(cells.get(n, "")).replace(".", ",") for n in names))
    (folder / "all.csv").write_text("\n".join(lines) + "\n")
    text = """
[imu]
time = { column = "Date", unit = "iso" }
gyro = { columns = ["-wy", "wx", "wz"], unit = "deg/h" }
accel = { columns = ["-fy", "fx", "fz"], unit = "mg" }
[dvl]
time = { column = "Date", unit = "iso" }
beam = { columns = ["v1", "v2", "v3", "v4"], unit = "ft/s", valid = "ok" }
[depth]
time = { column = "Date", unit = "iso" }
depth = { column = "z", unit = "cm" }
[gnss]
time = { column = "Date", unit = "iso" }
lat = { column = "lat", unit = "rad" }
lon = { column = "lon", unit = "rad" }
height = "alt"
sigma = { columns = ["s", "s", "s"] }
"""
    return [folder / "all.csv"], text.replace('"iso" }', f'"iso", offset_s = {-UNIX} }}')


def two_columns_of_time(folder: Path, m: Mission) -> tuple[list[Path], str]:
    """Write seconds and nanoseconds, tabs, RFU, knots; every reading of the DVL twice."""
    assert m.depth is not None
    assert m.gnss is not None

    def clock(t: Array) -> dict[str, Any]:
        ns = np.rint((t + UNIX) * 1e6).astype(np.int64) * 1000
        return {"sec": ns // 10**9, "nsec": ns % 10**9}

    turned = [1, 0, 2]
    gyro, accel = (v[:, turned] * [1, 1, -1] for v in (m.imu.gyro_b, m.imu.accel_b))
    _csv(
        folder / "a.txt",
        {
            **clock(m.imu.time_s),
            **{f"w{a}": v for a, v in zip("xyz", gyro.T, strict=True)},
            **{f"a{a}": v for a, v in zip("xyz", accel.T, strict=True)},
        },
        between="\t",
    )
    twice = np.repeat(m.dvl.speed, 2, axis=0) / (1852.0 / 3600.0)
    t = np.column_stack([m.dvl.time_s, m.dvl.time_s + 0.01]).ravel()
    _csv(
        folder / "b.txt",
        {**clock(t), **{f"b{i}": v for i, v in enumerate(_beams(twice))}},
        between="\t",
    )
    write_table(
        folder / "d.parquet",
        {"t": m.depth.time_s / 60.0, "down": m.depth.depth / 1.8288},
    )
    write_table(
        folder / "g.parquet",
        {
            "t": m.gnss.time_s / 60.0,
            "lat": np.degrees(m.gnss.lat),
            "lon": np.degrees(m.gnss.lon),
            "h": m.gnss.height,
        },
    )
    text = f"""
[imu]
file = "a.txt"
time = {{ columns = ["sec", "nsec"], units = ["s", "ns"], offset_s = {-UNIX} }}
gyro = {{ columns = ["wx", "wy", "wz"], axes = "RFU" }}
accel = {{ columns = ["ax", "ay", "az"], axes = "RFU" }}
[dvl]
file = "b.txt"
time = {{ columns = ["sec", "nsec"], units = ["s", "ns"], offset_s = {-UNIX} }}
beam = {{ columns = ["b0", "b1", "b2", "b3"], unit = "knot" }}
only_changes = true
[depth]
file = "d.parquet"
time = {{ column = "t", unit = "min" }}
depth = {{ column = "down", unit = "fathom" }}
[gnss]
file = "g.parquet"
time = {{ column = "t", unit = "min" }}
lat = "lat"
lon = "lon"
height = "h"
sigma = {{ values = [2.0, 2.0, 2.0] }}
"""
    return sorted(p for p in folder.iterdir() if p.suffix in (".txt", ".parquet")), text


HEAD = 'format = 1\nvehicle = "mission.toml"\n'


@pytest.mark.parametrize("convention", [forward_left_up, one_file_of_dates, two_columns_of_time])
def test_foreign_conventions_end_where_the_mission_does(
    mission: Mission,
    smoothed: Trajectory,
    tmp_path: Path,
    convention: Callable[[Path, Mission], tuple[list[Path], str]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Exported in foreign units, converted and smoothed: the same track as the mission itself.

    Times of microseconds, and degrees of fifteen digits, leave micrometres.
    """
    m = mission
    write_vehicle(tmp_path, vehicle_of(m))
    files, text = convention(tmp_path, m)
    (tmp_path / "map.toml").write_text(HEAD + text)
    out = tmp_path / "out"
    words = ["convert", "--map", str(tmp_path / "map.toml"), *map(str, files), "--out", str(out)]
    assert main(words) == 0, capsys.readouterr().err
    found = read_mission(out)
    np.testing.assert_allclose(found.imu.time_s, m.imu.time_s, atol=1e-6)
    np.testing.assert_allclose(found.imu.gyro_b, m.imu.gyro_b, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(found.imu.accel_b, m.imu.accel_b, rtol=1e-9, atol=1e-12)
    known = np.isfinite(m.dvl.speed).any(axis=1)
    np.testing.assert_allclose(found.dvl.speed, m.dvl.speed[known], rtol=1e-9, atol=1e-12)
    ours = smooth(found).trajectory
    for name in ("lat", "lon"):
        np.testing.assert_allclose(getattr(ours, name)[-1], getattr(smoothed, name)[-1], atol=1e-11)
    np.testing.assert_allclose(ours.height[-1], smoothed.height[-1], atol=1e-4)


def test_units_of_the_world() -> None:
    """By pint, with a number before them, and g that is no gram."""
    cases = {
        ("g", "m/s^2"): GRAVITY,
        ("0.25 mg", "m/s^2"): 0.25e-3 * GRAVITY,
        ("deg/s", "rad/s"): np.pi / 180.0,
        ("°/h", "rad/s"): np.pi / 648_000.0,
        ("mGauss", "uT"): 0.1,
        ("dbar", "Pa"): 1e4,
        ("1e-7 deg", "deg"): 1e-7,
    }
    for (given, wanted), factor in cases.items():
        assert factor_to(given, wanted, place="m") == pytest.approx(factor, rel=1e-12)
    with pytest.raises(ConfigError, match=r"m \[dvl\]: expected a unit like m/s, got 'mm'"):
        factor_to("mm", "m/s", place="m [dvl]")
    with pytest.raises(ConfigError, match="'knobs' is no unit"):
        factor_to("knobs", "m/s", place="m")
    with pytest.raises(ConfigError, match="'0 s' is no unit"):
        factor_to("0 s", "s", place="m")


MAP = (
    HEAD
    + """
[imu]
file = "imu.csv"
time = "t"
gyro = ["gx", "gy", "gz"]
accel = ["ax", "ay", "az"]
[dvl]
file = "dvl.csv"
time = "t"
beam = ["b1", "b2", "b3", "b4"]
"""
)


@pytest.fixture
def small(tmp_path: Path, mission: Mission) -> Path:
    """Return a folder with a map, a vehicle and tables of two instruments."""
    write_vehicle(tmp_path, vehicle_of(mission))
    (tmp_path / "map.toml").write_text(MAP)
    imu, dvl = mission.imu, mission.dvl
    vectors = {f"g{a}": v for a, v in zip("xyz", imu.gyro_b.T, strict=True)}
    vectors |= {f"a{a}": v for a, v in zip("xyz", imu.accel_b.T, strict=True)}
    _csv(tmp_path / "imu.csv", {"t": imu.time_s, **vectors})
    beams = {f"b{i + 1}": v for i, v in enumerate(_beams(dvl.speed))}
    _csv(tmp_path / "dvl.csv", {"t": dvl.time_s, **beams})
    return tmp_path


def _converted(folder: Path) -> Mission:
    column_map: ColumnMap = read_map(folder / "map.toml")
    vehicle: Vehicle = read_vehicle(folder / "mission.toml")
    return convert_columns(sorted(folder.glob("*.csv")), column_map, vehicle, name="x")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"gx"', '"ggx"', "imu.csv has no column 'ggx'; did you mean 'gx'"),
        ("[dvl]", "[dlv]", "unknown section; did you mean 'dvl'"),
        ("beam =", "beams =", r"\[dvl\] beams: unknown key; did you mean 'beam'"),
        (', "b4"', "", "expected 4 columns, got 3; .* has 4 beams"),
        ('["gx", "gy", "gz"]', '{ columns = ["gx", "gy", "gz"], unit = "m" }', "unit like rad/s"),
        ('["gx", "gy", "gz"]', '{ columns = ["gx", "gy", "gz"], axes = "XYZ" }', "one of FRD"),
        ('file = "dvl.csv"', "", r"\[dvl\]: no file and the files dvl.csv, imu.csv"),
        ('beam = ["b1", "b2", "b3", "b4"]', 'velocity = ["b1", "b2", "b3"]', "beam_vectors ="),
        ("time =", "tyme =", r"\[imu\] tyme: unknown key; did you mean 'time'"),
        ("format = 1", "format = 2", "expected format = 1"),
    ],
)
def test_a_map_that_does_not_fit_is_refused(small: Path, old: str, new: str, told: str) -> None:
    """With section, key and the nearest known name."""
    (small / "map.toml").write_text(MAP.replace(old, new, 1))
    with pytest.raises((ConfigError, DataError), match=told):
        _converted(small)


def test_a_map_has_a_reference(small: Path, mission: Mission) -> None:
    """With units of its own; what it does not say is unknown, and it needs no vehicle section."""
    gnss = mission.gnss
    assert gnss is not None
    lat, lon = np.degrees(gnss.lat), np.degrees(gnss.lon)
    zeros = np.zeros_like(lat)
    track = {"ms": 1e3 * gnss.time_s, "lat": lat, "lon": lon, "h": gnss.height, "v": zeros + 2.0}
    _csv(small / "rtk.csv", {**track, "none": zeros})
    section = """
[reference]
file = "rtk.csv"
time = { column = "ms", unit = "ms" }
lat = "lat"
lon = "lon"
height = "h"
velocity = { columns = ["v", "none", "none"], unit = "knot" }
"""
    (small / "map.toml").write_text(MAP + section)
    found = _converted(small).reference
    assert found is not None
    np.testing.assert_allclose(found.time_s, gnss.time_s)
    np.testing.assert_allclose(found.lat, gnss.lat)
    np.testing.assert_allclose(found.velocity_enu[:, 0], 2.0 * 1852.0 / 3600.0)
    assert np.isnan(found.roll_pitch_heading).all()


def _broken(path: Path, line: int, change: Callable[[str], str]) -> None:
    lines = path.read_text().splitlines()
    lines[line - 1] = change(lines[line - 1])
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("file", "change", "told"),
    [
        ("imu.csv", lambda s: s.replace(s.split(",")[1], "bad"), "imu.csv:7: column 'gx' holds 'b"),
        ("imu.csv", lambda s: s.replace(s.split(",")[1], "n/a"), r"imu.csv:7: .*\('gx' of imu.csv"),
        ("imu.csv", lambda s: s + ",1", "imu.csv:7: 8 cells, expected 7"),
        ("imu.csv", lambda s: "0.0" + s[s.index(",") :], "imu.csv:7: time_s goes back"),
        ("imu.csv", lambda s: s.rsplit(",", 1)[0] + ",", r"imu.csv:7: .*\('az' of imu.csv\)"),
        ("dvl.csv", lambda s: s.split(",")[0] + ",1,1,1,4000", "dvl.csv:7: .*'b4' of dvl.csv"),
    ],
)
def test_a_bad_cell_is_named(
    small: Path, file: str, change: Callable[[str], str], told: str
) -> None:
    """With file, line and its own column, also where the house's checks find it."""
    _broken(small / file, 7, change)
    with pytest.raises(DataError, match=told):
        _converted(small)


def test_h5_and_mat_have_paths(tmp_path: Path) -> None:
    """Structures and groups within each other; a matrix has numbered columns."""
    h5py = pytest.importorskip("h5py")
    io = pytest.importorskip("scipy.io")
    gyro, t = np.arange(30.0).reshape(10, 3), np.arange(10.0)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["nav/imu/gyro"], file["nav/imu/t"] = gyro, t
    io.savemat(tmp_path / "b.mat", {"nav": {"imu": {"gyro": gyro.T, "t": t}}})
    for name in ("a.h5", "b.mat"):
        source = read_source(tmp_path / name)
        np.testing.assert_array_equal(source.numbers("nav/imu/gyro[2]", "x"), gyro[:, 2])
        np.testing.assert_array_equal(source.numbers("nav/imu/t", "x"), t)
    (tmp_path / "c.h5").write_bytes(b"no")
    with pytest.raises(DataError, match="expected an HDF5 file"):
        read_source(tmp_path / "c.h5")
    with pytest.raises(DataError, match="expected a table that ends in"):
        read_source(tmp_path / "c.xls")


def test_a_draft_of_own_columns_converts(mission: Mission, tmp_path: Path) -> None:
    """What inspect drafts of a table in other units and axes is right but for the beams' sign."""
    write_vehicle(tmp_path, vehicle_of(mission))
    files, _ = forward_left_up(tmp_path, mission)
    imu = draft_map(read_source(tmp_path / "imu.csv"))
    assert imu.found == ("imu",)
    drafted = tomllib.loads(imu.text)["imu"]
    assert drafted["time"] == {"column": "Time [ms]", "unit": "ms"}
    assert drafted["gyro"]["unit"] == "deg/s"
    assert drafted["accel"]["unit"] == "g"
    assert drafted["gyro"]["axes"] == drafted["accel"]["axes"] == "FLU"
    dvl = draft_map(read_source(tmp_path / "dvl.csv"))
    assert tomllib.loads(dvl.text)["dvl"]["beam"]["unit"] == "mm/s"
    gnss = draft_map(read_source(tmp_path / "gps.csv"))
    assert tomllib.loads(gnss.text)["gnss"]["lat"]["unit"] == "1e-7 deg"
    tables = tmp_path / "tables"
    tables.mkdir()
    for file in files:
        (tables / file.name).write_bytes(file.read_bytes())
    drafted_map = tmp_path / "map.toml"
    assert main(["inspect", str(tables), "--draft-map", str(drafted_map)]) == 4  # no mission yet
    both = drafted_map.read_text()
    assert list(tomllib.loads(both))[2:] == ["imu", "dvl", "gnss"]
    both = both.replace('"beam', '"-beam').replace("vehicle.toml", "mission.toml")
    drafted_map.write_text(both)
    found = convert_columns(
        files, read_map(tmp_path / "map.toml"), read_vehicle(tmp_path / "mission.toml"), name="x"
    )
    np.testing.assert_allclose(found.imu.accel_b, mission.imu.accel_b, rtol=1e-9, atol=1e-12)
    _csv(tmp_path / "no.csv", {"a": [1, 2], "b": [3, 4]})
    nameless = read_source(tmp_path / "no.csv")
    with pytest.raises(DataError, match="no column whose name says that it is a time"):
        draft_map(nameless)


def test_times_in_several_columns_are_drafted(tmp_path: Path) -> None:
    """Seconds and nanoseconds, date and time of the day, GPS week and milliseconds: one instant."""
    at = 1_777_629_600.25 + 0.5 * np.arange(4.0)
    gps = at - 315_964_800.0 + 18.0
    clock = [f"10:00:{t - 1_777_629_600.0:05.2f}" for t in at]
    ways: dict[str, dict[str, Any]] = {
        "ros": {"stamp_sec": np.floor(at), "stamp_nanosec": np.round(1e9 * (at % 1.0))},
        "date": {"Date": ["2026-05-01"] * 4, "Time": clock},
        "week": {"GPS Week": gps // 604_800.0, "iTOW [ms]": 1e3 * (gps % 604_800.0)},
        "when": {"Date": [f"2026-05-01T{text}Z" for text in clock]},
    }
    for name, columns in ways.items():
        path = tmp_path / f"{name}.csv"
        _csv(path, {**columns, "depth_m": [1.0, 2.0, 3.0, 4.0], "mood": [7] * 4}, between=";")
        text = draft_map(read_source(path)).text
        assert f"# not drafted, of {name}.csv: mood\n" in text
        of = tomllib.loads(text)["depth"]["time"]
        names = tuple(of.get("columns") or [of["column"]])
        units = tuple(of.get("units") or [of["unit"]])
        wanted = Times("map.toml [depth] time", names, units, float(of.get("offset_s", 0.0)))
        np.testing.assert_allclose(times(wanted, read_source(path)), at, atol=1e-6)


@pytest.mark.parametrize(
    ("speeds", "ranges", "others"),
    [
        ("field.bottomVelocityBeam{}", "field.altitudeBeam{}", "field.waterVelocityBeam{}"),
        ("beam{}_velocity", "beam{}_distance", "beam{}_valid"),
        ("bt_vel_{}", "bt_range_{}", "wt_vel_{}"),
    ],
)
def test_a_draft_takes_the_speeds_off_the_ground(
    tmp_path: Path, speeds: str, ranges: str, others: str
) -> None:
    """Not those off the water, nor flags, ranges and a code that never changes."""
    k = np.arange(6.0)
    columns: dict[str, Any] = {"time": 0.25 * k, "heading": 0.0 * k, "pressure": 0.0 * k + 101.0}
    for form, size in ((others, 0.1), (ranges, 9.0), (speeds, 0.3)):
        columns |= {form.format(beam): size + 0.01 * k for beam in range(4)}
    _csv(tmp_path / "a.csv", columns)
    drafted = tomllib.loads(draft_map(read_source(tmp_path / "a.csv")).text)
    assert drafted["dvl"]["beam"]["columns"] == [speeds.format(beam) for beam in range(4)]
    assert drafted["dvl"]["range"]["columns"] == [ranges.format(beam) for beam in range(4)]
    assert not {"depth", "heading"} & set(drafted)
    said = " ".join(inspect_path(tmp_path / "a.csv").sensors[0].facts)
    assert f"may be beam of [dvl]: {speeds.format(0)}" in said


def test_tables_of_other_loggers(tmp_path: Path) -> None:
    """Bars, runs of blanks, a row of units below the header."""
    for text in (
        "t|p\n0.5|1.0\n1.0|2.0\n",
        " t   p\n 0.5  1.0 \n1.0 2.0\n",
        "t,p\ns,bar\n0.5,1\n1,2\n",
        "t\tp\n0,5\t1,0\n1,0\t2\n",
        "t;p;H\u00f6he (\u00b0)\n0,5;1,0;1\n1,0;2;1\n",
    ):
        path = tmp_path / "other.csv"
        path.write_text(text, encoding="cp1252")
        found = read_source(path)
        assert found.numbers("t", "x").tolist() == [0.5, 1.0]
        assert found.numbers("p", "x").tolist() == [1.0, 2.0]
    assert found.numbers("H\u00f6he (\u00b0)", "x").tolist() == [1.0, 1.0]
    path.write_text("t\tp\n0.5\t1,000\n1.0\t999.5\n")
    with pytest.raises(DataError, match=r"other.csv:2: column 'p' holds '1,000'"):
        read_source(path).numbers("p", "x")


def test_words_for_a_missing_reading_are_empty_cells(tmp_path: Path) -> None:
    """Whatever a logger calls it."""
    path = tmp_path / "log.csv"
    path.write_text("t,p\n1.0,NULL\n2.0,n/a\n3.0,-\n4.0,\n5.0,-7\n")
    found = read_source(path).numbers("p", "x")
    np.testing.assert_array_equal(found, [np.nan, np.nan, np.nan, np.nan, -7.0])


@pytest.mark.parametrize("end", ["", "3.0", "3.0,", "3.0,7", "3.0,7.12345e-", "3.0,-"])
def test_a_line_that_ends_with_the_file_is_no_reading(tmp_path: Path, end: str) -> None:
    """A number that was cut is a number, too."""
    path = tmp_path / "log.csv"
    path.write_text("t,p\n1.0,7.12345\n2.0,7.12346\n" + end)
    found = read_source(path)
    assert found.numbers("t", "x").tolist() == [1.0, 2.0, 3.0][: 3 if end == "3.0," else 2]
    assert len(found.notes) == bool(end)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "the file is empty"),
        ("t,p\n", "a header and no rows"),
        ("0,5;1,5\n1;2\n", "add a header"),
    ],
)
def test_tables_without_rows_or_header(tmp_path: Path, text: str, told: str) -> None:
    """Each is told by what it lacks."""
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(DataError, match=told):
        read_source(tmp_path / "log.csv")


def test_templates_are_valid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both are read as they are, and never written over what was filled in."""
    assert main(["template", "--out", str(tmp_path)]) == 0
    column_map = read_map(tmp_path / "map.toml")
    vehicle = read_vehicle(tmp_path / "vehicle.toml")
    assert [one.name for one in column_map.sections] == ["imu", "dvl", "depth", "gnss"]
    assert vehicle.mount.n_beams == 4
    assert main(["template", "--out", str(tmp_path)]) == 2
    assert "is there already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"gz"]', '"short"]', "gyro: its columns of imu.mat have 2 and 4 rows"),
        (
            '["gx", "gy", "gz"]',
            '{ columns = ["gx", "gy", "gz"], valid = "short" }',
            "have 2 and 4 rows",
        ),
        ('time = "t"', 'time = { columns = ["t", "short"], units = ["s", "s"] }', "has 2 rows"),
    ],
)
def test_columns_of_several_lengths_are_refused(small: Path, old: str, new: str, told: str) -> None:
    """Times, readings and what says whether they count: never stretched, never a broken program."""
    (small / "map.toml").write_text(MAP.replace("imu.csv", "imu.mat").replace(old, new, 1))
    whole = {name: np.arange(4.0) for name in ("t", "gx", "gy", "gz", "ax", "ay", "az")}
    savemat(small / "imu.mat", whole | {"short": np.arange(2.0)})
    files = [small / "imu.mat", small / "dvl.csv"]
    with pytest.raises(DataError, match=told):
        convert_columns(files, read_map(small / "map.toml"), read_vehicle(small), name="x")


def test_dates_that_are_missing_are_none() -> None:
    """An empty cell of a Parquet table is no time of the year 1677."""
    dates = np.array(["2026-05-01T10:00:00", "NaT"], "datetime64[us]")
    found = times(Times("map time", ("t",), ("iso",), 0.0), Source("a.parquet", {"t": dates}))
    np.testing.assert_array_equal(found, [UNIX, np.nan])


@pytest.mark.parametrize("cell", ["10:61:00", "25:00:00", "10:00:75"])
def test_a_time_that_no_day_has_is_refused(cell: str) -> None:
    """Rather than counted on into the next hour; a leap second is one."""
    asked = Times("map time", ("t",), ("iso",), 0.0)
    found = times(asked, Source("a.csv", {"t": ["09:05:59.5", "23:59:60"]}))
    np.testing.assert_array_equal(found, [32759.5, 86400.0])
    with pytest.raises(DataError, match="expected a time like"):
        times(asked, Source("a.csv", {"t": ["10:00:00", cell]}))


def test_files_that_only_say_that_they_are_tables(tmp_path: Path) -> None:
    """A quotation mark that is never closed; a matrix of a terabyte that was never written."""
    path = tmp_path / "a.csv"
    path.write_text('t,x\n0,"1' + "\n1" * 200_000)
    with pytest.raises(DataError, match="quotation mark not closed"):
        read_source(path)
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"] = np.arange(3.0)
        file.create_dataset("frames", (1000, 480, 640), "u1")
    assert list(read_source(tmp_path / "a.h5").columns) == ["t"]
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file.create_dataset("x", (2**40,), "f8", chunks=(1024,))
    with pytest.raises(DataError, match="expected columns of at most 2 GiB"):
        read_source(tmp_path / "a.h5")
