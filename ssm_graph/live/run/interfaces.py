"""What a live run is made of, as far as it has to know: estimator, source, connections."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from ssm_graph.base.frozen import Array
from ssm_graph.live.sockets.publisher import Outlet
from ssm_graph.mission.estimate import BeamTable, CurrentTrack, Found, Trajectory
from ssm_graph.mission.navigation import Event, Health, Navigation
from ssm_graph.mission.run_status import SourceStatus
from ssm_graph.sensors.messages import Message


class Delayed(Protocol):
    """Successive states that nothing will change any more."""

    @property
    def trajectory(self) -> Trajectory: ...  # noqa: D102
    @property
    def beams(self) -> BeamTable: ...  # noqa: D102
    @property
    def current(self) -> CurrentTrack | None: ...  # noqa: D102


class Estimator(Protocol):
    """What is run: `ssm_graph.live.estimator.FixedLagSmoother`, or a stand-in for it."""

    def push(self, message: Message) -> None: ...  # noqa: D102
    def newest(self) -> Navigation | None: ...  # noqa: D102
    def found(self) -> Found: ...  # noqa: D102
    def status(self) -> tuple[Health, str]: ...  # noqa: D102
    def take_events(self) -> Sequence[Event]: ...  # noqa: D102
    def take_delayed(self) -> Sequence[Delayed]: ...  # noqa: D102
    def finish(self) -> Sequence[Delayed]: ...  # noqa: D102
    def checkpoint(self) -> tuple[Mapping[str, Array], Mapping[str, Any]]: ...  # noqa: D102


class Engine(NamedTuple):
    """How an estimator is made."""

    new: Callable[[], Estimator]
    restore: Callable[[Mapping[str, Array], Mapping[str, Any]], Estimator]
    """From the arrays and the meta values of a checkpoint."""


class Source(Protocol):
    """Where messages come from."""

    @property
    def is_finished(self) -> bool: ...  # noqa: D102
    @property
    def time_s(self) -> float: ...  # noqa: D102
    @property
    def elapsed_s(self) -> float: ...  # noqa: D102
    def poll(self, timeout_s: float) -> list[Message]: ...  # noqa: D102
    def take_events(self) -> list[Event]: ...  # noqa: D102
    def source_status(self) -> tuple[SourceStatus, ...]: ...  # noqa: D102


class Connections(NamedTuple):
    """What a run is connected with."""

    source: Source
    outlet: Outlet


Connect = Callable[[int], Connections]
"""Opens the connections, told how many messages earlier processes of the run were given."""
