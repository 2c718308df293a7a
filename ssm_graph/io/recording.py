"""Recordings of instruments: read whole, and what becomes of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ssm_graph.base.errors import DataError
from ssm_graph.sensors.messages import Message

_LARGEST: Final = 1 << 31


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording as messages of a mission folder."""

    about: str
    """Its format, how many reports of what, and in how many the bottom was tracked."""
    messages: tuple[Message, ...]
    """In order of time, by the clock of the instrument, s."""
    notes: tuple[str, ...]
    """What was left out or assumed, and what mission.toml has to say, one sentence each."""


def whole(path: Path) -> bytes:
    """Return the content of a file; raise :class:`DataError` for one that is too large or gone."""
    try:
        if path.stat().st_size > _LARGEST:
            raise DataError(f"{path}: larger than 2 GiB: split it, for example by time")
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
