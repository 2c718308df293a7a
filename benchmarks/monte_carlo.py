"""Monte-Carlo study: cases x grades x seeds x methods, parallel and resumable.

``python benchmarks/monte_carlo.py --seeds 20 --cases sparse10 one_beam50 --jobs 2``

Finished runs are kept in ``OUT/runs.jsonl``; started again with the same settings, only what is
missing is run. ``OUT/runs.csv`` and ``OUT/summary.md`` are made of it at the end; ``--keep NAME``
also writes ``benchmarks/results/NAME.md``, which is under version control.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shlex
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from benchmarks.study_cases import CASES, DEFAULT_DURATION_S, DEFAULT_METHODS, Method, parse_method
from benchmarks.study_report import markdown, write_csv
from benchmarks.study_runs import Job, Run, RunKey, do_job
from benchmarks.study_store import ResultsFile, code_version
from benchmarks.study_summary import summarise
from ssm_graph.errors import ConfigError, SsmGraphError, nearest_hint
from ssm_graph.simulation import Grade

RESULTS = Path(__file__).resolve().parent / "results"


def parse_args(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the settings given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=20, help="number of trials, seeds 0 to N-1")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--cases", nargs="+", default=["sparse10"], help=", ".join(CASES))
    parser.add_argument("--grades", nargs="+", default=["NAVIGATION", "TACTICAL"])
    parser.add_argument(
        "--methods", nargs="+", default=list(DEFAULT_METHODS), help="for example oracle log:5 exp:3"
    )
    parser.add_argument("--duration", type=float, default=DEFAULT_DURATION_S, help="of a run, s")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("out/monte_carlo"))
    parser.add_argument("--fresh", action="store_true", help="throw earlier runs in --out away")
    parser.add_argument("--keep", metavar="NAME", help="write benchmarks/results/NAME.md as well")
    return parser.parse_args(argv)


def missing_jobs(wanted: Iterable[Job], done: ResultsFile) -> list[Job]:
    """Return the jobs with only those methods that have not been run yet."""
    jobs = []
    for job in wanted:
        methods = tuple(m for m in job.methods if key_of(job, m) not in done)
        if methods:
            jobs.append(Job(job.case, job.grade, job.seed, methods, job.duration_s))
    return jobs


def key_of(job: Job, method: Method) -> RunKey:
    """Return the key of one run of a job."""
    return RunKey(job.case, job.grade.name, method.name, job.seed)


def run_jobs(jobs: Sequence[Job], results: ResultsFile, *, n_processes: int) -> None:
    """Run the jobs in processes, and store every one as soon as it is finished."""
    # One thread each: the processes share the cores already. Read when a process imports NumPy.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    spawn = multiprocessing.get_context("spawn")
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with (
        ProcessPoolExecutor(n_processes, mp_context=spawn) as pool,
        Progress(*columns, console=Console(stderr=True)) as progress,
    ):
        task = progress.add_task("missions", total=len(jobs))
        waiting: set[Future[list[Run]]] = {pool.submit(do_job, job) for job in jobs}
        try:
            for future in as_completed(waiting):
                runs = future.result()
                results.append(runs)
                progress.update(task, advance=1, description=_label(runs))
        except BaseException:  # an interrupt above all: leave without the jobs not yet begun
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _label(runs: Sequence[Run]) -> str:
    first = runs[0]
    return f"{first.case} {first.grade.lower()} seed {first.seed}"


def wanted_jobs(args: argparse.Namespace) -> list[Job]:
    """Return all missions of a study with all of its methods."""
    for name in args.cases:
        if name not in CASES:
            raise ConfigError(f"--cases: there is no {name!r}; {nearest_hint(name, CASES)}")
    for name in args.grades:
        if name not in Grade.__members__:
            hint = nearest_hint(name, Grade.__members__)
            raise ConfigError(f"--grades: there is no {name!r}; {hint}")
    methods = tuple(dict.fromkeys(parse_method(text) for text in args.methods))
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    return [
        Job(case, Grade[grade], seed, methods, args.duration)
        for case in args.cases
        for grade in args.grades
        for seed in seeds
    ]


def report(args: argparse.Namespace, results: ResultsFile, wanted: Sequence[Job]) -> str:
    """Write table and report of the wanted runs; return the report."""
    order = {key_of(job, m): i for i, job in enumerate(wanted) for m in job.methods}
    names = [method.name for method in wanted[0].methods]
    runs = sorted(
        (run for run in results.runs if run.key in order),
        key=lambda run: (order[run.key], names.index(run.method)),
    )
    write_csv(args.out / "runs.csv", runs)
    text = markdown(
        summarise(runs),
        title=f"Monte-Carlo study: {', '.join(args.cases)}",
        command=shlex.join(["python", "benchmarks/monte_carlo.py", *args.command]),
        code=str(results.settings["code"]),
        seeds=f"seeds {args.first_seed} to {args.first_seed + args.seeds - 1}, {_lengths(args)}",
    )
    (args.out / "summary.md").write_text(text, encoding="utf-8")
    if args.keep:
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / f"{args.keep}.md").write_text(text, encoding="utf-8")
    return text


def _lengths(args: argparse.Namespace) -> str:
    lengths = {args.duration * CASES[name].longer for name in args.cases}
    return " and ".join(f"{length:g} s" for length in sorted(lengths))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; return 0, or 1 if it could not be done."""
    args = parse_args(argv)
    args.command = list(sys.argv[1:] if argv is None else argv)
    try:
        wanted = wanted_jobs(args)
        settings = {"code": code_version(), "duration_s": args.duration}
        results = ResultsFile(args.out / "runs.jsonl", settings, fresh=args.fresh)
        jobs = missing_jobs(wanted, results)
        if jobs:
            run_jobs(jobs, results, n_processes=args.jobs)
        print(report(args, results, wanted))
    except SsmGraphError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
