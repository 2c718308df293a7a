"""Import of Blueye X3 logs: against the real logs where they are, errors and clocks everywhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import DataError, MissingExtraError
from ssm_graph.io.blueye.convert import GAP_S, convert_blueye, smooth_arrivals
from ssm_graph.io.blueye.log import TOPICS
from ssm_graph.sensors.compass import HeadingLog
from tests.blueye_fixture import DIVE, GRID, LOGS, SQUARE, converted, needs_logs, tables


@needs_logs
@pytest.mark.parametrize(
    ("name", "duration", "imu_rate", "dvl_rate", "n_fixes"),
    [
        (SQUARE, 235.9, 36.6, 5.25, 471),
        (DIVE, 166.2, 37.2, 6.78, 79),
        (GRID, 225.5, 24.5, 4.47, 449),
    ],
)
def test_spans_and_rates(
    name: str,
    duration: float,
    imu_rate: float,
    dvl_rate: float,
    n_fixes: int,
) -> None:
    """Repeats are gone: what is left comes at the instruments' own rates."""
    mission = converted(name)
    assert mission.gnss is not None
    span = mission.imu.time_s[-1] - mission.imu.start_s
    assert span == pytest.approx(duration, abs=0.1)
    assert len(mission.imu.time_s) / span == pytest.approx(imu_rate, abs=0.1)
    assert len(mission.dvl.time_s) / span == pytest.approx(dvl_rate, abs=0.1)
    assert len(mission.gnss.time_s) == n_fixes
    assert mission.name == name
    assert mission.initial is None
    assert mission.reference is None


@needs_logs
@pytest.mark.parametrize("name", [SQUARE, DIVE, GRID])
def test_beams_fit_the_published_velocity(name: str) -> None:
    """Sign, order and directions of the beams: residuals of 3 to 6 mm/s, outliers left out."""
    mount = converted(name).dvl.mount
    table = tables(name).dvl
    speed, valid, velocity = table[:, 4:8], table[:, 8:12], table[:, 16:19]
    good = np.all(valid > 0.0, axis=1) & (np.abs(velocity).max(axis=1) > 0.0)
    residual = speed[good] - velocity[good] @ mount.beams_d.T
    np.testing.assert_array_less(residual.std(axis=0), 6.5e-3)
    np.testing.assert_allclose(np.median(residual, axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(mount.beams_d, axis=1), 1.0, atol=1e-12)


@needs_logs
@pytest.mark.parametrize(("name", "norm"), [(SQUARE, 9.831), (DIVE, 9.832), (GRID, 9.726)])
def test_specific_force_points_up(name: str, norm: float) -> None:
    """Both units of the logs end in m/s^2, forward-right-down."""
    accel = converted(name).imu.accel_b
    assert np.linalg.norm(accel, axis=1).mean() == pytest.approx(norm, abs=2e-3)
    np.testing.assert_allclose(accel.mean(axis=0), [0.0, 0.0, -norm], atol=0.65)
    assert np.abs(converted(name).imu.gyro_b).max() < 1.0


@needs_logs
@pytest.mark.parametrize("name", [SQUARE, DIVE, GRID])
def test_clocks_are_strict_and_even(name: str) -> None:
    """No step backwards, and most of the arrival jitter gone."""
    mission = converted(name)
    assert mission.gnss is not None
    assert mission.depth is not None
    for time_s in (mission.dvl.time_s, mission.depth.time_s, mission.gnss.time_s):
        assert np.all(np.diff(time_s) > 0.0)
        assert time_s[0] >= mission.imu.start_s
        assert time_s[-1] <= mission.imu.time_s[-1] + 0.1
    steps = np.diff(mission.imu.time_s)
    assert steps.min() > 0.01
    assert steps.max() < 0.06
    assert np.diff(mission.dvl.time_s).min() > 0.07


@needs_logs
def test_gnss_ends_at_the_dive() -> None:
    """Fixes exist before and after the dive, the bad ones dropped, heights from depth."""
    mission = converted(DIVE)
    gnss, depth = mission.gnss, mission.depth
    assert gnss is not None
    assert depth is not None
    since_start = gnss.valid_s - mission.imu.start_s
    assert np.all((since_start < 24.0) | (since_start > 144.0))
    assert gnss.sigma_enu[:, :2].max() <= 1.0
    assert any("10 with sigma above 1.0 m dropped" in note for note in mission.notes)
    antenna = -np.interp(gnss.valid_s, depth.time_s, depth.depth) - gnss.lever_arm_b[2]
    np.testing.assert_allclose(gnss.height, antenna)
    np.testing.assert_allclose([depth.depth.min(), depth.depth.max()], [0.196, 7.668], atol=1e-3)
    assert np.isnan(mission.dvl.speed).sum() == 15


@needs_logs
@pytest.mark.parametrize(("name", "n_jumps"), [(SQUARE, 0), (DIVE, 1), (GRID, 0)])
def test_the_heading_of_the_dvl_turns_as_the_gyros_do(name: str, n_jumps: int) -> None:
    """To 2 degrees rms in two to four minutes, with up to 2000 of turns; a reset is bridged."""
    mission = converted(name)
    imu, log = mission.imu, mission.aids.get(HeadingLog)
    assert log is not None
    angle = np.cumsum(imu.gyro_b[:, 2] * np.diff(imu.time_s, prepend=imu.start_s))
    off = np.unwrap(log.heading - np.interp(log.time_s, imu.time_s, angle))
    assert np.std(off) < np.deg2rad(2.0)
    assert any(f"{n_jumps} jumps of its dead reckoning" in note for note in mission.notes)


@needs_logs
def test_turning_and_moving_agree_with_gnss() -> None:
    """Gyro z, beams and fixes describe one track: dead reckoning fits to a metre."""
    mission = converted(GRID)
    imu, dvl, gnss = mission.imu, mission.dvl, mission.gnss
    assert gnss is not None
    angle = np.cumsum(imu.gyro_b[:, 2] * np.diff(imu.time_s, prepend=imu.start_s))
    velocity = np.linalg.lstsq(dvl.mount.beams_b, dvl.speed.T, rcond=None)[0].T
    time_s = dvl.time_s - dvl.mount.time_offset_s
    forward_right = velocity[:, 0] + 1j * velocity[:, 1]
    step = forward_right * np.exp(1j * np.interp(time_s, imu.time_s, angle))
    track = np.cumsum(step * np.diff(time_s, prepend=time_s[0]))
    fixes = mission.frame.p_n_from_geodetic(gnss.lat, gnss.lon, gnss.height)
    inside = gnss.valid_s < time_s[-1]
    walked = np.interp(gnss.valid_s[inside], time_s, track)
    design = np.column_stack([walked, np.ones_like(walked)])
    north_east = fixes[inside, 1] + 1j * fixes[inside, 0]
    (scale, _), *_ = np.linalg.lstsq(design, north_east, rcond=None)
    error = design @ np.array([scale, np.mean(north_east - scale * walked)]) - north_east
    assert np.sqrt(np.mean(np.abs(error) ** 2)) < 1.2
    assert 0.97 < abs(scale) < 1.03


@needs_logs
def test_reports_off_the_water_are_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    """No log at hand has any: some reports of one are given the flag."""
    ground, logged = converted(DIVE).dvl, tables(DIVE)
    flagged = logged.dvl.copy()
    flagged[len(flagged) // 2 :, 2] = 1.0
    monkeypatch.setattr(
        "ssm_graph.io.blueye.convert.read_blueye_tables", lambda _: logged._replace(dvl=flagged)
    )
    mission = convert_blueye(LOGS / f"{DIVE}.mcap")
    assert ground.water_track is None
    n_water = int(mission.dvl.is_water.sum())
    assert n_water == pytest.approx(len(ground.time_s) / 2, rel=0.1)
    assert any(f"{n_water} reports off the water" in note for note in mission.notes)
    np.testing.assert_array_equal(mission.dvl.speed, ground.speed)


def test_smoothing_keeps_order_and_gaps() -> None:
    """An even clock with arrival jitter comes back nearly even; a gap stays as long as it was."""
    rng = np.random.default_rng(0)
    even = 1.7e9 + 0.027 * np.arange(400.0)
    even[200:] += 3.0
    smooth = smooth_arrivals(even + rng.uniform(0.0, 0.02, 400))
    error = smooth - even
    assert np.std(error) < 0.6 * 0.02 / np.sqrt(12.0)
    assert np.all(np.diff(smooth) > 0.0)
    assert np.diff(smooth).max() > 3.0 - GAP_S
    np.testing.assert_allclose(smooth_arrivals(even), even, atol=1e-6)


@pytest.mark.parametrize("content", [b"", b"not an MCAP file", b"\x89MCAP0\r\n" + bytes(40)])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    """What is no MCAP says so."""
    pytest.importorskip("mcap_protobuf", reason="needs the extra 'blueye'")
    log = tmp_path / "other.mcap"
    log.write_bytes(content)
    with pytest.raises(DataError, match=r"other\.mcap: not a complete MCAP file"):
        convert_blueye(log)
    with pytest.raises(DataError, match=r"cannot be read: No such file"):
        convert_blueye(tmp_path / "none.mcap")


@needs_logs
def test_cut_off_log_is_refused(tmp_path: Path) -> None:
    """A recording without its end names the way out."""
    pytest.importorskip("mcap_protobuf", reason="needs the extra 'blueye'")
    log = tmp_path / "cut.mcap"
    log.write_bytes((LOGS / f"{DIVE}.mcap").read_bytes()[:1_000_000])
    with pytest.raises(DataError, match="mcap recover"):
        convert_blueye(log)


def test_other_topics_are_listed(tmp_path: Path) -> None:
    """A log of something else: what was expected and what was found."""
    writer_module = pytest.importorskip("mcap.writer", reason="needs the extra 'blueye'")
    log = tmp_path / "car.mcap"
    with log.open("wb") as stream:
        writer = writer_module.Writer(stream)
        writer.start()
        schema = writer.register_schema(name="speed", encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(topic="/speed", message_encoding="json", schema_id=schema)
        writer.add_message(channel_id=channel, log_time=0, publish_time=0, data=b"{}")
        writer.finish()
    with pytest.raises(DataError, match=rf"{TOPICS[0]}.* missing; found: /speed"):
        convert_blueye(log)


def test_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the decoder the message says what to install."""
    monkeypatch.setitem(__import__("sys").modules, "mcap_protobuf.decoder", None)
    with pytest.raises(MissingExtraError, match=r"ssm-graph\[blueye\]"):
        convert_blueye(tmp_path / "log.mcap")
