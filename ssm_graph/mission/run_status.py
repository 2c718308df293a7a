"""How the live estimator and its connections are doing, for people."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import Self

import numpy as np

from ssm_graph.mission.estimate import Found
from ssm_graph.mission.navigation import Event, Navigation


class LinkState(Enum):
    """What a source is doing; the text is shown to the user."""

    CONNECTING = "connecting"
    CONNECTED = "connected"
    WAITING = "waiting"
    LISTENING = "listening"
    SILENT = "silent"
    REPLAYING = "replaying"
    DONE = "done"


@dataclass(frozen=True, slots=True)
class SourceStatus:
    """One source."""

    name: str
    address: str
    state: LinkState
    n_bytes: int = 0
    n_messages: int = 0
    """Passed on."""
    n_refused: int = 0
    """By the decoder, or for another clock."""
    n_limited: int = 0
    """Above the message rate, left out."""
    n_reconnects: int = 0
    rate_hz: float = 0.0
    """Messages passed on in the last whole second."""
    age_s: float = math.inf
    """Since the last message; infinite before the first."""
    altitude_m: float = math.nan
    """Above the ground, by its last report, m; NaN where it does not say."""


@dataclass(frozen=True, slots=True)
class OutputStatus:
    """One output."""

    name: str
    address: str
    n_clients: int
    """Of a server; 1 where there are no connections."""
    n_sent: int
    n_dropped: int
    """Answers that could not be sent, and clients that were too slow."""


@dataclass(frozen=True, slots=True)
class Latency:
    """Time from the arrival of messages to the answer that has them, of the last 1000, s."""

    median_s: float
    p99_s: float
    max_s: float

    @classmethod
    def of(cls, latencies_s: Collection[float]) -> Self | None:
        """Return that of single ones, None for none."""
        if not latencies_s:
            return None
        return cls(*np.percentile(np.array(list(latencies_s)), [50, 99, 100]).tolist())


@dataclass(frozen=True, slots=True)
class RunStatus:
    """Everything that a person on watch wants to see at once."""

    vehicle: str
    folder: str
    elapsed_s: float
    n_messages: int
    """Given to the estimator, those of earlier processes of this run too."""
    navigation: Navigation | None
    reason: str
    """Of its health; before there is an answer, what is waited for."""
    latency: Latency | None = None
    sources: tuple[SourceStatus, ...] = ()
    outputs: tuple[OutputStatus, ...] = ()
    events: tuple[Event, ...] = ()
    """The last ones, newest last."""
    log_problem: str | None = None
    checkpoint_age_s: float = math.inf
    """Data time since the last one; infinite before the first."""
    found: Found = Found()
    """What is known beside the state of the vehicle."""
    note: str = ""
    """What is going on besides: recovering, stopping."""
