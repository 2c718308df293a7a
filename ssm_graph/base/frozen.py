"""Frozen values with arrays: copied in, checked for shape and made read-only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, fields
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_graph.base.errors import DataError

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


def read_only(name: str, value: ArrayLike, shape: Sequence[int | None]) -> Array:
    """Return a read-only float copy of ``value`` after checking its shape (None matches any)."""
    array = np.array(value, dtype=np.float64)
    expected = tuple(shape)
    if array.ndim != len(expected) or any(
        want is not None and got != want for got, want in zip(array.shape, expected, strict=False)
    ):
        wanted = tuple("N" if size is None else size for size in expected)
        raise DataError(f"{name}: expected an array of shape {wanted}, got {array.shape}")
    array.setflags(write=False)
    return array


class FrozenArrays:
    """Apply :func:`read_only` to every array field, by the shape kept in the field's metadata.

    A letter in a shape stands for a length: that of the first field that has it.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        lengths: dict[str, int] = {}
        for spec in fields(cast(Any, self)):
            shape = spec.metadata.get("shape")
            value = getattr(self, spec.name)
            if shape is None or value is None:
                continue
            wanted = [lengths.get(size) if isinstance(size, str) else size for size in shape]
            array = read_only(f"{type(self).__name__}.{spec.name}", value, wanted)
            named = zip(shape, array.shape, strict=True)
            lengths |= {size: got for size, got in named if isinstance(size, str)}
            object.__setattr__(self, spec.name, array)


class ReadOnlyArrays:
    """Clear the write flag of every array field, without copy: for arrays made on the spot."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for spec in fields(cast(Any, self)):
            value = getattr(self, spec.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)


def shaped(*shape: int | str) -> Array:
    """Declare an array field of :class:`FrozenArrays` with its shape."""
    declared: Array = field(metadata={"shape": shape})
    return declared


def optional_shaped(*shape: int | str) -> Array | None:
    """Declare an array field that may be None."""
    declared: Array | None = field(default=None, metadata={"shape": shape})
    return declared
