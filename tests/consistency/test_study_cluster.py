"""A study on a real Dask cluster, one worker of which is killed on the way."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

from ssm_graph.base.errors import ConfigError, MissingExtraError
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.study.jobs import DaskCluster
from ssm_graph.study.scoring import TIMING_COLUMNS

STUDY = """\
name = "cluster"
duration_s = 25.0
[[methods]]
names = ["oracle", "smoother-log", "smoother-gaussian"]
seeds = 8
[[cases]]
kinds = ["none", "sparse"]
"""
DASK = ("-m", "dask")
needs_dask = pytest.mark.skipif(find_spec("distributed") is None, reason="the extra dask")


def wait_for(condition: Callable[[], bool], *, seconds: float = 60.0) -> None:
    """Wait until something is so."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


@contextmanager
def started(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run Python, ended with everything that it started."""
    command = [sys.executable, *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def table_of(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a table without their times."""
    with (folder / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{name: row[name] for name in row if name not in TIMING_COLUMNS} for row in rows]


def n_done(folder: Path) -> int:
    """Return how many runs are on disk."""
    path = folder / "runs.jsonl"
    return len(path.read_text().splitlines()) - 1 if path.exists() else 0


@pytest.mark.slow
@needs_dask
def test_killed_worker_changes_nothing(tmp_path: Path) -> None:
    """The study ends well, and its table is that of a single machine but for the times."""
    study, cluster = tmp_path / "study.toml", tmp_path / "scheduler.json"
    study.write_text(STUDY)
    words = ["compare", str(study), "--no-figures", "--out"]
    there, here = tmp_path / "there", tmp_path / "here"
    scheduler = ["scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1"]
    with started(*DASK, *scheduler, "--scheduler-file", str(cluster)):
        wait_for(cluster.exists)
        address = json.loads(cluster.read_text())["address"]
        # Without a nanny, so that nobody starts the killed worker anew.
        worker = ["worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        worker += ["--local-directory", str(tmp_path)]
        with started(*DASK, *worker) as first, started(*DASK, *worker):
            words_there = [*words, str(there), "--scheduler", address]
            code = (
                f"import sys; from ssm_graph.cli.main import main; sys.exit(main({words_there!r}))"
            )
            with started("-c", code) as client:
                wait_for(lambda: n_done(there) > 0, seconds=120.0)
                first.kill()
                n_at_kill = n_done(there)
                assert client.wait(timeout=300.0) == ExitCode.GOOD
    assert n_at_kill < 48
    assert main([*words, str(here), "--jobs", "1"]) == ExitCode.GOOD
    assert len(table_of(here)) == 48
    assert table_of(there) == table_of(here)


@needs_dask
def test_address_of_nobody_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message says what an address looks like."""
    monkeypatch.setattr("ssm_graph.study.jobs.CONNECT_S", 0.2)
    with pytest.raises(ConfigError, match="--scheduler: expected the address of a Dask scheduler"):
        list(DaskCluster("tcp://127.0.0.1:1")([]))


def test_missing_extra_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the words that install it."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"try  pip install 'ssm-graph\[dask\]'"):
        DaskCluster("tcp://127.0.0.1:8786")
