"""Names, paths and numbers that nobody expects: no traceback, no hang, the cause that is there."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.settings import LEAST_SIZE, Key
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.tables import files
from ssm_graph.io.tables.files import read_parquet, read_table, write_table
from ssm_graph.mission.problem import SHORTEST_INTERVAL_S, ProblemConfig
from ssm_graph.report.mission.figure import draw_figure
from ssm_graph.report.style import log_ticks, new_figure, save
from ssm_graph.sensors.depth import DEPTH
from ssm_graph.simulation import SimulationConfig
from ssm_graph.study.scenario import read_study
from tests.estimate_fixture import make_run
from tests.mission_damage import toml
from tests.mission_fixture import make_mission

PATHS = ("[bold]x", "[/]", "[/bold]", "a:smile:b", "%s{0}", "$x^{$", "back\\")


@pytest.mark.parametrize("name", PATHS)
def test_paths_are_told_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    """Brackets are no markup, colons no pictures."""
    folder = tmp_path / name
    assert main(["smooth", str(folder / "none"), "--out", str(folder / "r")]) == ExitCode.USAGE
    assert name in capsys.readouterr().err.replace("\\\\", "\\")
    words = ["simulate", "survey", "--duration", "30", "--out", str(folder / "s")]
    assert main(words) == ExitCode.GOOD
    assert f"{folder / 's'}: " in capsys.readouterr().out


def test_names_of_missions_are_no_formulas(tmp_path: Path) -> None:
    """On the figure, where a dollar used to begin one; a long one is cut."""
    estimate, reference = make_run(n=60)
    for name in ("$x^{$", "a$b$c", r"$\frac{1}{$", "x" * 300, "[/]", "a_b^c\\d{"):
        figure = draw_figure(estimate, reference, title=name)
        assert len(figure.get_suptitle()) < 100
        assert figure.get_suptitle().startswith(name[:80])
        for axes in figure.axes:  # the name alone is drawn: laying out all panels takes long
            axes.remove()
        save(figure, tmp_path / "figure.png", dpi=40)
        assert (tmp_path / "figure.png").stat().st_size > 1000


def test_decades_are_written_without_formulas(tmp_path: Path) -> None:
    """Ticks used to be the only ones."""
    figure = new_figure(3.0, 3.0, "ticks")
    axes = figure.add_subplot()
    log_ticks(axes.yaxis, 1e-6, 1e-3)
    save(figure, tmp_path / "figure.png", dpi=40)
    labels = {label.get_text() for label in axes.get_yticklabels()}
    assert "10⁻⁵" in labels
    assert not any("$" in label for label in labels)


@pytest.mark.parametrize("key", ["gyro_bias_deg_per_h", "scale_sigma", "time_offset_sigma_s"])
def test_a_prior_whose_square_is_zero_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str
) -> None:
    """A division by zero an hour later says nothing about the key."""
    write_mission(tmp_path / "m", make_mission())
    lines = (tmp_path / "m" / "mission.toml").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith(f"{key} = "))
    toml(line, f"{key} = 1e-300")(tmp_path / "m")
    assert main(["smooth", str(tmp_path / "m"), "--out", str(tmp_path / "r")]) == ExitCode.USAGE
    assert f"{key}: expected" in capsys.readouterr().err
    assert Key(positive=True).problem(LEAST_SIZE) == ""
    assert Key(low=0.0).problem(0.0) == ""
    assert Key(low=-1.0, high=1.0).problem(1e-300) == ""


@pytest.mark.parametrize(
    ("kernel", "parameter"),
    [("log", "dof"), ("exp", "width"), ("huber", "width"), ("dcs", "phi"), ("gnc-tls", "width")],
)
@pytest.mark.parametrize("value", ["1e300", "1e-300"])
def test_widths_whose_squares_are_none_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kernel: str, parameter: str, value: str
) -> None:
    """Before the mission is read."""
    words = ["smooth", "m", "--out", str(tmp_path), "--kernel", kernel, f"--{parameter}", value]
    assert main(words) == ExitCode.USAGE
    assert f"{parameter}: expected a number from 1e-15 to 1e+15" in capsys.readouterr().err


def test_keyframes_without_number_are_refused() -> None:
    """A millionth of a second from one to the next is a slip, and for ever."""
    with pytest.raises(ConfigError, match=r"keyframe_interval_s: expected 0\.01 s or more"):
        ProblemConfig(keyframe_interval_s=1e-6)
    ProblemConfig(keyframe_interval_s=SHORTEST_INTERVAL_S)
    with pytest.raises(ConfigError, match=r"at most 2e\+08 IMU samples"):
        SimulationConfig(duration_s=1e12)


def test_a_study_that_is_a_pipe_is_refused(tmp_path: Path) -> None:
    """Every file of settings is read by one function."""
    os.mkfifo(tmp_path / "s.toml")
    with pytest.raises(ConfigError, match="expected a file"):
        read_study(tmp_path / "s.toml")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda content: content[:-20], "magic bytes"),
        (lambda content: bytes(len(content) - 8) + content[-8:], "deserialize"),
        (lambda _: b"", "size is 0 bytes"),
    ],
)
def test_parquet_says_what_arrow_said(tmp_path: Path, damage: object, said: str) -> None:
    """No guess at one cause where several fit."""
    pytest.importorskip("pyarrow")
    path = tmp_path / "depth.parquet"
    write_table(path, {"time_s": [0.0, 1.0], "depth_m": [1.0, 2.0]})  # type: ignore[dict-item]
    path.write_bytes(damage(path.read_bytes()))  # type: ignore[operator]
    with pytest.raises(DataError, match=said):
        read_table(path, "depth.parquet", DEPTH.spec(None))


def test_too_little_memory_is_told_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrow's error is an error of memory and of Arrow at once."""
    arrow = pytest.importorskip("pyarrow")
    path = tmp_path / "depth.parquet"
    write_table(path, {"time_s": [0.0, 1.0], "depth_m": [1.0, 2.0]})  # type: ignore[dict-item]
    modules = files.pyarrow_module

    class Small:
        """Reads headers only."""

        read_schema = staticmethod(modules("pyarrow.parquet").read_schema)

        @staticmethod
        def read_table(_: Path) -> None:
            raise arrow.lib.ArrowMemoryError("malloc of size 8000000064 failed")

    def module(name: str) -> object:
        return Small if name == "pyarrow.parquet" else modules(name)

    monkeypatch.setattr(files, "pyarrow_module", module)
    with pytest.raises(DataError, match=r"not enough memory for this table \(malloc of size 8"):
        read_parquet(path, "depth.parquet", DEPTH.spec(None))


def test_memory_that_is_not_there_is_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whoever asks for too much is told so."""

    def simulate(_: SimulationConfig) -> None:
        raise MemoryError("Unable to allocate 2.13 PiB")

    monkeypatch.setattr("ssm_graph.cli.simulate.simulate", simulate)
    assert main(["simulate", "survey", "--out", str(tmp_path / "m")]) == ExitCode.DATA
    assert "out of memory: Unable to allocate" in capsys.readouterr().err
    assert json.dumps(sorted(tmp_path.iterdir(), key=str)) == "[]"
