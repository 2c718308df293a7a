"""A segment of comma2k19 as a drive: in the plane of the map, read again, its instruments told."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.projection import TransverseMercator
from ssm_graph.cli.main import main
from ssm_graph.systems.road_map.comma2k19 import drive_of_comma2k19
from ssm_graph.systems.road_map.drive import Chassis, dead_reckoned
from ssm_graph.systems.road_map.folder import read_drive
from ssm_graph.systems.road_map.maps.read import read_map

LAT, LON = np.radians(37.4), np.radians(-122.1)
DELAY_S, SCALE = 0.2, 1.02


def ecef(lat: Array, lon: Array) -> Array:
    """Return Earth-fixed positions (N, 3) on the ellipsoid, m."""
    a, e_sq = 6378137.0, 6.69437999014e-3
    n = a / np.sqrt(1.0 - e_sq * np.sin(lat) ** 2)
    return np.column_stack(
        [
            n * np.cos(lat) * np.cos(lon),
            n * np.cos(lat) * np.sin(lon),
            n * (1.0 - e_sq) * np.sin(lat),
        ]
    )


@pytest.fixture
def segment(tmp_path: Path) -> Path:
    """Write a winding minute as the data set has it: fixes late, a speed that reads short."""
    folder = tmp_path / "segment"
    folder.mkdir()
    t = np.arange(0.0, 60.0, 0.05)
    speed, rate = 12.0 + 3.0 * np.sin(t / 7.0), 0.2 * np.sin(t / 11.0)
    plane = TransverseMercator(float(LAT), float(LON))
    chassis = Chassis(t, speed, rate)
    way = dead_reckoned(np.array([5.0, -3.0, 2.0]), t, chassis)
    stamp = np.arange(2.0, 58.0, 0.5)
    when = dead_reckoned(way[0], np.append(0.0, stamp - DELAY_S), chassis)[1:]
    lat, lon = plane.inverse(when[:, :2])
    fixes = np.zeros((len(stamp), 6))
    fixes[:, 0], fixes[:, 1] = np.degrees(lat), np.degrees(lon)
    arrays = {
        "processed_log_CAN_speed_t": t,
        "processed_log_CAN_speed_value": (speed / SCALE)[:, None],
        "processed_log_IMU_gyro_t": t,
        "processed_log_IMU_gyro_value": np.column_stack([0 * t, 0 * t, -rate]),
        "global_pose_frame_times": t,
        "global_pose_frame_positions": ecef(*plane.inverse(way[:, :2])),
    }
    for name in ("ublox", "qcom"):
        arrays[f"processed_log_GNSS_live_gnss_{name}_t"] = stamp
        arrays[f"processed_log_GNSS_live_gnss_{name}_value"] = fixes
    for stem, values in arrays.items():
        np.save(folder / f"{stem}.npy", values)
    return folder


def a_map(path: Path, *, plane: bool = False) -> Path:
    """Write a map of one line, some kilometres beside the segment's begin."""
    lon, lat = np.degrees(LON) + 0.02, np.degrees(LAT) + 0.01
    line = {"type": "LineString", "coordinates": [[lon, lat], [lon + 0.001, lat]]}
    feature = {"properties": {"kind": "boundary"}, "geometry": line}
    path.write_text(json.dumps({"plane": plane, "features": [feature]}))
    return path


def test_a_segment_becomes_a_drive(
    segment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the plane of the map; scale and delay are told, and a table of curves is taken along."""
    file, out, curves = a_map(tmp_path / "map.geojson"), tmp_path / "drive", tmp_path / "seen.csv"
    curves.write_text(
        "time_s,kind,side,c0_m,c1,c2_per_m,c3_per_m2,x_min_m,x_max_m\n1.0,0,1,1.75,0,0,0,0,30\n"
    )
    command = ["locate-convert", str(segment), "--map", str(file), "--out", str(out)]
    assert main([*command, "--curves", str(curves)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "speed times 1.020" in told
    late = re.search(r"stamped ([0-9.]+) s too late", told)
    assert late is not None
    assert float(late[1]) == pytest.approx(DELAY_S, abs=0.01)
    drive, road_map = read_drive(out)
    assert drive.curves.cubic[0, 0] == 1.75
    assert road_map.projection is not None
    assert drive.truth is not None
    here = road_map.projection.forward(LAT, LON)
    np.testing.assert_allclose(drive.truth.x_y[0], here, atol=6.0)
    at = drive.truth.at(drive.gnss.time_s - DELAY_S)
    np.testing.assert_allclose(drive.gnss.x_y, at[:, :2], atol=0.05)
    way = np.diff(drive.truth.x_y, axis=0)
    course = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    off = np.remainder(course - drive.truth.yaw[1:] + np.pi, 2.0 * np.pi) - np.pi
    assert np.abs(off).max() < 0.01


def test_a_map_without_a_place_is_refused(segment: Path, tmp_path: Path) -> None:
    """By its name, with the formats that have one."""
    road_map = read_map(a_map(tmp_path / "flat.geojson", plane=True))
    with pytest.raises(DataError, match=r"flat.geojson: expected a map that knows its place"):
        drive_of_comma2k19(segment, road_map)


def test_a_segment_that_lacks_an_array_is_refused(segment: Path, tmp_path: Path) -> None:
    """By the name of its file."""
    (segment / "processed_log_IMU_gyro_t.npy").unlink()
    road_map = read_map(a_map(tmp_path / "map.geojson"))
    with pytest.raises(DataError, match=r"processed_log_IMU_gyro_t\.npy"):
        drive_of_comma2k19(segment, road_map)
