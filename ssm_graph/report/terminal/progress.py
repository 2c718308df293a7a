"""What a user sees while an estimator works."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

from ssm_graph.base.progress import listened
from ssm_graph.mission.estimate import Iteration

PLAIN_EVERY: Final = 10
"""Iterations from one plain line to the next."""
N_PLAIN: Final = 5
"""Plain lines on the way through the keyframes."""
PATIENCE_S: Final = 2.0
"""A part of the work that takes longer is shown with its share in plain lines, too."""


class ProgressDisplay:
    """A bar on a terminal, a few plain lines elsewhere; gone when the work is done.

    ::

        with ProgressDisplay(Console(stderr=True)) as show:
            show.stage("reading the mission")
            estimate = smoother.solve(problem, on_iteration=show)
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._is_live = console.is_terminal and not console.is_dumb_terminal
        self._unprinted: str | None = None
        self._task: TaskID | None = None
        self._stage, self._began_s, self._shown, self._done = "", time.monotonic(), 0.0, 0.0
        self._listening = ExitStack()
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[state]}", markup=False),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not self._is_live,
        )

    def __enter__(self) -> ProgressDisplay:
        self._progress.start()
        self._listening.enter_context(listened(self.share))
        return self

    def __exit__(self, *_: object) -> None:
        self._listening.close()
        self._progress.stop()
        self._flush()

    def __call__(self, index: int, limit: int, iteration: Iteration) -> None:
        """Do as :meth:`iteration`: the display itself is a callback."""
        self.iteration(index, limit, iteration)

    def stage(self, text: str) -> None:
        """Show that another part of the work begins."""
        self._stage, self._began_s, self._shown, self._done = text, time.monotonic(), 0.0, 0.0
        if not self._is_live:
            self._flush()
            self._print(text)
            return
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._task = self._progress.add_task(text, total=None, state="")

    def share(self, done: float) -> None:
        """Show which share, 0 to 1, of what is under way is done; plainly where it takes long."""
        if self._is_live and self._task is not None:
            self._progress.update(self._task, total=1.0, completed=done, state=f"{done:.0%}")
            return
        if done < self._done:  # another table of the same stage
            self._began_s, self._shown = time.monotonic(), 0.0
        self._done = done
        is_due = done - self._shown >= 1.0 / N_PLAIN
        if not self._is_live and is_due and time.monotonic() - self._began_s > PATIENCE_S:
            self._shown = done
            self._print(f"{self._stage}: {done:.0%}")

    def iteration(self, index: int, limit: int, iteration: Iteration) -> None:
        """Show one finished pass.

        Parameters
        ----------
        index : its number, counted from 1.
        limit : the number after which the estimator gives up.
        iteration : how far it moved.
        """
        state = (
            f"{index} of at most {limit}: update {iteration.update_sigmas:.2g} sigma, "
            f"weights {iteration.weight_change:.2g}, {iteration.kernel}"
        )
        if not self._is_live:
            self._unprinted = f"iteration {state}"
            if index == 1 or index % PLAIN_EVERY == 0:
                self._flush()
            return
        if self._task is None:
            self.stage("smoothing")
        assert self._task is not None
        self._progress.update(self._task, total=limit, completed=index, state=state)

    def keyframe(self, index: int, total: int) -> None:
        """Show that this many keyframes are done."""
        self._count(index, index - 1, total, "keyframe")

    def rows(self, done: int, before: int, total: int) -> None:
        """Show that so many of the rows of a stage are done, and were before."""
        self._count(done, before, total, "row")

    def _count(self, done: int, before: int, total: int, what: str) -> None:
        if self._is_live and self._task is not None:
            state = f"{100 * done // total} %"
            self._progress.update(self._task, total=total, completed=done, state=state)
        elif not self._is_live and done * N_PLAIN // total > before * N_PLAIN // total:
            self._print(f"{what} {done} of {total}, {100 * done // total} %")

    def _flush(self) -> None:
        if self._unprinted is not None:
            self._print(self._unprinted)
            self._unprinted = None

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)
