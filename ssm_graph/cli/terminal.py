"""What surrounds every command: standard streams that may fail, and signals that end the work."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import IO, TYPE_CHECKING, Any, Final, TextIO, cast

from ssm_graph.base.errors import printable

if TYPE_CHECKING:
    from rich.console import Console

SIGNALS: Final = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
"""By which a person, a service manager and a terminal that is closed end a process."""


class TolerantStream:
    """A standard stream whose reader may be gone and whose disk may be full: the work goes on.

    Characters that it cannot hold, and bytes of a path that are no text, are written as escapes.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.failure: str | None = None
        """Why nothing is written any more."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, or do nothing once that has failed."""
        encoding = self._stream.encoding or "utf-8"
        shown = text.encode(encoding, "backslashreplace").decode(encoding)
        self._try(lambda: self._stream.write(shown))
        return len(text)

    def flush(self) -> None:
        """Have the system take what was written."""
        self._try(self._stream.flush)

    def _try(self, act: Callable[[], object]) -> None:
        if self.failure is not None:
            return
        try:
            act()
        except (OSError, ValueError) as error:  # of a closed file
            self.failure = str(getattr(error, "strerror", None) or error)
            with contextlib.suppress(OSError, ValueError):  # what waits would fail at exit again
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


def console_on(stream: TextIO | None, *, is_stderr: bool = False) -> Console:
    """Return a console on a standard stream; None for one that was closed before the start.

    Names and paths are shown as they are, brackets and colons too; control characters of theirs,
    which would steer the terminal, as escapes.
    """
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

    class PlainConsole(Console):
        def render(
            self, renderable: RenderableType, options: ConsoleOptions | None = None
        ) -> Iterator[Segment]:
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else printable(text), style, control)

    file = None if stream is None else cast(IO[str], TolerantStream(stream))
    return PlainConsole(file=file, stderr=is_stderr, markup=False, emoji=False)


def silent() -> Console:
    """Return a console that shows nothing."""
    from rich.console import Console

    return Console(quiet=True)


def say(console: Console, text: str) -> None:
    """Print a text as it is, whatever it holds and however long it is."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def say_json(console: Console, value: Any) -> None:
    """Print a value as JSON that stays so: nothing of it is left for the console to escape."""
    say(console, json.dumps(value, indent=2, allow_nan=False).replace("\x7f", "\\u007f"))


def occupy_closed_streams() -> None:
    """Open the null device where a standard stream is closed: else a result file would be it."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


@contextlib.contextmanager
def signals_to(handler: Callable[..., None]) -> Iterator[None]:
    """Handle what ends a process; a signal that is ignored (nohup, background) stays so."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    wanted = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in wanted}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def interrupt(*_: object) -> None:
    """End the work as Ctrl-C does."""
    raise KeyboardInterrupt
