"""Write ``docs/attacks.md``: ``python -m tests.make_attacks_table`` from the root."""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

from ssm_graph.base.errors import SsmGraphError
from ssm_graph.live.run.disk import CheckpointWriter
from ssm_graph.study.store import StudyStore
from tests.live_fixture import Crash, ListSource, some_messages
from tests.unit.test_doors import DOORS, at_door
from tests.unit.test_run_files import Meddled, altered, content, run
from tests.unit.test_study_damage import HEADS, N_RUNS, ROWS, SERIES
from tests.unit.test_study_store import SETTINGS, a_result

DOC = Path(__file__).parents[1] / "docs" / "attacks.md"
INTRO = """\
# Attacks on files

What somebody or something does with files at the doors of the command line, and to files of a live
run or of a study, what is said about it, and what it costs. Beside it:
[malformed missions](malformed-input.md),
[faults of instruments, sockets and processes](../benchmarks/results/faults.md),
[damaged bytes](../benchmarks/results/fuzz.md).

This page is made by `python -m tests.make_attacks_table`; the same attacks are in
`tests/unit/test_doors.py`, `test_run_files.py`, `test_study_damage.py`, `test_cli_terminal.py` and
`test_output_place.py`.
"""
Act = Callable[[Path], object]
N_ROWS = 101
"""Lines of the trajectory of a whole run."""


def gone(*names: str) -> Act:
    """Return what removes files and folders of a run."""

    def act(path: Path) -> None:
        for name in names:
            one = path / name
            shutil.rmtree(one) if one.is_dir() else one.unlink(missing_ok=True)

    return act


def replaced(name: str, make: Callable[[Path], object]) -> Act:
    """Return what makes something else where a file or folder was."""

    def act(path: Path) -> None:
        gone(name)(path)
        make(path / name)

    return act


def cut(name: str, share: float = 0.3) -> Act:
    """Return what cuts a file off."""
    return lambda path: os.truncate(path / name, int((path / name).stat().st_size * share))


def written(name: str, data: bytes) -> Act:
    """Return what puts something else in the place of a file."""
    return lambda path: (path / name).write_bytes(data)


def moved(name: str) -> Act:
    """Return what moves a file, a folder or the whole run."""
    return lambda path: (path / name).rename(path.with_name("aside"))


CHECKPOINTS = ("checkpoint.npz", "checkpoint.older.npz")
AT_REST: dict[str, Act] = {
    "`log/` not mounted": gone("log"),
    "`log/` an empty mount point": replaced("log", os.mkdir),
    "`log/mission.toml` gone": gone("log/mission.toml"),
    "`log/mission.toml` empty": written("log/mission.toml", b""),
    "`log/mission.toml` of zeros": written("log/mission.toml", bytes(500)),
    "`log/imu.csv` gone": gone("log/imu.csv"),
    "`log/imu.csv` cut off": cut("log/imu.csv"),
    "`log/imu.csv` with other columns": written("log/imu.csv", b"time_s,x\n1.0,2.0\n"),
    "`log/arrivals` gone": gone("log/arrivals"),
    "`log/arrivals` of zeros": written("log/arrivals", bytes(300)),
    "`log/waiting` of noise": written("log/waiting", bytes(range(256)) * 9),
    "`log/waiting` a folder": replaced("log/waiting", os.mkdir),
    "`run.json` gone": gone("run.json"),
    "`run.json` cut off": cut("run.json"),
    "`run.json` of another run": written("run.json", b'{"format": 1}'),
    "newest checkpoint gone": gone(CHECKPOINTS[0]),
    "newest checkpoint cut off": cut(CHECKPOINTS[0]),
    "both checkpoints gone": gone(*CHECKPOINTS),
    "both checkpoints of zeros": lambda p: [written(n, bytes(900))(p) for n in CHECKPOINTS],
    "both checkpoints gone, the log cut off": lambda p: [
        act(p) for act in (gone(*CHECKPOINTS), cut("log/imu.csv"), cut("log/arrivals"))
    ],
    "`trajectory.csv` gone": gone("trajectory.csv"),
    "`trajectory.csv` cut off": cut("trajectory.csv"),
    "`events.jsonl` gone": gone("events.jsonl"),
    "all but the trajectory gone": lambda p: [
        gone(one.name)(p) for one in p.iterdir() if one.name != "trajectory.csv"
    ],
}
UNDER_WAY: dict[str, Act] = {
    **{
        f"`{name}` moved": moved(name)
        for name in ("log", "log/imu.csv", "log/dvl.csv", "log/arrivals", "log/mission.toml")
    },
    **{f"`{name}` moved": moved(name) for name in ("trajectory.csv", "beams.csv", "events.jsonl")},
    **{f"`{name}` removed": gone(name) for name in ("run.json", "lock", "log/imu.csv", "log")},
    "the whole run moved": moved("."),
    "`trajectory.csv` emptied": written("trajectory.csv", b""),
    "`log/imu.csv` emptied": written("log/imu.csv", b""),
    "`beams.csv` replaced by a folder": replaced("beams.csv", os.mkdir),
    "`log/dvl.csv` replaced by a pipe": replaced("log/dvl.csv", os.mkfifo),
    "`log/dvl.csv` replaced by another table": written("log/dvl.csv", b"x\n"),
}


def at_rest(act: Act, folder: Path) -> tuple[str, str]:
    """Do it to a run whose process died; return what is said at the restart, and what is lost."""
    path = folder / "run"
    try:
        run(path, ListSource(some_messages(), crash_after=400))
    except Crash:
        act(path)
    before = content(path)
    try:
        run(path, ListSource(some_messages()))
    except SsmGraphError as error:
        same = content(path) == before
        return f"refused: {error}", "nothing, untouched" if same else "**changed**"
    told = (path / "events.jsonl").read_text()
    said = re.findall(r'"kind": "resumed_with_loss", "text": "(.*?)"[,}]', told)
    n_lines = (path / "trajectory.csv").read_bytes().count(b"\n")
    older = path / "trajectory.older.csv"
    if n_lines >= N_ROWS and not older.exists():
        return "; ".join(said) or "gone on with", "nothing"
    if older.exists():
        return "; ".join(said) or "gone on with", "nothing: see `trajectory.older.csv`"
    return "; ".join(
        said
    ) or "gone on with", f"{N_ROWS - n_lines} rows of results, in the log still"


def under_way(act: Act, folder: Path) -> tuple[str, str]:
    """Do it to a run that goes on; return what is said, and what its log lacks at the end."""
    path = folder / "run"
    run(path, Meddled(some_messages(), 200, lambda: act(path)))
    told = (path / "events.jsonl").read_text()
    said = altered(path) or re.findall(r'"kind": "disk", "text": "(.*?)"[,}]', told)
    if not said:
        said = ["the file was taken over again"]
    has_moved = path.with_name("aside").exists()
    is_data = any(name in said[0] for name in (".csv", "arrivals", "more)"))
    lost = "nothing: it is whole where it went" if has_moved else "what was removed until then"
    text = said[0] + (f" (and {len(said) - 1} more)" if len(said) > 1 else "")
    return text, lost if is_data else "nothing"


def in_store(damage: Act, folder: Path) -> tuple[str, str]:
    """Do it to a study; return what is said when it is gone on with, and what is done again."""
    store = StudyStore(folder / "study", SETTINGS)
    for seed in range(3):
        store.append(a_result(seed))
    damage(store.folder)
    try:
        again = StudyStore(store.folder, SETTINGS)
    except SsmGraphError as error:
        return f"refused: {error}", "nothing, untouched"
    return again.notes[0], f"{N_RUNS - len(again)} of {N_RUNS} runs are done again"


def rows() -> Iterator[tuple[str, str, Callable[[Path], tuple[str, str]]]]:
    """Yield heading, attack, and what does it in a folder."""
    for title, (_, door) in DOORS.items():
        yield "At the doors", title, lambda f, a=door: at_door(a, f)  # type: ignore[misc]
    for title, act in AT_REST.items():
        yield "A live run at its restart", title, lambda f, a=act: at_rest(a, f)  # type: ignore[misc]
    for title, act in UNDER_WAY.items():
        yield "A live run under way", title, lambda f, a=act: under_way(a, f)  # type: ignore[misc]
    for title, act in ROWS.items():
        yield "A run in `runs.jsonl`", title, lambda f, a=act: in_store(a, f)  # type: ignore[misc]
    for title, act in SERIES.items():
        yield "Errors over time of a job", title, lambda f, a=act: in_store(a, f)  # type: ignore[misc]
    for title, data in HEADS.items():
        act = written("runs.jsonl", data)
        yield "The first line of `runs.jsonl`", title, lambda f, a=act: in_store(a, f)  # type: ignore[misc]


def make_page() -> str:
    """Return the whole page."""
    page, last = INTRO, ""
    write = CheckpointWriter.write

    def write_and_wait(writer: CheckpointWriter, *state: Any) -> None:
        write(writer, *state)
        writer.wait()

    prompt = patch.object(CheckpointWriter, "write", write_and_wait)  # whatever the disk does
    for heading, title, attack in rows():
        with tempfile.TemporaryDirectory() as name, prompt:
            said, lost = attack(Path(name))
            said = said.replace(f"{name}/", "").replace("|", "\\|").replace("`", "'")
        if heading != last:
            page += f"\n## {heading}\n\n| attack | what is said | lost |\n|---|---|---|\n"
        page, last = page + f"| {title} | `{said[:260]}` | {lost} |\n", heading
    return page


if __name__ == "__main__":
    DOC.write_text(make_page(), encoding="utf-8")
    sys.stdout.write(f"wrote {DOC}\n")
