"""The faults of processes, through the command line: killed, out of disk, damaged checkpoints."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from benchmarks.faults.case import Row, Stage, judge, simulated_stage
from benchmarks.faults.sockets import SOCKET_CASES, run_socket_case
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.tables.checkpoint import CHECKPOINT_NAME, older_name
from ssm_graph.live.run.run_folder import LOG_NAME

STAGE: Final = Stage(duration_s=40.0, gnss=((0.0, 20.0),))
PATIENCE_S: Final = 120.0
RESULTS: Final = ("trajectory.csv", "beams.csv", "log/imu.csv", "log/dvl.csv", "log/depth.csv")


class Outcome(NamedTuple):
    """What a fault did to a run."""

    folder: Path
    notes: list[str]
    """What is wrong beyond the comparison with the uninterrupted run."""
    recovery_s: float
    """How long the last start took until it had caught up and ended, s"""


Fault = Callable[[Path, Path], Outcome]
"""From a mission and a new run folder."""

FULL_AT: Final = 400_000
"""Bytes of a file on a full disk: more than a checkpoint, less than the inertial table comes to."""


def start(
    mission: Path, run: Path, *, largest_file: int | None = None, speed: str = "full"
) -> subprocess.Popen[str]:
    """Start a run; files may not become larger than so many bytes, for now."""

    def limit() -> None:
        if largest_file is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, resource.RLIM_INFINITY))

    options = ["--speed", speed, "--lag", "5", "--checkpoint-every", "3"]
    program = [sys.executable, "-m", "ssm_graph.cli.main", "online"]
    return subprocess.Popen(
        [*program, "--replay", str(mission), "--out", str(run), *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limit,
    )


def ended(process: subprocess.Popen[str]) -> list[str]:
    """Wait for the end of a run; return what was wrong with it."""
    try:
        _, errors = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return [f"did not end within {PATIENCE_S:.0f} s"]
    if process.returncode not in (0, 1) or "Traceback" in errors:
        return [f"exit code {process.returncode}: {errors.strip()[-200:]}"]
    return []


def finish(mission: Path, run: Path, notes: list[str]) -> Outcome:
    """Run to the end."""
    begin_s = time.monotonic()
    notes += ended(start(mission, run))
    return Outcome(run, notes, time.monotonic() - begin_s)


def wait_for(process: subprocess.Popen[str], is_there: Callable[[], bool]) -> bool:
    """Wait until something is the case; return whether it was before the process ended."""
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s and process.poll() is None:
        if is_there():
            return True
        time.sleep(0.01)
    return is_there()


def killed_at(mission: Path, run: Path, n_rows: int) -> list[str]:
    """Run until so many rows are logged, then kill -9."""
    process, arrivals = start(mission, run), run / "log" / "arrivals"
    was_there = wait_for(process, lambda: arrivals.exists() and arrivals.stat().st_size >= n_rows)
    was_running = process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.communicate()
    return [] if was_there and was_running else [f"not killed at {n_rows} rows"]


def kill_thrice(mission: Path, run: Path) -> Outcome:
    """Kill -9 at a quarter, the half and three quarters."""
    notes = [note for n in (1000, 2000, 3000) for note in killed_at(mission, run, n)]
    return finish(mission, run, notes)


def torn_checkpoint(mission: Path, run: Path) -> Outcome:
    """Kill -9 at three quarters, with a checkpoint half written under its own name."""
    notes = killed_at(mission, run, 3000)
    newest = run / CHECKPOINT_NAME
    content = newest.read_bytes()
    newest.write_bytes(content[: len(content) // 2])
    newest.with_name(f"{CHECKPOINT_NAME}.part").write_bytes(content[:1000])
    return _told(finish(mission, run, notes), "resumed_with_loss")


def no_sound_checkpoint(mission: Path, run: Path) -> Outcome:
    """Kill -9 at three quarters, a bit flipped in both checkpoints."""
    notes = killed_at(mission, run, 3000)
    for path in (run / CHECKPOINT_NAME, older_name(run / CHECKPOINT_NAME)):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(bytes(content))
    return _told(finish(mission, run, notes), "resumed_with_loss")


def full_disk_for_a_while(mission: Path, run: Path) -> Outcome:
    """No file may be larger than 400 kB until the run, at ten times its speed, has said so."""
    process = start(mission, run, largest_file=FULL_AT, speed="10")
    has_told = wait_for(process, lambda: "disk" in kinds(run))
    time.sleep(0.3)
    notes = [] if process.poll() is None else ["ended before there was room again"]
    with contextlib.suppress(ProcessLookupError):
        unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, unlimited)
    begin_s = time.monotonic()
    notes += ended(process) + ([] if has_told else ["disk not told"])
    return Outcome(run, notes, time.monotonic() - begin_s)


def full_disk_for_ever(mission: Path, run: Path) -> Outcome:
    """No file may be larger than 400 kB to the end."""
    begin_s = time.monotonic()
    notes = ended(start(mission, run, largest_file=FULL_AT))
    return _told(Outcome(run, notes, time.monotonic() - begin_s), "disk")


def removed_log(mission: Path, run: Path) -> Outcome:
    """Kill -9 at the half; 2000 bytes of the inertial table are gone, as by a power cut."""
    notes = killed_at(mission, run, 2000)
    table = run / "log" / "imu.csv"
    os.truncate(table, table.stat().st_size - 2000)
    return finish(mission, run, notes)


def _told(outcome: Outcome, kind: str) -> Outcome:
    if kind not in kinds(outcome.folder):
        outcome.notes.append(f"{kind} not told")
    return outcome


def kinds(run: Path) -> Counter[str]:
    """Return the kinds of events of a run."""
    path = run / "events.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    found: Counter[str] = Counter()
    for line in lines:
        with contextlib.suppress(ValueError):  # torn by the kill
            found[json.loads(line)["kind"]] += 1
    return found


FAULTS: Final[dict[str, Fault]] = {
    "kill -9, three times": kill_thrice,
    "kill -9, torn checkpoint": torn_checkpoint,
    "kill -9, no sound checkpoint": no_sound_checkpoint,
    "kill -9, torn log": removed_log,
    "disk full for a while": full_disk_for_a_while,
    "disk full for ever": full_disk_for_ever,
}
LOSSY: Final = (removed_log, full_disk_for_ever)
"""After all others results and logs have to be those of the uninterrupted run, byte by byte."""
PROCESS_ROWS: Final = (*FAULTS, *SOCKET_CASES)


def run_process_row(name: str) -> Row:
    """Return the row of a fault."""
    if name in SOCKET_CASES:
        return judge(*run_socket_case(name))
    with tempfile.TemporaryDirectory() as folder:
        mission = Path(folder) / "mission"
        write_mission(mission, simulated_stage(STAGE)[0].mission)
        whole = finish(mission, Path(folder) / "whole", [])
        return _compared(name, FAULTS[name](mission, Path(folder) / "run"), whole)


def _compared(name: str, outcome: Outcome, whole: Outcome) -> Row:
    """Compare a run with the uninterrupted one."""
    fault = FAULTS[name]
    faults = [*whole.notes, *outcome.notes]
    told = kinds(outcome.folder)
    faults += [f"{kind} told" for kind in told if kind.endswith("_failed") and kind != "disk"]
    differing = [x for x in RESULTS if not _same(outcome.folder / x, whole.folder / x)]
    if fault not in LOSSY and differing:
        faults.append(f"other than uninterrupted: {', '.join(differing)}")
    missing = _n_lines(whole.folder / "log") - _n_lines(outcome.folder / "log")
    cells = (
        name,
        (fault.__doc__ or "").rstrip("."),
        ", ".join(f"{kind} {n}" for kind, n in told.items()) or "none",
        f"at the end {_health(outcome.folder)}",
        f"{outcome.recovery_s:.1f} (whole run {whole.recovery_s:.1f})",
        f"{missing} rows of the log",
        f"differ: {', '.join(differing)}" if differing else "the same",
        "–",
    )
    return Row(cells, tuple(faults))


def _health(folder: Path) -> str:
    path = folder / "summary.json"
    if not path.exists():
        return "no summary"
    return str(json.loads(path.read_text(encoding="utf-8"))["status"])


def _same(a: Path, b: Path) -> bool:
    """Return whether files are the same; results to nine digits, a restart integrates anew."""
    if not a.exists():
        return False
    if a.parent.name == LOG_NAME:
        return a.read_bytes() == b.read_bytes()
    x, y = (np.genfromtxt(path, delimiter=",", skip_header=1) for path in (a, b))
    return x.shape == y.shape and np.allclose(x, y, rtol=1e-9, atol=1e-9, equal_nan=True)


def _n_lines(log: Path) -> int:
    return sum(path.read_bytes().count(b"\n") for path in log.glob("*.csv"))
