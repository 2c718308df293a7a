"""Trials of any kind are kept one by one, and a study goes on where it was."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.study.ledger import ERROR, Key, Ledger, Row, run_trials

KEYS: list[Key] = [("square", seed) for seed in range(4)]


def square(key: Key) -> Row:
    """Return a row that depends on the key alone; the third trial cannot be done."""
    seed = int(key[1])
    if seed == 2:
        raise DataError("no landmark in view")
    return {"value": float(seed**2), "unknown": math.nan, "word": "ok"}


def never(key: Key) -> Row:
    """Fail if anybody asks: everything is done."""
    raise AssertionError(key)


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    """The second call reads all rows, failed ones and NaN among them."""
    path = tmp_path / "study" / "trials.jsonl"
    seen: list[tuple[int, int]] = []
    first = run_trials(
        square, KEYS, Ledger(path, {"n": 4}), on_progress=lambda n, of, _: seen.append((n, of))
    )
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert first["square", 2] == {ERROR: "no landmark in view"}
    again = run_trials(never, KEYS, Ledger(path, {"n": 4}))
    assert again["square", 3]["value"] == 9.0
    assert math.isnan(again["square", 1]["unknown"])


def test_processes_make_the_same_rows(tmp_path: Path) -> None:
    """How many do the work does not matter."""
    one = run_trials(square, KEYS, Ledger(tmp_path / "a.jsonl", {}))
    two = run_trials(square, KEYS, Ledger(tmp_path / "b.jsonl", {}), n_jobs=2)
    assert repr(one) == repr(two)
    with pytest.raises(ConfigError, match="--jobs"):
        run_trials(square, KEYS, Ledger(tmp_path / "c.jsonl", {}), n_jobs=0)


def test_damage_is_named_and_done_again(tmp_path: Path) -> None:
    """A bad line and a torn one cost their own trials; the file as it was is kept."""
    path = tmp_path / "trials.jsonl"
    run_trials(square, KEYS, Ledger(path, {}))
    lines = path.read_bytes().split(b"\n")
    lines[2] = lines[2].replace(b"{", b"<")
    path.write_bytes(b"\n".join(lines[:-2]) + b"\n" + lines[-2][:9])
    ledger = Ledger(path, {})
    assert [note.partition(", ")[2] for note in ledger.notes] == [
        "line 3: damaged; that trial is done again"
    ]
    assert path.with_suffix(".damaged").exists()
    assert [key in ledger for key in KEYS] == [True, False, True, False]
    run_trials(square, KEYS, ledger)
    assert len(Ledger(path, {})) == 4


@pytest.mark.parametrize(
    "line",
    [
        b'{"key": [["x"], 1], "row": {}}',
        b'{"key": {"x": 1}, "row": {}}',
        b'{"key": "xy", "row": {}}',
        b'{"key": [null], "row": {}}',
        b'{"key": ["x"], "row": [1]}',
        b'{"key": ["x"], "row": {"v": NaN}}',
        b'{"key": ["x"], "row": ' + b"[" * 100_000,
        b"\0" * 100,
        b"\xff",
        b"",
    ],
)
def test_no_row_is_a_trial(tmp_path: Path, line: bytes) -> None:
    """It is named and done again; the others stay."""
    path = tmp_path / "trials.jsonl"
    run_trials(square, KEYS, Ledger(path, {}))
    lines = path.read_bytes().split(b"\n")
    lines[2] = line
    path.write_bytes(b"\n".join(lines))
    ledger = Ledger(path, {})
    assert [note.partition(", ")[2][:6] for note in ledger.notes] == ["line 3"]
    assert len(ledger) == len(KEYS) - 1


def test_other_settings_are_refused(tmp_path: Path) -> None:
    """Rows of other settings are not mixed in; a fresh start throws them away."""
    path = tmp_path / "trials.jsonl"
    run_trials(square, KEYS, Ledger(path, {"window": 30}))
    with pytest.raises(ConfigError, match="window: expected 200, got 30"):
        Ledger(path, {"window": 200})
    assert len(Ledger(path, {"window": 200}, fresh=True)) == 0
    for head in (b"\x00\x01", b'{"settings": 3}\n'):
        path.write_bytes(head)
        with pytest.raises(ConfigError, match="line 1"):
            Ledger(path, {})
    with pytest.raises(ConfigError, match="file that can be written"):
        Ledger(tmp_path, {})
