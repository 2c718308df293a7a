"""Which jobs a study needs that have not been done yet, and in which order."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from itertools import groupby
from typing import Final

from ssm_graph.simulation import Grade
from ssm_graph.study.cells import Cell, Recording, Source
from ssm_graph.study.jobs import Job, RunKey
from ssm_graph.study.methods import parse_method
from ssm_graph.study.scenario import Study
from ssm_graph.study.trials import block_size

MAX_RUNS: Final = 20
"""Runs of a job whose methods take missions one by one; an interruption costs the jobs at work."""


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
    jobs = []
    for grade in study.grades:
        for length, sources in groupby(sorted(study.sources, key=_length), key=_length):
            size = block_size(length)
            jobs += list(_jobs_of(study, grade, tuple(sources), size, done))
    return jobs


def _length(source: Source) -> float:
    return source.duration_s


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
