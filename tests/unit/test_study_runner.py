"""Studies as a whole: interrupted, resumed, spread over processes, and on the command line."""

from __future__ import annotations

import csv
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.simulation import Grade, scenario_config, simulate
from ssm_graph.study.jobs import Job, JobProcesses, JobResult, do_job
from ssm_graph.study.runner import (
    Progress,
    example_estimates,
    in_this_process,
    open_store,
    run_study,
)
from ssm_graph.study.scoring import COLUMNS
from tests.study_fixture import SPARSE, tiny_study, untimed

STUDY = """\
name = "tiny"
duration_s = 20.0
[[methods]]
names = ["oracle", "smoother-log"]
seeds = 2
[[cases]]
kinds = ["none", "sparse"]
"""


def interrupted_after(n: int) -> Any:
    """Return an executor that is interrupted after some jobs."""

    def execute(jobs: Sequence[Job]) -> Iterator[JobResult]:
        for i, job in enumerate(jobs):
            if i == n:
                raise KeyboardInterrupt
            yield do_job(job)

    return execute


def test_interrupted_study_goes_on(tmp_path: Path) -> None:
    """Nothing is done twice, and the table is that of a study in one go, in the other order."""
    study, seen = tiny_study(), list[Progress]()
    store = open_store(study, tmp_path / "a")
    with pytest.raises(KeyboardInterrupt):
        run_study(study, store, execute=interrupted_after(1), on_progress=seen.append)
    n_kept = len(store)
    assert 0 < n_kept < 10
    assert (seen[-1].n_done, seen[-1].n_wanted) == (n_kept, 10)
    store = open_store(study, tmp_path / "a")
    assert len(store) == n_kept
    resumed = run_study(study, store, on_progress=seen.append)
    assert (seen[-1].n_done, seen[-1].n_wanted) == (10 - n_kept, 10 - n_kept)
    whole = run_study(
        study,
        open_store(study, tmp_path / "b"),
        execute=lambda jobs: in_this_process(list(reversed(jobs))),
    )
    assert [untimed(row) for row in resumed.rows] == [untimed(row) for row in whole.rows]
    assert list(resumed.series) == list(whole.series)
    assert resumed.n_failed == 0
    seeds = [(row["case"], row["method"], row["seed"]) for row in resumed.rows]
    assert seeds[:3] == [
        ("clean", "oracle", 0),
        ("clean", "oracle", 1),
        ("clean", "smoother-log", 0),
    ]


def test_finished_study_runs_nothing(tmp_path: Path) -> None:
    """Started again it only reports; with more seeds, only these are run."""
    study = tiny_study(cases=[{"kinds": ["none"]}], methods=[{"names": ["oracle"], "seeds": 1}])
    run_study(study, open_store(study, tmp_path))

    def never(_: Any) -> Iterator[JobResult]:
        raise AssertionError("there was nothing to run")

    result = run_study(study, open_store(study, tmp_path), execute=never)
    assert len(result.rows) == 1
    seeds: list[tuple[int, ...]] = []

    def noted(jobs: Sequence[Job]) -> Iterator[JobResult]:
        seeds.extend(job.seeds for job in jobs)
        return in_this_process(jobs)

    more = run_study(study.changed(n_seeds=2), open_store(study, tmp_path), execute=noted)
    assert seeds == [(1,)]
    assert len(more.rows) == 2


def test_workers_of_another_version_are_refused(tmp_path: Path) -> None:
    """Their numbers would be others."""
    study = tiny_study()

    def elsewhere(jobs: Sequence[Job]) -> Iterator[JobResult]:
        return (replace(result, code="9.9+x") for result in in_this_process(jobs))

    store = open_store(study, tmp_path)
    with pytest.raises(DataError, match=r"expected a worker with ssm-graph .* got one with 9\.9"):
        run_study(study, store, execute=elsewhere)
    assert len(store) == 0


def test_example_is_of_a_cell_with_outliers() -> None:
    """All methods on one mission, with its truth."""
    found = example_estimates(tiny_study())
    assert [name for name, _, _ in found] == ["oracle", "smoother-log", "smoother-gaussian"]
    assert len({len(reference.time_s) for _, _, reference in found}) == 1
    oracle, log = (len(estimate.beams.weight) for _, estimate, _ in found[:2])
    assert oracle == log - 2


def test_number_of_processes_is_checked() -> None:
    """At the border."""
    with pytest.raises(ConfigError, match="--jobs: expected 1 or more processes, got 0"):
        JobProcesses(0)


@pytest.mark.slow
@pytest.mark.parametrize("n_processes", [1, 2])
def test_dead_processes_lose_nothing(n_processes: int, tmp_path: Path) -> None:
    """Killed at work or idle, what they were at is done by others, also where none is left."""
    study = tiny_study(methods=[{"names": ["smoother-log", "oracle"], "seeds": 12}])
    expected = run_study(study, open_store(study, tmp_path / "a"))
    killed: list[int] = []

    def kill_all(_: Progress) -> None:
        if not killed:
            killed.extend(child.pid or 0 for child in multiprocessing.active_children())
            for child in multiprocessing.active_children():
                child.kill()
                child.join()

    store = open_store(study, tmp_path / "b")
    found = run_study(study, store, execute=JobProcesses(n_processes), on_progress=kill_all)
    assert len(killed) == n_processes
    assert [untimed(row) for row in found.rows] == [untimed(row) for row in expected.rows]


class Deadly(int):
    """A seed that ends the process that receives it."""

    def __reduce__(self) -> tuple[Any, tuple[int]]:
        return os._exit, (3,)


@pytest.mark.slow
def test_run_that_kills_its_process_is_lost_alone() -> None:
    """Down to the one seed and method; all others have their rows."""
    jobs = [
        Job("tiny", SPARSE, Grade.NAVIGATION, (0, Deadly(1)), ("oracle", "smoother-log")),
        Job("tiny", SPARSE, Grade.NAVIGATION, (2,), ("oracle",)),
    ]
    rows = {key: row for result in JobProcesses(2)(jobs) for key, row in result.rows.items()}
    statuses = {(key.seed, key.method): row["status"] for key, row in rows.items()}
    assert statuses == {
        (0, "oracle"): "CONVERGED",
        (0, "smoother-log"): "CONVERGED",
        (1, "oracle"): "LOST",
        (1, "smoother-log"): "LOST",
        (2, "oracle"): "CONVERGED",
    }
    lost = next(row for row in rows.values() if row["status"] == "LOST")
    assert (lost["failed"], lost["error"]) == (1, "its process ended with exit code 3, twice")


@pytest.mark.slow
def test_interrupt_keeps_what_is_done(tmp_path: Path) -> None:
    """Ctrl-C in the middle: exit code 130, what is kept is said, and the rest follows later."""
    file = tmp_path / "tiny.toml"
    file.write_text(STUDY.replace("seeds = 2", "seeds = 40").replace("20.0", "60.0"))
    words = ["compare", str(file), "--out", str(tmp_path / "out"), "--jobs", "1", "--no-figures"]
    # Whatever starts the tests in the background may have had the signal ignored.
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += f"from ssm_graph.cli.main import main; sys.exit(main({words!r}))"
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    path = tmp_path / "out" / "runs.jsonl"
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline:
        if path.exists() and len(path.read_text().splitlines()) > 1:
            break
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60.0)
    assert process.returncode == ExitCode.INTERRUPTED
    n_kept = len(path.read_text().splitlines()) - 1
    assert 0 < n_kept < 160
    assert f"{n_kept} finished runs are kept in" in said


@pytest.mark.slow
def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A study file in, all files out; a second start does nothing but report."""
    file, out = tmp_path / "tiny.toml", tmp_path / "out"
    file.write_text(STUDY)
    words = ["compare", str(file), "--out", str(out), "--jobs", "2"]
    assert main(words) == ExitCode.GOOD
    shown = capsys.readouterr()
    assert "8 of 8 runs" in shown.err
    assert "8 runs, 0 without a result" in shown.out
    with (out / "table.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    assert list(rows[0]) == list(COLUMNS)
    assert len(rows) == 8
    assert "| smoother-log |" in (out / "summary.md").read_text()
    assert r"\begin{table}" in (out / "summary.tex").read_text()
    assert list((out / "figures").glob("*.png"))
    assert main([*words, "--no-figures", "--format", "parquet", "--seeds", "1"]) == ExitCode.GOOD
    assert "going on: 8 runs are done already" in capsys.readouterr().err
    import pyarrow.parquet

    read = pyarrow.parquet.read_table(out / "table.parquet").to_pylist()
    assert len(read) == 4
    assert read[0]["horizontal_rms_m"] == float(rows[0]["horizontal_rms_m"])
    assert read[0]["outliers_rejected"] is None


@pytest.mark.slow
def test_recorded_missions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Folders by name, without truth about the beams; the reference tells the errors."""
    for seed, name in enumerate(("first", "second")):
        config = scenario_config("survey", seed=seed, duration_s=20.0)
        write_mission(tmp_path / name, simulate(config).mission)
    folders = [str(tmp_path / name) for name in ("first", "second")]
    out = tmp_path / "out"
    words = ["compare", *folders, "--out", str(out), "--methods", "smoother-log,smoother-log:7"]
    assert main([*words, "--jobs", "1"]) == ExitCode.GOOD
    capsys.readouterr()
    with (out / "table.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    assert [(row["case"], row["method"]) for row in rows] == [
        ("first", "smoother-log"),
        ("first", "smoother-log:7"),
        ("second", "smoother-log"),
        ("second", "smoother-log:7"),
    ]
    assert all(row["grade"] == row["kind"] == row["outliers_rejected"] == "" for row in rows)
    assert all(0.0 < float(row["horizontal_rms_m"]) < 5.0 for row in rows)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["none.toml"], ExitCode.USAGE, "cannot be read"),
        (["a.toml", "b.toml"], ExitCode.USAGE, "expected one study file or mission folders"),
        (["nowhere"], ExitCode.USAGE, "nowhere: mission.toml"),
        (["{study}", "--methods", "orakel"], ExitCode.USAGE, "did you mean 'oracle'"),
        (["{study}", "--seeds", "0"], ExitCode.USAGE, "--seeds: expected 1 or more"),
        (["{study}", "--jobs", "0"], ExitCode.USAGE, "--jobs: expected 1 or more"),
    ],
)
def test_bad_words_are_refused(
    words: list[str],
    code: ExitCode,
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Before anything is run or written."""
    (tmp_path / "tiny.toml").write_text(STUDY)
    given = [word.format(study=tmp_path / "tiny.toml") for word in words]
    assert main(["compare", *given, "--out", str(tmp_path / "out")]) == code
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_failed_runs_are_not_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 4, and the table says why."""
    (tmp_path / "tiny.toml").write_text(STUDY)

    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr("ssm_graph.study.methods.SsmSmoother.solve", broken)
    monkeypatch.setattr("ssm_graph.cli.compare_run.execute_from", lambda _: in_this_process)
    out = tmp_path / "out"
    words = ["compare", str(tmp_path / "tiny.toml"), "--out", str(out), "--no-figures"]
    assert main(words) == ExitCode.NOT_GOOD
    assert "8 runs, 8 without a result" in capsys.readouterr().out
    assert "ZeroDivisionError: oh" in (out / "table.csv").read_text()
