"""Damaged files of a study: no traceback, the bad run is named and done again, the rest is kept."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.io.tables import append_file
from ssm_graph.study.store import StudyStore
from tests.unit.test_study_store import SETTINGS, a_result, key

Damage = Callable[[Path], object]
N_RUNS = 6


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of a study with three jobs of one seed and two methods each."""
    store = StudyStore(tmp_path / "out", SETTINGS)
    for seed in range(3):
        store.append(a_result(seed))
    return store.folder


def line(change: Callable[[dict[str, Any]], object]) -> Damage:
    """Change what the third line of the file, seed 0 of the second method, says."""

    def damage(folder: Path) -> None:
        path = folder / "runs.jsonl"
        lines = path.read_text().splitlines()
        values = json.loads(lines[2])
        change(values)
        lines[2] = json.dumps(values)
        path.write_text("\n".join(lines) + "\n")

    return damage


def text(change: Callable[[bytes], bytes]) -> Damage:
    """Change the bytes of the third line."""

    def damage(folder: Path) -> None:
        path = folder / "runs.jsonl"
        lines = path.read_bytes().splitlines()
        lines[2] = change(lines[2])
        path.write_bytes(b"\n".join(lines) + b"\n")

    return damage


ROWS: dict[str, Damage] = {
    "bad JSON": text(lambda _: b"{broken"),
    "cut off amid the file": text(lambda old: old[: len(old) // 2]),
    "an empty line": text(lambda _: b""),
    "zeros, as after a power failure": text(lambda old: bytes(len(old))),
    "bytes that are no text": text(lambda old: b"\xff\xfe" + old),
    "a list": text(lambda _: b"[1, 2]"),
    "a number": text(lambda _: b"7"),
    "null": text(lambda _: b"null"),
    "NaN": text(lambda old: old.replace(b"null", b"NaN", 1)),
    "Infinity": text(lambda old: old.replace(b"null", b"-Infinity", 1)),
    "deep nesting": text(lambda _: b"[" * 100_000),
    "two rows in one line": text(lambda old: old + old),
    "5000 digits": text(lambda old: old.replace(b'"seed": 0', b'"seed": ' + b"9" * 5000)),
    "no key": line(lambda row: row.pop("key")),
    "a key of two parts": line(lambda row: row.update(key=["a", "b"])),
    "a key that is a text": line(lambda row: row.update(key="abcd")),
    "a key with a list in it": line(lambda row: row.update(key=[["x"], "navigation", 0, "m"])),
    "the key of another run": line(lambda row: row["key"].__setitem__(2, 17)),
    "no status": line(lambda row: row.pop("status")),
    "a status that is a number": line(lambda row: row.update(status=3)),
    "no error number": line(lambda row: row.pop("horizontal_rms_m")),
    "a text for a number": line(lambda row: row.update(horizontal_rms_m="1.0")),
    "a truth value for a number": line(lambda row: row.update(horizontal_rms_m=True)),
    "a seed with a fraction": line(lambda row: row.update(seed=0.5)),
    "a method that is null": line(lambda row: row.update(method=None)),
    "an overflow": text(
        lambda old: old.replace(b'"horizontal_rms_m": 0.0', b'"horizontal_rms_m": 1e999')
    ),
}


def series(change: Callable[[Path], object]) -> Damage:
    """Do something to the file of one job."""
    return lambda folder: change(min((folder / "series").glob("*.npz")))


def rewritten(**arrays: Any) -> Callable[[Path], object]:
    """Return what changes members of a series file; None leaves one out."""

    def change(path: Path) -> None:
        with np.load(path) as file:
            members = dict(file)
        members |= arrays
        kept = {name: value for name, value in members.items() if value is not None}
        with path.open("wb") as stream:
            np.savez(stream, **kept)

    return change


def header(**changes: Any) -> Callable[[Path], object]:
    """Return what changes the header of a series file."""

    def change(path: Path) -> None:
        with np.load(path) as file:
            found = json.loads(str(file["header"])) | changes
        rewritten(header=np.array(json.dumps(found)))(path)

    return change


def folder_instead(path: Path) -> None:
    """Put a folder in its place."""
    path.unlink()
    path.mkdir()


def enormous(path: Path) -> None:
    """Claim an array that no memory holds."""
    with path.open("wb") as stream, zipfile.ZipFile(stream, "w") as archive:
        for name in ("header.npy", "m0.npy"):
            head = io.BytesIO()
            shape = (10**9, 10**9)
            np.lib.format.write_array_header_1_0(
                head, {"descr": "<f8", "fortran_order": False, "shape": shape}
            )
            archive.writestr(name, head.getvalue())


SERIES: dict[str, Damage] = {
    "gone": series(lambda path: path.unlink()),
    "empty": series(lambda path: path.write_bytes(b"")),
    "cut off": series(lambda path: path.write_bytes(path.read_bytes()[:-40])),
    "zeros": series(lambda path: path.write_bytes(bytes(path.stat().st_size))),
    "no archive": series(lambda path: path.write_bytes(b"something else")),
    "a pickle": series(lambda path: np.array([{}], dtype=object).dump(path)),
    "a folder": series(folder_instead),
    "no header": series(rewritten(header=None)),
    "a header of numbers": series(rewritten(header=np.zeros(3))),
    "a member missing": series(rewritten(m1=None)),
    "texts": series(rewritten(m0=np.array(["a", "b"]))),
    "another shape": series(rewritten(m0=np.zeros((1, 2)))),
    "another length": series(rewritten(m0=np.zeros((1, 9, 3)))),
    "more seeds than arrays": series(header(seeds=[0, 1, 2])),
    "seeds that are texts": series(header(seeds=["x"])),
    "methods that are a number": series(header(methods=3)),
    "an array of 8e18 bytes": series(enormous),
}


@pytest.mark.parametrize("damage", ROWS.values(), ids=ROWS)
def test_a_damaged_row_is_named_and_done_again(folder: Path, damage: Damage) -> None:
    """All others are kept, and the file as it was found too."""
    before = (folder / "runs.jsonl").read_bytes()
    damage(folder)
    found = (folder / "runs.jsonl").read_bytes()
    assert found != before
    store = StudyStore(folder, SETTINGS)
    assert len(store) == N_RUNS - 1
    assert key(0, "smoother-log") not in store
    (note,) = store.notes
    assert "runs.jsonl, line 3: " in note
    assert len(note) < 500
    assert (folder / "runs.damaged.jsonl").read_bytes() == found
    store.append(a_result(0))
    again = StudyStore(folder, SETTINGS)
    assert (len(again), again.notes) == (N_RUNS, ())
    assert len(again.samples()) == N_RUNS


@pytest.mark.parametrize("damage", SERIES.values(), ids=SERIES)
def test_damaged_errors_over_time_have_their_runs_done_again(folder: Path, damage: Damage) -> None:
    """The file is kept under another name; the runs of others are not concerned."""
    damage(folder)
    store = StudyStore(folder, SETTINGS)
    assert len(store) == N_RUNS - 2
    assert len(store.notes) == 1
    assert len(store.samples()) == N_RUNS - 2
    for seed in range(3):
        if key(seed) not in store:
            store.append(a_result(seed))
    again = StudyStore(folder, SETTINGS)
    assert (len(again), again.notes) == (N_RUNS, ())
    assert len(again.samples()) == N_RUNS


HEADS = {
    "binary": bytes(range(256)) * 10 + b"\n",
    "binary without an end": b"\x89PNG" + bytes(100),
    "no settings": b"{}\n",
    "a list": b"[]\n",
    "settings that are a number": b'{"settings": 3}\n',
    "bad JSON": b'{"settings": {"code": \n',
}


@pytest.mark.parametrize("content", HEADS.values(), ids=HEADS)
def test_without_the_settings_nothing_is_thrown_away(folder: Path, content: bytes) -> None:
    """Nobody knows what the runs are of; whoever wants to begin anew has to say so."""
    path = folder / "runs.jsonl"
    content += b"\n".join(path.read_bytes().splitlines()[1:]) if b"\n" in content else b""
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="line 1: expected the settings of a study"):
        StudyStore(folder, SETTINGS)
    assert path.read_bytes() == content
    assert len(list((folder / "series").iterdir())) == 3
    assert len(StudyStore(folder, SETTINGS, fresh=True)) == 0


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_file_is_refused_at_once(folder: Path, make: Callable[[Path], object]) -> None:
    """A pipe would be waited for."""
    (folder / "runs.jsonl").unlink()
    make(folder / "runs.jsonl")
    with pytest.raises(ConfigError, match="expected a file"):
        StudyStore(folder, SETTINGS)


def test_errors_over_time_are_on_the_disk_before_their_row(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a power failure there is no row without its series."""
    store = StudyStore(folder, SETTINGS)
    order: list[str] = []
    write, sync = append_file.write_through, os.fsync

    def written(path: Path, content: bytes) -> None:
        order.append(path.suffix)
        write(path, content)

    def synced(descriptor: int) -> None:
        order.append("fsync")
        sync(descriptor)

    monkeypatch.setattr("ssm_graph.study.store.write_through", written)
    monkeypatch.setattr(os, "fsync", synced)
    store.append(a_result(7))
    assert order == [".part", "fsync", "fsync", "fsync"]
