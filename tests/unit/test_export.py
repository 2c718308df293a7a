"""Results in the formats of other software say there what they say here."""

from __future__ import annotations

import csv
import json
import math
import sqlite3
import struct
import zipfile
from contextlib import closing
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.io import netcdf_file
from scipy.spatial.transform import Rotation

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.cli.main import main
from ssm_graph.evaluation.errors import evaluate
from ssm_graph.io.export.formats import FORMATS, export_track
from ssm_graph.io.export.maps import GX, KML, degrees, lines
from ssm_graph.io.export.sbet import gps_seconds_of_week
from ssm_graph.io.export.track import Track, parse_epoch, track_of
from ssm_graph.io.nmea_sentences import checksum
from ssm_graph.io.results.tables import (
    BEAM_COLUMNS,
    TRAJECTORY_COLUMNS,
    Results,
    format_table,
)
from ssm_graph.mission.estimate import Trajectory
from ssm_graph.mission.mission import Reference

EPOCH = "2026-05-01T10:00:00Z"
EPOCH_S = 1777629600.0
N = 40


def results(*, lon_deg: float = 7.0, begin_s: float = 0.0) -> Results:
    """Return a result: 40 s eastwards with all angles different, doubtful from 10 to 14 s."""
    t = begin_s + np.arange(N, dtype=float)
    k = np.arange(N, dtype=float)
    rows = {
        "time_s": t,
        "lat_deg": 60.0 + 1e-6 * k,
        "lon_deg": lon_deg + 2e-5 * k,
        "height_m": -5.0 - 0.1 * k,
    }
    for i, name in enumerate(("east", "north", "up")):
        rows[f"vel_{name}_m_per_s"] = np.full(N, (1.1, 0.1, -0.1)[i])
        rows[f"sigma_{name}_m"] = 0.1 * (i + 1) + 0.01 * k
        rows[f"sigma_vel_{name}_m_per_s"] = np.full(N, 0.001 * (i + 1))
    for i, name in enumerate(("roll", "pitch", "heading")):
        rows[f"{name}_deg"] = (2.0, -3.0, 84.0)[i] + 0.1 * k
        rows[f"sigma_{name}_deg"] = np.full(N, 0.01 * (i + 1))
    rows["suspect"] = ((k >= 10) & (k <= 14)).astype(float)
    summary = {"mission": "lake <trial> & 3", "method": "smoother", "status": "CONVERGED"}
    return Results(Path("result"), rows, {}, {**summary, "reason": "settled"})


@pytest.fixture
def result_folder(tmp_path: Path) -> Path:
    """Return that result as a folder."""
    return write_result(tmp_path / "result")


def write_result(folder: Path) -> Path:
    """Write that result; return its folder."""
    of = results()
    folder.mkdir()
    filler = np.zeros(N)
    columns = {name: (of.trajectory.get(name, filler), "%.17g") for name in TRAJECTORY_COLUMNS}
    (folder / "trajectory.csv").write_text(format_table(columns))
    (folder / "beams.csv").write_text(",".join(BEAM_COLUMNS) + "\n")
    (folder / "summary.json").write_text(json.dumps(dict(of.summary)))
    return folder


def track(**options: float) -> Track:
    """Return that result's track with its UTC."""
    return track_of(results(**options), epoch_s=EPOCH_S)


def written(tmp_path: Path, form: str, of: Track | None = None) -> Path:
    """Return the file of a format."""
    path = tmp_path / f"track{FORMATS[form].suffix}"
    assert path in export_track(of or track(), form, path)
    assert not list(tmp_path.glob(".part*"))
    return path


def test_tum_and_kitti_hold_the_same_poses(tmp_path: Path) -> None:
    """Body axes are forward, left, up: at a heading of 84 degrees forward is nearly east."""
    tum = np.loadtxt(written(tmp_path, "tum"))
    kitti = np.loadtxt(written(tmp_path, "kitti")).reshape(-1, 3, 4)
    turn = Rotation.from_quat(tum[:, 4:]).as_matrix()
    np.testing.assert_allclose(kitti[:, :, :3], turn, atol=1e-8)
    np.testing.assert_allclose(kitti[:, :, 3], tum[:, 1:4], atol=1e-4)
    forward, left, up = turn[0].T
    heading, pitch = math.radians(84.0), math.radians(-3.0)
    expected = [math.sin(heading), math.cos(heading), math.tan(pitch)]
    np.testing.assert_allclose(forward, np.array(expected) * math.cos(pitch), atol=1e-8)
    assert left[1] > 0.9  # northwards
    assert up[2] > 0.9
    # 2e-5 degrees of longitude at 60 degrees north.
    np.testing.assert_allclose(np.diff(tum[:, 1]), 1.1158, atol=2e-4)


def test_ape_of_evo_is_our_error(tmp_path: Path) -> None:
    """Of the exported track against an exported reference, as ``rescore`` has it."""
    metrics = pytest.importorskip("evo.core.metrics")
    files = pytest.importorskip("evo.tools.file_interface")
    off, k = results(), np.arange(N)
    off.trajectory["lat_deg"] += 2e-6 * np.sin(k)
    off.trajectory["lon_deg"] += 3e-6 * np.cos(k)
    off.trajectory["height_m"] += 0.3 * np.sin(2.0 * k)
    truth, moved = track(), track_of(off, epoch_s=EPOCH_S, origin=track().frame)
    paths = [tmp_path / "truth.tum", tmp_path / "moved.tum"]
    for path, one in zip(paths, (truth, moved), strict=True):
        export_track(one, "tum", path)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(tuple(map(files.read_tum_trajectory_file, paths)))
    theirs = ape.get_statistic(metrics.StatisticsType.rmse)
    of_tracks = ("time_s", "lat", "lon", "height", "velocity_enu", "roll_pitch_heading")
    zeros = np.zeros((N, 3))
    columns = {name: getattr(moved, name) for name in of_tracks}
    zeros = np.zeros((N, 3))
    unknown = ("gyro_bias", "accel_bias", "velocity_sigma_enu", "attitude_sigma")
    cov = np.tile(np.eye(3), (N, 1, 1))
    columns |= {**dict.fromkeys(unknown, zeros), "position_cov_enu": cov, "n_beams": zeros[:, 0]}
    reference = Reference(**{name: getattr(truth, name) for name in of_tracks})
    found = evaluate(Trajectory(**columns), reference)
    ours = math.hypot(found.rmse_horizontal_m, found.rmse_vertical_m)
    assert theirs == pytest.approx(ours, rel=1e-4)
    assert ours > 0.2


def test_the_wide_table_loses_nothing(tmp_path: Path) -> None:
    """Every number comes back to the last bit; UTC stands beside seconds."""
    of = track()
    with written(tmp_path, "csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows[3]["utc"] == "2026-05-01T10:00:03.000Z"
    assert [float(row["lat_deg"]) for row in rows] == np.degrees(of.lat).tolist()
    assert [float(row["suspect"]) for row in rows] == of.is_suspect.tolist()
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(written(tmp_path, "parquet"))
    assert table["sigma_up_m"].to_pylist() == of.position_sigma_enu[:, 2].tolist()


def test_netcdf_is_a_cf_trajectory(tmp_path: Path) -> None:
    """Coordinates, units and the trajectory's name are those that CF readers look for."""
    of = track()
    with netcdf_file(str(written(tmp_path, "netcdf")), mmap=False) as file:
        assert (file.Conventions, file.featureType) == (b"CF-1.11", b"trajectory")
        assert file.variables["time"].units == b"seconds since 1970-01-01T00:00:00Z"
        np.testing.assert_array_equal(file.variables["time"].data, of.unix_s)
        np.testing.assert_array_equal(file.variables["lat"].data, np.degrees(of.lat))
        assert file.variables["trajectory"].data.tobytes() == of.name.encode()
        named = [v for v in file.variables.values() if hasattr(v, "ancillary_variables")]
        assert all(v.ancillary_variables.decode() in file.variables for v in named)
        assert len(named) == 6


def test_geojson_and_kml_show_the_doubtful_stretch(tmp_path: Path) -> None:
    """A line for all, one for each stretch; times where they are known."""
    of = track()
    whole, doubtful = json.loads(written(tmp_path, "geojson").read_text())["features"]
    assert whole["geometry"]["type"] == "LineString"
    np.testing.assert_allclose(whole["geometry"]["coordinates"], degrees(of))
    assert whole["properties"]["coordTimes"][0] == "2026-05-01T10:00:00.000Z"
    assert (doubtful["properties"]["begin_s"], doubtful["properties"]["end_s"]) == (10.0, 14.0)
    assert len(doubtful["geometry"]["coordinates"]) == 5
    root = ElementTree.fromstring(written(tmp_path, "kml").read_bytes())
    assert len(root.findall(f".//{{{KML}}}LineString")) == 2
    assert len(root.findall(f".//{{{GX}}}coord")) == len(root.findall(f".//{{{KML}}}when")) == N
    with zipfile.ZipFile(written(tmp_path, "kmz")) as archive:
        assert archive.read("doc.kml") == written(tmp_path, "kml").read_bytes()
    ring = root.find(f".//{{{KML}}}LinearRing/{{{KML}}}coordinates")
    assert ring is not None
    assert ring.text is not None
    corners = np.array([c.split(",") for c in ring.text.split()], dtype=float)
    # Three sigma of 0.1 m east, of 0.2 m north; a degree of latitude is 111.4 km there.
    assert np.ptp(corners[:, 1]) * 111412.0 / 2.0 == pytest.approx(0.6, abs=1e-3)
    assert np.ptp(corners[:, 0]) * 55800.0 / 2.0 == pytest.approx(0.3, abs=1e-3)


def test_a_line_over_the_antimeridian_is_cut_there() -> None:
    """Both parts end on the meridian, at the same latitude: nothing runs around the world."""
    east, west = lines(degrees(track(lon_deg=180.0 - 1e-4)))
    assert (east[-1, 0], west[0, 0]) == (180.0, -180.0)
    assert east[-1, 1] == west[0, 1]
    assert max(np.abs(np.diff(part[:, 0])).max() for part in (east, west)) < 3e-5
    assert len(east) + len(west) == N + 2


def test_gpx_holds_heights_and_times(tmp_path: Path) -> None:
    """A point a row; text that XML would take for its own is escaped."""
    root = ElementTree.fromstring(written(tmp_path, "gpx").read_bytes())
    space = {"g": "http://www.topografix.com/GPX/1/1"}
    assert root.findtext("g:trk/g:name", namespaces=space) == "lake <trial> & 3"
    points = root.findall(".//g:trkpt", space)
    assert [float(p.attrib["lon"]) for p in points] == degrees(track())[:, 0].tolist()
    assert points[1].findtext("g:time", namespaces=space) == "2026-05-01T10:00:01.000Z"


def test_geopackage_has_a_line_and_points(tmp_path: Path) -> None:
    """Head, reference system and well-known binary are where the standard has them."""
    path = written(tmp_path, "geopackage")
    with closing(sqlite3.connect(path)) as base:
        assert base.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        listed = base.execute("SELECT table_name, srs_id FROM gpkg_contents").fetchall()
        assert listed == [("track", 4326), ("keyframes", 4326)]
        (line,) = base.execute("SELECT geom FROM track").fetchone()
        magic, _, flags, system = struct.unpack_from("<2sBBi", line)
        assert (magic, flags, system) == (b"GP", 1, 4326)
        assert struct.unpack_from("<BIIBII", line.ljust(40), 8)[1:3] == (1005, 1)
        point, sigma = base.execute("SELECT geom, sigma_up_m FROM keyframes").fetchall()[-1]
        assert struct.unpack_from("<ddd", point, 13) == tuple(degrees(track())[-1])
        assert sigma == track().position_sigma_enu[-1, 2]


def test_kml_and_geojson_are_valid(tmp_path: Path) -> None:
    """By the schemata of OGC and Google, and by a library of RFC 7946."""
    validator = pytest.importorskip("fastkml.validator")
    geojson = pytest.importorskip("geojson")
    path = written(tmp_path, "kml")
    assert validator.validate(file_to_validate=path)
    path.write_text(
        path.read_text().replace("<name>", "<nome>", 1).replace("</name>", "</nome>", 1)
    )
    with pytest.raises(AssertionError):  # else it sees nothing
        validator.validate(file_to_validate=path)
    over = geojson.loads(written(tmp_path, "geojson", track(lon_deg=180.0 - 1e-4)).read_text())
    assert over.is_valid, over.errors()
    assert over.features[0].geometry.type == "MultiLineString"


def test_gdal_and_a_cf_checker_take_the_files(tmp_path: Path) -> None:
    """Layers, reference system and the numbers themselves, read by the libraries of others."""
    gdal = pytest.importorskip("pyogrio")
    for form in ("geopackage", "geojson", "kml", "gpx"):
        layers = gdal.list_layers(written(tmp_path, form))
        assert len(layers) >= 1
    path = written(tmp_path, "geopackage")
    info = gdal.read_info(path, layer="keyframes")
    assert (info["features"], info["crs"]) == (N, "EPSG:4326")
    west, _, east, _ = info["total_bounds"]
    assert (west, east) == (degrees(track())[0, 0], degrees(track())[-1, 0])
    runner = pytest.importorskip("compliance_checker.runner")
    runner.CheckSuite.load_all_available_checkers()
    words = {"criteria": "strict", "verbose": 0, "output_filename": str(tmp_path / "said.txt")}
    netcdf = str(written(tmp_path, "netcdf"))
    passed, broke = runner.ComplianceChecker.run_checker(netcdf, ["cf:1.11"], **words)
    assert (passed, broke) == (True, False), (tmp_path / "said.txt").read_text()


def test_sbet_goes_round(tmp_path: Path) -> None:
    """Seventeen doubles a row and ten of accuracy, in GPS time, down positive, arc minutes."""
    path, of = written(tmp_path, "sbet"), track()
    rows = np.fromfile(path, "<f8").reshape(-1, 17)
    # A Friday: five days, ten hours and eighteen leap seconds since Sunday.
    assert rows[0, 0] == 5 * 86400 + 10 * 3600 + 18
    np.testing.assert_array_equal(rows[:, 1:4], np.column_stack([of.lat, of.lon, of.height]))
    np.testing.assert_array_equal(rows[:, 6], -of.velocity_enu[:, 2])
    np.testing.assert_allclose(rows[:, 7:10], of.roll_pitch_heading)
    accuracy = np.fromfile(path.with_name("smrmsg_track.sbet"), "<f8").reshape(-1, 10)
    np.testing.assert_array_equal(accuracy[:, 1], of.position_sigma_enu[:, 1])
    np.testing.assert_allclose(accuracy[:, 9], 0.03 * 60.0)
    with pytest.raises(ConfigError, match="2006"):
        gps_seconds_of_week(np.array([1.0e9]))


def test_mcap_is_read_back_by_its_own_library(tmp_path: Path) -> None:
    """Three topics with a message a row, in order of time."""
    reader = pytest.importorskip("mcap.reader")
    with written(tmp_path, "mcap").open("rb") as stream:
        messages = [
            (channel.topic, message.log_time, json.loads(message.data))
            for _, channel, message in reader.make_reader(stream).iter_messages()
        ]
    fixes = [(when, content) for topic, when, content in messages if topic == "/location"]
    assert len(messages) == 3 * N
    assert fixes[5][0] == round((EPOCH_S + 5.0) * 1e9)
    assert fixes[5][1]["latitude"] == pytest.approx(60.000005, abs=1e-12)
    assert fixes[0][1]["position_covariance"][0] == pytest.approx(0.01)
    doubtful = [c["suspect"] for topic, _, c in messages if topic == "/navigation"]
    assert doubtful == track().is_suspect.tolist()


def test_nmea_can_be_read_by_plotters(tmp_path: Path) -> None:
    """Three sound sentences a row, with the time of day."""
    sentences = written(tmp_path, "nmea").read_bytes().decode().split("\r\n")[:-1]
    assert len(sentences) == 3 * N
    assert sentences[3].startswith("$INGGA,100001.000,6000.000060,N,00700.001200,E,6,")
    for sentence in sentences:
        body, _, digits = sentence[1:].partition("*")
        assert checksum(body) == digits


def test_utc_is_asked_for_and_never_guessed(tmp_path: Path) -> None:
    """Unix time needs no epoch and takes none; another clock needs one where UTC is written."""
    assert parse_epoch(EPOCH) == EPOCH_S == parse_epoch(str(EPOCH_S))
    assert datetime.fromisoformat(track_of(results(begin_s=EPOCH_S)).utc()[0]).minute == 0
    with pytest.raises(ConfigError, match="which is Unix time"):
        track_of(results(begin_s=EPOCH_S), epoch_s=0.0)
    with pytest.raises(ConfigError, match="no Unix time; try --epoch"):
        export_track(track_of(results()), "sbet", tmp_path / "x.sbet")
    assert not list(tmp_path.iterdir())
    for text in ("yesterday", "2026-05-01T10:00:00"):
        with pytest.raises(ConfigError, match="with its zone"):
            parse_epoch(text)


def test_what_is_no_answer_is_not_handed_on() -> None:
    """A run away or empty trajectory is refused with its place."""
    bad = results()
    bad.trajectory["lat_deg"][7] = np.nan
    with pytest.raises(DataError, match=r"trajectory.csv:9: lat_deg is not finite"):
        track_of(bad)
    empty = Results(bad.folder, {k: v[:0] for k, v in bad.trajectory.items()}, {}, {})
    with pytest.raises(DataError, match="at least one row"):
        track_of(empty)
    with pytest.raises(ConfigError, match="did you mean 'geojson'"):
        export_track(track(), "geojsn", Path("x"))


def test_the_command_writes_what_it_is_asked_for(
    result_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Several formats into a folder, one into a file; nothing among the result's own files."""
    words = ["export", str(result_folder), "--epoch", EPOCH]
    assert main([*words, "--format", "tum,kml", "--out", str(tmp_path / "maps")]) == 0
    assert [p.suffix for p in sorted((tmp_path / "maps").iterdir())] == [".kml", ".tum"]
    assert main([*words, "--format", "tum", "--out", str(tmp_path / "a.txt")]) == 0
    assert len((tmp_path / "a.txt").read_text().splitlines()) > 5
    own = result_folder / "trajectory.csv"
    before = own.read_bytes()
    assert main([*words, "--format", "csv", "--out", str(own)]) == 2
    assert own.read_bytes() == before
    assert "would lie in the result folder" in capsys.readouterr().err
    assert main([*words, "--format", "tum"]) == 0
    assert list((tmp_path / "result-export").iterdir())
