"""The file of a study: one JSON line for every finished run, so that a study can be resumed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import factors.similarity
import ssm_graph
from benchmarks.study_runs import Run, RunKey
from ssm_graph.errors import ConfigError, DataError

_LEFT_OUT = ("io", "report", "cli.py")
"""Parts of the package that no number of a study depends on."""


def code_version() -> str:
    """Return the package version with a digest of all source that a study's numbers depend on.

    The version alone does not do: between releases the source changes.
    """
    package = Path(ssm_graph.__file__).parent
    sources = [p for p in package.rglob("*.py") if p.relative_to(package).parts[0] not in _LEFT_OUT]
    sources += Path(factors.similarity.__file__).parent.glob("*.py")
    sources += [Path(__file__).parent / name for name in ("study_cases.py", "study_runs.py")]
    digest = hashlib.sha256()
    for path in sorted(sources):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return f"{version('ssm-graph')}+{digest.hexdigest()[:10]}"


class ResultsFile:
    """Finished runs on disk; the first line holds the settings that made them."""

    def __init__(self, path: Path, settings: dict[str, Any], *, fresh: bool = False) -> None:
        """Open or create the file.

        Parameters
        ----------
        path : JSON lines.
        settings : whatever must be the same for all runs of the file.
        fresh : throw an old file away.

        Raises
        ------
        ConfigError
            The file was made with other settings.
        DataError
            A line other than the last cannot be read.
        """
        self.path = path
        self.settings = settings
        self._runs: dict[RunKey, Run] = {}
        if fresh or not path.exists() or not self._load():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(_line({"settings": settings}), encoding="utf-8")

    @property
    def runs(self) -> list[Run]:
        """All finished runs."""
        return list(self._runs.values())

    def __contains__(self, key: RunKey) -> bool:
        return key in self._runs

    def append(self, runs: Iterable[Run]) -> None:
        """Write finished runs; they are on disk when this returns."""
        new = {run.key: run for run in runs if run.key not in self._runs}
        with self.path.open("a", encoding="utf-8") as file:
            file.writelines(_line(run.to_dict()) for run in new.values())
            file.flush()
        self._runs |= new

    def _load(self) -> bool:
        """Read what is there; False if not even the first line is whole."""
        text = self.path.read_text(encoding="utf-8")
        # What follows the last line break was being written when the study was stopped.
        whole, _, torn = text.rpartition("\n")
        if not whole:
            return False
        header, *lines = [self._parse(i, line) for i, line in enumerate(whole.split("\n"), 1)]
        self._check(header.get("settings"))
        for values in lines:
            run = Run.from_dict(values)
            self._runs[run.key] = run
        if torn:
            self.path.write_text(whole + "\n", encoding="utf-8")
        return True

    def _parse(self, number: int, line: str) -> dict[str, Any]:
        try:
            values = json.loads(line)
        except json.JSONDecodeError as error:
            raise DataError(
                f"{self.path}, line {number}: expected a JSON object, got {line[:40]!r}; "
                "only the last line may be damaged, use --fresh to begin anew"
            ) from error
        return dict(values)

    def _check(self, found: dict[str, Any] | None) -> None:
        if found == self.settings:
            return
        found = found or {}
        names = sorted(found.keys() | self.settings.keys())
        differing = [
            f"{name}: expected {self.settings.get(name)!r}, got {found.get(name)!r}"
            for name in names
            if self.settings.get(name) != found.get(name)
        ]
        raise ConfigError(
            f"{self.path}: made with other settings ({'; '.join(differing)}); "
            "use --fresh to throw it away, or another --out"
        )


def _line(values: dict[str, Any]) -> str:
    return json.dumps(values, allow_nan=False) + "\n"
