"""What was found of the instruments, as a user gets it: summary, lines for the mission, table."""

from __future__ import annotations

import io
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from rich.console import Console
from scipy.spatial.transform import Rotation

from ssm_graph.base.frames import BodyAxes
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.io.results.tables import read_results, write_results
from ssm_graph.report.mission.summary import summary_table
from tests import mission_fixture
from tests.estimate_fixture import calibrated, make_run


@pytest.mark.parametrize("axes", [BodyAxes.FRD, BodyAxes.FLU])
def test_calibration_is_told_and_ready_for_the_mission(tmp_path: Path, axes: BodyAxes) -> None:
    """By label in the summary, as keys of the mission in a file of its own; reds are left out."""
    estimate, _ = make_run(n=10)
    full = mission_fixture.make_mission()
    mount = replace(full.dvl.mount, scale_error=0.1, lever_arm_b=np.array([1.0, 2.0, 3.0]))
    full = replace(full, dvl=replace(full.dvl, mount=mount))
    write_results(
        tmp_path,
        calibrated(estimate, gnss_sigma=0.01),
        mission=full,
        metrics=None,
        settings={},
        axes=axes,
    )
    summary = read_results(tmp_path).summary["calibration"]
    assert summary["dvl_mounting_z_deg"]["value"] == pytest.approx(2.0)
    assert summary["dvl_mounting_z_deg"]["sigma"] == pytest.approx(0.1)
    assert summary["dvl_scale_error"]["determined"] == "green"
    assert summary["gnss_time_offset_s"]["determined"] == "red"
    text = (tmp_path / "calibration.toml").read_text()
    lines = tomllib.loads(text)
    assert lines["dvl"]["scale_error"] == pytest.approx(1.1 * 0.98 - 1.0)
    np.testing.assert_allclose(lines["dvl"]["mounting_rpy_deg"], [0.0, 0.0, 2.0], atol=1e-6)
    sign = 1.0 if axes is BodyAxes.FRD else -1.0
    np.testing.assert_allclose(lines["gnss"]["lever_arm_m"], [0.1, sign * 0.1, sign * 0.1])
    assert "time_offset_s" not in lines["gnss"]
    assert "# time_offset_s: not determined, sigma 0.29 of 0.3 before" in text
    assert "not determined: gnss_lever_arm_z_m" in text
    assert "# scale_sigma = 0.001" in text

    write_results(
        tmp_path, calibrated(estimate, gnss_sigma=0.39), mission=full, metrics=None, settings={}
    )
    assert "lever_arm_m" not in tomllib.loads((tmp_path / "calibration.toml").read_text())["gnss"]
    write_results(tmp_path, estimate, mission=full, metrics=None, settings={})
    assert not (tmp_path / "calibration.toml").exists()


def test_lines_of_a_calibration_are_a_mission_again(tmp_path: Path) -> None:
    """Every key is one that the reader knows, and leads to the value that was found."""
    estimate, _ = make_run(n=10)
    full = mission_fixture.make_mission()
    assert full.gnss is not None
    write_results(
        tmp_path / "run",
        calibrated(estimate, gnss_sigma=0.01),
        mission=full,
        metrics=None,
        settings={},
    )
    write_mission(tmp_path / "mission", full)
    path = tmp_path / "mission" / "mission.toml"
    settings = tomllib.loads(path.read_text())
    for section, keys in tomllib.loads((tmp_path / "run" / "calibration.toml").read_text()).items():
        settings[section] |= keys
    path.write_text(tomli_w.dumps(settings))
    got = read_mission(tmp_path / "mission")
    assert got.gnss is not None
    assert got.dvl.mount.scale_error == pytest.approx(-0.02)
    turned = full.dvl.mount.R_bd.T @ got.dvl.mount.R_bd
    np.testing.assert_allclose(
        Rotation.from_matrix(turned).as_rotvec(degrees=True), [0.0, 0.0, 2.0], atol=1e-6
    )
    np.testing.assert_allclose(got.gnss.lever_arm_b, full.gnss.lever_arm_b + 0.1, atol=1e-7)


def test_the_table_has_a_colour_for_each_value() -> None:
    """Green, amber and red by posterior over prior sigma, beside the value in 80 columns."""
    estimate, _ = make_run(n=10)
    console = Console(file=io.StringIO(), width=80, force_terminal=True)
    console.print(summary_table(calibrated(estimate, gnss_sigma=0.2)))
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    shown = {
        label: next(line for line in text.splitlines() if label in line)
        for label in ("dvl_scale_error", "gnss_lever_arm_x_m", "gnss_lever_arm_z_m")
    }
    assert "\x1b[32mgreen" in shown["dvl_scale_error"]
    assert "\x1b[33mamber" in shown["gnss_lever_arm_x_m"]
    assert "\x1b[31mred" in shown["gnss_lever_arm_z_m"]
    assert "-0.02" in shown["dvl_scale_error"]
