"""Result folders: the contract of names and units, precision, strict JSON, interrupted writes."""

from __future__ import annotations

import cProfile
import json
import pstats
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.evaluation.errors import evaluate
from ssm_graph.io.results import tables as results_module
from ssm_graph.io.results.summary import as_json
from ssm_graph.io.results.tables import read_results, write_results
from ssm_graph.mission.estimate import BeamTable, Status, path_length_m
from tests.estimate_fixture import (
    EPOCH,
    NOTES,
    make_mission,
    make_run,
    with_current,
    with_faults,
)

TRAJECTORY_HEADER = (
    "time_s,lat_deg,lon_deg,height_m,vel_east_m_per_s,vel_north_m_per_s,vel_up_m_per_s,"
    "roll_deg,pitch_deg,heading_deg,sigma_east_m,sigma_north_m,sigma_up_m,"
    "sigma_vel_east_m_per_s,sigma_vel_north_m_per_s,sigma_vel_up_m_per_s,"
    "sigma_roll_deg,sigma_pitch_deg,sigma_heading_deg,"
    "gyro_bias_x_deg_per_h,gyro_bias_y_deg_per_h,gyro_bias_z_deg_per_h,"
    "accel_bias_x_ug,accel_bias_y_ug,accel_bias_z_ug,n_beams"
)


def test_names_are_the_contract(tmp_path: Path) -> None:
    """The header of both tables, written out as mission-format.md has it."""
    estimate, _ = make_run(n=20)
    write_results(tmp_path, estimate, mission=make_mission(estimate), metrics=None, settings={})
    lines = (tmp_path / "trajectory.csv").read_text().splitlines()
    assert lines[0] == f"{TRAJECTORY_HEADER},suspect"
    assert len(lines) == 21
    lines = (tmp_path / "beams.csv").read_text().splitlines()
    assert lines[0] == "time_s,beam,innovation_m_per_s,mahalanobis_sq,weight"
    assert lines[1].split(",")[:2] == ["1746622514.2500000", "1"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "beams.csv",
        "summary.json",
        "trajectory.csv",
    ]


def test_a_current_has_columns_of_its_own(tmp_path: Path) -> None:
    """Behind those of the contract, and in the summary; read again with the others."""
    estimate = with_current(make_run(n=20)[0])
    write_results(tmp_path, estimate, mission=make_mission(estimate), metrics=None, settings={})
    header = (tmp_path / "trajectory.csv").read_text().splitlines()[0]
    columns = [f"{name}_{axis}_m_per_s" for name in NAMES for axis in ("east", "north", "up")]
    assert header == ",".join([TRAJECTORY_HEADER, *columns, "suspect"])
    assert estimate.current is not None
    got = read_results(tmp_path)
    np.testing.assert_allclose(
        got.trajectory["current_east_m_per_s"], estimate.current.velocity_enu[:, 0], atol=1e-7
    )
    np.testing.assert_allclose(got.trajectory["sigma_current_north_m_per_s"], 0.02)
    current = got.summary["current"]
    assert current["largest_m_per_s"] == pytest.approx(0.5)
    assert current["mean_sigma_enu_m_per_s"] == pytest.approx([0.02, 0.02, 0.0])
    plain = replace(estimate, current=None)
    write_results(tmp_path, plain, mission=make_mission(plain), metrics=None, settings={})
    assert read_results(tmp_path).summary["current"] == {}


NAMES = ("current", "sigma_current")


def test_who_was_off_is_told(tmp_path: Path) -> None:
    """A row of the summary each; the trajectory is doubtful where one of them is not settled."""
    estimate = with_faults(make_run(n=20)[0])
    write_results(tmp_path, estimate, mission=make_mission(estimate), metrics=None, settings={})
    got = read_results(tmp_path)
    since = got.trajectory["time_s"] - got.trajectory["time_s"][0]
    np.testing.assert_array_equal(got.trajectory["suspect"], (since >= 10.0) & (since <= 14.0))
    left_out, undecided = got.summary["faults"]
    assert left_out["sensor"] == "DVL beam 2"
    assert left_out["treatment"] == "left_out"
    assert not left_out["is_suspect"]
    assert undecided["rivals"] == ["DVL, 0.20 m/s to the north"]
    assert undecided["what"] == "3.1 m to the east"
    assert undecided["is_suspect"]
    assert undecided["cost_m"] == 2.5


def test_numbers_survive(tmp_path: Path) -> None:
    """Unix times to a microsecond, positions to 1e-10 deg, biases in deg/h and micro-g."""
    estimate, _ = make_run(n=50)
    trajectory = replace(estimate.trajectory, time_s=estimate.trajectory.time_s + 0.123457)
    estimate = replace(estimate, trajectory=trajectory)
    write_results(tmp_path, estimate, mission=make_mission(estimate), metrics=None, settings={})
    got = read_results(tmp_path)
    table, beams = got.trajectory, got.beams
    np.testing.assert_allclose(table["time_s"], trajectory.time_s, rtol=0, atol=5e-7)
    np.testing.assert_allclose(table["lat_deg"], np.rad2deg(trajectory.lat), rtol=0, atol=1e-11)
    np.testing.assert_allclose(table["lon_deg"], np.rad2deg(trajectory.lon), rtol=0, atol=1e-11)
    np.testing.assert_allclose(table["height_m"], trajectory.height, rtol=0, atol=1e-6)
    np.testing.assert_allclose(table["vel_north_m_per_s"], trajectory.velocity_enu[:, 1], atol=1e-7)
    np.testing.assert_allclose(
        table["sigma_east_m"] ** 2, trajectory.position_cov_enu[:, 0, 0], rtol=1e-6
    )
    np.testing.assert_allclose(table["gyro_bias_x_deg_per_h"], 0.0206264806)
    np.testing.assert_allclose(table["accel_bias_x_ug"], 3e-4 / 9.80665e-6)
    np.testing.assert_allclose(table["n_beams"], 4.0)
    np.testing.assert_allclose(beams["innovation_m_per_s"], estimate.beams.innovation, rtol=1e-8)
    np.testing.assert_allclose(beams["weight"], estimate.beams.weight, rtol=1e-8)


def test_summary_tells_the_run(tmp_path: Path) -> None:
    """Everything the contract asks for, and nothing that strict JSON forbids."""
    estimate, reference = make_run()
    metrics = evaluate(estimate.trajectory, reference)
    write_results(
        tmp_path / "new" / "folder",
        estimate,
        mission=make_mission(estimate, reference),
        metrics=metrics,
        settings={"dof": np.float64(5.0), "limit": np.inf, "where": tmp_path},
    )
    text = (tmp_path / "new" / "folder" / "summary.json").read_text()
    summary = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    assert summary["method"] == "smoother"
    assert summary["kernel"] == "log(dof=5)"
    assert summary["status"] == "CONVERGED"
    assert summary["reason"] == estimate.reason
    assert summary["iterations"] == 6
    assert summary["wall_seconds"] == 1.25
    assert summary["mission"] == "lawn-mower"
    assert set(summary["versions"]) == {"ssm_graph", "gtsam", "numpy", "scipy", "python"}
    assert summary["start"]["origin"] == "alignment"
    assert summary["start"]["heading_deg"] == pytest.approx(350.0)
    assert summary["start"]["attitude_sigma_deg"] == pytest.approx([0.1, 0.1, 3.0])
    assert summary["notes"] == list(NOTES)
    assert summary["settings"] == {"dof": 5.0, "limit": None, "where": str(tmp_path)}
    assert summary["history"][0]["update_sigmas"] is None
    assert summary["n_outliers"] == np.sum(estimate.beams.weight < 0.05)
    for name in (
        "rmse_horizontal_m",
        "end_error_m",
        "drift_percent",
        "rmse_velocity_m_per_s",
        "nees_position",
        "path_length_m",
    ):
        assert summary[name] == pytest.approx(getattr(metrics, name))
    assert summary["drift_percent"] == pytest.approx(
        100.0 * summary["end_error_m"] / summary["path_length_m"]
    )
    assert summary["total_path_length_m"] == pytest.approx(path_length_m(estimate.trajectory))


def test_summary_without_reference(tmp_path: Path) -> None:
    """No comparison, no calibration: the keys of the first are absent, the second is empty."""
    estimate, _ = make_run(n=10, status=Status.SUSPECT)
    estimate = replace(estimate, beams=BeamTable(*[np.empty(0)] * 5))
    mission = replace(make_mission(estimate), initial=estimate.start)
    write_results(tmp_path, estimate, mission=mission, metrics=None, settings={})
    got = read_results(tmp_path)
    assert got.summary["calibration"] == {}
    assert got.summary["start"]["origin"] == "mission"
    assert got.summary["status"] == "SUSPECT"
    assert got.summary["is_good"] is False
    assert "rmse_horizontal_m" not in got.summary
    assert len(got.beams["weight"]) == 0


def test_interrupted_write_leaves_no_mixture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk: the old results stay as they are, no half file, no leftovers."""
    estimate, _ = make_run(n=10)
    mission = make_mission(estimate)
    write_results(tmp_path, estimate, mission=mission, metrics=None, settings={"run": 1})
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def no_space(path: Path, content: bytes) -> None:
        path.write_bytes(content[:100])
        if "beams" in path.name:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(results_module, "write_through", no_space)
    with pytest.raises(DataError, match="No space left"):
        write_results(tmp_path, estimate, mission=mission, metrics=None, settings={"run": 2})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_unusable_folders_are_named(tmp_path: Path) -> None:
    """Writing onto a file, reading what is missing, cut off or no result."""
    estimate, _ = make_run(n=10)
    mission = make_mission(estimate)
    (tmp_path / "file").write_text("x")
    with pytest.raises(DataError, match="cannot write results"):
        write_results(tmp_path / "file", estimate, mission=mission, metrics=None, settings={})
    with pytest.raises(DataError, match="no such folder"):
        read_results(tmp_path / "none")
    with pytest.raises(DataError, match=r"summary\.json, found none"):
        read_results(tmp_path)
    folder = tmp_path / "run"
    write_results(folder, estimate, mission=mission, metrics=None, settings={})
    beams = (folder / "beams.csv").read_text()
    (folder / "beams.csv").write_text(beams.replace("weight", "load"))
    with pytest.raises(DataError, match=r"beams\.csv:1: column 'weight' is missing"):
        read_results(folder)
    (folder / "beams.csv").write_text(beams[:-20])
    with pytest.raises(DataError, match=r"beams\.csv:41"):
        read_results(folder)
    (folder / "beams.csv").unlink()
    with pytest.raises(DataError, match=r"beams\.csv: cannot be read"):
        read_results(folder)
    (folder / "summary.json").write_text('{"method": ')
    with pytest.raises(DataError, match="expected valid JSON"):
        read_results(folder)


def test_further_columns_are_kept(tmp_path: Path) -> None:
    """Columns only grow: a later version's folder can still be read."""
    estimate, _ = make_run(n=3)
    write_results(tmp_path, estimate, mission=make_mission(estimate), metrics=None, settings={})
    path = tmp_path / "trajectory.csv"
    path.write_text(
        "\n".join(
            line + (",new_column" if i == 0 else ",1.5")
            for i, line in enumerate(path.read_text().splitlines())
        )
        + "\n"
    )
    np.testing.assert_allclose(read_results(tmp_path).trajectory["new_column"], 1.5)


def test_anything_becomes_json() -> None:
    """NumPy, enums, paths, infinities."""
    value = {
        "a": np.array([1.0, np.nan]),
        "b": Status.DIVERGED,
        3: (np.int64(2), True, None),
        "c": {1.5},
        "d": Path("x"),
        "e": -np.inf,
    }
    assert as_json(value) == {
        "a": [1.0, None],
        "b": "DIVERGED",
        "3": [2, True, None],
        "c": [1.5],
        "d": "x",
        "e": None,
    }


def test_long_missions_are_written_whole_columns_at_a_time(tmp_path: Path) -> None:
    """Thousands of keyframes more, with four beams each, take hardly a function call more."""
    n_calls = []
    for n in (10, 1_000, 3_000):  # the first is for what is done once
        estimate, _ = make_run(n=n)
        mission, profile = make_mission(estimate), cProfile.Profile()
        with profile:
            write_results(tmp_path / str(n), estimate, mission=mission, metrics=None, settings={})
        n_calls.append(pstats.Stats(profile).total_calls)  # type: ignore[attr-defined]
    assert n_calls[2] < n_calls[1] + 500
    assert read_results(tmp_path / "3000").trajectory["time_s"][-1] == EPOCH + 2_999.0
