"""What the benchmark of further aids measures and prints, on small missions."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from benchmarks.aids import (
    CASES,
    Case,
    Run,
    case_lines,
    results_of,
    run,
    simulated,
    unknown_beacon,
)
from factors.similarity import LogKernel


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_run_is_judged_by_the_truth(case: Case) -> None:
    """A minute of every kind, with and without the aid."""
    short = case._replace(config=dataclasses.replace(case.config, duration_s=60.0))
    sim = simulated(short, 0, 0.1)
    aided, without = (run(sim, LogKernel(), is_aided=is_aided) for is_aided in (True, False))
    assert math.isfinite(aided.nees)
    assert aided.horizontal_m < 3.0 * without.horizontal_m
    assert without.error == ()
    n_estimated = {"Compass": 5, "Ranges to one beacon whose place is not known": 3}
    assert len(aided.error) == n_estimated.get(case.name, 0)
    assert all(abs(error) < 5.0 for error in aided.error)


def test_every_way_is_taken_on_the_same_missions() -> None:
    """Without the aid, and with it by either kernel; without gross errors where there are none."""
    rest = CASES[-1]
    short = rest._replace(config=dataclasses.replace(rest.config, duration_s=20.0))
    results = results_of(short, 2)
    assert list(results) == ["without the aid", "gaussian", "log"]
    assert all(len(runs) == 2 for runs in results.values())


def test_the_unknown_beacon_is_another_in_every_run() -> None:
    """Drawn from what the mission states."""
    drawn = np.array([unknown_beacon(seed).stated_off for seed in range(200)])
    np.testing.assert_allclose(drawn.std(axis=0), (80.0, 80.0, 10.0), rtol=0.2)


def test_report() -> None:
    """Means, statuses and shares from made-up runs."""
    good = Run(1.0, 0.1, 1.0, "CONVERGED", (0.5, -2.9, 1.0))
    bad = Run(3.0, 0.3, 5.0, "SUSPECT", (0.5, -3.1, 1.0))
    text = "\n".join(case_lines(CASES[2], {"10 % gross errors, log": [good, bad]}))
    assert "| 10 % gross errors, log | 2 (" in text
    assert "| 1 / 1 |" in text
    assert "within 3 sigma in 1 of 2 runs, 83.33 % of 6 values" in text
    assert "largest error 3.1 sigma" in text
