"""Checkpoints come back whole, or the one before does; a damaged one is never believed."""

from __future__ import annotations

import errno
import math
import multiprocessing
import os
import resource
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.tables import checkpoint as checkpoint_module
from ssm_graph.io.tables.checkpoint import (
    CHECKPOINT_NAME,
    JSON,
    newest_checkpoint,
    older_name,
    read_checkpoint,
    write_checkpoint,
)

FORK = multiprocessing.get_context("fork")
ARRAYS: dict[str, Array] = {
    "meta": np.array([0.1, -0.0, np.nan, np.inf, 5e-324]),
    "covariance": np.arange(12.0).reshape(3, 4) / 7.0,
    "empty": np.empty((0, 3)),
    "scalar": np.array(1 / 3),
}
META: dict[str, JSON] = {"offsets": {"imu.csv": 2**60}, "names": ["a", "ß"], "t": 0.1, "no": None}


def write(folder: Path, k: int) -> Path:
    """Write the k-th checkpoint of a folder."""
    write_checkpoint(folder / CHECKPOINT_NAME, ARRAYS, {**META, "k": k})
    return folder / CHECKPOINT_NAME


def newest(folder: Path) -> tuple[JSON, tuple[str, ...]]:
    """Return the number of the newest sound checkpoint, and the notes."""
    found = newest_checkpoint(folder)
    assert found is not None
    return found.meta["k"], found.notes


def test_everything_comes_back(tmp_path: Path) -> None:
    """Bit for bit, with the types of the arrays and what JSON can hold."""
    write_checkpoint(tmp_path / "c.npz", ARRAYS, META)
    arrays, meta = read_checkpoint(tmp_path / "c.npz")
    assert meta == META
    assert list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].tobytes() == array.tobytes()
        assert (arrays[name].shape, arrays[name].dtype) == (array.shape, array.dtype)
    assert [path.name for path in tmp_path.iterdir()] == ["c.npz"]


def test_numbers_that_json_does_not_know(tmp_path: Path) -> None:
    """An estimator's times may be infinite."""
    write_checkpoint(tmp_path / "c.npz", {}, {"since": math.inf, "sigma": math.nan, "v": (1, 2)})  # type: ignore[dict-item]
    _, meta = read_checkpoint(tmp_path / "c.npz")
    assert repr(meta) == "{'since': inf, 'sigma': nan, 'v': [1, 2]}"


def test_numpy_reads_it_without_us(tmp_path: Path) -> None:
    """It is an npz file, without pickles."""
    path = write(tmp_path, 1)
    with np.load(path, allow_pickle=False) as members:
        np.testing.assert_array_equal(members["array.covariance"], ARRAYS["covariance"])


def test_what_cannot_be_kept_is_refused(tmp_path: Path) -> None:
    """Before anything is written."""
    with pytest.raises(DataError, match="got objects in 'x'"):
        write_checkpoint(tmp_path / "c.npz", {"x": np.array([None])}, {})
    with pytest.raises(DataError, match="JSON can hold"):
        write_checkpoint(tmp_path / "c.npz", {}, {"x": Path("y")})  # type: ignore[dict-item]
    assert not list(tmp_path.iterdir())


def test_two_are_kept_and_the_newest_is_read(tmp_path: Path) -> None:
    """However many are written."""
    assert newest_checkpoint(tmp_path) is None
    assert newest_checkpoint(tmp_path / "no-folder") is None
    for k in range(4):
        path = write(tmp_path, k)
        assert newest(tmp_path) == (k, ())
    assert {p.name for p in tmp_path.iterdir()} == {"checkpoint.npz", "checkpoint.older.npz"}
    assert read_checkpoint(older_name(path))[1]["k"] == 2


def test_falls_back_to_the_older_one_with_a_note(tmp_path: Path) -> None:
    """Where the newest is damaged or missing; where both are, it says so."""
    write(tmp_path, 1)
    path = write(tmp_path, 2)
    path.write_bytes(path.read_bytes()[:-1])
    k, notes = newest(tmp_path)
    assert k == 1
    assert "cut off" in notes[0]
    assert notes[0].endswith("going on from checkpoint.older.npz")
    path.unlink()
    assert newest(tmp_path) == (
        1,
        ("checkpoint.npz: there is none; going on from checkpoint.older.npz",),
    )
    older_name(path).write_bytes(b"")
    with pytest.raises(DataError, match=r"no sound checkpoint: checkpoint.npz: there is none"):
        newest_checkpoint(tmp_path)
    write(tmp_path, 3)
    assert newest(tmp_path) == (3, ())


def test_a_damaged_one_does_not_push_out_the_older_one(tmp_path: Path) -> None:
    """Else the power could end when only damaged ones are there."""
    write(tmp_path, 1)
    path = write(tmp_path, 2)
    path.write_bytes(path.read_bytes()[:-1])
    write(tmp_path, 3)
    assert newest(tmp_path) == (3, ())
    assert read_checkpoint(older_name(path))[1]["k"] == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected a checkpoint, got another file"),
        (b"PK\x03\x04 some archive", "expected a checkpoint"),
        (b"ssm-graph checkpoint 00000001 sha256 " + b"0" * 64, "of version 3, got version 1"),
        (b"ssm-graph checkpoint 00000003 sha256 " + b"0" * 64, "damaged: its digest"),
    ],
)
def test_foreign_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    """By what they are."""
    (tmp_path / "c.npz").write_bytes(content)
    with pytest.raises(DataError, match=f"c.npz: .*{message}"):
        read_checkpoint(tmp_path / "c.npz")
    with pytest.raises(DataError, match="cannot be read: No such file"):
        read_checkpoint(tmp_path / "other.npz")


@settings(max_examples=40)
@given(place=st.floats(0.0, 1.0, exclude_max=True), bits=st.integers(1, 255), cut=st.booleans())
def test_any_damage_is_found(place: float, bits: int, cut: bool) -> None:
    """A byte that changed anywhere, and a cut at any place."""
    with tempfile.TemporaryDirectory() as name:
        path = write(Path(name), 1)
        content = bytearray(path.read_bytes())
        index = int(place * len(content))
        if cut:
            del content[index:]
        else:
            content[index] ^= bits
        path.write_bytes(content)
        with pytest.raises(DataError, match="checkpoint"):
            read_checkpoint(path)


@pytest.mark.parametrize("fails", ["fsync", "first replace", "second replace", "folder"])
def test_interrupted_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str) -> None:
    """A sound checkpoint is always there, and nothing that is none."""
    write(tmp_path, 1)
    write(tmp_path, 2)
    steps = {"first replace": 0, "second replace": 1}
    calls = []
    replace = Path.replace

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "no")

    def counted(path: Path, target: Path) -> Path:
        calls.append(path)
        if steps.get(fails) == len(calls) - 1:
            fail()
        return replace(path, target)

    with monkeypatch.context() as patch:
        if fails == "fsync":
            patch.setattr(os, "fsync", fail)
        if fails == "folder":
            patch.setattr(checkpoint_module, "sync_path", fail)
        patch.setattr(Path, "replace", counted)
        with pytest.raises(OSError, match="no"):
            write(tmp_path, 3)
    assert newest(tmp_path)[0] == (3 if fails == "folder" else 2)
    assert not list(tmp_path.glob("*.part"))
    write(tmp_path, 4)
    assert newest(tmp_path) == (4, ())


def _write_where_nothing_fits(folder: Path, pipe: Connection) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, resource.RLIM_INFINITY))
    try:
        write(folder, 3)
    except OSError as error:
        pipe.send(error.errno)


def test_a_disk_that_is_really_full(tmp_path: Path) -> None:
    """The error is raised and both old ones are there."""
    write(tmp_path, 1)
    write(tmp_path, 2)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    ours, theirs = FORK.Pipe()
    process = FORK.Process(target=_write_where_nothing_fits, args=(tmp_path, theirs))
    process.start()
    assert ours.poll(20.0)
    assert ours.recv() == errno.EFBIG
    process.join()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
