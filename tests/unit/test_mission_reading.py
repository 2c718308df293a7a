"""Units, axes, stamps and defaults of the mission reader, each against numbers done by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.aids.gnss import GNSS_DRIFT
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.mission.calibration import DVL_DRIFT, extras_of
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.drift import Drift
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
    raw,
    toml,
)
from tests.mission_fixture import write_example


def read_after(folder: Path, *changes: Damage) -> Mission:
    """Write the example, change it, read it."""
    write_example(folder)
    both(*changes)(folder)
    return read_mission(folder)


def test_units_become_si(tmp_path: Path) -> None:
    """Data-sheet units by hand."""
    mission = read_after(
        tmp_path,
        toml(
            "accel_bias_ug = 100.0",
            "accel_bias_ug = 100\ngyro_bias_walk_deg_per_h_per_sqrt_h = 0.6\n"
            "accel_bias_walk_ug_per_sqrt_h = 30.0",
        ),
    )
    noise = mission.imu.noise
    degree = math.pi / 180.0
    assert noise.gyro_density == pytest.approx(0.05 * degree / 60.0, rel=1e-14)
    assert noise.accel_density == pytest.approx(50.0 * 9.80665e-6, rel=1e-14)
    assert noise.gyro_bias_sigma == pytest.approx(0.5 * degree / 3600.0, rel=1e-14)
    assert noise.accel_bias_sigma == pytest.approx(9.80665e-4, rel=1e-14)
    assert noise.gyro_bias_density == pytest.approx(0.01 * degree / 3600.0, rel=1e-14)
    assert noise.accel_bias_density == pytest.approx(0.5 * 9.80665e-6, rel=1e-14)
    assert mission.initial is not None
    assert mission.initial.heading == pytest.approx(63.4 * degree)
    np.testing.assert_allclose(
        mission.initial.attitude_sigma, np.array([0.06, 0.06, 0.3]) * degree, rtol=1e-14
    )


def test_optional_dvl_keys_are_zero_when_absent(tmp_path: Path) -> None:
    """Zero switches a calibration off; a bias walk that is not given is zero."""
    mission = read_after(tmp_path)
    mount = mission.dvl.mount
    assert mount.misalignment_sigma == mount.scale_sigma == 0.0
    assert mount.time_offset_s == mount.time_offset_sigma_s == 0.0
    assert mission.imu.noise.gyro_bias_density == mission.imu.noise.accel_bias_density == 0.0


def test_optional_dvl_keys_are_read(tmp_path: Path) -> None:
    """Each key reaches its field."""
    keys = (
        "misalignment_sigma_deg = 2.0\nscale_sigma = 0.03\ntime_offset_s = 0.12\n"
        "time_offset_sigma_s = 0.05\n\n[depth]"
    )
    mount = read_after(tmp_path, toml("\n[depth]", keys)).dvl.mount
    assert mount.misalignment_sigma == pytest.approx(math.radians(2.0))
    assert (mount.scale_sigma, mount.time_offset_s, mount.time_offset_sigma_s) == (0.03, 0.12, 0.05)


def test_calibration_keys_are_read(tmp_path: Path) -> None:
    """Each key reaches its field; known offsets are taken off the readings."""
    for name in ("plain", "changed"):
        (tmp_path / name).mkdir()
    plain = read_after(tmp_path / "plain")
    dvl = (
        "scale_error = -0.03\nscale_sigma = 0.02\nscale_walk_per_sqrt_h = 0.06\n"
        "beam_scale_error = [0, 0.01, 0, 0]\nbeam_scale_sigma = 0.005\nlever_arm_sigma_m = 0.3\n"
    )
    changes = (
        toml("\n[depth]", f"{dvl}\n[depth]\noffset_m = 0.5\noffset_sigma_m = 0.2"),
        toml(
            "\n[gnss]",
            "\n[gnss]\ntime_offset_s = 0.3\ntime_offset_sigma_s = 0.1\nlever_arm_sigma_m = 0.4",
        ),
    )
    mission = read_after(tmp_path / "changed", *changes)
    mount, depth, gnss = mission.dvl.mount, mission.depth, mission.gnss
    assert depth is not None
    assert gnss is not None
    assert plain.depth is not None
    assert plain.gnss is not None
    assert (mount.scale_error, mount.scale_sigma) == (-0.03, 0.02)
    assert mount.scale_walk_density == pytest.approx(0.001)
    assert (mount.beam_scale_sigma, mount.lever_arm_sigma) == (0.005, 0.3)
    longer = np.linalg.norm(mount.beams_b, axis=1)
    np.testing.assert_allclose(longer, [0.97, 0.97 * 1.01, 0.97, 0.97])
    assert (depth.calibration.offset, depth.calibration.offset_sigma) == (0.5, 0.2)
    np.testing.assert_array_equal(depth.depth, plain.depth.depth)
    np.testing.assert_allclose(depth.true_depth, plain.depth.depth - 0.5)
    assert (gnss.calibration.time_offset_sigma_s, gnss.calibration.lever_arm_sigma) == (0.1, 0.4)
    np.testing.assert_array_equal(gnss.time_s, plain.gnss.time_s)
    np.testing.assert_allclose(gnss.valid_s, plain.gnss.time_s - 0.3)


def test_a_scale_that_walks_needs_a_sigma_to_start_from(tmp_path: Path) -> None:
    """Without one the walk would never be looked at."""
    with pytest.raises(ConfigError, match=r"scale_walk_per_sqrt_h: expected with a scale_sigma"):
        read_after(tmp_path, toml("\n[depth]", "scale_walk_per_sqrt_h = 0.01\n\n[depth]"))


def test_beams_and_mounting(tmp_path: Path) -> None:
    """Beam 1 looks 45 degrees to starboard; a mounting yaw of 90 degrees turns x to starboard."""
    mission = read_after(
        tmp_path, toml("mounting_rpy_deg = [0.0, 0.0, 0.0]", "mounting_rpy_deg = [0, 0, 90]")
    )
    mount, half = mission.dvl.mount, math.sqrt(0.5)
    first = [0.5 * half, 0.5 * half, math.cos(math.radians(30.0))]
    np.testing.assert_allclose(mount.beams_d[0], first, atol=1e-15)
    np.testing.assert_allclose(mount.R_bd @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(mount.beams_b[0], [-first[1], first[0], first[2]], atol=1e-15)


def test_beam_vectors_are_normalised(tmp_path: Path) -> None:
    """Four digits, as makers print them, are enough."""
    vectors = (
        "[[.2706,-.2706,.9239],[.2706,.2706,.9239],[-.2706,.2706,.9239],[-.2706,-.2706,.9239]]"
    )
    vectors = vectors.replace(".", "0.")
    mission = read_after(
        tmp_path,
        toml(
            "beam_azimuth_deg = [45, 135, 225, 315]\nbeam_janus_deg = 30.0",
            f"beam_vectors = {vectors}",
        ),
    )
    np.testing.assert_allclose(np.linalg.norm(mission.dvl.mount.beams_d, axis=1), 1.0, rtol=1e-15)


TURNS = {
    "FLU": lambda v: v * [1.0, -1.0, -1.0],
    "RFU": lambda v: np.column_stack([v[:, 1], v[:, 0], -v[:, 2]]),
}


@pytest.mark.parametrize("body", sorted(TURNS))
def test_body_axes_are_turned(tmp_path: Path, body: str) -> None:
    """The same run, written in other axes, reads the same; the mounting is left alone."""
    (tmp_path / "frd").mkdir()
    (tmp_path / "other").mkdir()
    lever = {"FLU": "[0.2, -0.0, -0.1]", "RFU": "[0.0, 0.2, -0.1]"}[body]
    tilt = toml("mounting_rpy_deg = [0.0, 0.0, 0.0]", "mounting_rpy_deg = [1, 2, 3]")
    want = read_after(tmp_path / "frd", tilt)
    got = read_after(
        tmp_path / "other",
        tilt,
        toml('body = "FRD"', f'body = "{body}"'),
        toml("lever_arm_m = [0.2, 0.0, 0.1]", f"lever_arm_m = {lever}"),
        columns("imu.csv", GYRO, TURNS[body]),
        columns("imu.csv", ACCEL, TURNS[body]),
    )
    np.testing.assert_array_equal(got.imu.gyro_b, want.imu.gyro_b)
    np.testing.assert_array_equal(got.imu.accel_b, want.imu.accel_b)
    np.testing.assert_array_equal(got.dvl.mount.lever_arm_b, want.dvl.mount.lever_arm_b)
    np.testing.assert_array_equal(got.dvl.mount.R_bd, want.dvl.mount.R_bd)
    np.testing.assert_array_equal(got.dvl.mount.beams_d, want.dvl.mount.beams_d)


def early(time_s: Array) -> Array:
    """Return stamps of the beginning of each interval of 0.05 s."""
    return time_s - 0.05


def half_early(time_s: Array) -> Array:
    """Return stamps of the middle of each interval of 0.05 s."""
    return time_s - 0.025


@pytest.mark.parametrize(("stamp", "shift"), [("start", early), ("middle", half_early)])
def test_stamps_become_interval_ends(tmp_path: Path, stamp: str, shift: Damage) -> None:
    """Whatever instant a stamp names, the same intervals come out."""
    mission = read_after(
        tmp_path,
        toml('stamp = "end"', f'stamp = "{stamp}"'),
        columns("imu.csv", ["time_s"], shift),  # type: ignore[arg-type]
    )
    np.testing.assert_allclose(mission.imu.time_s, np.arange(1, 1201) / 20.0, atol=1e-9)
    assert mission.imu.start_s == pytest.approx(0.0, abs=1e-9)


def test_uneven_stamps(tmp_path: Path) -> None:
    """Intervals touch each other also where the rate wavers."""
    wavering = columns("imu.csv", ["time_s"], lambda t: t + 0.01 * np.sin(t))
    mission = read_after(tmp_path, toml('stamp = "end"', 'stamp = "start"'), wavering)
    time_s = np.arange(1, 1201) / 20.0
    stamps = time_s + 0.01 * np.sin(time_s)
    assert mission.imu.start_s == stamps[0]
    np.testing.assert_array_equal(mission.imu.time_s[:-1], stamps[1:])


def test_origin_is_that_of_the_file(tmp_path: Path) -> None:
    """[origin] comes first."""
    mission = read_after(tmp_path, toml("height_m = 0.0", "height_m = 3.0"))
    assert (mission.frame.lat, mission.frame.height) == (math.radians(45.7), 3.0)


def test_origin_is_the_first_fix_else(tmp_path: Path) -> None:
    """The first GNSS fix comes second."""
    mission = read_after(tmp_path, drop_section("origin"), cell("gnss.csv", 2, "height_m", "-19.5"))
    assert mission.frame.height == -19.5


def test_origin_is_the_initial_position_at_last(tmp_path: Path) -> None:
    """[initial] comes third."""
    mission = read_after(tmp_path, drop_section("origin"), drop_section("gnss"))
    assert mission.frame.height == -20.0
    assert mission.gnss is None


def test_longitudes_are_wrapped(tmp_path: Path) -> None:
    """Longitudes from 0 to 360 are as good as those from -180 to 180."""
    mission = read_after(
        tmp_path,
        toml("lon_deg = 126.6\nheight_m = 0.0", "lon_deg = 233.4\nheight_m = 0.0"),
        toml("lon_deg = 126.6", "lon_deg = -126.6"),
        columns("gnss.csv", ["lon_deg"], lambda lon: 360.0 - lon),
        columns("reference.csv", ["lon_deg"], lambda lon: -lon),
    )
    assert mission.frame.lon == pytest.approx(math.radians(-126.6), abs=1e-12)
    assert mission.gnss is not None
    assert mission.gnss.lon[0] == pytest.approx(math.radians(-126.6), abs=1e-9)


def test_beams_may_be_empty(tmp_path: Path) -> None:
    """Empty and NaN are beams without bottom lock; their sigma falls back to the common one."""
    mission = read_after(
        tmp_path,
        cell("dvl.csv", 5, "beam1_m_per_s", ""),
        cell("dvl.csv", 6, "beam4_m_per_s", "NaN"),
        cell("dvl.csv", 7, "beam2_sigma_m_per_s", ""),
        cell("dvl.csv", 7, "range3_m", ""),
    )
    dvl = mission.dvl
    assert np.isnan(dvl.speed[3, 0])
    assert np.isnan(dvl.speed[4, 3])
    assert dvl.sigma[5, 1] == 0.005
    assert dvl.sigma[5, 0] != 0.005
    assert dvl.range_m is not None
    assert np.isnan(dvl.range_m[5, 2])


def test_reference_needs_positions_only(tmp_path: Path) -> None:
    """Columns that a reference lacks are NaN."""
    mission = read_after(
        tmp_path,
        lines("reference.csv", lambda rows: [",".join(row.split(",")[:5]) for row in rows]),
    )
    reference = mission.reference
    assert reference is not None
    assert np.isfinite(reference.velocity_enu[:, 0]).all()
    assert np.isnan(reference.velocity_enu[:, 1:]).all()
    assert np.isnan(reference.roll_pitch_heading).all()


def test_harmless_habits_of_writers(tmp_path: Path) -> None:
    """Byte order mark, Windows line ends, blanks, quoted names, another order of columns."""

    def reorder(rows: list[str]) -> list[str]:
        return [" , ".join(reversed(row.split(","))) for row in rows]

    mission = read_after(
        tmp_path,
        lines("depth.csv", reorder),
        raw("depth.csv", lambda content: content.replace(b"depth_m", b'"depth_m"', 1)),
        raw("depth.csv", lambda content: b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n")),
        raw("gnss.csv", lambda content: content.replace(b"\n", b"\n\n")),
    )
    assert mission.depth is not None
    assert mission.depth.depth[0] == pytest.approx(20.0, abs=0.5)
    assert mission.gnss is not None
    assert len(mission.gnss.time_s) == 7


def test_lines_are_counted_as_an_editor_counts(tmp_path: Path) -> None:
    """Blank lines count, also for defects that are found only after the table was read."""
    with pytest.raises(DataError, match=r"^gnss\.csv:9: column 'sigma_up_m' holds 0\.0"):
        read_after(
            tmp_path,
            cell("gnss.csv", 5, "sigma_up_m", "0.0"),
            raw("gnss.csv", lambda content: content.replace(b"\n", b"\r\n\r\n")),
        )


def test_parquet_rows_are_named(tmp_path: Path) -> None:
    """In Parquet the row takes the place of the line."""
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    write_example(tmp_path, suffix=".parquet")
    table = parquet.read_table(tmp_path / "imu.parquet")
    values = table["gyro_x_rad_per_s"].to_pylist()
    values[16] = None
    column = table.schema.get_field_index("gyro_x_rad_per_s")
    holed = table.set_column(column, "gyro_x_rad_per_s", arrow.array(values))
    parquet.write_table(holed, tmp_path / "imu.parquet")
    with pytest.raises(DataError, match=r"^imu\.parquet: row 17: .*'gyro_x_rad_per_s' holds null"):
        read_mission(tmp_path)
    words = table.set_column(column, "gyro_x_rad_per_s", arrow.array(["abc"] * len(table)))
    parquet.write_table(words, tmp_path / "imu.parquet")
    with pytest.raises(DataError, match=r"^imu\.parquet: .*of type string; expected numbers"):
        read_mission(tmp_path)


def test_tables_may_lie_elsewhere(tmp_path: Path) -> None:
    """Relative and absolute paths are followed; messages name them as the file does."""
    write_example(tmp_path)
    (tmp_path / "raw").mkdir()
    (tmp_path / "imu.csv").rename(tmp_path / "raw" / "imu.csv")
    (tmp_path / "dvl.csv").rename(tmp_path / "raw" / "dvl.csv")
    toml('file = "imu.csv"', 'file = "raw/imu.csv"')(tmp_path)
    toml('file = "dvl.csv"', f"file = '{tmp_path / 'raw' / 'dvl.csv'}'")(tmp_path)
    assert len(read_mission(tmp_path).dvl.time_s) == 60
    columns("raw/imu.csv", BEAMS[:0] + ACCEL, lambda f: f / 9.8)(tmp_path)
    with pytest.raises(DataError, match=r"^raw/imu\.csv: "):
        read_mission(tmp_path)


def test_no_folder(tmp_path: Path) -> None:
    """A folder that does not exist is named."""
    with pytest.raises(ConfigError, match="nowhere"):
        read_mission(str(tmp_path / "nowhere"))


def test_drifts_are_read(tmp_path: Path) -> None:
    """Of DVL and GNSS; all of the noise stays white unless a share is given."""
    dvl = "drift_sigma_m_per_s = 0.006\ndrift_correlation_s = 20\ndrift_white_share = 0.25"
    dvl += "\ndrift_z_share = 0.41"
    gnss = "drift_sigma_m = 0.5\ndrift_correlation_s = 120\ndrift_up_share = 2"
    mission = read_after(
        tmp_path, toml("\n[depth]", f"{dvl}\n\n[depth]"), toml("\n[gnss]", f"\n[gnss]\n{gnss}")
    )
    assert mission.gnss is not None
    assert mission.dvl.mount.drift == Drift(0.006, 20.0, 0.25)
    assert mission.dvl.mount.drift_z_share == 0.41
    drift = next(one for one in extras_of(mission).blocks if one.name == DVL_DRIFT)
    np.testing.assert_allclose(drift.sigma, [0.006, 0.006, 0.00246])
    steady = np.tile(drift.sigma, (2, 1))
    kept, grown = Extras((drift,)).transitions(np.array([1.0, 1e4]))
    np.testing.assert_allclose(np.hypot(kept * steady, grown), steady)
    assert mission.gnss.calibration.drift == Drift(0.5, 120.0, 1.0)
    of_fixes = next(one for one in extras_of(mission).blocks if one.name == GNSS_DRIFT)
    np.testing.assert_allclose(of_fixes.sigma, [0.5, 0.5, 1.0])


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("drift_sigma_m_per_s = 0.006", "expected with a drift_correlation_s"),
        ("drift_correlation_s = 20.0", "expected with a drift_sigma_m_per_s above 0"),
        ("drift_white_share = 0.5", "expected with a drift_sigma_m_per_s above 0"),
        ("drift_z_share = 0.5", "expected with a drift_sigma_m_per_s above 0"),
        ("drift_correlation_s = 20.0\ndrift_white_share = 1.5", "above 0 and up to 1"),
    ],
)
def test_a_drift_is_given_whole(tmp_path: Path, keys: str, message: str) -> None:
    """One key without the other would never be looked at."""
    with pytest.raises(ConfigError, match=rf"\[dvl\] drift_\w+: .*{message}"):
        read_after(tmp_path, toml("\n[depth]", f"{keys}\n\n[depth]"))
