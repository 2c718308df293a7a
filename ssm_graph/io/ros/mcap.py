"""MCAP files of ROS 2, whole or cut off, with a profile or without one: read from front to end.

Nothing of the index at the end of a file is needed, so a recorder that was killed costs the last
chunk alone, and messages come in the order in which they were written. The format is that of
https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, Final, NamedTuple

from ssm_graph.base.errors import DataError

MAGIC: Final = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 1, 2, 3, 4, 5, 6, 15
_LARGEST: Final = 1 << 30
"""Bytes of one record; chunks have some megabytes."""
_SNIFFED: Final = 64 << 20
"""Bytes in which a file without a profile shows what it is."""
_ENCODINGS: Final = {"ros2msg": "MSG", "ros2idl": "IDL"}
_MESSAGE_HEAD: Final = struct.Struct("<HIQ")
_MESSAGE_SIZE: Final = _MESSAGE_HEAD.size + 8
"""Bytes before the content: channel, number, time of recording and of sending."""
_HEAD: Final = struct.Struct("<BQ")


class McapTopic(NamedTuple):
    """One channel of a file, in the terms of the library ``rosbags``."""

    id: int
    topic: str
    msgtype: str
    msgdef: Any
    """``data`` and ``format.name``, MSG, IDL or NONE."""
    msgcount: int
    encoding: str
    """Of the messages: cdr in ROS 2."""
    ext: Any = None


class _Reader:
    """Reads the fields of a record; one that is too short raises ``struct.error``."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def block(self) -> bytes:
        (size,) = self.take("I")
        if self.at + size > len(self.data):
            raise struct.error("a text is longer than its record")
        self.at += size
        return self.data[self.at - size : self.at]


class McapFile:
    """One file, a context manager as the readers of ``rosbags`` are.

    Raises :class:`DataError` for what is no MCAP, or holds other messages than those of ROS 2. What
    is damaged or missing at the end is left out: :attr:`cut_off` says so.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut_off = ""
        self.connections: list[McapTopic] = []

    def __enter__(self) -> McapFile:
        schemas, channels, counts = dict[int, Any](), dict[int, Any](), dict[int, int]()
        for opcode, data in self._records():
            try:
                if opcode == _SCHEMA:
                    number, schema = _schema(data)
                    schemas.setdefault(number, schema)
                elif opcode == _CHANNEL:
                    number, channel = _channel(data)
                    channels.setdefault(number, channel)
                elif opcode == _MESSAGE:
                    number, _, _ = _MESSAGE_HEAD.unpack_from(data)
                    counts[number] = counts.get(number, 0) + 1
            except struct.error as error:
                self.cut_off = f"a record of kind {opcode} is damaged ({error})"
        nothing = ("", SimpleNamespace(data="", format=SimpleNamespace(name="NONE")))
        for number, (schema, topic, encoding) in channels.items():
            name, definition = schemas.get(schema, nothing)
            self.connections.append(
                McapTopic(number, topic, name, definition, counts.get(number, 0), encoding)
            )
        return self

    def __exit__(self, *_: object) -> None:
        self.connections = []

    def messages(self, connections: Collection[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield channel, time of recording in ns and bytes, in the order of the file."""
        wanted = {one.id: one for one in connections}
        for opcode, data in self._records():
            if opcode == _MESSAGE and len(data) >= _MESSAGE_SIZE:
                number, _, time_ns = _MESSAGE_HEAD.unpack_from(data)
                if number in wanted:
                    if wanted[number].encoding != "cdr":
                        raise DataError(
                            f"{self.path}: topic {wanted[number].topic} is written as "
                            f"{wanted[number].encoding!r}; expected cdr, as ROS 2 writes"
                        )
                    yield wanted[number], time_ns, data[_MESSAGE_SIZE:]

    def _records(self) -> Iterator[tuple[int, bytes]]:
        """Yield opcode and content of all records, those in chunks as well, as far as sound."""
        with self.path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise DataError(f"{self.path}: expected an MCAP file, got other bytes")
            while True:
                place = stream.tell()
                record = _next(stream)
                if record is None:
                    self.cut_off = f"it ends amid a record at byte {place}"
                    return
                opcode, data = record
                if opcode in (_FOOTER, _DATA_END):
                    return
                if opcode != _CHUNK:
                    yield opcode, data
                    continue
                try:
                    inner = _chunk(data)
                except (struct.error, ValueError, EOFError, RuntimeError, OSError) as error:
                    self.cut_off = f"the chunk at byte {place} is damaged ({error})"
                    continue
                yield from inner


def is_ros2_mcap(path: Path) -> bool:
    """Return whether an MCAP holds messages of ROS 2: by its profile, else by its channels."""
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return False
            record = _next(stream)
        if record is None or record[0] != _HEADER:
            return False
        profile = _Reader(record[1]).block()
        return profile == b"ros2" or (not profile and _has_cdr(path))
    except (OSError, struct.error):
        return False


def _has_cdr(path: Path) -> bool:
    with path.open("rb") as stream:
        stream.seek(len(MAGIC))
        while stream.tell() < _SNIFFED and (record := _next(stream)) is not None:
            try:
                inner = _chunk(record[1]) if record[0] == _CHUNK else [record]
                found = [_channel(data)[1][2] for opcode, data in inner if opcode == _CHANNEL]
            except (struct.error, ValueError, ImportError, EOFError, RuntimeError):
                return False
            if found:
                return "cdr" in found
    return False


def _next(stream: IO[bytes]) -> tuple[int, bytes] | None:
    """Return the next record, None where the file ends before it does."""
    head = stream.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    opcode, size = _HEAD.unpack(head)
    if size > _LARGEST:
        return None
    data = stream.read(size)
    return (opcode, data) if len(data) == size else None


def _chunk(data: bytes) -> list[tuple[int, bytes]]:
    """Return the records of a chunk."""
    reader = _Reader(data)
    _, _, size, crc = reader.take("QQQI")
    if size > _LARGEST:
        raise ValueError(f"it states {size} bytes")
    compression = reader.block().decode("ascii")
    (length,) = reader.take("Q")
    content = _decompressor(compression)(data[reader.at : reader.at + length])
    if len(content) != size or (crc and zlib.crc32(content) != crc):
        raise ValueError("its size or checksum is wrong")
    records, at = [], 0
    while at < size:
        opcode, length = _HEAD.unpack_from(content, at)
        at += _HEAD.size + length
        if at > size:
            raise ValueError("a record is longer than its chunk")
        records.append((opcode, content[at - length : at]))
    return records


def _decompressor(name: str) -> Callable[[bytes], bytes]:
    if not name:
        return bytes
    if name == "zstd":
        return zstd_decompress
    if name == "lz4":
        return import_module("lz4.frame").decompress  # type: ignore[no-any-return]
    raise ValueError(f"its compression {name!r} is not known")


def zstd_decompress(data: bytes) -> bytes:
    """Return the content of zstd frames; of the library that ``rosbags`` brings along."""
    try:
        zstd = import_module("compression.zstd")
    except ImportError:  # before Python 3.14
        zstd = import_module("backports.zstd")
    try:
        return bytes(zstd.decompress(data))
    except zstd.ZstdError as error:
        raise ValueError(str(error)) from error


def _schema(data: bytes) -> tuple[int, tuple[str, Any]]:
    reader = _Reader(data)
    (number,) = reader.take("H")
    name, encoding, text = (reader.block().decode("utf-8", "replace") for _ in range(3))
    form = SimpleNamespace(name=_ENCODINGS.get(encoding, "NONE"))
    return number, (name, SimpleNamespace(data=text, format=form))


def _channel(data: bytes) -> tuple[int, tuple[int, str, str]]:
    reader = _Reader(data)
    number, schema = reader.take("HH")
    topic, encoding = (reader.block().decode("utf-8", "replace") for _ in range(2))
    return number, (schema, topic, encoding)
