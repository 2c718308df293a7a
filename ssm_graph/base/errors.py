"""Errors of this package; every message says where, what was expected, what came, what to try."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from unicodedata import category


def printable(text: str) -> str:
    """Return a text with all that is no print, space or line end as escapes.

    It may come out of a file. Spaces of any width are in the names of people's files.
    """
    if text.isprintable():
        return text
    return "".join(x if _is_plain(x) else ascii(x)[1:-1] for x in text)


def _is_plain(x: str) -> bool:
    return x.isprintable() or x == "\n" or category(x) == "Zs"


class SsmGraphError(Exception):
    """Base of all errors that this package raises on purpose."""

    def __str__(self) -> str:
        """Return the message; names and texts out of files cannot steer a terminal with it."""
        return printable(super().__str__())


class ConfigError(SsmGraphError):
    """A setting is missing, unknown or out of range."""


class DataError(SsmGraphError):
    """A sensor table holds something that cannot be used as it is."""


class SolverError(SsmGraphError):
    """An estimator could not produce a finite result."""


class MissingExtraError(SsmGraphError):
    """An optional dependency is needed and not installed."""

    def __init__(self, package: str, *, extra: str, purpose: str) -> None:
        super().__init__(
            f"{purpose} needs {package!r}, which is not installed: "
            f"try  pip install 'ssm-graph[{extra}]'"
        )


def nearest_hint(name: str, known: Iterable[str]) -> str:
    """Return the tail of a message that names the nearest known spelling of ``name``."""
    choices = sorted(known)
    close = get_close_matches(name, choices, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known are: {', '.join(choices)}"
