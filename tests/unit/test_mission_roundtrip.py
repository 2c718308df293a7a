"""What is written is read back, to rounding, and an interrupted write leaves no mixture."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from ssm_graph.base.errors import ConfigError, DataError, MissingExtraError
from ssm_graph.base.units import in_unit
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of
from ssm_graph.io.tables import files as tables_module
from ssm_graph.io.tables.files import TableFormat
from ssm_graph.mission.mission import Aids, Mission
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthCalibration
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.dvl import DvlLog, R_bd_from_rpy, rpy_from_R_bd
from ssm_graph.sensors.gnss import GnssCalibration
from ssm_graph.sensors.registry import INSTRUMENTS
from tests.mission_damage import both, columns, new_column, toml
from tests.mission_fixture import make_mission, write_example

SIGMAS = [f"beam{beam}_sigma_m_per_s" for beam in range(1, 5)]


def assert_same(got: Any, want: Any, where: str = "mission") -> None:
    """Compare two frozen values field by field, to a few units in the last place."""
    if isinstance(want, Aids):
        got, want = tuple(got), tuple(want)
    if is_dataclass(want):
        for spec in fields(want):
            if spec.name != "notes":
                name = spec.name
                assert_same(getattr(got, name), getattr(want, name), f"{where}.{name}")
    elif isinstance(want, tuple):
        for i, (one, other) in enumerate(zip(got, want, strict=True)):
            assert_same(one, other, f"{where}[{i}]")
    elif isinstance(want, float | np.ndarray):
        np.testing.assert_allclose(got, want, rtol=1e-15, atol=1e-15, err_msg=where)
    else:
        assert got == want, where


def without_optional_parts(mission: Mission) -> Mission:
    """Return the smallest mission: IMU, DVL and an origin."""
    return replace(mission, depth=None, gnss=None, initial=None, reference=None)


@pytest.mark.parametrize("table_format", TableFormat)
def test_round_trip(tmp_path: Path, table_format: TableFormat) -> None:
    """Every value of a full mission comes back."""
    if table_format is TableFormat.PARQUET:
        pytest.importorskip("pyarrow")
    mission = make_mission()
    write_mission(tmp_path, mission, table_format=table_format)
    got = read_mission(tmp_path)
    assert_same(got, mission)
    np.testing.assert_array_equal(got.imu.accel_b, mission.imu.accel_b)
    np.testing.assert_array_equal(got.dvl.speed, mission.dvl.speed)
    assert got.notes == ()


def test_round_trip_of_the_smallest_mission(tmp_path: Path) -> None:
    """Optional parts may be missing; constant noise needs no columns of its own."""
    mission = without_optional_parts(make_mission())
    dvl = replace(mission.dvl, sigma=np.full_like(mission.dvl.sigma, 0.0123), range_m=None)
    mission = replace(mission, dvl=dvl)
    write_mission(tmp_path, mission)
    assert_same(read_mission(tmp_path), mission)
    assert "sigma" not in (tmp_path / "dvl.csv").read_text().splitlines()[0]


def test_round_trip_of_known_and_doubted_errors(tmp_path: Path) -> None:
    """All that can be said of instruments' errors; offsets of quarters leave no rounding."""
    mission = make_mission()
    assert mission.depth is not None
    assert mission.gnss is not None
    mount = replace(
        mission.dvl.mount,
        scale_error=-0.03,
        scale_walk_density=1e-4 / 60.0,
        beam_scale_error=np.array([0.01, 0.0, -0.02, 0.005]),
        beam_scale_sigma=0.01,
        lever_arm_sigma=0.3,
        drift=Drift(0.006, 20.0, 0.25),
    )
    depth = DepthCalibration(offset=0.25, offset_sigma=0.1)
    gnss = GnssCalibration(
        time_offset_s=0.25, time_offset_sigma_s=0.2, lever_arm_sigma=0.4, drift=Drift(0.5, 120.0)
    )
    mission = replace(
        mission,
        dvl=replace(mission.dvl, mount=mount),
        depth=replace(mission.depth, calibration=depth),
        gnss=replace(mission.gnss, calibration=gnss),
    )
    write_mission(tmp_path, mission)
    got = read_mission(tmp_path)
    assert_same(got, mission)
    assert got.depth is not None
    assert got.gnss is not None
    np.testing.assert_array_equal(got.depth.true_depth, got.depth.depth - 0.25)
    np.testing.assert_array_equal(got.gnss.valid_s, got.gnss.time_s - 0.25)
    for vehicle in (read_vehicle(tmp_path), vehicle_of(got)):
        assert vehicle.depth is not None
        assert_same(vehicle.depth.calibration, depth)
        assert_same(vehicle.gnss.calibration, gnss)


@pytest.mark.parametrize("table_format", TableFormat, ids=lambda f: f.name)
def test_round_trip_of_water_track(tmp_path: Path, table_format: TableFormat) -> None:
    """The mark of each ping, both noises without columns of sigmas, and the current."""
    if table_format is TableFormat.PARQUET:
        pytest.importorskip("pyarrow")
    mission = make_mission()
    water = (np.arange(len(mission.dvl.time_s)) % 3 == 0).astype(float)
    sigma = np.where(water[:, None] > 0.0, 0.02, 0.005) * np.ones(4)
    dvl = replace(mission.dvl, water_track=water, sigma=sigma)
    current = CurrentModel(sigma=0.3, correlation_s=7200.0, vertical_sigma=0.0)
    mission = replace(mission, dvl=dvl, current=current)
    write_mission(tmp_path, mission, table_format=table_format)
    got = read_mission(tmp_path)
    assert_same(got, mission)
    assert got.current == current
    assert "water_noise_m_per_s = 0.02" in (tmp_path / "mission.toml").read_text()
    if table_format is TableFormat.CSV:
        assert "sigma" not in (tmp_path / "dvl.csv").read_text().splitlines()[0]
    odd = np.array(sigma)
    odd[3, 1] = 0.7
    write_mission(tmp_path, replace(mission, dvl=replace(dvl, sigma=odd)))
    assert_same(read_mission(tmp_path).dvl, replace(dvl, sigma=odd))


def test_water_track_without_its_keys(tmp_path: Path) -> None:
    """Empty cells are ground; the noise is that of the beams; keys left out take the defaults."""
    write_example(tmp_path)
    both(
        new_column("dvl.csv", "water_track", lambda k: "1" if k < 5 else ""),
        columns("dvl.csv", SIGMAS, lambda s: np.full_like(s, np.nan)),
        toml("[depth]", "[current]\nsigma_m_per_s = 0.25\n\n[depth]"),
    )(tmp_path)
    got = read_mission(tmp_path)
    assert got.dvl.is_water.sum() == 5
    assert np.all(got.dvl.sigma == 0.005)
    assert got.current == CurrentModel(sigma=0.25)
    ground = got.dvl.of_ground()
    assert len(ground.time_s) == len(got.dvl.time_s) - 5
    assert not ground.is_water.any()
    assert ground.of_ground() is ground


def test_round_trip_of_a_silent_dvl(tmp_path: Path) -> None:
    """A DVL without a single ping is a mission all the same."""
    mission = make_mission()
    empty = np.empty((0, 4))
    dvl = DvlLog(mount=mission.dvl.mount, time_s=np.empty(0), speed=empty, sigma=empty)
    write_mission(tmp_path, replace(mission, dvl=dvl))
    got = read_mission(tmp_path)
    assert got.dvl.speed.shape == (0, 4)
    assert "no rows" in got.notes[0]


@given(st.tuples(*[st.floats(-np.pi, np.pi)] * 3))
def test_mounting_angles_give_the_same_matrix(rpy: tuple[float, float, float]) -> None:
    """Angles are not unique; the matrix they stand for is."""
    R_bd = R_bd_from_rpy(np.array(rpy))
    np.testing.assert_allclose(R_bd_from_rpy(rpy_from_R_bd(R_bd)), R_bd, rtol=0.0, atol=2e-8)


@pytest.mark.parametrize("pitch", [-0.5 * np.pi, 0.5 * np.pi])
def test_mounting_with_vertical_pitch(pitch: float) -> None:
    """At the singularity only a combination of roll and yaw is defined."""
    R_bd = R_bd_from_rpy(np.array([0.3, pitch, -1.1]))
    np.testing.assert_allclose(R_bd_from_rpy(rpy_from_R_bd(R_bd)), R_bd, atol=1e-15)


UNITS = sorted({key.unit for one in INSTRUMENTS for key in one.keys.values()})


@given(st.sampled_from(UNITS), st.floats(-1e6, 1e6))
def test_units_come_back(unit: float, value: float) -> None:
    """Conversions are inverse to rounding."""
    np.testing.assert_allclose(in_unit(value, unit) * unit, value, rtol=4e-16, atol=1e-320)


def test_data_sheet_numbers_stay_short() -> None:
    """A number that a person typed is written as it was typed."""
    for unit in UNITS:
        for typed in (0.05, 45.7, 126.6, 0.003, 1e-5):
            assert in_unit(typed * unit, unit) == typed


def test_interrupted_write_keeps_the_old_mission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the new one cannot be completed, the old one is still whole."""
    write_mission(tmp_path, make_mission())

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tomli_w, "dumps", fail)
    shorter = without_optional_parts(make_mission())
    with pytest.raises(KeyboardInterrupt):
        write_mission(tmp_path, shorter)
    assert_same(read_mission(tmp_path), make_mission())
    with pytest.raises(KeyboardInterrupt):
        write_mission(tmp_path / "new", shorter)
    assert not [*(tmp_path / "new").iterdir()]
    with pytest.raises(ConfigError, match="there is none in"):
        read_mission(tmp_path / "new")


def test_mount_that_is_no_rotation_is_not_written(tmp_path: Path) -> None:
    """Angles could not express it."""
    mission = make_mission()
    dvl = replace(mission.dvl, mount=replace(mission.dvl.mount, R_bd=2.0 * np.eye(3)))
    with pytest.raises(DataError, match="expected a rotation matrix"):
        write_mission(tmp_path, replace(mission, dvl=dvl))


def test_parquet_without_pyarrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The missing extra is named, with the command that installs it."""
    pytest.importorskip("pyarrow")
    write_mission(tmp_path, make_mission(), table_format=TableFormat.PARQUET)

    def fail(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(tables_module, "import_module", fail)
    with pytest.raises(MissingExtraError, match=r"pip install 'ssm-graph\[parquet\]'"):
        read_mission(tmp_path)
    with pytest.raises(MissingExtraError, match="pyarrow"):
        write_mission(tmp_path, make_mission(), table_format=TableFormat.PARQUET)
