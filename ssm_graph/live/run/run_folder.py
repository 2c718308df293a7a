"""The folder of a live run: what is kept so that it can be gone on with, and what it results in.

=====================  =============================================================================
``log/``               everything received, a mission folder: ``ssm-graph smooth RUN/log`` reads it
``trajectory.csv``,    smoothed states and their beams, as they leave the window
``beams.csv``
``protection.csv``     protection levels at their times, as they were known then
``events.jsonl``       what happened, a line of JSON each
``checkpoint.npz``     the estimator, and the sizes of the files above at that moment
``clock.csv``          by how much the vehicle's clock was set (`clock_file.ClockFile`)
``places.json``        where each instrument was heard (`place_file.PlaceFile`)
``summary.json``       how it ended; not there while it goes on
``run.json``           settings; a run is gone on with the same ones only
``lock``               held by the process that writes here
=====================  =============================================================================
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, Final

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import parse_json
from ssm_graph.io.mission_folder.toml import TOML_NAME
from ssm_graph.io.mission_folder.vehicle import check_same_vehicle
from ssm_graph.io.raw_log.log import RawLog
from ssm_graph.io.raw_log.rows import ARRIVALS, replay
from ssm_graph.io.results.place import RUN_NAME, SUMMARY_NAME
from ssm_graph.io.results.summary import as_json
from ssm_graph.io.results.tables import (
    BEAMS_NAME,
    PROTECTION_NAME,
    TRAJECTORY_NAME,
    GrowingResults,
)
from ssm_graph.io.tables.append_file import AppendFile, write_through
from ssm_graph.io.tables.checkpoint import (
    CHECKPOINT_NAME,
    newest_checkpoint,
    older_name,
)
from ssm_graph.live.run.disk import CheckpointWriter, Syncer
from ssm_graph.mission.navigation import Event
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.messages import Message

if sys.platform != "win32":
    import fcntl

LOG_NAME: Final = "log"
EVENTS_NAME: Final = "events.jsonl"
LOCK_NAME: Final = "lock"
FORMAT: Final = 1


@dataclass(frozen=True, slots=True, eq=False)
class Resumed:
    """Where an earlier process of the same run had got to."""

    arrays: Mapping[str, Array] = field(default_factory=dict)
    meta: Mapping[str, Any] = field(default_factory=dict)
    """Of the estimator; empty where there is no checkpoint."""
    offsets: Mapping[str, int] = field(default_factory=dict)
    """Of the log."""
    sizes: Mapping[str, int] = field(default_factory=dict)
    """Of the results and events; what is beyond is written once more."""
    n_messages: int = 0
    """That the estimator of the checkpoint had been given."""
    data_s: float = 0.0
    """Time of the last inertial one of them."""
    notes: tuple[str, ...] = ()
    """What a person should know, one sentence each."""


class RunFolder:
    """One live run on the disk.

    Raises :class:`ConfigError` for the run of another vehicle or of other settings, one that
    another process writes, and for a folder that holds something else. Raises :class:`DataError`
    for a folder that cannot be written.

    The folder is made if it does not exist; one that holds a run is gone on with. The settings are
    those of the estimator: plain values with units in the keys.
    """

    def __init__(self, folder: Path, vehicle: Vehicle, settings: Mapping[str, Any]) -> None:
        self.path, self.vehicle, self.settings = folder, vehicle, dict(as_json(settings))
        self._noted = {"format": FORMAT, "vehicle": vehicle.name, "settings": self.settings}
        self._altered: list[str] = []
        self._folder_problem: str | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = _locked(folder)
        except OSError as error:
            raise _unwritable(folder, error) from error
        try:
            self._check()
            self._events = AppendFile(folder / EVENTS_NAME, ending=b" torn\n")
        except BaseException as error:
            self._lock.close()
            if isinstance(error, OSError):
                raise _unwritable(folder, error) from error
            raise
        self.event_problem: str | None = None
        self.results: GrowingResults | None = None
        self.log: RawLog | None = None
        results = [folder / name for name in (TRAJECTORY_NAME, BEAMS_NAME, PROTECTION_NAME)]
        self.writer = CheckpointWriter(folder, folder / LOG_NAME, results)
        self.syncer = Syncer(folder / LOG_NAME)
        self._known: Counter[bytes] = Counter()

    def resume(self) -> Resumed:
        """Return where the run had got to; the begin where nothing was logged yet."""
        if not self._has_log:
            return Resumed()
        try:
            found = newest_checkpoint(self.path)
        except DataError as error:
            return Resumed(notes=(f"{error}; the whole log is gone through",))
        if found is None:
            return Resumed()
        meta: dict[str, Any] = found.meta
        in_log = {f"{LOG_NAME}/{name}": size for name, size in meta["offsets"].items()}
        return Resumed(
            arrays=found.arrays,
            meta=meta["estimator"],
            offsets=meta["offsets"],
            sizes=meta["sizes"],
            n_messages=meta["n_messages"],
            data_s=meta["data_s"],
            notes=(*found.notes, *self._missing({**meta["sizes"], **in_log})),
        )

    def logged(self, resumed: Resumed) -> Iterator[Message]:
        """Return what was logged since, and get ready to write results and events once more."""
        messages: Iterator[Message] = iter(())
        if self._has_log:  # a log that cannot be read is refused before results are cut
            messages = replay(self.path / LOG_NAME, self.vehicle, resumed.offsets)
        has_current = self.vehicle.current is not None
        self.results = GrowingResults(self.path, sizes=resumed.sizes, has_current=has_current)
        with (self.path / EVENTS_NAME).open("rb") as stream:
            stream.seek(resumed.sizes.get(EVENTS_NAME, 0))
            self._known = Counter(stream)
        return messages

    def open_log(self) -> RawLog:
        """Begin the log, or go on with it; from here on all events are new."""
        self._known.clear()
        make = RawLog.reopen if self._has_log else RawLog
        try:
            self.log = make(self.path / LOG_NAME, self.vehicle)
        except OSError as error:
            raise _unwritable(self.path / LOG_NAME, error) from error
        return self.log

    def write_event(self, event: Event) -> None:
        """Append an event, unless an earlier process has written the very same one already."""
        line = _line(event)
        if self._known[line] > 0:
            self._known[line] -= 1
            return
        try:
            self._events.append(line)
            self.event_problem = None
        except OSError as error:
            self.event_problem = f"{EVENTS_NAME} cannot be written: {error.strerror or error}"

    def write_checkpoint(
        self,
        arrays: Mapping[str, Array],
        meta: Mapping[str, Any],
        *,
        n_messages: int,
        data_s: float,
    ) -> None:
        """Begin to write the estimator's state of this very moment, with all sizes."""
        assert self.log is not None
        assert self.results is not None
        sizes = {**self.results.sizes(), EVENTS_NAME: self._events.size}
        whole = {
            "estimator": dict(meta),
            "offsets": self.log.offsets(),
            "sizes": sizes,
            "n_messages": n_messages,
            "data_s": data_s,
        }
        self.writer.write(arrays, whole)

    def problems(self) -> str | None:
        """Return one sentence where something is not on its way to the disk."""
        found = [
            self.log.problems() if self.log is not None else None,
            self.results.problem if self.results is not None else None,
            self.event_problem,
            self._events.problem,
            self._folder_problem,
            self.syncer.problem,
        ]
        return "; ".join(text for text in found if text) or None

    def settle(self) -> list[str]:
        """Wait for the disk; return what is not on it, and what somebody altered there."""
        if self.log is not None:
            self.log.sync()
        problem = self.problems()
        return [*self._altered, *([f"at the end: {problem}"] if problem else [])]

    def close(self) -> None:
        """Wait for the disk, and let others have the folder."""
        self.writer.wait()
        self.syncer.wait()
        if self.log is not None:
            self.log.sync()
            self.log.close()
        if self.results is not None:
            self.results.close()
        with contextlib.suppress(OSError):
            self._events.sync()
        self._events.close()
        self._lock.close()

    @property
    def _has_log(self) -> bool:
        return (self.path / LOG_NAME / TOML_NAME).exists()

    def _check(self) -> None:
        """Refuse what is not this run, before anything is changed; note a new one's settings."""
        path = self.path / RUN_NAME
        if path.exists():
            try:
                found = parse_json(path.read_text(encoding="utf-8"))
            except (OSError, ValueError) as error:
                raise DataError(
                    f"{path}: expected the settings of a run: {error}; bring it back, or give "
                    "another folder; nothing was changed"
                ) from error
            if found != self._noted:
                raise ConfigError(
                    f"{path}: this run was begun with {_difference(found, self._noted)}; go on "
                    "with the same, or give another folder"
                )
            if self._has_log:
                check_same_vehicle(self.path / LOG_NAME, self.vehicle)
            elif traces := self._traces():
                raise ConfigError(
                    f"{self.path / LOG_NAME / TOML_NAME}: not there, but {', '.join(traces)} of "
                    "the run that was begun here; if the log was moved or its partition is not "
                    "mounted, bring it back and start again; else give another folder; nothing was "
                    "changed"
                )
        elif traces := self._traces():
            raise ConfigError(
                f"{str(self.path)!r}: expected a new folder or that of a live run ({RUN_NAME}), "
                f"found {', '.join(traces)} of something else; give another folder, or bring "
                f"{RUN_NAME} back; nothing was changed"
            )
        else:
            self._note_settings()

    def _note_settings(self) -> None:
        part = self.path / f"{RUN_NAME}.part"
        write_through(part, (json.dumps(self._noted, indent=2) + "\n").encode())
        part.replace(self.path / RUN_NAME)

    def _traces(self) -> list[str]:
        """Return the files that a start that was cut short would not have left."""
        whole = (TOML_NAME, SUMMARY_NAME, CHECKPOINT_NAME, str(older_name(Path(CHECKPOINT_NAME))))
        logged = [f"{LOG_NAME}/{path.name}" for path in (self.path / LOG_NAME).glob("*.csv")]
        found = [name for name in (*whole, f"{LOG_NAME}/{TOML_NAME}") if self._exists(name)]
        tables = (TRAJECTORY_NAME, BEAMS_NAME, PROTECTION_NAME, *sorted(logged))
        found += [name for name in tables if _has_rows(self.path / name, beyond=1)]
        beside = (EVENTS_NAME, f"{LOG_NAME}/{ARRIVALS}")
        return found + [name for name in beside if _has_rows(self.path / name, beyond=0)]

    def _exists(self, name: str) -> bool:
        return (self.path / name).exists()

    def regain(self) -> list[str]:
        """Go on where somebody removed, replaced or changed files of the run; return what happened.

        What cannot be gone on with is among :meth:`problems`.
        """
        assert self.log is not None
        assert self.results is not None
        texts = []
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if not self._exists(RUN_NAME):
                self._note_settings()
                texts.append(f"{self.path / RUN_NAME} was removed or moved; written again")
            if not _is_same(self.path / LOCK_NAME, self._lock):
                lock = _locked(self.path)
                self._lock.close()
                self._lock = lock
            self._folder_problem = None
        except (OSError, ConfigError) as error:
            self._folder_problem = str(error)
        events = self._events.regain()
        texts += [*self.log.regain(), *self.results.regain(), *([events] if events else [])]
        self._altered += texts
        return texts

    def _missing(self, sizes: Mapping[str, int]) -> list[str]:
        """Return a sentence for every file that is shorter than the checkpoint knew it."""
        found = {name: (self.path / name) for name in sizes}
        return [
            f"{name}: {sizes[name]} bytes were written and are not all there; did the power fail?"
            for name, path in found.items()
            if not path.exists() or path.stat().st_size < sizes[name]
        ]


def _has_rows(path: Path, *, beyond: int) -> bool:
    """Return whether a file has more than so many lines; what cannot be read has."""
    try:
        with path.open("rb") as stream:
            return len([line for line, _ in zip(stream, range(beyond + 1), strict=False)]) > beyond
    except FileNotFoundError:
        return False
    except OSError:
        return True


def _unwritable(folder: Path, error: OSError) -> DataError:
    return DataError(f"{folder}: cannot be written: {error.strerror or error}")


def _is_same(path: Path, stream: IO[str]) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(stream.fileno()))
    except FileNotFoundError:
        return False


def _locked(folder: Path) -> IO[str]:
    """Return the open lock of a folder, which the system lets go of with the process."""
    lock = (folder / LOCK_NAME).open("a+", encoding="ascii")
    try:
        if sys.platform != "win32":
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.seek(0)
        owner = lock.read(20).strip() or "?"
        lock.close()
        raise ConfigError(
            f"{str(folder)!r}: another process (number {owner}) writes this run; stop it, or give "
            "another folder"
        ) from None
    lock.truncate(0)
    lock.write(f"{os.getpid()}\n")
    lock.flush()
    return lock


def _line(event: Event) -> bytes:
    fields = asdict(event) | {"severity": event.severity.value}
    return (json.dumps(as_json(fields), ensure_ascii=False) + "\n").encode()


def _difference(found: Any, wanted: dict[str, Any]) -> str:
    """Return the first value of a run that is another one now."""
    if isinstance(found, dict):
        before, now = ({**x, **x.get("settings", {})} for x in (found, wanted))
        for key in now:
            if key != "settings" and before.get(key) != now[key]:
                return f"{key} = {before.get(key)!r}, not {now[key]!r}"
    return "other settings"
