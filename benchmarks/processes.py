"""Work in fresh processes: side by side, or alone where memory and time are counted by process."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, TypeVar

from benchmarks.report import note
from ssm_graph.base.errors import SsmGraphError
from ssm_graph.study.ledger import ERROR, Key, Row

T = TypeVar("T")


def tell(number: int, of: int, what: object) -> None:
    """Say that one of many is done."""
    note(f"{number} of {of}: {what} done")


def all_done(rows: Mapping[Key, Row]) -> Mapping[Key, Row]:
    """Return rows of which a page is made; raise :class:`SsmGraphError` for one that has none."""
    for key, row in rows.items():
        if ERROR in row:
            raise SsmGraphError(
                f"trial {key}: expected a row, got an error: {row[ERROR]}; its line of the ledger "
                "stays until the code is another, or is taken out"
            )
    return rows


def side_by_side(
    task: Callable[..., T], cases: Iterable[tuple[Any, ...]], jobs: int, *, each_fresh: bool = False
) -> list[T]:
    """Return what a task makes of the arguments of each case, in order, and tell how far it is.

    So many jobs at a time are done; with ``each_fresh`` each by a process of its own.
    """
    context = multiprocessing.get_context("spawn")
    per_child = 1 if each_fresh else None
    with ProcessPoolExecutor(jobs, context, max_tasks_per_child=per_child) as pool:
        futures = {pool.submit(task, *case): case for case in cases}
        for number, future in enumerate(as_completed(futures), start=1):
            future.result()
            tell(number, len(futures), futures[future])
        return [future.result() for future in futures]


def in_fresh_process(task: Callable[..., T], *args: object) -> T:
    """Return what ``task`` returns in a process of its own: peak memory is counted by process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(task, *args).result()
