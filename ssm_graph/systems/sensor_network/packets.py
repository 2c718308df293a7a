"""A measurement as a packet of few bytes: node, step, indices of so many bits each, and a tag."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.systems.sensor_network.codes import Indices, Keystream

HEADER_BYTES: Final = 5
"""One of the node, four of the step."""


class NotAuthenticError(DataError):
    """A packet whose tag does not fit: another key, or somebody else."""


@dataclass(frozen=True, slots=True)
class PacketForm:
    """What all nodes agree on."""

    bits: tuple[int, ...]
    """Of each index, 1 to 32."""
    keystream: Keystream | None = None

    @property
    def _body_bytes(self) -> int:
        return (sum(self.bits) + 7) // 8

    @property
    def n_bytes(self) -> int:
        """Of a packet."""
        tag = self.keystream.tag_bytes if self.keystream else 0
        return HEADER_BYTES + self._body_bytes + tag

    def packed(self, node: int, step: int, index: Indices) -> bytes:
        """Return a packet of whole numbers, each from 0 to 2^bits - 1."""
        sizes = 2 ** np.array(self.bits, dtype=np.int64)
        if index.shape != sizes.shape or np.any((index < 0) | (index >= sizes)):
            raise DataError(
                f"packet of node {node}, step {step}: expected {len(self.bits)} indices of "
                f"{self.bits} bits, got {index.tolist()}"
            )
        if self.keystream:
            index = self.keystream.hidden(index, node=node, step=step, bits=self.bits)
        number = 0
        for one, bits in zip(index.tolist(), self.bits, strict=True):
            number = number << bits | one
        body = number.to_bytes(self._body_bytes, "big")
        message = node.to_bytes(1, "big") + step.to_bytes(4, "big") + body
        return message + (self.keystream.tag(message) if self.keystream else b"")

    def unpacked(self, packet: bytes) -> tuple[int, int, Indices]:
        """Return node, step and indices.

        Raises :class:`DataError` for a packet of another length, :class:`NotAuthenticError` for one
        whose tag does not fit.
        """
        if len(packet) != self.n_bytes:
            raise DataError(f"packet: expected {self.n_bytes} bytes, got {len(packet)}")
        if self.keystream:
            cut = len(packet) - self.keystream.tag_bytes
            packet, tag = packet[:cut], packet[cut:]
            if not self.keystream.is_authentic(packet, tag):
                raise NotAuthenticError(
                    f"packet of node {packet[0]}: its tag does not fit; is it of another key?"
                )
        node, step = packet[0], int.from_bytes(packet[1:HEADER_BYTES], "big")
        number = int.from_bytes(packet[HEADER_BYTES:], "big")
        found = []
        for bits in reversed(self.bits):
            found.append(number & (2**bits - 1))
            number >>= bits
        index = np.array(found[::-1], dtype=np.int64)
        if self.keystream:
            index = self.keystream.shown(index, node=node, step=step, bits=self.bits)
        return node, step, index


def unsigned(index: Indices, bits: int) -> Indices:
    """Return signed indices as whole numbers from 0 to 2^bits - 1."""
    return np.asarray(index % 2**bits)


def signed(index: Indices, bits: int) -> Indices:
    """Return what :func:`unsigned` was given."""
    half = 2 ** (bits - 1)
    return np.asarray((index + half) % 2**bits - half)
