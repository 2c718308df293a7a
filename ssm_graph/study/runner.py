"""Run a study: do what is missing, keep it at once, and gather everything."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from ssm_graph.base.errors import DataError
from ssm_graph.mission.estimate import Estimate
from ssm_graph.mission.mission import Reference
from ssm_graph.simulation import OutlierKind
from ssm_graph.study.cells import Cell, Recording
from ssm_graph.study.code import code_version
from ssm_graph.study.jobs import Execute, Job, JobResult, RunKey, do_job
from ssm_graph.study.methods import parse_method
from ssm_graph.study.plan import missing_jobs, wanted_keys
from ssm_graph.study.scenario import Study
from ssm_graph.study.scoring import Row
from ssm_graph.study.store import Series, StudyStore, gather_series
from ssm_graph.study.trials import Trial, recorded_trial, simulated_trials

FORMAT = 1
"""Of the store."""


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
    return _gather(study, store)


def _gather(study: Study, store: StudyStore) -> StudyResult:
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
