"""Output is one set, is looked at before the work, and is never over an input."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.results.place import LEAST_FREE, check_place
from ssm_graph.io.results.tables import read_results, write_results
from tests.estimate_fixture import make_mission, make_run
from tests.mission_fixture import make_mission as simple_mission

TABLES = ("trajectory.csv", "beams.csv", "summary.json")


def write(folder: Path, *, figure: bytes | None = None) -> None:
    """Write a result folder, with a figure or without one."""
    estimate = make_run()[0]
    draw = None if figure is None else lambda path: path.write_bytes(figure)
    mission = make_mission(estimate)
    write_results(folder, estimate, mission=mission, metrics=None, settings={}, draw=draw)


def names(folder: Path) -> set[str]:
    """Return what is in a folder."""
    return {path.name for path in folder.iterdir()}


def test_a_figure_goes_and_comes_with_its_tables(tmp_path: Path) -> None:
    """A run leaves no figure and no report of an earlier run beside its tables."""
    write(tmp_path, figure=b"first")
    assert (tmp_path / "figure.png").read_bytes() == b"first"
    write(tmp_path, figure=b"second")
    assert (tmp_path / "figure.png").read_bytes() == b"second"
    (tmp_path / "report.html").write_text("of the second")
    write(tmp_path)
    assert names(tmp_path) == set(TABLES)


def test_a_figure_that_fails_costs_no_table(tmp_path: Path) -> None:
    """The tables are there, the old figure is not, and what went wrong is raised."""
    write(tmp_path, figure=b"first")
    estimate = make_run()[0]

    def draw(path: Path) -> None:
        path.write_bytes(b"half")
        raise MemoryError("no room for pixels")

    options = {"mission": make_mission(estimate), "metrics": None, "settings": {"run": 2}}
    with pytest.raises(MemoryError):
        write_results(tmp_path, estimate, draw=draw, **options)  # type: ignore[arg-type]
    assert names(tmp_path) == set(TABLES)
    assert read_results(tmp_path).summary["settings"] == {"run": 2}


@pytest.mark.parametrize(("name", "what"), [("mission.toml", "a mission"), ("run.json", "live")])
def test_results_never_go_into_a_mission_or_a_run(tmp_path: Path, name: str, what: str) -> None:
    """Its trajectory.csv or dvl.csv might be all that there is."""
    (tmp_path / name).write_text("")
    (tmp_path / "trajectory.csv").write_text("mine")
    link = tmp_path.with_name(f"{tmp_path.name}-link")
    link.symlink_to(tmp_path)
    for folder in (tmp_path, link):
        with pytest.raises(ConfigError, match=what):
            write(folder)
    assert (tmp_path / "trajectory.csv").read_text() == "mine"


@pytest.fixture
def mission(tmp_path: Path) -> Path:
    """Return a mission folder."""
    folder = tmp_path / "mission"
    write_mission(folder, simple_mission())
    return folder


@pytest.mark.parametrize("command", ["smooth", "filter", "compare"])
def test_out_is_looked_at_before_the_work(
    mission: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
) -> None:
    """A file, a mission, a long name, a folder below a file: named before anything is read."""

    def read(*_: object) -> None:
        raise AssertionError("the work was begun")

    monkeypatch.setattr("ssm_graph.io.mission_folder.folder.read_mission", read)
    monkeypatch.setattr("ssm_graph.cli.compare_run.run_study", read)
    (tmp_path / "file").write_text("mine")
    for out, said in (
        (tmp_path / "file", "expected a folder, got the file"),
        (tmp_path / "file" / "below", "Not a directory"),
        (mission, "that of a mission"),
        (tmp_path / ("x" * 300), "File name too long"),
        (tmp_path / "new" / ("x" * 300), "File name too long"),
        (Path("/proc/none"), "/proc/none"),
    ):
        assert main([command, str(mission), "--out", str(out)]) == ExitCode.USAGE, out
        shown = capsys.readouterr().err
        assert said in shown, out
        assert "Traceback" not in shown
    assert names(tmp_path) == {"file", "mission"}
    assert (tmp_path / "file").read_text() == "mine"


def test_a_full_disk_is_seen_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By what is free, not by the failure an hour later."""
    usage = shutil.disk_usage(tmp_path)._replace(free=LEAST_FREE - 1)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(ConfigError, match="make room"):
        check_place(tmp_path / "a" / "b")
    assert not os.listdir(tmp_path)


def test_a_simulation_is_over_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder with anything in it is refused unless that is asked for; a live run always."""
    words = ["simulate", "survey", "--duration", "30", "--out", str(tmp_path)]
    (tmp_path / "imu.csv").write_text("mine")
    assert main(words) == ExitCode.USAGE
    assert "'imu.csv' in it; give another, or --overwrite" in capsys.readouterr().err
    assert (tmp_path / "imu.csv").read_text() == "mine"
    assert main([*words, "--overwrite"]) == ExitCode.GOOD
    (tmp_path / "run.json").write_text("{}")
    assert main([*words, "--overwrite"]) == ExitCode.USAGE


def test_a_study_is_one_set(tmp_path: Path) -> None:
    """Figures and a table of another format of an earlier state are gone."""
    study = tmp_path / "s.toml"
    study.write_text(
        'name = "s"\nscenario = "survey"\nduration_s = 60.0\ngrades = ["tactical"]\n'
        '[[methods]]\nnames = ["smoother-gaussian"]\nseeds = 1\n[[cases]]\nkinds = ["sparse"]\n'
        "rates = [0.1]\n"
    )
    out = tmp_path / "out"
    (out / "figures").mkdir(parents=True)
    for name in ("figures/errors_over_time.png", "table.parquet", "summary.md"):
        (out / name).write_text("old")
    words = ["compare", str(study), "--out", str(out), "--jobs", "1", "--no-figures"]
    assert main(words) == ExitCode.GOOD
    assert names(out) == {"runs.jsonl", "series", "figures", "table.csv", "summary.md"} | {
        "summary.tex"
    }
    assert not list((out / "figures").iterdir())
    assert json.loads((out / "runs.jsonl").read_text().splitlines()[0])["settings"]["study"] == "s"
