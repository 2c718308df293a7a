"""What decoders of framed traffic share: bytes to frames, frames to messages, the rest refused."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

from ssm_graph.live.protocols.decoder import Refusals, RefusedError
from ssm_graph.sensors.messages import Message


class Framer(Protocol):
    """Cuts a stream of bytes into texts, each of which may be a message."""

    def feed(self, data: bytes) -> list[str]:
        """Return the texts that these bytes complete."""
        ...

    @property
    def n_held(self) -> int:
        """Bytes held of an unfinished text."""
        ...


class FramedDecoder(ABC):
    """A :class:`~ssm_graph.live.protocols.decoder.Decoder` of texts that a framer cuts out."""

    _framer: Framer

    def __init__(self, place: str) -> None:
        """``place`` is how refusals call the source."""
        self._place = place
        self._refusals = Refusals()

    @property
    def n_held(self) -> int:
        """Bytes held of an unfinished text."""
        return self._framer.n_held

    @property
    def n_refused(self) -> int:
        """How much was refused so far."""
        return self._refusals.n_total

    def feed(self, data: bytes, *, arrival_s: float) -> list[Message]:
        """Return the messages that these bytes complete, and those that waited long enough."""
        messages: list[Message] = []
        for text in self._framer.feed(data):
            try:
                messages += self._decode(text, arrival_s)
            except RefusedError as error:
                self._refuse(str(error))
        return messages + self._overdue(arrival_s)

    def take_refusals(self) -> list[str]:
        """Return what was refused since the last call, a sentence each, and forget it."""
        return self._refusals.take()

    @abstractmethod
    def _decode(self, text: str, arrival_s: float) -> list[Message]:
        """Return the messages of one text; raise :class:`RefusedError` for what is none."""

    def _overdue(self, arrival_s: float) -> list[Message]:  # noqa: ARG002
        """Return messages that waited for others long enough; most protocols have none."""
        return []

    def _refuse(self, text: str) -> None:
        self._refusals.add(f"{self._place}: {text}")
