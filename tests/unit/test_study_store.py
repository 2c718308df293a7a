"""A study's files: nothing is lost, nothing is done twice, nothing is mixed."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.simulation import Grade
from ssm_graph.study.jobs import Job, JobResult, RunKey, failed_job, lost_job
from ssm_graph.study.scoring import Row
from ssm_graph.study.store import StudyStore, gather_series
from tests.study_fixture import SPARSE

SETTINGS = {"code": "1", "study": "tiny"}


def a_job(*seeds: int) -> Job:
    """Return a job of two methods."""
    return Job("tiny", SPARSE, Grade.NAVIGATION, seeds, ("oracle", "smoother-log"))


def a_result(*seeds: int, offset: float = 0.0) -> JobResult:
    """Return finished runs whose error is the seed."""
    failed = failed_job(a_job(*seeds), "")
    rows: dict[RunKey, Row] = {
        key: {**row, "status": "CONVERGED", "failed": 0, "horizontal_rms_m": key.seed + offset}
        for key, row in failed.rows.items()
    }
    samples = np.arange(6.0).reshape(1, 2, 3) + np.array(seeds)[:, None, None]
    return JobResult(failed.job, rows, {"oracle": samples, "smoother-log": -samples}, "1")


def key(seed: int, method: str = "oracle") -> RunKey:
    """Return the key of a run."""
    return RunKey(SPARSE.id, "navigation", seed, method)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of a study with two jobs of one seed each."""
    store = StudyStore(tmp_path / "out", SETTINGS)
    store.append(a_result(0))
    store.append(a_result(1))
    return store.folder


def test_what_is_written_is_read(folder: Path) -> None:
    """NaN survives as null, since JSON has none; memory and file tell the same."""
    store = StudyStore(folder, SETTINGS)
    assert len(store) == 4
    row = store[key(1)]
    assert row["horizontal_rms_m"] == 1.0
    assert isinstance(row["wall_s"], float)
    assert math.isnan(row["wall_s"])
    assert "NaN" not in store.path.read_text()
    store.append(a_result(2, offset=math.inf))
    assert repr(store[key(2)]) == repr(StudyStore(folder, SETTINGS)[key(2)])


@pytest.mark.parametrize("cut", [1, 7, 40])
def test_torn_last_line_is_dropped(folder: Path, cut: int) -> None:
    """A study stopped while writing loses that run only, and goes on on a line of its own."""
    path = folder / "runs.jsonl"
    path.write_text(path.read_text()[:-cut])
    store = StudyStore(folder, SETTINGS)
    assert key(1) in store
    assert key(1, "smoother-log") not in store
    store.append(a_result(2))
    assert len(StudyStore(folder, SETTINGS)) == 5


def test_torn_first_line_begins_anew(folder: Path) -> None:
    """Not even the settings are there: nothing can be lost."""
    path = folder / "runs.jsonl"
    path.write_text('{"settings": {"co')
    assert len(StudyStore(folder, SETTINGS)) == 0
    assert json.loads(path.read_text()) == {"settings": SETTINGS}
    assert list((folder / "series").iterdir()) == []


@pytest.mark.parametrize("changed", [{"code": "2"}, {"study": "x"}, {"new": 1}])
def test_other_settings_are_refused(folder: Path, changed: dict[str, Any]) -> None:
    """Unless asked for, runs of different settings do not meet in one file."""
    with pytest.raises(ConfigError, match=f"made with other settings .*{next(iter(changed))}"):
        StudyStore(folder, SETTINGS | changed)
    assert len(StudyStore(folder, SETTINGS)) == 4
    assert len(StudyStore(folder, SETTINGS | changed, fresh=True)) == 0
    assert list((folder / "series").iterdir()) == []


def test_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    """Before anything is run."""
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="--out: expected a folder that can be written"):
        StudyStore(tmp_path / "file" / "out", SETTINGS)


def test_lost_runs_are_tried_again(folder: Path) -> None:
    """A failure is a result; a process that died is none."""
    store = StudyStore(folder, SETTINGS)
    store.append(lost_job(a_job(2), "its process ended"))
    store.append(failed_job(a_job(3), "cannot"))
    assert store[key(2)]["status"] == "LOST"
    again = StudyStore(folder, SETTINGS)
    assert key(2) not in again
    assert again[key(3)]["error"] == "cannot"
    again.append(a_result(2))
    assert StudyStore(folder, SETTINGS)[key(2)]["status"] == "CONVERGED"


def test_series_are_gathered(folder: Path) -> None:
    """By case, grade and method, as three arrays (runs, times)."""
    store = StudyStore(folder, SETTINGS)
    rows = {key(seed): store[key(seed)] for seed in (0, 1)}
    series = gather_series(store.samples(), rows)
    assert list(series) == [("sparse10", "navigation", "oracle")]
    time_s, horizontal, velocity, nees = series["sparse10", "navigation", "oracle"]
    np.testing.assert_array_equal(time_s, [0.0, 10.0])
    np.testing.assert_array_equal(horizontal, [[0.0, 3.0], [1.0, 4.0]])
    np.testing.assert_array_equal(velocity, [[1.0, 4.0], [2.0, 5.0]])
    np.testing.assert_array_equal(nees, [[2.0, 5.0], [3.0, 6.0]])


def test_series_of_unknown_runs_are_left_out(folder: Path) -> None:
    """Interrupted between the two files, the run is done again, and its series replaced."""
    path = folder / "runs.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-2]))
    store = StudyStore(folder, SETTINGS)
    assert {k.seed for k in store.samples()} == {0}
    store.append(a_result(1))
    assert len(store.samples()) == 4
    assert len(list((folder / "series").iterdir())) == 2
