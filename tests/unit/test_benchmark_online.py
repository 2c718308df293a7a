"""What the benchmark of the live estimator measures and prints."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.online_report import (
    ACCURACY,
    growth,
    lag_lines,
    log_lines,
    percentiles_ms,
    setting_lines,
    stream_lines,
    verdict_lines,
)
from benchmarks.online_stream import Accuracy
from benchmarks.online_tasks import (
    LogRow,
    SettingRow,
    StreamRun,
    stream_ours,
    stream_theirs,
    survey,
)
from benchmarks.online_theirs import Kind, TheirConfig, run_theirs
from ssm_graph.live.estimator import ONLINE

DURATION_S = 6.0


def made_up(name: str, scale: float, *, hours: float = 1.0) -> StreamRun:
    """Return a run whose latencies are 1 to 10 ms times ``scale``, over and over."""
    time_s = np.arange(0.0, 3600.0 * hours, 1.0)
    latency_s = np.asarray(scale * 1e-3 * (1.0 + time_s % 10.0))
    accuracy = Accuracy(*[scale] * len(ACCURACY))
    parts = {"part": latency_s}
    return StreamRun(
        name, time_s, latency_s, latency_s, parts, accuracy, accuracy, (1.0, 2.0), 1.0, ""
    )


def test_ours_answers_after_every_ping() -> None:
    """At 5 Hz every ping that is covered has a keyframe and a latency of its own."""
    run = stream_ours(DURATION_S, 0, 5.0, ONLINE)
    late = run.keyframe_s[run.keyframe_s > 1.5]
    np.testing.assert_allclose(late, 1.65 + 0.2 * np.arange(len(late)), atol=1e-9)
    assert late[-1] == pytest.approx(5.85)
    assert np.all(run.latency_s > 0.0)
    assert np.all(run.cpu_s > 1e-4)
    assert 0.0 < run.newest.velocity < 100.0
    assert 0.0 < run.delayed.horizontal < 2.0
    assert run.rss_mb[0] > 10.0


@pytest.mark.parametrize("kind", list(Kind))
def test_theirs_sees_the_same_keyframes(kind: Kind) -> None:
    """GTSAM's smoothers take them all and come out where ours does."""
    config = TheirConfig(kind, relinearize_skip=1, max_iterations=3)
    run = stream_theirs(DURATION_S, 0, 5.0, config, np.inf)
    np.testing.assert_allclose(run.keyframe_s, 0.2 * np.arange(1, 30), atol=1e-9)
    assert run.remark == ""
    assert 0.0 < run.newest.velocity < 200.0
    assert np.isfinite(run.newest.nees_velocity) == (kind is Kind.INCREMENTAL)


def test_theirs_stops_when_time_is_out() -> None:
    """What there was until then counts."""
    mission = survey(DURATION_S, dvl_hz=5.0, seed=0).mission
    run = run_theirs(mission, TheirConfig(), most_wall_s=0.0)
    assert "out of time" in run.failure
    assert len(run.update_s) == 1


def test_growth_finds_a_slope() -> None:
    """A latency that doubles is seen, a constant one is not; a short run cannot tell."""
    time_s = np.arange(0.0, 3600.0, 1.0)
    noise = np.random.default_rng(0).uniform(0.5, 1.5, size=len(time_s))
    steady = growth(time_s, noise, begin_s=60.0)
    rising = growth(time_s, noise * (1.0 + time_s / 3600.0), begin_s=60.0)
    assert steady is not None
    assert rising is not None
    assert 1.0 in steady
    assert rising.low > 1.5
    assert growth(time_s[:300], noise[:300], begin_s=60.0) is None


def test_percentiles_leave_out_what_was_not_timed() -> None:
    """NaN is no time; nothing timed is NaN."""
    assert percentiles_ms(np.array([0.001, np.nan, 0.003])) == pytest.approx((2.0, 2.98, 3.0))
    assert np.isnan(percentiles_ms(np.full(3, np.nan))).all()


def test_report_compares_with_the_fastest() -> None:
    """Ratios are to ours in the table, and of ours to the fastest of theirs in the verdict."""
    runs = [made_up("ours", 2.0), made_up("fast", 1.0), made_up("slow", 8.0)]
    text = "\n".join(verdict_lines(runs, runs[0], lag_s=30.0))
    assert "Fastest of theirs: fast. Our median is 2.00 times its (met" in text
    assert "99th percentile 20.0 ms" in text
    assert "2.00 times in horizontal position (MISSED" in text
    lines = stream_lines(runs)
    assert any(
        line.startswith("| slow | 3600 | 44.0 | 80.0 | 80.0 | 4.00 | 4.00 |") for line in lines
    )
    others = [("ekf", runs[0].newest), ("batch", runs[1].newest)]
    assert sum("delayed" in line for line in lag_lines(runs, others)) == 3


def test_tables_of_settings_and_logs() -> None:
    """Means over missions with ratios to the first setting; NaN is a dash."""
    rows = [
        SettingRow("TACTICAL", seed, name, Accuracy(*[x * (1 + seed)] * 6), 1.0)
        for seed in range(3)
        for name, x in (("a", 1.0), ("b", 2.0))
    ]
    lines = setting_lines(rows, ["TACTICAL"], ["a", "b"])
    assert any(line.startswith("| b | 4 ± ") and "2.000 (2.000 to 2.000)" in line for line in lines)
    log = LogRow("log_auto_square_x", "live", np.nan, 1.0, 7, "")
    assert log_lines([log])[-2] == "| log_auto_square_ | live | – | 1 | 7 | – |"
