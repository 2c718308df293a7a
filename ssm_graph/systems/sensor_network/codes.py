"""From numbers to few bits and back, so that what rounding took is known: never a silent wrap.

A value is sent as the whole number ``i = floor(y / step + 1/2)`` and read as ``i step``: at most
half a step off, which the receiver adds to the bound. Plain codes have a range, beyond which they
refuse; residue codes send ``i mod 2^bits`` and leave it to the receiver's own set to tell which i
it was.
"""

from __future__ import annotations

import hashlib
import hmac
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array

Indices = NDArray[np.int64]
MOST_BITS: Final = 32
HEADING_BITS: Final = 12
"""Of the index of a heading; a turn has so many steps, so that its residue says all there is."""
HEADING_STEP: Final = 2.0 * math.pi / 2**HEADING_BITS
"""rad"""
TAG_BYTES: Final = (0, 4, 8)
"""Of an authentication tag; forging one of 4 bytes succeeds once in 2^32 attempts."""
_LESS: Final = 1e-9
"""Of a step: what rounding may do to a quotient."""


def require_step(step: float) -> None:
    """Refuse a step that is none."""
    if not (math.isfinite(step) and step > 0.0):
        raise ConfigError(f"[code] step: expected a number above 0, got {step}; try 0.1")


@dataclass(frozen=True, slots=True)
class UniformCode:
    """A uniform mid-tread quantiser."""

    step: float
    """In the unit of what is coded; of the patent this is ``key * d``."""
    bits: int = MOST_BITS
    """Of one index, its sign included."""

    def __post_init__(self) -> None:
        require_step(self.step)
        if not 1 <= self.bits <= MOST_BITS:
            raise ConfigError(f"[code] bits: expected 1 to {MOST_BITS}, got {self.bits}")

    @property
    def error(self) -> float:
        """Bound of what rounding takes."""
        return 0.5 * self.step * (1.0 + _LESS)

    @property
    def most(self) -> int:
        """Largest absolute index."""
        return int(2 ** (self.bits - 1) - 1)

    def index(self, value: ArrayLike) -> Indices:
        """Return whole numbers; one that needs more bits is refused, for a wrap would be a lie."""
        y = np.asarray(value, dtype=np.float64)
        if not np.isfinite(y).all():
            raise DataError(
                "measurement: expected finite numbers, got one that is not; leave it out"
            )
        index = np.floor(y / self.step + 0.5)
        worst = float(np.max(np.abs(index), initial=0.0))
        if worst > self.most:
            raise DataError(
                f"measurement {worst * self.step:g}: expected at most {self.most * self.step:g}, "
                f"what {self.bits} bits hold in steps of {self.step:g}; "
                f"give {bits_for(worst * self.step, self.step)} bits or a larger step"
            )
        return index.astype(np.int64)

    def value(self, index: ArrayLike) -> Array:
        """Return what is read from whole numbers."""
        return np.asarray(index, dtype=np.float64) * self.step


def bits_for(largest: float, step: float) -> int:
    """Return the bits of a plain index for values up to ``largest``."""
    return math.ceil(math.log2(2.0 * abs(largest) / step + 1.0))


def residue_bits(width: float, step: float) -> int:
    """Return the bits of a residue where the receiver knows the value within ``width``."""
    return max(1, math.ceil(math.log2(width / step + 2.0)))


@dataclass(frozen=True, slots=True)
class ResidueCode:
    """Innovation coding without a shared prediction: residues, told apart by the receiver's set.

    The receiver's set says that ``h.x`` is in an interval, the bound of the noise that the value
    is, and so the index. If no more than 2^bits indices are possible, the residue is one of them,
    and which one is certain. The more a receiver knows, the fewer bits it takes; packets that were
    lost change nothing, for nothing refers to them.
    """

    step: float
    bits: int

    def __post_init__(self) -> None:
        UniformCode(self.step, self.bits)

    @property
    def error(self) -> float:
        """Bound of what rounding takes."""
        return UniformCode(self.step).error

    def residue(self, value: ArrayLike) -> Indices:
        """Return indices modulo 2^bits."""
        return np.asarray(UniformCode(self.step).index(value) % 2**self.bits, dtype=np.int64)

    def value(self, residue: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
        """Return the values that residues (...) stand for, given that each is in [low, high].

        NaN where more than one is possible: the message is of no use to this receiver. Where none
        is possible, the nearest is returned, which misses the receiver's set and raises the alarm.
        """
        size = 2**self.bits
        first = np.floor(np.asarray(low) / self.step + 0.5 - _LESS)
        last = np.floor(np.asarray(high) / self.step + 0.5 + _LESS)
        unique = last - first < size
        start = np.where(unique, first, 0.0)
        index = start + (np.asarray(residue) - start) % size
        back = index - size
        beyond = index - np.where(unique, last, 0.0)
        before = start - back
        index = np.where((beyond > 0.0) & (before < beyond), back, index)
        return np.where(unique, index * self.step, np.nan)


@dataclass(frozen=True, slots=True)
class Keystream:
    """Secrecy and authenticity from HMAC-SHA256 alone, at no cost of accuracy.

    An index is sent as ``(i + s) mod 2^bits`` where s comes from HMAC(key, node, step, number):
    as secret as the key is, so long as no pair of node and step is sent twice with other content.
    """

    key: bytes
    """Of 16 bytes or more, the same at all nodes."""
    tag_bytes: int = 4

    def __post_init__(self) -> None:
        if len(self.key) < 16:
            raise ConfigError(
                f"[code] secret: expected 16 bytes or more, got {len(self.key)}; try those of "
                "python -c 'import secrets; print(secrets.token_hex(16))'"
            )
        if self.tag_bytes not in TAG_BYTES:
            raise ConfigError(f"[code] tag_bytes: expected 0, 4 or 8, got {self.tag_bytes}")

    def of_session(self, session: bytes) -> Keystream:
        """Return the keystream of one session, whose bytes need not be secret, but be new.

        Steps begin at 1 in every session: by one key for all, two of them would have the same
        numbers, and packets of one would be authentic in the next.
        """
        key = hmac.digest(self.key, b"session" + session, hashlib.sha256)
        return Keystream(key, self.tag_bytes)

    def _numbers(self, node: int, step: int, bits: tuple[int, ...]) -> Indices:
        found: list[int] = []
        block = 0
        while len(found) < len(bits):
            text = b"stream" + node.to_bytes(2, "big") + step.to_bytes(8, "big")
            digest = hmac.digest(self.key, text + block.to_bytes(4, "big"), hashlib.sha256)
            found += [int.from_bytes(digest[i : i + 4], "big") for i in range(0, 32, 4)]
            block += 1
        return np.array(found[: len(bits)], dtype=np.int64)

    def hidden(self, index: Indices, *, node: int, step: int, bits: tuple[int, ...]) -> Indices:
        """Return whole numbers (n,), each from 0 to 2^bits - 1, as they are sent."""
        sizes = 2 ** np.array(bits, dtype=np.int64)
        return np.asarray((index + self._numbers(node, step, bits)) % sizes)

    def shown(self, sent: Indices, *, node: int, step: int, bits: tuple[int, ...]) -> Indices:
        """Return what :meth:`hidden` was given."""
        sizes = 2 ** np.array(bits, dtype=np.int64)
        return np.asarray((sent - self._numbers(node, step, bits)) % sizes)

    def tag(self, message: bytes) -> bytes:
        """Return the tag of a message as it is sent."""
        return hmac.digest(self.key, b"tag" + message, hashlib.sha256)[: self.tag_bytes]

    def is_authentic(self, message: bytes, tag: bytes) -> bool:
        """Return whether who sent it has the key."""
        return hmac.compare_digest(self.tag(message), tag)
