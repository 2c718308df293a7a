"""The log of events: what repeats itself is counted, what fails is noted, nothing grows."""

from __future__ import annotations

import pytest

from ssm_graph.mission.events import MOST, QUIET_S, EventLog
from ssm_graph.mission.navigation import Severity


class Clocks:
    """A wall clock and one that is never set."""

    def __init__(self) -> None:
        self.wall, self.steady = 1e9, 50.0

    def log(self) -> EventLog:
        """Return a log that goes by them."""
        return EventLog(lambda: self.wall, lambda: self.steady)


def texts(log: EventLog) -> list[str]:
    """Return what is taken."""
    return [event.text for event in log.take()]


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_one_of_a_kind_is_told_and_the_others_counted(direction: float) -> None:
    """By the time of the data, forwards or set back."""
    log = EventLog()
    for elapsed_s in (0.0, 1.0, 0.999 * QUIET_S, QUIET_S):
        log.tell(100.0 + direction * elapsed_s, Severity.WARNING, "gap", f"at {elapsed_s:g}")
    log.tell(100.0, Severity.INFO, "other", "another kind")
    assert texts(log) == ["at 0", f"at {QUIET_S:g} (and 2 more since)", "another kind"]
    assert log.take() == ()


def test_a_burst_is_told_and_no_more_within_ten_seconds() -> None:
    """However the wall clock is set meanwhile; another place has a burst of its own."""
    clocks = Clocks()
    log = clocks.log()
    for k in range(8):
        clocks.wall -= 3600.0
        clocks.steady += 0.5
        log.note("dvl", "refused", f"{k}", Severity.WARNING, burst=3)
    log.note("imu", "refused", "x", Severity.WARNING)
    assert texts(log) == ["dvl: 0", "dvl: 1", "dvl: 2", "imu: x"]
    clocks.steady += QUIET_S
    log.note("dvl", "refused", "8", Severity.WARNING, burst=3)
    (event,) = log.take()
    assert event.text == "dvl: 8 (and 5 more since)"
    assert (event.time_s, event.severity, event.kind) == (clocks.wall, Severity.WARNING, "refused")


def test_a_defect_is_survived_and_says_where() -> None:
    """Untold ones are counted as errors too; what is no exception of a defect goes on."""
    log = Clocks().log()
    for _ in range(3):
        with log.surviving("estimator", "estimator_failed"):
            raise ValueError("a defect")
    (event,) = log.take()
    assert event.text.startswith("estimator: ValueError: a defect (")
    assert "test_event_log.py:" in event.text
    assert (event.severity, log.n_errors) == (Severity.ERROR, 3)
    with pytest.raises(KeyboardInterrupt), log.surviving("estimator", "estimator_failed"):
        raise KeyboardInterrupt


def test_the_oldest_go_where_nobody_takes_them() -> None:
    """So many are kept."""
    log = EventLog()
    for k in range(MOST + 5):
        log.tell(0.0, Severity.INFO, f"kind_{k}", f"{k}")
    kept = texts(log)
    assert (len(kept), kept[0], kept[-1]) == (MOST, "5", f"{MOST + 4}")
