"""Recordings of instruments: read whole, and what becomes of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

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


def running_sums(data: bytes, width: int = 1, offset: int = 0) -> NDArray[np.uint16]:
    """Return the sums of the first 0, 1, 2 ... numbers of ``width`` bytes, modulo 65536.

    What lies between two places sums up to their difference, so that a file full of begins of long
    packets costs no more than one of packets.
    """
    count = max(0, (len(data) - offset) // width)
    numbers = np.frombuffer(data, f"<u{width}", count=count, offset=offset if count else 0)
    sums = np.zeros(count + 1, np.uint16)
    np.cumsum(numbers, dtype=np.uint16, out=sums[1:])
    return sums
