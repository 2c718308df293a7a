"""Answers on their way out, each form at its own rate."""

from __future__ import annotations

from typing import Final, Protocol

from ssm_graph.base.errors import ConfigError
from ssm_graph.live.protocols.json_messages import encode_navigation
from ssm_graph.live.protocols.nmea_encoder import encode_nmea
from ssm_graph.live.sockets.outputs import OutputFormat
from ssm_graph.mission.navigation import Navigation
from ssm_graph.mission.run_status import OutputStatus

_ROUNDING: Final = 1e-6
"""Of a period: sampling times are not exact."""


class Outlet(Protocol):
    """Takes answers as bytes; never waits."""

    def wants(self, form: OutputFormat) -> bool:
        """Return whether anybody listens to this form."""
        ...

    def send(self, form: OutputFormat, data: bytes) -> None:
        """Send one answer to everybody who listens to this form."""
        ...

    def output_status(self) -> tuple[OutputStatus, ...]:
        """Return how the outputs are doing."""
        ...


class Every:
    """Says when something is due again; a clock that was set begins anew."""

    def __init__(self, period_s: float, *, at_once: bool = False) -> None:
        self._period_s, self._at_once = period_s, at_once
        self._last_s: float | None = None

    def is_due(self, now_s: float) -> bool:
        """Return whether it is due now, and take it as done."""
        if self._last_s is None:
            self._last_s = now_s
            return self._at_once
        if abs(now_s - self._last_s) < self._period_s * (1.0 - _ROUNDING):
            return False
        self._last_s = now_s
        return True


class Publisher:
    """Sends the newest answer, in every form that somebody listens to.

    Parameters
    ----------
    rate_hz, nmea_rate_hz : JSON lines and NMEA sentences at most so often, by the vehicle's clock.
    geoid_separation_m : of the heights in NMEA sentences.
    """

    def __init__(
        self, *, rate_hz: float = 50.0, nmea_rate_hz: float = 1.0, geoid_separation_m: float = 0.0
    ) -> None:
        for name, rate in (("output rate", rate_hz), ("NMEA rate", nmea_rate_hz)):
            if not 0.0 < rate < float("inf"):
                raise ConfigError(f"{name}: expected a number above 0 Hz, got {rate}")
        self._geoid_separation_m = geoid_separation_m
        self._dues = {
            OutputFormat.JSON: Every(1.0 / rate_hz, at_once=True),
            OutputFormat.NMEA: Every(1.0 / nmea_rate_hz, at_once=True),
        }

    def due(self, outlet: Outlet, now_s: float) -> list[OutputFormat]:
        """Return the forms in which an answer is due and wanted."""
        return [
            form for form, every in self._dues.items() if outlet.wants(form) and every.is_due(now_s)
        ]

    def send(self, outlet: Outlet, form: OutputFormat, navigation: Navigation) -> None:
        """Send one answer in one form."""
        if form is OutputFormat.JSON:
            outlet.send(form, encode_navigation(navigation))
        else:
            separation_m = self._geoid_separation_m
            outlet.send(form, encode_nmea(navigation, geoid_separation_m=separation_m))
