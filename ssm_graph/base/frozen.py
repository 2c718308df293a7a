"""Frozen values with arrays: copied in, checked for shape and made read-only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import field, fields, replace
from enum import Enum
from typing import Any, Final, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_graph.base.errors import DataError

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

_SHOWN_NUMBERS: Final = 4
_SHOWN_ITEMS: Final = 3
_SHOWN_CHARACTERS: Final = 60


def shown(value: object) -> str:
    """Return a value as :class:`ShortRepr` shows it: short, however much it holds."""
    if isinstance(value, np.ndarray):
        return _shown_array(value)
    if isinstance(value, ShortRepr):
        return f"{type(value).__name__}({', '.join(f'{n}={size}' for n, size in _lengths(value))})"
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, tuple) and len(value) > _SHOWN_ITEMS:
        return f"{len(value)} of {type(value[0]).__name__}"
    if isinstance(value, tuple):
        return f"({', '.join(shown(item) for item in value)})"
    text = repr(value)
    return text if len(text) <= _SHOWN_CHARACTERS else text[:_SHOWN_CHARACTERS] + "..."


def _lengths(value: object) -> Iterator[tuple[str, int]]:
    """Yield the named lengths of a value's declared shapes, each once."""
    named: dict[str, int] = {}
    for spec in fields(cast(Any, value)):
        shape = spec.metadata.get("shape", ())
        named |= dict(zip(shape, np.shape(getattr(value, spec.name)), strict=False))
    yield from ((name, size) for name, size in named.items() if isinstance(name, str))


def _shown_array(array: NDArray[Any]) -> str:
    """Return few numbers as they are, of many the shape, the range and how many are missing."""
    if array.size <= _SHOWN_NUMBERS:
        return np.array2string(array, precision=6, separator=", ").replace("\n", "")
    shape = " x ".join(str(size) for size in array.shape)
    if array.dtype == bool:
        return f"<{shape} bool, {int(array.sum())} true>"
    finite = array[np.isfinite(array)]
    text = f"{shape}, {finite.min():.6g} to {finite.max():.6g}" if finite.size else shape
    missing = array.size - finite.size
    return f"<{text}, {missing} not finite>" if missing else f"<{text}>"


class ShortRepr:
    """Give a dataclass a ``repr`` of one short line: arrays by shape and range, values by name."""

    __slots__ = ()

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "__repr__" not in cls.__dict__:  # or else `dataclass` would write one of its own
            cls.__repr__ = ShortRepr._short  # type: ignore[method-assign, assignment]

    def _short(self) -> str:
        specs = (spec for spec in fields(cast(Any, self)) if spec.repr)
        shown_fields = ", ".join(f"{s.name}={shown(getattr(self, s.name))}" for s in specs)
        return f"{type(self).__name__}({shown_fields})"


def read_only(name: str, value: ArrayLike, shape: Sequence[int | None]) -> Array:
    """Return a read-only float copy of ``value`` after checking its shape (None matches any).

    Raises :class:`DataError` for another shape and for what is no number: dates would be counted
    in the ticks of their own clock.
    """
    try:
        given = np.asarray(value)
        if given.dtype.kind in "mMc":
            raise DataError(f"{name}: expected numbers, times in seconds, got {given.dtype}")
        array = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{name}: expected numbers in rows of one length, got: {error}") from error
    expected = tuple(shape)
    if array.ndim != len(expected) or any(
        want is not None and got != want for got, want in zip(array.shape, expected, strict=False)
    ):
        wanted = tuple("N" if size is None else size for size in expected)
        raise DataError(f"{name}: expected an array of shape {wanted}, got {array.shape}")
    array.setflags(write=False)
    return array


class FrozenArrays(ShortRepr):
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

    @classmethod
    def empty(cls) -> Self:
        """Return a value of nothing but arrays without any rows: every lettered length is zero."""
        shapes = {spec.name: spec.metadata["shape"] for spec in fields(cast(Any, cls))}
        sizes = {k: [n if isinstance(n, int) else 0 for n in shape] for k, shape in shapes.items()}
        return cls(**{name: np.zeros(size) for name, size in sizes.items()})

    def rows(self, kept: NDArray[np.bool_]) -> Self:
        """Return the rows that a mask (N,) keeps, of every field whose shape begins with ``N``."""
        own = cast(Any, self)
        names = [f.name for f in fields(own) if f.metadata.get("shape", ("",))[0] == "N"]
        present = [name for name in names if getattr(own, name) is not None]
        return cast(Self, replace(own, **{name: getattr(own, name)[kept] for name in present}))


class ReadOnlyArrays(ShortRepr):
    """Clear the write flag of every array field, without copy: for arrays made on the spot."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for name in cast(Any, self).__dataclass_fields__:
            value = getattr(self, name)
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
