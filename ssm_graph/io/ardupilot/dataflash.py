"""Dataflash logs of ArduPilot: the records of some messages as columns, whatever is damaged.

A record is A3 95, the number of its type, and its fields without gaps; records ``FMT`` say the
length, the fields and their codes of each type. Layout: ArduPilot, ``AP_Logger/LogStructure.h``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.progress import teller

MAGIC: Final = b"\xa3\x95"
_FMT: Final = 0x80
_FMT_SIZE: Final = 89
_CODES: Final[Mapping[str, tuple[str, float]]] = {
    "a": ("(32,)<i2", 1.0),
    "b": ("<i1", 1.0),
    "B": ("<u1", 1.0),
    "M": ("<u1", 1.0),
    "h": ("<i2", 1.0),
    "H": ("<u2", 1.0),
    "i": ("<i4", 1.0),
    "I": ("<u4", 1.0),
    "q": ("<i8", 1.0),
    "Q": ("<u8", 1.0),
    "f": ("<f4", 1.0),
    "d": ("<f8", 1.0),
    "g": ("<f2", 1.0),
    "c": ("<i2", 0.01),
    "C": ("<u2", 0.01),
    "e": ("<i4", 0.01),
    "E": ("<u4", 0.01),
    "L": ("<i4", 1e-7),
    "n": ("S4", 1.0),
    "N": ("S16", 1.0),
    "Z": ("S64", 1.0),
}
"""NumPy type of a field by its code, and what its number is multiplied by."""

Columns = Mapping[str, NDArray[Any]]
"""Fields (N,) of a message by name."""


@dataclass(frozen=True, slots=True, eq=False)
class Dataflash:
    """What a log holds of the messages that were asked for."""

    messages: Mapping[str, Columns]
    n_records: int
    """Of all types."""
    n_skipped: int
    """Bytes that belong to no sound record."""


@dataclass(frozen=True, slots=True)
class _Format:
    name: str
    size: int
    dtype: np.dtype[Any]
    scales: Mapping[str, float]


def is_dataflash(head: bytes) -> bool:
    """Return whether a file begins with a record that says what records are."""
    return head.startswith(MAGIC + bytes([_FMT]))


def read_dataflash(data: bytes, wanted: Iterable[str]) -> Dataflash:
    """Return the records of some messages; torn and unknown ones are skipped and counted."""
    names = set(wanted)
    formats: dict[int, _Format] = {}
    sizes: dict[int, int] = {_FMT: _FMT_SIZE}
    places: dict[int, list[int]] = {}
    at, n_records, n_skipped, end = 0, 0, 0, len(data)
    tell = teller(end)
    while at + 3 <= end:
        if not n_records & 0xFFF:
            tell(at)
        kind = data[at + 2]
        size = sizes.get(kind, 0)
        is_sound = data[at] == MAGIC[0] and data[at + 1] == MAGIC[1] and size > 0
        following = at + size
        if is_sound and following + 2 <= end:  # what follows has to be a record too
            is_sound = data[following] == MAGIC[0] and data[following + 1] == MAGIC[1]
        if not is_sound or following > end:
            found = data.find(MAGIC, at + 1)
            n_skipped += (found if found >= 0 else end) - at
            at = found if found >= 0 else end
            continue
        if kind == _FMT:
            format_ = _format(data[at + 3 : following])
            if format_ is not None:
                formats[format_[0]] = format_[1]
                sizes[format_[0]] = format_[1].size
        elif kind in formats and formats[kind].name in names:
            places.setdefault(kind, []).append(at + 3)
        n_records += 1
        at = following
    n_skipped += end - at
    found_messages = {
        formats[kind].name: _columns(data, formats[kind], starts) for kind, starts in places.items()
    }
    return Dataflash(found_messages, n_records, n_skipped)


def _format(fields: bytes) -> tuple[int, _Format] | None:
    """Return number and format of a type; None where its codes are not known or do not add up."""
    kind, size = fields[0], fields[1]
    name, codes, labels = (
        part.rstrip(b"\0").decode("ascii", "replace")
        for part in (fields[2:6], fields[6:22], fields[22:86])
    )
    columns = labels.split(",") if labels else []
    if kind == _FMT or len(columns) != len(codes) or "" in columns:
        return None
    if any(code not in _CODES for code in codes):
        return None
    try:
        dtype = np.dtype([(c, _CODES[k][0]) for c, k in zip(columns, codes, strict=True)])
    except ValueError:  # one name twice
        return None
    if dtype.itemsize + 3 != size:
        return None
    scales = {c: _CODES[k][1] for c, k in zip(columns, codes, strict=True)}
    return kind, _Format(name, size, dtype, scales)


def _columns(data: bytes, format_: _Format, starts: list[int]) -> Columns:
    size = format_.dtype.itemsize
    records = np.frombuffer(b"".join(data[at : at + size] for at in starts), format_.dtype)
    return {
        name: records[name] if scale == 1.0 else records[name] * scale
        for name, scale in format_.scales.items()
    }
