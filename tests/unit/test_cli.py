"""The command line: what a person types, what comes back, and with which exit code."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from ssm_graph import cli
from ssm_graph.base.errors import SsmGraphError
from ssm_graph.cli.main import COMMANDS, EXIT_CODES, ExitCode, main
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.results.tables import read_results


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate two minutes, GNSS at their begin."""
    folder = tmp_path_factory.mktemp("cli") / "mission"
    words = ["simulate", "demo", "--duration", "120", "--seed", "3", "--out", str(folder)]
    assert main(words) == ExitCode.GOOD
    return folder


def test_simulate_writes_what_was_asked_for(tmp_path: Path) -> None:
    """Grade, outliers, rate, duration and seed reach the mission."""
    words = "simulate hover --grade mems --outliers one_beam --rate 0.5 --duration 20 --seed 2"
    assert main([*words.split(), "--format", "parquet", "--out", str(tmp_path / "m")]) == 0
    read = read_mission(tmp_path / "m")
    assert read.imu.noise.gyro_bias_sigma == pytest.approx(np.radians(100.0) / 3600.0)
    assert read.imu.time_s[-1] == pytest.approx(20.0)
    assert (tmp_path / "m" / "imu.parquet").exists()


def test_simulate_realistic_instruments(tmp_path: Path) -> None:
    """The same run, read by other instruments."""
    words = ["simulate", "survey", "--duration", "20", "--seed", "3", "--out"]
    assert main([*words, str(tmp_path / "plain")]) == 0
    assert main([*words, str(tmp_path / "real"), "--realistic"]) == 0
    plain, real = (read_mission(tmp_path / name) for name in ("plain", "real"))
    assert (plain.imu.gyro_b != real.imu.gyro_b).mean() > 0.9
    assert plain.reference is not None
    assert real.reference is not None
    np.testing.assert_array_equal(plain.reference.lat, real.reference.lat)


@pytest.mark.parametrize(("word", "n_beams"), [("3", 3), ("velocity", 3), ("1", 1), ("8", 8)])
def test_simulate_any_number_of_beams(tmp_path: Path, word: str, n_beams: int) -> None:
    """The instrument that was asked for, as written and read again."""
    words = ["simulate", "survey", "--duration", "30", "--beams", word, "--outliers", "sparse"]
    assert main([*words, "--rate", "0.5", "--out", str(tmp_path)]) == ExitCode.GOOD
    dvl = read_mission(tmp_path).dvl
    assert dvl.speed.shape == (30, n_beams)
    mount = dvl.mount
    assert (word == "velocity") == np.allclose(mount.beams_d, np.eye(3) if n_beams == 3 else 0.0)
    for bad in ("0", "9", "many"):
        with pytest.raises(SystemExit):
            main([*words[:4], "--beams", bad, "--out", str(tmp_path)])


def test_smooth_writes_results_and_figure(
    mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The main job: a table on the terminal, four files, exit code 0."""
    out = tmp_path / "out"
    assert main(["smooth", str(mission), "--out", str(out)]) == ExitCode.GOOD
    shown = capsys.readouterr()
    assert "CONVERGED" in shown.out
    assert "horizontal error, rms, m" in shown.out
    assert "smoothing" in shown.err
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "CONVERGED"
    assert summary["rmse_horizontal_m"] < 1.0
    assert (out / "figure.png").stat().st_size > 10_000
    results = read_results(out)
    assert len(results.trajectory["lat_deg"]) > 100


def test_smooth_aligns_where_the_start_is_missing(mission: Path, tmp_path: Path) -> None:
    """Without [initial] a navigation-grade start is found, and said."""
    folder = tmp_path / "m"
    shutil.copytree(mission, folder)
    text = (folder / "mission.toml").read_text()
    begin, end = text.index("[initial]"), text.index("[reference]")
    (folder / "mission.toml").write_text(text[:begin] + text[end:])
    code = main(["smooth", str(folder), "--out", str(tmp_path / "out"), "--no-figure"])
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert code == ExitCode.GOOD, summary["reason"]
    assert any(note.startswith("aligned: heading") for note in summary["notes"])
    assert summary["rmse_horizontal_m"] < 1.5
    assert not (tmp_path / "out" / "figure.png").exists()


def test_smooth_calibrates_where_the_mission_asks_for_it(
    mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A prior sigma is all it takes; the lines to put in place are in the file's own axes."""
    folder, out = tmp_path / "m", tmp_path / "out"
    shutil.copytree(mission, folder)
    text = (folder / "mission.toml").read_text()
    text = text.replace("[dvl]\n", "[dvl]\nscale_sigma = 0.03\nlever_arm_sigma_m = 0.2\n")
    (folder / "mission.toml").write_text(text)
    assert main(["smooth", str(folder), "--out", str(out), "--no-figure"]) == ExitCode.GOOD
    shown = capsys.readouterr().out
    assert "dvl_scale_error" in shown
    assert "calibration.toml" in shown
    found = read_results(out).summary["calibration"]
    assert abs(found["dvl_scale_error"]["value"]) < 4.0 * found["dvl_scale_error"]["sigma"]
    lines = tomllib.loads((out / "calibration.toml").read_text())
    assert lines["dvl"]["scale_error"] == pytest.approx(found["dvl_scale_error"]["value"], abs=1e-6)


def test_faults_are_searched_for_unless_refused(mission: Path, tmp_path: Path) -> None:
    """The summary says whether the search was on."""
    for words, is_on in (([], True), (["--no-find-faults"], False)):
        out = tmp_path / str(is_on)
        assert main(["smooth", str(mission), "--out", str(out), "--no-figure", *words]) == 0
        settings = json.loads((out / "summary.json").read_text())["settings"]
        assert settings["find_faults"] is is_on


def test_an_unconverged_run_is_marked_and_written(mission: Path, tmp_path: Path) -> None:
    """One iteration is not enough: exit code 4, results there, status plain."""
    words = ["smooth", str(mission), "--out", str(tmp_path), "--max-iterations", "1"]
    assert main([*words, "--no-figure"]) == ExitCode.NOT_GOOD
    assert json.loads((tmp_path / "summary.json").read_text())["status"] == "MAX_ITERATIONS"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--kernel", "gaussian", "--dof", "5"], ExitCode.USAGE, "--dof"),
        (["--kernel", "log", "--width", "5"], ExitCode.USAGE, "--width"),
        (["--kernel", "log", "--dof", "-1"], ExitCode.USAGE, "above zero"),
        (["--gnss-until", "1e6"], ExitCode.USAGE, "--gnss-until"),
        (["--merge-rate", "0"], ExitCode.USAGE, "merge_rate_hz"),
    ],
)
def test_wrong_options_are_refused(
    mission: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    code: ExitCode,
    said: str,
) -> None:
    """A setting that does not fit is refused before any work, and named."""
    assert main(["smooth", str(mission), "--out", str(tmp_path / "out"), *words]) == code
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_bad_data_and_missing_folders_have_their_codes(
    mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A damaged table names file and line; a folder that is not there is named."""
    folder = tmp_path / "m"
    shutil.copytree(mission, folder)
    lines = (folder / "imu.csv").read_text().splitlines(keepends=True)
    lines[100] = lines[100].replace(",", ",oops", 1)
    (folder / "imu.csv").write_text("".join(lines))
    assert main(["smooth", str(folder), "--out", str(tmp_path / "o")]) == ExitCode.DATA
    assert "imu.csv:101" in capsys.readouterr().err
    code = main(["smooth", str(tmp_path / "nothing"), "--out", str(tmp_path / "o")])
    assert code in (ExitCode.USAGE, ExitCode.DATA)
    assert "nothing" in capsys.readouterr().err
    assert main(["convert", str(folder / "imu.csv"), "--out", str(tmp_path / "o")]) == (
        ExitCode.DATA
    )


def test_help_lists_the_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    """They stand in the help of every command."""
    for words in ([], *([name] for name in COMMANDS)):
        with pytest.raises(SystemExit) as stop:
            main([*words, "--help"])
        assert stop.value.code == 0
        assert "exit codes" in capsys.readouterr().out


def test_every_kind_of_error_has_a_code() -> None:
    """No error of ours ends as a crash."""

    def kinds(kind: type[SsmGraphError]) -> set[type[SsmGraphError]]:
        return {kind}.union(*(kinds(sub) for sub in kind.__subclasses__()))

    def code(kind: type[SsmGraphError]) -> ExitCode:
        return next(code for base, code in EXIT_CODES if issubclass(kind, base))

    ours = kinds(SsmGraphError) - {SsmGraphError}
    assert len(ours) >= 4
    assert ExitCode.CRASH not in {code(kind) for kind in ours}


def test_the_package_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    """In the order of the help."""
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = re.findall(r"^  ([a-z][a-z-]*)  +\w", capsys.readouterr().out, flags=re.MULTILINE)
    named = re.findall(r"([\w-]+)(?: \||``)", cli.__doc__ or "")
    assert len(named) > 6
    assert named == shown


def test_a_command_that_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    """The nearest one is named; without any all are listed."""
    with pytest.raises(SystemExit) as stop:
        main(["smoth", "m"])
    assert stop.value.code == ExitCode.USAGE
    assert "'smoth' is no command, did you mean 'smooth'?" in capsys.readouterr().err
    assert main([]) == ExitCode.USAGE
    shown = capsys.readouterr().err
    assert all(f"  {name} " in shown for name in COMMANDS)
