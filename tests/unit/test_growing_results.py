"""Results of a run that goes on: nothing that was written is lost, whatever the disk does."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.io.results.place import SUMMARY_NAME
from ssm_graph.io.results.tables import (
    BEAMS_NAME,
    PROTECTION_NAME,
    TRAJECTORY_NAME,
    GrowingResults,
)
from ssm_graph.mission.estimate import ProtectionTrack
from tests.estimate_fixture import make_run

NAMES = (TRAJECTORY_NAME, BEAMS_NAME, PROTECTION_NAME)

LEVELS = ProtectionTrack(
    np.array([1.0, 2.0]), np.array([3.512345, 3.523456]), np.array([0.512345, 0.723456])
)


def add(results: GrowingResults, times: int = 1) -> None:
    """Append the rows of an estimate."""
    estimate, _ = make_run(n=20)
    for _ in range(times):
        results.append(estimate.trajectory, estimate.beams, protection=LEVELS)


def content(folder: Path) -> list[bytes]:
    """Return what all tables hold."""
    return [(folder / name).read_bytes() for name in NAMES]


def undisturbed(folder: Path, times: int) -> list[bytes]:
    """Return what all tables hold after so many appends that nothing disturbs."""
    add(GrowingResults(folder), times)
    return content(folder)


def failing(*_: Any, **__: Any) -> Any:
    """Fail as a disk does."""
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def written_half(write: Callable[[int, bytes], int]) -> Callable[[int, bytes], int]:
    """Return an ``os.write`` that takes half of its first data and fails from then on."""
    calls: list[int] = []

    def half(file: int, data: bytes) -> int:
        calls.append(len(data))
        if len(calls) > 1:
            failing()
        return write(file, data[: len(data) // 2])

    return half


@pytest.mark.parametrize("owner", [Path, os])
def test_a_file_that_cannot_be_looked_at_keeps_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: Any
) -> None:
    """The size of a file is nothing that an append has to ask the disk for."""
    results = GrowingResults(tmp_path / "run")
    add(results)
    with monkeypatch.context() as patch:
        for name in ("stat", "fstat") if owner is os else ("stat",):
            patch.setattr(owner, name, failing)
        add(results)
    add(results)
    assert results.problem is None
    assert content(tmp_path / "run") == undisturbed(tmp_path / "same", 3)


def test_rows_wait_for_a_disk_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was written in part is taken back, the problem is said, the next time writes all."""
    results = GrowingResults(tmp_path / "run")
    add(results)
    before, sizes = content(tmp_path / "run"), results.sizes()
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", written_half(os.write))
        add(results)
        assert results.problem is not None
        assert BEAMS_NAME in results.problem
        assert "Input/output error" in results.problem
    assert content(tmp_path / "run") == before
    assert results.sizes() == sizes == {n: len(b) for n, b in zip(NAMES, before, strict=True)}
    add(results)
    assert results.problem is None
    assert content(tmp_path / "run") == undisturbed(tmp_path / "same", 3)


def test_the_end_writes_what_waited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no later append that would."""
    results = GrowingResults(tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", failing)
        add(results)
    results.finish({})
    results.close()
    assert results.problem is None
    assert content(tmp_path / "run") == undisturbed(tmp_path / "same", 1)
    assert (tmp_path / "run" / SUMMARY_NAME).read_text() == "{}\n"


@pytest.mark.parametrize("n_lost", [0, 1, 20])
def test_a_restart_goes_on_behind_the_last_whole_row(tmp_path: Path, n_lost: int) -> None:
    """Rows after the checkpoint are written once more; one cut by a power failure is left out."""
    results = GrowingResults(tmp_path)
    add(results)
    sizes = results.sizes()
    kept = content(tmp_path)
    add(results)
    results.close()
    for name in NAMES:
        if n_lost:
            os.truncate(tmp_path / name, sizes[name] - n_lost)
    GrowingResults(tmp_path, sizes=sizes).close()
    last = -1 if n_lost else None
    expected = [b"".join(table.splitlines(keepends=True)[:last]) for table in kept]
    assert content(tmp_path) == expected


def test_tables_that_cannot_be_read_are_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A restart that cannot see where it was says so, and cuts nothing."""
    results = GrowingResults(tmp_path)
    add(results)
    sizes, before = results.sizes(), content(tmp_path)
    results.close()
    for name in ("pread", "fstat"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, failing)
            with pytest.raises(DataError, match="cannot write results: Input/output error"):
                GrowingResults(tmp_path, sizes=sizes)
        assert content(tmp_path) == before
    assert min(sizes.values()) > 0
