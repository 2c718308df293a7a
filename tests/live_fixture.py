"""Stand-ins for everything around the loop of a live run: estimator, source, outlet."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.live.run.run_folder import RunFolder
from ssm_graph.live.run.runner import Connections, Engine
from ssm_graph.live.sockets.outputs import OutputFormat
from ssm_graph.mission.estimate import (
    BeamTable,
    CurrentTrack,
    Found,
    ProtectionTrack,
    Trajectory,
)
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.mission.run_status import LinkState, OutputStatus, SourceStatus
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message, Readings
from tests.mission_fixture import make_mission

LAG = 3
"""Pings that a stand-in holds back."""


class Delayed(NamedTuple):
    """States that nothing will change any more."""

    trajectory: Trajectory
    beams: BeamTable
    current: CurrentTrack | None = None
    protection: ProtectionTrack | None = None


class FakeEstimator:
    """Its answer is a digest of all messages in their order; a ping is a state."""

    def __init__(self) -> None:
        self.digest = "0" * 64
        self.time_s, self.n_pushed = 0.0, 0
        self.pings: list[float] = []
        self._settled: list[tuple[float, str]] = []
        self._events: list[Event] = []

    def push(self, message: Message) -> None:
        """Take one message."""
        self.n_pushed += 1
        text = f"{self.digest} {type(message).__name__} {message}"
        self.digest = hashlib.sha256(text.encode()).hexdigest()
        self.time_s = message.time_s
        if isinstance(message, Ping):
            self.pings.append(message.time_s)
            self._settled += [(time_s, self.digest) for time_s in self.pings[:-LAG]]
            self.pings = self.pings[-LAG:]
            if self.n_pushed % 10 < 3:
                text = f"digest {self.digest[:8]}"
                self._events.append(Event(message.time_s, Severity.INFO, "ping", text))

    def newest(self) -> Navigation | None:
        """Return an answer once there is a ping."""
        return a_navigation(self.time_s, number(self.digest)) if self.pings else None

    def status(self) -> tuple[Health, str]:
        """Return what is waited for."""
        return Health.ALIGNING, "waiting for a ping"

    def take_events(self) -> Sequence[Event]:
        """Return what happened since the last call."""
        taken, self._events = self._events, []
        return taken

    def found(self) -> Found:
        """Return nothing: it knows the state alone."""
        return Found()

    def take_delayed(self) -> Sequence[Delayed]:
        """Return what is settled."""
        taken, self._settled = self._settled, []
        return [delayed(taken)] if taken else []

    def finish(self) -> Sequence[Delayed]:
        """Return everything."""
        self._settled += [(time_s, self.digest) for time_s in self.pings]
        self.pings = []
        return self.take_delayed()

    def checkpoint(self) -> tuple[Mapping[str, Array], Mapping[str, Any]]:
        """Return the state."""
        meta = {"digest": self.digest, "time_s": self.time_s, "n_pushed": self.n_pushed}
        return {"pings": np.array(self.pings)}, meta

    @classmethod
    def restore(cls, arrays: Mapping[str, Array], meta: Mapping[str, Any]) -> FakeEstimator:
        """Return the estimator of a checkpoint."""
        found = cls()
        found.digest, found.time_s = meta["digest"], meta["time_s"]
        found.n_pushed = meta["n_pushed"]
        found.pings = arrays["pings"].tolist()
        return found


FAKE = Engine(FakeEstimator, FakeEstimator.restore)


class ListSource:
    """Messages, so many at each poll; ``crash_after`` ends the process without a word."""

    def __init__(
        self, messages: Iterable[Message], *, batch: int = 7, crash_after: int | None = None
    ) -> None:
        self._messages, self._batch, self._crash_after = list(messages), batch, crash_after
        self._n_given = 0
        self.time_s = self.elapsed_s = 0.0
        self.events: list[Event] = []
        self.last_events: list[Event] = []

    @property
    def is_finished(self) -> bool:
        """Whether all were given."""
        return self._n_given >= len(self._messages)

    def waiting(self) -> list[Readings]:
        """Return what has come and waits: nothing."""
        return []

    def end(self) -> list[Message]:
        """Return what waits at the end, and tell of it: a test may want something to happen."""
        self.events, self.last_events = [*self.events, *self.last_events], []
        return []

    def poll(self, timeout_s: float) -> list[Message]:  # noqa: ARG002
        """Return the next ones."""
        if self._crash_after is not None and self._n_given >= self._crash_after:
            raise Crash
        taken = self._messages[self._n_given : self._n_given + self._batch]
        self._n_given += len(taken)
        self.time_s = taken[-1].time_s
        self.elapsed_s = self.time_s - self._messages[0].time_s
        return taken

    def take_events(self) -> list[Event]:
        """Return what a test wants to happen."""
        taken, self.events = self.events, []
        return taken

    def source_status(self) -> tuple[SourceStatus, ...]:
        """Return how far it is."""
        return (SourceStatus("list", "", LinkState.REPLAYING, n_messages=self._n_given),)


class Crash(BaseException):
    """The end of a process."""


class Recorder:
    """Takes answers."""

    set_by_s = 0.0
    is_behind = False

    def __init__(self, *forms: OutputFormat) -> None:
        self.forms = forms or tuple(OutputFormat)
        self.sent: list[tuple[OutputFormat, bytes]] = []

    def wants(self, form: OutputFormat) -> bool:
        """Return whether a test wants it."""
        return form in self.forms

    def send(self, form: OutputFormat, data: bytes) -> None:
        """Keep it."""
        self.sent.append((form, data))

    def output_status(self) -> tuple[OutputStatus, ...]:
        """Return how many came."""
        return (OutputStatus("recorder", "", 1, len(self.sent), 0),)


def connect(source: ListSource, outlet: Recorder | None = None) -> Any:
    """Return what opens the connections; a source that was told of goes on where it was."""

    def opened(n_messages: int) -> Connections:
        source._n_given = n_messages
        return Connections(source, outlet or Recorder())

    return opened


def some_messages(n: int = 400) -> list[Message]:
    """Return inertial samples at 20 Hz and pings at 5 Hz."""
    found: list[Message] = []
    for k in range(n):
        time_s = 0.05 * (k + 1)
        found.append(ImuSample(time_s, (0.001 * k, 0.0, 0.1), (0.0, 0.0, -9.8 - 1e-3 * k)))
        if k % 4 == 3:
            found.append(Ping(time_s - 0.01, (0.1, -0.2, 0.3, 1e-3 * k)))
    return found


def vehicle() -> Vehicle:
    """Return the vehicle of the example."""
    return vehicle_of(make_mission())


def run_folder(path: Path, **settings: Any) -> RunFolder:
    """Return the folder of a run with these settings."""
    return RunFolder(path, vehicle(), {"lag_s": 3.0, **settings})


def delayed(settled: Sequence[tuple[float, str]]) -> Delayed:
    """Return states that depend on all that was before."""
    n, times = len(settled), np.array([time_s for time_s, _ in settled])
    one = np.array([number(digest) for _, digest in settled])
    vector = np.tile(one[:, None], (1, 3))
    trajectory = Trajectory(
        times,
        one,
        one,
        one,
        velocity_enu=vector,
        roll_pitch_heading=vector,
        gyro_bias=vector,
        accel_bias=vector,
        position_cov_enu=np.tile(np.eye(3), (n, 1, 1)),
        velocity_sigma_enu=vector,
        attitude_sigma=vector,
        n_beams=np.full(n, 4.0),
    )
    return Delayed(trajectory, BeamTable(times, np.ones(n), one, one, one))


def number(digest: str) -> float:
    """Return a number from 0 to 1."""
    return int(digest[:8], 16) / 2.0**32


def a_navigation(time_s: float, value: float = 0.5, **changes: Any) -> Navigation:
    """Return an answer."""
    fields: dict[str, Any] = {
        "time_s": time_s,
        "lat": value,
        "lon": -value,
        "height": -20.0,
        "health": Health.GOOD,
        "reason": "all is well",
        "confidence": 0.9,
        "bottom_lock": True,
        "since_aid_s": 0.25,
        "latency_s": 0.002,
        "velocity_enu": np.array([1.0, -0.5, 0.01]),
        "roll_pitch_heading": np.radians([1.0, -2.0, 350.0]),
        "position_sigma_enu": np.array([0.3, 0.4, 0.05]),
        "velocity_sigma_enu": np.full(3, 0.01),
        "attitude_sigma": np.radians([0.02, 0.02, 0.5]),
        "gyro_bias": np.zeros(3),
        "accel_bias": np.zeros(3),
        "beam_weights": np.array([1.0, 0.6, 0.02, np.nan]),
        "protection_m": 2.5,
        "protection_up_m": 0.75,
        "innovation_ratios": {"DVL": 0.12, "GNSS": 0.7, "depth": 1.4},
    }
    return Navigation(**{**fields, **changes})
