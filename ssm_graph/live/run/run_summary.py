"""How a live run ended, and its ``summary.json``."""

from __future__ import annotations

from enum import Enum
from typing import Any, Final, NamedTuple

from ssm_graph.io.results.summary import as_json, calibration_fields, current_fields, versions
from ssm_graph.live.protocols.json_messages import navigation_fields
from ssm_graph.live.run.run_folder import LOG_NAME, RunFolder
from ssm_graph.mission.estimate import Found, Status
from ssm_graph.mission.navigation import Health, Navigation

MOST_FAILURES: Final = 100
"""Messages in a row that an estimator may fail at before the run is given up."""
_STATUS: Final = {
    Health.GOOD: Status.CONVERGED,
    Health.DEGRADED: Status.SUSPECT,
    Health.BAD: Status.DIVERGED,
    Health.ALIGNING: Status.SUSPECT,
}


class StopReason(Enum):
    """Why a run ended; the text is shown to the user."""

    SOURCE_ENDED = "all messages were given"
    ASKED = "it was asked to stop"
    DURATION = "its time was over"
    FAILED = f"the estimator failed at {MOST_FAILURES} messages in a row: a defect"


class RunEnd(NamedTuple):
    """How a run ended."""

    reason: StopReason
    navigation: Navigation | None
    """The last answer."""
    found: Found
    """What was known then beside it."""
    n_messages: int
    n_errors: int
    """Exceptions that nobody expected and the run survived."""


def summary_of(folder: RunFolder, end: RunEnd) -> dict[str, Any]:
    """Return how a run ended, in the terms of the summaries of other estimators."""
    navigation = end.navigation
    health = Health.ALIGNING if navigation is None else navigation.health
    status = _STATUS[health]
    summary: dict[str, Any] = {
        "mission": folder.vehicle.name,
        "method": "live fixed lag, delayed states",
        "kernel": folder.settings.get("kernel"),
        "status": status.name,
        "status_text": status.value,
        "is_good": status.is_good,
        "reason": health.value if navigation is None else navigation.reason,
        "ended": end.reason.value,
        "n_messages": end.n_messages,
        "raw_log": LOG_NAME,
        "newest": None if navigation is None else navigation_fields(navigation),
        "settings": folder.settings,
        "calibration": calibration_fields(end.found.calibration),
        "current": current_fields(end.found.current),
        "notes": [],
        "versions": versions(),
    }
    return {key: as_json(value) for key, value in summary.items()}
