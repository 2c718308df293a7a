"""What ``ssm-graph compare`` does once its options are read."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.compare import FOLDER_METHODS
from ssm_graph.cli.terminal import say
from ssm_graph.evaluation.comparison import compare_methods
from ssm_graph.io.results.place import check_result_place
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.io.tables.files import TableFormat, pyarrow_module
from ssm_graph.report.comparison.tables import latex, markdown
from ssm_graph.study.jobs import DaskCluster, Execute, JobProcesses
from ssm_graph.study.runner import Progress, StudyResult, example_estimates, open_store, run_study
from ssm_graph.study.scenario import Study, read_study, study_of_folders
from ssm_graph.study.store import write_rows

PLAIN_EVERY_S: Final = 30.0
"""From one plain line to the next, where there is no terminal."""
FIGURES_NAME: Final = "figures"


def compare(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Run what is missing, then write table, summaries and figures."""
    if arguments.format is TableFormat.PARQUET:
        pyarrow_module("pyarrow")
    check_result_place(arguments.out)
    study, execute = study_from(arguments), execute_from(arguments)
    store = open_store(study, arguments.out, fresh=arguments.fresh)
    for note in store.notes:
        say(errors, f"note: {note}")
    if len(store) > 0:
        errors.print(f"going on: {len(store)} runs are done already", highlight=False)
    try:
        with StudyDisplay(errors) as show:
            result = run_study(study, store, execute=execute, on_progress=show)
    except KeyboardInterrupt:
        # As many as the file has: the signal may have come between writing and counting.
        store = open_store(study, arguments.out, fresh=False)
        say(
            errors,
            f"{len(store)} finished runs are kept in {store.path}; the same command goes on there",
        )
        raise
    command = shlex.join(["ssm-graph", *sys.argv[1:]])
    text = write_study(arguments.out, study, result, arguments.format, command=command)
    if not arguments.no_figures:
        _write_figures(arguments.out / FIGURES_NAME, study, result, errors)
    headline = text.partition("\n## Every cell")[0]
    say(console, headline)
    say(
        console,
        f"{len(result.rows)} runs, {result.n_failed} without a result; results in {arguments.out}",
    )
    return result.n_failed == 0


def study_from(arguments: argparse.Namespace) -> Study:
    """Return what is to be compared."""
    paths: Sequence[Path] = arguments.inputs
    files = [path for path in paths if path.suffix == ".toml" and not path.is_dir()]
    methods = None
    if arguments.methods is not None:
        methods = [name for name in arguments.methods.split(",") if name.strip()]
    if not files:
        study = study_of_folders(paths, FOLDER_METHODS if methods is None else methods)
        return study.changed(n_seeds=arguments.seeds)
    if len(paths) > 1:
        raise ConfigError(
            f"INPUT: expected one study file or mission folders, got {files[0]} among "
            f"{len(paths)}; run them one by one"
        )
    return read_study(files[0]).changed(methods=methods, n_seeds=arguments.seeds)


def execute_from(arguments: argparse.Namespace) -> Execute:
    """Return who does the work."""
    if arguments.scheduler is not None:
        return DaskCluster(arguments.scheduler)
    return JobProcesses(arguments.jobs)


def write_study(
    folder: Path, study: Study, result: StudyResult, form: TableFormat, *, command: str
) -> str:
    """Write the table and both summaries, one set; return the summary for the terminal.

    Figures and tables of an earlier state of the study go first.
    """
    comparison = compare_methods(result.rows, baseline=study.baseline)
    text = markdown(comparison, title=f"Study: {study.name}", command=command, code=result.code)
    caption = f"Study {study.name}: {command}; ssm-graph {result.code}"
    table = latex(comparison, caption=caption, label=f"tab:{study.name}")
    names = (f"table{form.value}", "summary.tex", "summary.md")
    parts = {name: folder / f".part-{name}" for name in names}
    try:
        write_rows(parts[names[0]], result.rows)
        write_through(parts[names[1]], table.encode())
        write_through(parts[names[2]], text.encode())
        old = [folder / names[2], *(folder / f"table{one.value}" for one in TableFormat)]
        for path in (*old, *(folder / FIGURES_NAME).glob("*.png")):
            path.unlink(missing_ok=True)
        for name, part in parts.items():
            part.replace(folder / name)
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
    return text


def _write_figures(folder: Path, study: Study, result: StudyResult, errors: Console) -> None:
    from ssm_graph.report.comparison.figures import save_figures

    errors.print("drawing figures; the example mission is run once more")
    save_figures(folder, result.rows, result.series, example_estimates(study))


class StudyDisplay:
    """A bar with the time left on a terminal, a plain line now and then elsewhere."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._said, self._n_said = time.monotonic(), 0
        self._bar = Bar(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("runs", total=None)

    def __enter__(self) -> StudyDisplay:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, progress: Progress) -> None:
        """Show what was done last, and how long the rest will take."""
        self._bar.update(
            self._task,
            description=progress.label,
            completed=progress.n_done,
            total=progress.n_wanted,
        )
        now, is_last = time.monotonic(), progress.n_done == progress.n_wanted
        if self._console.is_terminal or not (is_last or now - self._said >= PLAIN_EVERY_S):
            return
        # As fast as since the last line: some methods take a hundred times as long as others.
        s_per_run = (now - self._said) / max(progress.n_done - self._n_said, 1)
        self._said, self._n_said = now, progress.n_done
        left_s = s_per_run * (progress.n_wanted - progress.n_done)
        say(
            self._console,
            f"{progress.n_done} of {progress.n_wanted} runs, {progress.label}, "
            f"{left_s / 60.0:.1f} min left",
        )
