"""How far a long piece of work is, for whoever is there to show it.

::

    with listened(show):
        mission = read_mission(folder)  # calls show(0.01), show(0.02) ...

Whoever works says so without knowing of a display, and through callers that know of none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final, TypeVar

T = TypeVar("T")

_STEP: Final = 0.01
_listener: ContextVar[Callable[[float], None] | None] = ContextVar("listener", default=None)


@contextmanager
def listened(listener: Callable[[float], None]) -> Iterator[None]:
    """Have a listener called with the share, 0 to 1, of the piece of work that is under way."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def told(
    pieces: Iterable[T], total: float, *, size: Callable[[T], float] = lambda _: 1.0
) -> Iterable[T]:
    """Return the pieces one by one, and tell each hundredth of the work that is done.

    Parameters
    ----------
    pieces : what is worked on.
    total : the sum of their sizes.
    size : of a piece.
    """
    listener = _listener.get()
    return pieces if listener is None or total <= 0.0 else _telling(pieces, total, size, listener)


def teller(total: float) -> Callable[[float], None]:
    """Return what takes how much of a total is done, for loops over no row of pieces."""
    listener, due = _listener.get(), 0.0

    def tell(done: float) -> None:
        nonlocal due
        if listener is not None and total > 0.0 and done >= due:
            listener(min(1.0, done / total))
            due = done + _STEP * total

    return tell


def _telling(
    pieces: Iterable[T],
    total: float,
    size: Callable[[T], float],
    listener: Callable[[float], None],
) -> Iterator[T]:
    done, due = 0.0, _STEP * total
    for piece in pieces:
        yield piece
        done += size(piece)
        if done >= due:
            listener(min(1.0, done / total))
            due = done + _STEP * total
