"""What the benchmark of the calibration measures and prints, on small missions."""

from __future__ import annotations

import numpy as np

from benchmarks.calibration import (
    LABELS,
    TRUTH,
    Run,
    time_lines,
    transit,
    transit_lines,
    turns,
    turns_lines,
)
from factors.similarity import LogKernel


def made_up(error: float, ratio: float) -> Run:
    """Return a run with the same error and ratio in all parameters."""
    n = len(LABELS)
    return Run(np.full(n, error), np.full(n, ratio), n * error**2, 1.1, 1.0, "CONVERGED")


def test_a_run_is_judged_by_the_truth() -> None:
    """Two minutes are enough to come near it, and as good as being told."""
    run = turns(0, LogKernel(), 0.1, duration_s=120.0)
    assert run.error.shape == run.ratio.shape == TRUTH.shape == (len(LABELS),)
    assert np.all(np.abs(run.error) < 5.0)
    assert run.nees < 40.0
    assert run.rms_m < 2.0 * run.rms_known_m
    straight = transit(0, with_gnss=False, duration_s=60.0)
    assert straight.ratio[0] > 0.8
    assert np.isnan(straight.rms_known_m)


def test_report() -> None:
    """Shares, intervals, ratio and colours from made-up runs."""
    text = "\n".join(turns_lines("made up", [made_up(1.0, 0.1), made_up(-4.0, 0.1)]))
    assert "all pooled: 50.00 % of 16" in text
    assert "NEES of the eight / 8: 8.500" in text
    assert "ratio 1.100" in text
    text = "\n".join(transit_lines("made up", [made_up(1.0, 0.9), made_up(-2.5, 0.9)]))
    assert "| dvl_scale_error | 0.900 | red | 2.50 |" in text
    seconds, passes = np.array([[4.0, 5.0], [5.0, 5.0]]), np.array([[6.0, 7.0], [6.0, 7.0]])
    text = "\n".join(time_lines(60.0, seconds, passes))
    assert "**1.125 times**, the median of pairs one after the other (1.250, 1.000)" in text
    assert "fastest to fastest 1.250" in text
