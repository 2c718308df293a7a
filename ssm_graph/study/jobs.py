"""Jobs, some trials of one cell with the methods to try on them, and who does them.

They are done by processes of this machine, or by a Dask cluster. A process that dies takes no
other's work with it; a cluster's workers need this package in the same version.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.code_version import code_version
from ssm_graph.base.errors import ConfigError, MissingExtraError, SsmGraphError
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


MAX_DEATHS: Final = 2
"""A single run that ends its process as often is given up."""
MAX_DEATHS_IN_A_ROW: Final = 40
"""Without any result between them; no job is to blame for so many."""
_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class JobProcesses:
    """An :data:`~ssm_graph.study.jobs.Execute` for a number of processes.

    Every process has a pipe of its own, so that it is known which job a dead one was at: that job
    is halved and tried again, down to the single run that is to blame. A process prefers jobs
    whose missions it has simulated already.
    """

    def __init__(self, n_processes: int) -> None:
        if n_processes < 1:
            raise ConfigError(f"--jobs: expected 1 or more processes, got {n_processes}; try 2")
        self.n_processes = n_processes

    def __call__(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """Yield what comes of the jobs as it comes; closed early, the processes are ended."""
        waiting = list(jobs)
        deaths = _Deaths()
        with one_blas_thread():
            workers = [_Worker.start() for _ in range(min(self.n_processes, len(waiting)))]
            try:
                while waiting or any(worker.job for worker in workers):
                    self._hand_out(waiting, workers, deaths)
                    yield from self._collect(waiting, workers, deaths)
            finally:
                for worker in workers:
                    worker.process.terminate()
                for worker in workers:
                    worker.process.join()
                    worker.pipe.close()

    def _hand_out(self, waiting: list[Job], workers: list[_Worker], deaths: _Deaths) -> None:
        for i, worker in enumerate(workers):
            if worker.job is None and waiting:
                others = [other.seen for other in workers if other is not worker]
                job = waiting.pop(best_job(waiting, worker.seen, others))
                while not workers[i].give(job):  # died while idle
                    dead, workers[i] = workers[i], workers[i].replaced()
                    deaths.count(how=dead.ending())

    def _collect(
        self, waiting: list[Job], workers: list[_Worker], deaths: _Deaths
    ) -> Iterator[JobResult]:
        ready = wait([worker.pipe for worker in workers if worker.job])
        for i, worker in enumerate(workers):
            if worker.job is None or worker.pipe not in ready:
                continue
            job, worker.job = worker.job, None
            try:
                result: JobResult = worker.pipe.recv()
            except (EOFError, OSError):
                workers[i] = worker.replaced()
                if deaths.is_last(job, how=worker.ending()):
                    yield lost_job(job, f"its process ended {worker.ending()}, twice")
                else:
                    waiting[:0] = job.halves()
            else:
                deaths.in_a_row = 0
                yield result


def best_job(
    waiting: Sequence[Job], seen: set[tuple[object, ...]], others: Sequence[set[tuple[object, ...]]]
) -> int:
    """Return the place of the job that shares most missions with those seen, fewest with others'.

    Among equals the first; so no two processes simulate the same mission while others wait.
    """
    elsewhere = set().union(*others)

    def merit(place: int) -> tuple[int, int, int]:
        missions = waiting[place].missions
        return len(missions & seen), -len(missions & elsewhere), -place

    return max(range(len(waiting)), key=merit)


@dataclass(eq=False)
class _Deaths:
    """Processes that ended unasked."""

    of_job: dict[Job, int] = field(default_factory=dict)
    in_a_row: int = 0

    def is_last(self, job: Job, *, how: str) -> bool:
        """Count one, and return whether a job of a single run is to be given up."""
        self.count(how=how)
        self.of_job[job] = self.of_job.get(job, 0) + 1
        return job.n_runs == 1 and self.of_job[job] >= MAX_DEATHS

    def count(self, *, how: str) -> None:
        """Count one; raises :class:`SsmGraphError` where there is no end of them."""
        self.in_a_row += 1
        if self.in_a_row >= MAX_DEATHS_IN_A_ROW:
            raise SsmGraphError(
                f"--jobs: {self.in_a_row} processes in a row ended {how} without a result; is "
                "there memory for so many? try --jobs 1; what is done is kept"
            )


@dataclass(eq=False)
class _Worker:
    process: BaseProcess
    pipe: Connection
    job: Job | None = None
    """What it is at."""
    seen: set[tuple[object, ...]] = field(default_factory=set)
    """Missions that it has simulated."""

    @staticmethod
    def start() -> _Worker:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs,), daemon=True)
        process.start()
        theirs.close()  # so that its end is seen here
        return _Worker(process, ours)

    def give(self, job: Job) -> bool:
        """Hand a job over; False if there is nobody any more."""
        try:
            self.pipe.send(job)
        except OSError:
            return False
        self.job = job
        self.seen |= job.missions
        return True

    def replaced(self) -> _Worker:
        """Return a new one for one that died."""
        self.process.join()
        self.pipe.close()
        return _Worker.start()

    def ending(self) -> str:
        """Return how its process ended."""
        code = self.process.exitcode or 0
        return f"by signal {-code}" if code < 0 else f"with exit code {code}"


def _serve(pipe: Connection) -> None:
    """Do jobs until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one who started this decides
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(do_job(job))


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Give new processes one thread each: they share the cores already, and results stay equal."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # read when a process imports NumPy
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


RETRIES: Final = 2
CONNECT_S: Final = 20.0


def merged(jobs: Sequence[Job]) -> list[Job]:
    """Return jobs with those on the same missions, one after the other, made one.

    Nobody says which worker of a cluster gets which job: each may have to simulate its missions.
    """
    return [
        replace(first, methods=(*first.methods, *(name for job in group for name in job.methods)))
        for _, group in groupby(jobs, key=lambda job: (job.source, job.grade, job.seeds))
        for first in [next(group)]
    ]


class DaskCluster:
    """An :data:`~ssm_graph.study.jobs.Execute` for the cluster behind a scheduler.

    A job whose worker dies is done by another one; the scheduler gives up on it after as many
    deaths as its ``distributed.scheduler.allowed-failures`` says, and so it is lost.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        try:
            import distributed
        except ImportError as error:
            raise MissingExtraError("distributed", extra="dask", purpose="--scheduler") from error
        self._dask: Any = distributed

    def __call__(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """Yield what comes of the jobs as it comes; closed early, the rest is called off."""
        client = self._connect()
        futures: dict[Any, Job] = {}
        try:
            for job in merged(jobs):
                futures[client.submit(do_job, job, pure=False, retries=RETRIES)] = job
            for future in self._dask.as_completed(list(futures), loop=client.loop):
                yield self._result(client, future, futures.pop(future))
                future.release()
        finally:
            if client.status == "running":
                client.cancel(list(futures))
            client.close()

    def _connect(self) -> Any:
        try:
            return self._dask.Client(self.address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"--scheduler: expected the address of a Dask scheduler, got {self.address!r} "
                f"({error}); try tcp://HOST:8786, as printed by `dask scheduler`"
            ) from error

    def _result(self, client: Any, future: Any, job: Job) -> JobResult:
        try:
            result: JobResult = future.result()
        except Exception as error:
            if client.status != "running" or future.status == "cancelled":
                raise SsmGraphError(
                    f"--scheduler: the connection to {self.address} was lost ({error}); what is "
                    "done is kept: start the same command again"
                ) from error
            return lost_job(job, shown(error))
        return result
