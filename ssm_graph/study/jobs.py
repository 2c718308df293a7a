"""What a process is handed: some trials of one cell, and the methods to try on them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

import factors.similarity
from ssm_graph.base.frozen import Array
from ssm_graph.simulation import Grade
from ssm_graph.study.cells import Recording, Source
from ssm_graph.study.methods import parse_method, shown
from ssm_graph.study.scoring import LOST, Row, failed_row, score
from ssm_graph.study.trials import Trial, recorded_trial, simulated_trials


class RunKey(NamedTuple):
    """What tells one run from another."""

    source: str
    """``id`` of the cell or recording."""
    grade: str
    seed: int
    method: str


@dataclass(frozen=True, slots=True)
class Job:
    """Some trials and the methods that have not been run on them yet."""

    study: str
    source: Source
    grade: Grade | None
    """None for a recorded mission."""
    seeds: tuple[int, ...]
    methods: tuple[str, ...]

    @property
    def n_runs(self) -> int:
        """Number of missions times methods."""
        return len(self.seeds) * len(self.methods)

    @property
    def grade_name(self) -> str:
        """Name of the grade as in the table; empty for a recorded mission."""
        return "" if self.grade is None else self.grade.name.lower()

    @property
    def missions(self) -> frozenset[tuple[object, ...]]:
        """What has to be simulated or read: jobs that share it are best done by one process."""
        if isinstance(self.source, Recording):
            return frozenset({(self.source.id,)})
        common = (self.source.scenario, self.source.duration_s, self.grade_name)
        return frozenset((*common, seed) for seed in self.seeds)

    def run_keys(self) -> Iterator[RunKey]:
        """Yield the keys of all runs."""
        for method in self.methods:
            for seed in self.seeds:
                yield RunKey(self.source.id, self.grade_name, seed, method)

    def labels(self, seed: int, method: str) -> Row:
        """Return what a row says of a run before it is done."""
        own = {"study": self.study, "grade": self.grade_name, "method": method}
        return {**self.source.labels(), **own, "seed": seed}

    def halves(self) -> tuple[Job, ...]:
        """Return two smaller jobs; the job alone if there is nothing to share out."""
        for name in ("seeds", "methods"):
            whole = getattr(self, name)
            if len(whole) > 1:
                half = len(whole) // 2
                first, second = {name: whole[:half]}, {name: whole[half:]}
                return replace(self, **first), replace(self, **second)
        return (self,)


@dataclass(frozen=True, slots=True, eq=False)
class JobResult:
    """What came of a job."""

    job: Job
    rows: dict[RunKey, Row]
    series: dict[str, Array]
    """Errors over time (seeds, T, 3) by method, for figures."""
    code: str
    """Version of the code that did it."""


Execute = Callable[[Sequence[Job]], Iterator[JobResult]]
"""Does jobs somewhere, and yields what comes of them as it comes."""


def do_job(job: Job) -> JobResult:
    """Do a job here and now; whatever goes wrong with a run becomes its row.

    A method that overflows says so by its status; NumPy need not.
    """
    with np.errstate(all="ignore"):
        try:
            trials = _trials(job)
        except Exception as error:
            return failed_job(job, shown(error))
        rows: dict[RunKey, Row] = {}
        series: dict[str, Array] = {}
        for name in job.methods:
            outcomes = parse_method(name).run(trials)
            scored = [
                score(job.labels(trial.seed, name), trial, outcome)
                for trial, outcome in zip(trials, outcomes, strict=True)
            ]
            keys = (RunKey(job.source.id, job.grade_name, seed, name) for seed in job.seeds)
            rows |= zip(keys, (row for row, _ in scored), strict=True)
            series[name] = np.stack([samples for _, samples in scored])
        return JobResult(job, rows, series, code_version())


def _trials(job: Job) -> list[Trial]:
    if isinstance(job.source, Recording):
        return [recorded_trial(job.source)]
    assert job.grade is not None
    return simulated_trials(job.source, job.grade, job.seeds)


def failed_job(job: Job, message: str, **status: str) -> JobResult:
    """Return the result of a job of which nothing came."""
    rows: dict[RunKey, Row] = {
        key: failed_row(job.labels(key.seed, key.method), message, **status)
        for key in job.run_keys()
    }
    return JobResult(job, rows, {}, code_version())


def lost_job(job: Job, message: str) -> JobResult:
    """Return the result of a job that took its process with it."""
    return failed_job(job, message, status=LOST)


_LEFT_OUT: Final = ("report", "cli")
"""Parts of the package that no number of a study depends on."""


@cache
def code_version() -> str:
    """Return the package version with a digest of all that a study's numbers depend on.

    The version alone does not do: between releases the source changes. The versions of GTSAM,
    NumPy and SciPy are part of the digest.
    """
    package, others = Path(__file__).parents[1], Path(factors.similarity.__file__).parent
    sources = {p.relative_to(package).as_posix(): p for p in package.rglob("*.py")}
    digest = hashlib.sha256()
    for name in sorted(name for name in sources if name.split("/")[0] not in _LEFT_OUT):
        digest.update(f"ssm_graph/{name}\0".encode() + sources[name].read_bytes())
    for path in sorted(others.glob("*.py")):
        digest.update(f"factors/{path.name}\0".encode() + path.read_bytes())
    for name in ("gtsam", "numpy", "scipy"):
        digest.update(f"{name} {version(name)}\0".encode())
    return f"{version('ssm-graph')}+{digest.hexdigest()[:10]}"
