"""Jobs on a Dask cluster; its workers need this package in the same version."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any, Final

from ssm_graph.base.errors import ConfigError, MissingExtraError, SsmGraphError
from ssm_graph.study.jobs import Job, JobResult, do_job, lost_job
from ssm_graph.study.methods import shown

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
