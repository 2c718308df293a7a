"""Nortek's packets in a stream of bytes: found by two checksums, whatever stands between them.

A packet is a header of ten bytes (sync A5, its length, kind, family, length and checksum of the
data, checksum of the header; of twelve with a longer length) and the data. A checksum is B58C plus
the sum of the words, least significant byte first; an odd last byte counts as the upper half of a
word. Layout: Nortek, "Integrators Guide AD2CP", and its driver of the Nucleus.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.progress import teller
from ssm_graph.io.recording import running_sums

SYNC: Final = 0xA5
_START: Final = 0xB58C
_SHORT, _LONG = 10, 12
NUCLEUS_FAMILY: Final = 0x20


class Packet(NamedTuple):
    """One sound packet."""

    kind: int
    family: int
    data: memoryview


class Packets(NamedTuple):
    """All sound packets of a recording, and what else was met."""

    packets: tuple[Packet, ...]
    n_damaged: int
    """Sound headers whose data are torn or have another checksum."""
    n_other: int
    """Bytes that belong to no sound packet."""


def checksum(data: bytes | memoryview) -> int:
    """Return the checksum of header or data."""
    words = np.frombuffer(data, "<u2", count=len(data) // 2)
    odd = data[-1] << 8 if len(data) % 2 else 0
    return (_START + int(words.sum(dtype=np.uint64)) + odd) & 0xFFFF


def _checksum(data: bytes, sums: NDArray[np.uint16], start: int, end: int) -> int:
    """Return :func:`checksum` of a part by the sums of words from its begin or the byte before."""
    first, count = start // 2, (end - start) // 2
    odd = data[end - 1] << 8 if (end - start) % 2 else 0
    return (_START + int(sums[first + count]) - int(sums[first]) + odd) & 0xFFFF


def is_nortek(head: bytes) -> bool:
    """Return whether the first bytes of a file hold a sound header."""
    at = head.find(SYNC)
    while at >= 0:
        if _header(head, at) is not None:
            return True
        at = head.find(SYNC, at + 1)
    return False


def find_packets(data: bytes) -> Packets:
    """Return the packets of a recording in order."""
    found: list[Packet] = []
    view, tell = memoryview(data), teller(len(data))
    sums = [running_sums(data, 2, offset) for offset in (0, 1)]
    n_damaged, used, at = 0, 0, data.find(SYNC)
    while at >= 0:
        tell(at)
        header = _header(data, at)
        if header is None:
            at = data.find(SYNC, at + 1)
            continue
        kind, family, start, end, told = header
        if end <= len(data) and _checksum(data, sums[start % 2], start, end) == told:
            found.append(Packet(kind, family, view[start:end]))
            used += end - at
            at = data.find(SYNC, end)
        else:
            n_damaged += 1
            at = data.find(SYNC, at + 1)
    return Packets(tuple(found), n_damaged, len(data) - used)


def _header(data: bytes, at: int) -> tuple[int, int, int, int, int] | None:
    """Return kind, family, start and end of the data, their checksum; None for no sound header."""
    if at + _SHORT > len(data) or data[at + 1] not in (_SHORT, _LONG):
        return None
    length = data[at + 1]
    if at + length > len(data):
        return None
    if checksum(data[at : at + length - 2]) != struct.unpack_from("<H", data, at + length - 2)[0]:
        return None
    kind, family = data[at + 2], data[at + 3]
    size, told = struct.unpack_from("<HH" if length == _SHORT else "<IH", data, at + 4)
    return kind, family, at + length, at + length + size, told
