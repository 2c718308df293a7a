"""A study's file: nothing is lost, nothing is done twice, nothing is mixed."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

import benchmarks.monte_carlo as monte_carlo
from benchmarks.study_cases import parse_method
from benchmarks.study_runs import Job, Run, do_job
from benchmarks.study_store import ResultsFile, code_version
from ssm_graph.errors import ConfigError, DataError
from ssm_graph.simulation import Grade

SETTINGS = {"code": "1", "duration_s": 300.0}


def a_run(seed: int, method: str = "oracle", **values: Any) -> Run:
    """Return a finished run."""
    return Run("sparse10", "NAVIGATION", method, seed, "CONVERGED", "done", **values)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return the file of a study with two runs."""
    path = tmp_path / "out" / "runs.jsonl"
    ResultsFile(path, SETTINGS).append([a_run(0, rms_horizontal_m=0.5), a_run(1)])
    return path


def test_what_is_written_is_read(path: Path) -> None:
    """NaN survives as null, since JSON has none."""
    first, second = ResultsFile(path, SETTINGS).runs
    assert first.key == ("sparse10", "NAVIGATION", "oracle", 0)
    assert first.rms_horizontal_m == 0.5
    assert math.isnan(second.rms_horizontal_m)
    assert "NaN" not in path.read_text()


@pytest.mark.parametrize("cut", [1, 7, 40])
def test_torn_last_line_is_dropped(path: Path, cut: int) -> None:
    """A study stopped while writing loses that run only, and goes on on a line of its own."""
    path.write_text(path.read_text()[:-cut])
    results = ResultsFile(path, SETTINGS)
    assert [run.seed for run in results.runs] == [0]
    results.append([a_run(2)])
    assert [run.seed for run in ResultsFile(path, SETTINGS).runs] == [0, 2]


def test_torn_first_line_begins_anew(path: Path) -> None:
    """Not even the settings are there: nothing can be lost."""
    path.write_text('{"settings": {"co')
    assert ResultsFile(path, SETTINGS).runs == []
    assert json.loads(path.read_text()) == {"settings": SETTINGS}


def test_damage_elsewhere_is_refused(path: Path) -> None:
    """The message names file and line."""
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([lines[0], "{broken\n", *lines[1:]]))
    with pytest.raises(DataError, match=r"runs\.jsonl, line 2: expected a JSON object"):
        ResultsFile(path, SETTINGS)


@pytest.mark.parametrize("changed", [{"code": "2"}, {"duration_s": 60.0}, {"new": 1}])
def test_other_settings_are_refused(path: Path, changed: dict[str, Any]) -> None:
    """Unless asked for, runs of different settings do not meet in one file."""
    with pytest.raises(ConfigError, match=f"made with other settings .*{next(iter(changed))}"):
        ResultsFile(path, SETTINGS | changed)
    assert ResultsFile(path, SETTINGS | changed, fresh=True).runs == []


def test_same_run_is_stored_once(path: Path) -> None:
    """The first result stays."""
    ResultsFile(path, SETTINGS).append([a_run(0, rms_horizontal_m=9.0), a_run(3)])
    results = ResultsFile(path, SETTINGS)
    assert [run.seed for run in results.runs] == [0, 1, 3]
    assert results.runs[0].rms_horizontal_m == 0.5


def test_only_missing_methods_are_run(path: Path) -> None:
    """A job keeps what is missing; a finished one disappears."""
    oracle, log = parse_method("oracle"), parse_method("log")
    wanted = [
        Job("sparse10", Grade.NAVIGATION, 0, (oracle, log), 300.0),
        Job("sparse10", Grade.NAVIGATION, 1, (oracle,), 300.0),
        Job("sparse10", Grade.TACTICAL, 0, (oracle,), 300.0),
    ]
    missing = monte_carlo.missing_jobs(wanted, ResultsFile(path, SETTINGS))
    assert [(job.grade, job.seed, job.methods) for job in missing] == [
        (Grade.NAVIGATION, 0, (log,)),
        (Grade.TACTICAL, 0, (oracle,)),
    ]


def test_finished_study_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Started again it only reports; its version is that of the source."""
    command = ["--cases", "sparse10", "--grades", "NAVIGATION", "--methods", "oracle", "log"]
    command += ["--seeds", "2", "--duration", "30", "--out", str(tmp_path)]
    results = ResultsFile(tmp_path / "runs.jsonl", {"code": code_version(), "duration_s": 30.0})
    for seed in range(2):
        results.append(
            a_run(seed, method, rms_horizontal_m=1.0, nees_final=1.0, n_epochs=1)
            for method in ("oracle", "log:5")
        )

    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("there was nothing to run")

    monkeypatch.setattr(monte_carlo, "run_jobs", never)
    assert monte_carlo.main(command) == 0
    assert "## sparse10, navigation" in capsys.readouterr().out
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 5
    assert monte_carlo.main([*command, "--duration", "60"]) == 1
    assert "use --fresh" in capsys.readouterr().err


def test_failure_is_a_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """One method that breaks neither ends the job nor disappears."""

    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr("benchmarks.study_runs.SsmSmoother.solve", broken)
    methods = (parse_method("oracle"), parse_method("log"))
    runs = do_job(Job("clean", Grade.NAVIGATION, 0, methods, 5.0))
    assert [run.status for run in runs] == ["CRASHED", "CRASHED"]
    assert runs[0].reason == "ZeroDivisionError: oh"
    assert not runs[0].has_result
