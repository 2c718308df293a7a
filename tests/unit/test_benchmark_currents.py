"""What the benchmark of currents measures and prints."""

from __future__ import annotations

import math

import pytest

from benchmarks import currents
from benchmarks.currents import GROUND, KNOWN, Row, report, runs
from ssm_graph.simulation import Grade


def test_rows_are_judged_by_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two minutes of every kind: who has no current says nothing of it."""
    monkeypatch.setattr(currents, "LOCK_S", 20.0)
    monkeypatch.setattr(currents, "LOSS_S", 80.0)
    methods = (GROUND, "2 beams", KNOWN)
    monkeypatch.setattr(currents, "MISSIONS", (("random", True, methods), ("tide", False, methods)))
    rows = list(runs([Grade.INDUSTRIAL], [0]))
    assert [row.method for row in rows] == [*methods, *methods]
    for ground, water, known in (rows[:3], rows[3:]):
        assert max(known.velocity, water.velocity) < ground.velocity
        assert math.isnan(ground.current)
        assert math.isnan(known.current)
        assert 0.0 < water.current < 0.5
        assert 0.0 < water.nees_current < 20.0


def test_report() -> None:
    """Ratios are over the runs without water track of the same kind and seeds."""
    kind = "random, lock regained"
    rows = [
        Row("tactical", kind, method, seed, metres, 0.1, 1.0, current, 1.0, "CONVERGED")
        for method, metres, current in ((GROUND, 10.0, math.nan), ("4 beams", 5.0, 0.02))
        for seed in range(3)
    ]
    rows[-1] = rows[-1]._replace(status="SUSPECT")
    lines = report(rows)
    assert lines[0] == "## tactical, random, lock regained"
    ground, water = (line.split(" | ") for line in lines[4:6])
    assert ground[1:4] == ["3", "10 [10, 10]", "1.000 [1.000, 1.000]"]
    assert ground[7] == "–"
    assert water[3] == "0.500 [0.500, 0.500]"
    assert water[7] == "20 [20, 20]"
    assert water[-1] == "2 CONVERGED of 3 |"
