"""Checkpoints of a live estimator: whole or not there, and never believed when damaged.

A checkpoint is an npz file without pickles. It ends with a comment that holds the version of this
format and a digest of all bytes before, which is looked at before anything else is.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import parse_json
from ssm_graph.io.tables.append_file import sync_path, write_through

JSON = None | bool | int | float | str | list["JSON"] | dict[str, "JSON"]

CHECKPOINT_NAME: Final = "checkpoint.npz"
VERSION: Final = 3
_COMMENT: Final = "ssm-graph checkpoint {version:08d} sha256 {digest:0>64}"
_COMMENT_LENGTH: Final = len(_COMMENT.format(version=VERSION, digest=""))
_COMMENT_PATTERN: Final = re.compile(rb"ssm-graph checkpoint (\d{8}) sha256 ([0-9a-f]{64})")
_ARRAY: Final = "array."
_META: Final = "meta"


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """What was kept of an estimator."""

    arrays: dict[str, Array]
    meta: dict[str, JSON]
    notes: tuple[str, ...] = ()
    """Why it is not the newest one, if so; one sentence each."""


def write_checkpoint(path: Path, arrays: Mapping[str, Array], meta: Mapping[str, JSON]) -> None:
    """Write a checkpoint; the one that was there before stays beside it as the older one.

    When this returns, it is on the disk. Whenever the process or the power ends before, the one
    that was the newest is still there, whole, under its own name or that of the older one.

    Raises :class:`OSError` where the disk is full or fails; the old ones are as they were. Raises
    :class:`DataError` for an array of objects, and for a meta value that JSON cannot hold.

    Parameters
    ----------
    path : where; :func:`newest_checkpoint` looks for :data:`CHECKPOINT_NAME`.
    arrays : numbers of any shape; they come back bit for bit.
    meta : anything that JSON can hold, NaN and infinities too; a tuple comes back as a list.
    """
    content = _content(arrays, meta)
    part = path.with_name(f"{path.name}.part")
    try:
        write_through(part, content)
        if _is_sound(path):
            path.replace(older_name(path))
        part.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    sync_path(path.parent)


def read_checkpoint(path: Path) -> tuple[dict[str, Array], dict[str, JSON]]:
    """Read a checkpoint; return its arrays and its meta values.

    Raises :class:`DataError` for a file that is missing, damaged, cut off, of another version, or
    no checkpoint at all.
    """
    with np.load(io.BytesIO(_sound_content(path)), allow_pickle=False) as members:
        arrays = {
            name.removeprefix(_ARRAY): members[name] for name in members if name.startswith(_ARRAY)
        }
        return arrays, parse_json(members[_META].tobytes())


def newest_checkpoint(folder: Path, *, name: str = CHECKPOINT_NAME) -> Checkpoint | None:
    """Return the newest sound checkpoint of a folder, None where there never was one.

    Raises :class:`DataError` where there are checkpoints and none of them is sound.
    """
    newest = folder / name
    found = [path for path in (newest, older_name(newest)) if path.exists()]
    faults = [] if newest in found else [f"{name}: there is none"]
    for path in found:
        try:
            arrays, meta = read_checkpoint(path)
        except DataError as error:
            faults.append(str(error))
            continue
        notes = tuple(f"{fault}; going on from {path.name}" for fault in faults)
        return Checkpoint(arrays, meta, notes)
    if found:
        raise DataError(f"no sound checkpoint: {'; '.join(faults)}")
    return None


def older_name(path: Path) -> Path:
    """Return where the checkpoint goes that was at ``path`` before the last one."""
    return path.with_name(f"{path.stem}.older{path.suffix}")


def _content(arrays: Mapping[str, Array], meta: Mapping[str, JSON]) -> bytes:
    members: dict[str, Any] = {f"{_ARRAY}{name}": np.asarray(a) for name, a in arrays.items()}
    objects = [name for name, array in members.items() if array.dtype.hasobject]
    if objects:
        raise DataError(
            f"checkpoint: expected arrays of numbers, got objects in "
            f"{objects[0].removeprefix(_ARRAY)!r}"
        )
    try:
        members[_META] = np.frombuffer(json.dumps(dict(meta)).encode(), dtype=np.uint8)
    except (TypeError, ValueError) as error:
        raise DataError(f"checkpoint: expected meta values that JSON can hold: {error}") from error
    buffer = io.BytesIO()
    np.savez(buffer, **members)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = _COMMENT.format(version=VERSION, digest="").encode()
    body = buffer.getvalue()[:-_COMMENT_LENGTH]
    digest = hashlib.sha256(body).hexdigest()
    return body + _COMMENT.format(version=VERSION, digest=digest).encode()


def _sound_content(path: Path) -> bytes:
    """Return the bytes of a checkpoint after looking at version and digest."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path.name}: cannot be read: {error.strerror or error}") from error
    comment = _COMMENT_PATTERN.fullmatch(content[-_COMMENT_LENGTH:])
    if comment is None:
        raise DataError(
            f"{path.name}: expected a checkpoint, got another file or one that was cut off; "
            "delete it, or give the path of a checkpoint"
        )
    if int(comment[1]) != VERSION:
        raise DataError(
            f"{path.name}: expected a checkpoint of version {VERSION}, got version "
            f"{int(comment[1])}; it needs the program that wrote it"
        )
    if hashlib.sha256(content[:-_COMMENT_LENGTH]).hexdigest().encode() != comment[2]:
        raise DataError(f"{path.name}: the checkpoint is damaged: its digest is another; delete it")
    return content


def _is_sound(path: Path) -> bool:
    try:
        _sound_content(path)
    except DataError:
        return False
    return True
