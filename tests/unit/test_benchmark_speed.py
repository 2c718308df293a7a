"""What the benchmark of speed measures and prints."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.speed import FLOOR, OURS, PLAIN, comparison_lines, lengths_lines, verdict
from benchmarks.speed_tasks import (
    PlainStart,
    Timing,
    time_floor,
    time_ours,
    time_plain,
    write_mission,
)
from ssm_graph.smoothers.batch import SsmSmoother


def test_speed_times_all_three(tmp_path: Path) -> None:
    """Each part has a time, and the smoother is left as it was."""
    path = tmp_path / "mission.pickle"
    solve = SsmSmoother.solve
    write_mission(path, minutes=0.1, seed=0)
    ours, plain, floor = time_ours(path), time_plain(path), time_floor(path, 3)
    assert SsmSmoother.solve is solve
    assert ours.n_keyframes == plain.n_keyframes == 7
    assert floor.n_iterations == 3
    settled = time_plain(path, PlainStart.DEAD_RECKONING, 1e-9)
    assert settled.rms_horizontal_m == pytest.approx(plain.rms_horizontal_m, abs=0.01)
    assert all(seconds >= 0.0 for seconds in ours.parts.values())
    assert abs(ours.rms_horizontal_m - plain.rms_horizontal_m) < 0.5
    lines = "\n".join(comparison_lines(0.1, {OURS: ours, FLOOR: floor, PLAIN: plain}))
    assert "eliminate by QR" in lines
    assert "| 0.1 | 7 |" in "\n".join(lengths_lines({0.1: ours}))


def test_verdict_names_both_ratios() -> None:
    """Times of the whole, not of the passes."""
    timings = {
        name: Timing({"a": seconds, "b": seconds})
        for name, seconds in ((OURS, 2.0), (FLOOR, 1.0), (PLAIN, 300.0))
    }
    assert verdict(timings) == "150 times faster than (a); 2.00 times the floor (b)"
