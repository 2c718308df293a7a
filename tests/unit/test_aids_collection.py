"""The aids of a mission: found by their type, never changed, and said when missing or twice."""

from __future__ import annotations

import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.acoustic import UsblLog
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.standstill import Standstill


def test_logs_are_found_by_type_and_exchanged_in_place() -> None:
    """Those that are not there are None, or an error where they are needed."""
    heading, other = (HeadingLog(sigma, [0.0], [1.0]) for sigma in (0.1, 0.2))  # type: ignore[arg-type]
    stills = Standstill(0.0, 1.0), Standstill(2.0, 3.0)
    aids = Aids(None, heading, *stills)
    assert aids.get(HeadingLog) is aids[HeadingLog] is heading
    assert aids.all(Standstill) == stills
    assert aids.get(UsblLog) is None
    assert tuple(aids.having(other)) == (other, *stills)
    assert tuple(aids.having(stills[0])) == (heading, stills[0])
    assert aids.sections == ("[heading]", "[[standstill]]")
    assert not Aids()
    with pytest.raises(DataError, match="expected a UsblLog, got Aids"):
        aids[UsblLog]
    with pytest.raises(DataError, match="expected one Standstill, got 2"):
        aids.get(Standstill)
