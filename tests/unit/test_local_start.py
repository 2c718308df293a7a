"""A tank or a pool: a start at zero without a place on Earth, said in every output."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.inspection.look import inspect_mission
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.mission import LocalStart, Mission
from ssm_graph.sensors.imu import ImuNoise
from ssm_graph.simulation import Grade, scenario_config, simulate
from ssm_graph.smoothers.mission import smooth
from tests.mission_fixture import TOML, write_example


@pytest.fixture(scope="module")
def tank() -> Mission:
    """Return forty seconds of a MEMS unit without fixes, and its truth as the reference."""
    config = replace(scenario_config("demo", grade=Grade.MEMS), duration_s=40.0)
    found = simulate(config).mission
    return replace(found, gnss=None, initial=None)


def relative(estimate: Estimate, mission: Mission) -> tuple[Array, Array]:
    """Return the way from the first keyframe, ours and true, m east and north (N, 2)."""
    ours, truth = estimate.trajectory, mission.reference
    assert truth is not None
    p = mission.frame.p_n_from_geodetic(ours.lat, ours.lon, ours.height)[:, :2]
    q = mission.frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)[:, :2]
    at = np.column_stack([np.interp(ours.time_s, truth.time_s, axis) for axis in q.T])
    return p - p[0], at - at[0]


def test_a_stated_heading_gives_the_track_and_an_unknown_one_turns_it(tank: Mission) -> None:
    """Zero is the start; without a heading the track is that of a vehicle that looked north."""
    assert tank.reference is not None
    heading = float(tank.reference.roll_pitch_heading[0, 2])
    stated = replace(tank, local=LocalStart(tank.frame.lat, heading))
    estimate = smooth(stated)
    assert estimate.status.is_good, estimate.reason
    p, q = relative(estimate, stated)
    assert np.abs(p - q).max() < 1.5  # 40 s of a MEMS gyro that starts 1 deg off, 60 m
    assert abs(estimate.trajectory.lat[0] - tank.frame.lat) < 1e-7
    unknown = replace(tank, local=LocalStart(tank.frame.lat))
    estimate = smooth(unknown)
    assert any("heading not known: zero is where the vehicle looked" in n for n in estimate.notes)
    assert abs(estimate.trajectory.roll_pitch_heading[0, 2]) < np.radians(1.0)
    turned, _ = relative(estimate, unknown)
    c, s = np.cos(heading), np.sin(heading)
    # Clockwise by the true heading: east' = c e + s n of a track that begins northwards.
    back = turned @ np.array([[c, -s], [s, c]])
    assert np.abs(back - q).max() < 1.5


def test_every_output_says_it(
    tank: Mission, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Folder, command line, summary, report, export; a round trip keeps it."""
    pytest.importorskip("plotly")
    mission = tmp_path / "tank"
    write_mission(mission, replace(tank, local=LocalStart(), reference=None))
    again = read_mission(mission)
    assert again.local is not None
    assert not again.local.is_heading_known
    write_mission(tmp_path / "stated", replace(again, local=LocalStart(0.5, 1.0)))
    assert read_mission(tmp_path / "stated").local == LocalStart(0.5, 1.0)
    assert main(["inspect", str(mission)]) == 0
    result = tmp_path / "result"
    assert main(["smooth", str(mission), "--out", str(result), "--no-figure"]) == 0
    shown = capsys.readouterr().out.replace("\n", " ")
    assert "local start: positions are metres from the start" in " ".join(shown.split())
    summary = json.loads((result / "summary.json").read_text())
    assert summary["start"]["origin"] == "local"
    assert "no heading is stated" in summary["local_start"]
    assert main(["report", str(result)]) == 0
    page = (result / "report.html").read_text()
    head = page[page.index('class="verdict') :][:3000]
    assert "latitudes and longitudes are no place on Earth" in head
    assert main(["export", str(result), "--format", "kml,tum"]) == 0
    assert "no place on Earth" in capsys.readouterr().out


@pytest.mark.parametrize("other", ["origin", "gnss"])
def test_a_place_beside_it_is_refused(tmp_path: Path, other: str) -> None:
    """Only one of both can be."""
    text = TOML + "\n[local]\nheading_deg = 10.0\n"
    sections = {"origin": "[initial]", "gnss": "[initial]"}
    begin, end = text.index(sections[other]), text.index("[reference]")
    text = text[:begin] + text[end:].replace('[reference]\nfile = "reference.csv"\n', "")
    if other == "gnss":
        begin, end = text.index("[origin]"), text.index("[imu]")
        text = text[:begin] + text[end:]
    (write_example(tmp_path) / "mission.toml").write_text(text)
    with pytest.raises(ConfigError, match=rf"\[local\]: given together with \[{other}\]"):
        read_mission(tmp_path)


def test_gyros_that_feel_the_turn_of_the_earth(tank: Mission, tmp_path: Path) -> None:
    """Between those that find north and those that do not feel it, its turn counts as a bias."""
    fine = replace(tank.imu.noise, gyro_bias_sigma=np.radians(5.0) / 3600.0)
    sigmas = {}
    for name, local in (("unknown", LocalStart()), ("stated", LocalStart(heading=0.0))):
        imu = replace(tank.imu, noise=fine)
        mission = replace(tank, imu=imu, local=local, reference=None)
        write_mission(tmp_path / name, mission)
        noise: ImuNoise = read_mission(tmp_path / name).imu.noise
        sigmas[name] = np.degrees(noise.gyro_bias_sigma) * 3600.0
    assert sigmas["stated"] == pytest.approx(5.0)
    assert sigmas["unknown"] == pytest.approx(2.0 * 15.04 * np.cos(np.radians(45.0)), rel=1e-3)


def test_without_it_the_way_out_is_said(tank: Mission) -> None:
    """Who has neither fix nor place is told of it."""
    found = inspect_mission(tank, Path("tank"))
    assert "[local] for a tank or a pool" in found.verdict
    assert inspect_mission(replace(tank, local=LocalStart()), Path("tank")).missing == ()
