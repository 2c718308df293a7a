"""Instruments by name: figures in sheet units, keys of a mission, what is asked for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.main import main
from ssm_graph.io.instruments.library import _DVL_FIGURES, _IMU_KEYS, preset, presets
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.mission_folder.toml import SECTIONS
from tests.mission_fixture import TOML, write_example

NOISE = """gyro_random_walk_deg_per_sqrt_h = 0.05
accel_random_walk_ug_per_sqrt_hz = 50.0
gyro_bias_deg_per_h = 0.5
accel_bias_ug = 100.0
"""


def test_every_entry_is_sound() -> None:
    """Known figures above zero, a sheet, a basis; its keys are keys of the section, in range."""
    found = presets()
    with_figures = [one for one in found if one.figures]
    assert sum(one.section == "imu" for one in with_figures) >= 25
    assert sum(one.section == "dvl" for one in with_figures) >= 15
    words = [(one.section, word.casefold()) for one in found for word in (one.name, *one.aliases)]
    assert len(words) == len(set(words))
    for one in found:
        known = set(_IMU_KEYS) if one.section == "imu" else set(_DVL_FIGURES)
        assert set(one.figures) <= known, one.name
        assert set(one.published) <= set(one.figures), one.name
        assert one.basis in ("read", "quoted", "published")
        assert one.sheet
        for key, value in one.keys.items():
            number = [float(v) for v in value] if isinstance(value, list) else float(value)
            assert SECTIONS[one.section][key].problem(number) == "", (one.name, key)


def test_sheet_units_become_those_of_the_mission() -> None:
    """By hand: noise densities, velocity random walk, and a ping's horizontal component."""
    mti = preset("imu", "mti 300", place="x").keys
    assert mti["gyro_random_walk_deg_per_sqrt_h"] == 0.6
    assert mti["gyro_bias_deg_per_h"] == 720.0
    stim = preset("imu", "STIM300", place="x").keys
    assert stim["accel_random_walk_ug_per_sqrt_hz"] == pytest.approx(0.07 / 60.0 / 9.80665e-6)
    dvl = preset("dvl", "DVL1000", place="x").keys
    phins = preset("imu", "PHINS", place="x").keys
    east = np.radians(phins["gyro_bias_deg_per_h"] / 3600.0)  # turns a gyrocompass at the equator
    assert np.degrees(east / 7.292115e-5) == pytest.approx(0.01, rel=1e-3)
    assert np.degrees(1e-6 * phins["accel_bias_ug"]) == pytest.approx(0.01, rel=1e-3)
    beams = np.sin(np.radians(25.0)) * np.array([1.0, -1.0])  # forward parts of opposite beams
    forward = dvl["beam_noise_m_per_s"] * np.sqrt(2.0) / (beams[0] - beams[1])
    assert forward == pytest.approx(0.008, rel=2e-3)
    assert dvl["scale_sigma"] == 0.001


def _with(folder: Path, old: str, new: str) -> Path:
    path = write_example(folder) / "mission.toml"
    assert old in TOML
    path.write_text(TOML.replace(old, new))
    return folder


def test_a_mission_names_its_instruments(tmp_path: Path) -> None:
    """Own keys win over the library's, and a note says where the figures are from."""
    named = 'instrument = "vn100"\ngyro_bias_deg_per_h = 30.0\naccel_bias_ug = 2000.0\n'
    mission = read_mission(_with(tmp_path, NOISE, named))
    noise = mission.imu.noise
    assert noise.gyro_density == pytest.approx(np.radians(0.0035))
    assert noise.accel_density == pytest.approx(140e-6 * 9.80665)
    assert noise.gyro_bias_sigma == pytest.approx(np.radians(30.0) / 3600.0)
    assert any("VectorNav VN-100" in note and "quoted" in note for note in mission.notes)


def test_above_the_sections_too(tmp_path: Path) -> None:
    """``imu = "STIM300"`` is a section with the usual table; all it needs is in the sheet."""
    text = TOML.replace("[frames]", 'imu = "STIM300"\n\n[frames]', 1)
    begin, end = text.index("[imu]"), text.index("[dvl]")
    (write_example(tmp_path) / "mission.toml").write_text(text[:begin] + text[end:])
    assert read_mission(tmp_path).imu.noise.gyro_density == pytest.approx(np.radians(0.15) / 60.0)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (NOISE, 'instrument = "VM-100"\n', r"\[imu\] instrument: .*did you mean .*'VN-100'"),
        (NOISE, "instrument = 100\n", "expected a text in quotes, got 100"),
        (
            NOISE,
            'instrument = "VN-100"\n',
            r"\[imu\] gyro_bias_deg_per_h: expected beside instrument = 'VN-100', of which no "
            "source gives gyro_bias_deg_per_h, accel_bias_ug; state it",
        ),
        (
            "beam_azimuth_deg = [45, 135, 225, 315]\nbeam_janus_deg = 30.0\n",
            'instrument = "DVL500"\n',
            r"\[dvl\] beam_azimuth_deg: expected beside instrument = 'DVL500'",
        ),
    ],
)
def test_what_no_source_gives_is_asked_for(tmp_path: Path, old: str, new: str, told: str) -> None:
    """By its key, in the unit of data sheets; unknown names have near ones."""
    with pytest.raises(ConfigError, match=told):
        read_mission(_with(tmp_path, old, new))


def test_the_command_lists_and_shows(capsys: pytest.CaptureFixture[str]) -> None:
    """All of them, one, JSON; a wrong name is named with the right one."""
    assert main(["instruments"]) == 0
    out = capsys.readouterr().out
    assert all(one.name in out for one in presets())
    assert main(["instruments", "stim 300"]) == 0
    assert "gyro_random_walk_deg_per_sqrt_h = 0.15" in capsys.readouterr().out
    assert main(["instruments", "phins"]) == 0
    told = capsys.readouterr().out
    assert "gyro_random_walk_deg_per_sqrt_h, accel_random_walk_ug_per_sqrt_hz\n" in told
    assert main(["instruments", "A50", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["keys"]["beam_janus_deg"] == 22.5
    assert main(["instruments", "DLV1000"]) == 2
    assert "did you mean 'DVL1000'" in capsys.readouterr().err
