"""Long computations in small steps, for callers that may not be held up.

A function ``f_steps`` does what ``f`` does, piece by piece: it yields after each piece, and returns
the answer of ``f`` at the end; ``f = at_once(f_steps)``. It yields the size of the piece, by the
number of rows that it went through and not by a clock, in about milliseconds of a laptop's
processor. Whoever spends so much at a time comes to the same place in every run.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

Steps = Generator[float, None, T]
"""The pieces of a computation by their size, about ms; its answer is what the generator returns."""


def finished(steps: Steps[T]) -> T:
    """Make all steps at once and return the answer."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            answer: T = end.value
            return answer


def at_once(make_steps: Callable[P, Steps[T]]) -> Callable[P, T]:
    """Return ``f`` of an ``f_steps``, with its arguments and its documentation."""

    @wraps(make_steps)
    def whole(*args: P.args, **kwargs: P.kwargs) -> T:
        return finished(make_steps(*args, **kwargs))

    for name in ("__name__", "__qualname__"):
        setattr(whole, name, getattr(make_steps, name).removesuffix("_steps"))
    return whole
