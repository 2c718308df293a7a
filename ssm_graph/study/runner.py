"""Run a study: find what is missing, do it, keep it at once, and gather everything."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, cast

from ssm_graph.base.code_version import code_version
from ssm_graph.base.errors import DataError
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.mission import Reference
from ssm_graph.simulation import Grade, OutlierKind
from ssm_graph.study.cells import Cell, Recording, Source
from ssm_graph.study.jobs import Execute, Job, JobResult, RunKey, do_job
from ssm_graph.study.methods import parse_method
from ssm_graph.study.scenario import Study
from ssm_graph.study.scoring import Row
from ssm_graph.study.store import Series, StudyStore, gather_series
from ssm_graph.study.trials import Trial, block_size, recorded_trial, simulated_trials

FORMAT: Final = 1
"""Of the store."""
MAX_RUNS: Final = 20
"""Runs of a job whose methods take missions one by one; an interruption costs the jobs at work."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a study is, in runs; those of earlier starts are not counted."""

    n_done: int
    n_wanted: int
    label: str
    """What was done last."""


@dataclass(frozen=True, slots=True, eq=False)
class StudyResult:
    """All runs of a study."""

    rows: tuple[Row, ...]
    """In the order of cells, grades, methods and seeds, whoever did them and when."""
    series: dict[tuple[str, str, str], Series]
    """Errors over time by case, grade and method."""
    code: str
    """Version of the code that made them."""

    @property
    def n_failed(self) -> int:
        """Runs without a result."""
        return sum(int(row["failed"]) for row in self.rows)


def open_store(study: Study, folder: Path, *, fresh: bool = False) -> StudyStore:
    """Open the files of a study, or create them; see :class:`StudyStore` for errors."""
    settings: dict[str, Any] = {"format": FORMAT, "study": study.name, "code": code_version()}
    return StudyStore(folder, settings, fresh=fresh)


def in_this_process(jobs: Sequence[Job]) -> Iterator[JobResult]:
    """Do jobs one after the other, here."""
    return (do_job(job) for job in jobs)


def run_study(
    study: Study,
    store: StudyStore,
    *,
    execute: Execute = in_this_process,
    on_progress: Callable[[Progress], None] | None = None,
) -> StudyResult:
    """Do the runs that the store does not hold yet, and return all of them.

    Trials are drawn from their own numbers, so that it does not matter where, in which order and
    in how many goes they are done. Interrupted at any time, the store holds all finished jobs.
    """
    jobs = missing_jobs(study, store)
    n_wanted, n_done = sum(job.n_runs for job in jobs), 0
    if jobs:
        with closing(cast(Any, execute(jobs))) as results:
            for result in results:
                _check_code(result, store)
                store.append(result)
                n_done += result.job.n_runs
                if on_progress is not None:
                    on_progress(Progress(n_done, n_wanted, _label(result.job)))
    rows: dict[RunKey, Row] = {key: store[key] for key in wanted_keys(study)}
    series = gather_series(store.samples(), rows)
    return StudyResult(tuple(rows.values()), series, store.settings["code"])


def _check_code(result: JobResult, store: StudyStore) -> None:
    expected = store.settings["code"]
    if result.code != expected:
        raise DataError(
            f"{_label(result.job)}: expected a worker with ssm-graph {expected}, got one with "
            f"{result.code}; install the same source and GTSAM, NumPy and SciPy everywhere, and "
            "do not change them while a study is running"
        )


def _label(job: Job) -> str:
    return " ".join(word for word in (job.source.case, job.grade_name, _span(job)) if word)


def _span(job: Job) -> str:
    if isinstance(job.source, Recording):
        return ""
    first, last = job.seeds[0], job.seeds[-1]
    return f"seed {first}" if first == last else f"seeds {first}-{last}"


def wanted_keys(study: Study) -> list[RunKey]:
    """Return the keys of all runs of a study, in the order of its table."""
    return [
        RunKey(source.id, "" if grade is None else grade.name.lower(), seed, method)
        for source in study.sources
        for grade in study.grades
        for method in study.method_names
        for seed in _seeds(study, source, method)
    ]


def _seeds(study: Study, source: Source, method: str) -> Sequence[int]:
    return (0,) if isinstance(source, Recording) else study.seeds_of(method)


def missing_jobs(study: Study, done: Container[RunKey]) -> list[Job]:
    """Return the jobs for all runs that are not done.

    Cells of the same seeds follow each other: a process that simulates those seeds for the first
    cell only draws the DVL for the others.
    """
    jobs, length_of = [], attrgetter("duration_s")
    for grade in study.grades:
        for length, sources in groupby(sorted(study.sources, key=length_of), key=length_of):
            size = block_size(length)
            jobs += list(_jobs_of(study, grade, tuple(sources), size, done))
    return jobs


def _jobs_of(
    study: Study, grade: Grade | None, sources: Sequence[Source], size: int, done: Container[RunKey]
) -> Iterator[Job]:
    """Yield the jobs of sources of one length, block of seeds by block of seeds."""
    batched = [name for name in study.method_names if parse_method(name).is_batched]
    single = [name for name in study.method_names if name not in batched]
    n_seeds = max(len(_seeds(study, sources[0], name)) for name in study.method_names)
    small_size = max(1, MAX_RUNS // max(1, len(single)))
    first = study.first_seed if isinstance(sources[0], Cell) else 0
    for begin in range(first, first + n_seeds, size):
        end = min(begin + size, first + n_seeds)
        for source in sources:
            for name in batched:
                yield from _jobs(study, source, grade, range(begin, end), [name], done)
        for small in range(begin, end, small_size):
            seeds = range(small, min(small + small_size, end))
            for source in sources:
                yield from _jobs(study, source, grade, seeds, single, done)


def _jobs(
    study: Study,
    source: Source,
    grade: Grade | None,
    seeds: range,
    methods: Sequence[str],
    done: Container[RunKey],
) -> Iterator[Job]:
    """Yield one job for all methods that miss the same seeds."""
    grade_name = "" if grade is None else grade.name.lower()
    missing: dict[tuple[int, ...], list[str]] = {}
    for method in methods:
        wanted = _seeds(study, source, method)
        left = tuple(
            seed
            for seed in seeds
            if seed in wanted and RunKey(source.id, grade_name, seed, method) not in done
        )
        if left:
            missing.setdefault(left, []).append(method)
    for left, names in missing.items():
        yield Job(study.name, source, grade, left, tuple(names))


def example_estimates(study: Study) -> list[tuple[str, Estimate, Reference]]:
    """Run all methods on one mission once more, for figures of a single run.

    It is the first trial of the first cell with outliers or faults, or the first recorded mission.
    Methods that fail on it, and missions without a reference, are left out.
    """
    trial = _example_trial(study)
    reference = trial.mission.reference
    if reference is None:
        return []
    found = []
    for name in study.method_names:
        (outcome,) = parse_method(name).run([trial])
        if isinstance(outcome, Estimate):
            found.append((name, outcome, reference))
    return found


def _example_trial(study: Study) -> Trial:
    source = next((s for s in study.sources if _is_bad(s)), study.sources[0])
    if isinstance(source, Recording):
        return recorded_trial(source)
    grade = study.grades[0]
    assert grade is not None
    (trial,) = simulated_trials(source, grade, [study.first_seed])
    return trial


def _is_bad(source: Cell | Recording) -> bool:
    return isinstance(source, Cell) and (
        source.outliers.kind is not OutlierKind.NONE or bool(source.faults)
    )
