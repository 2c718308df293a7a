"""A study's arithmetic on a table made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2, t

from benchmarks.study_report import interval, markdown, number
from benchmarks.study_runs import Run
from benchmarks.study_summary import summarise
from ssm_graph.evaluation import Interval


def a_run(method: str, seed: int, rms: float, *, status: str = "CONVERGED", **more: float) -> Run:
    """Return a run of sparse10."""
    return Run(
        "sparse10",
        "TACTICAL",
        method,
        seed,
        status,
        "",
        iterations=4 + seed,
        build_s=0.5,
        solve_s=1.0 + seed,
        n_epochs=100 * (seed + 1),
        rms_horizontal_m=rms,
        nees_final=0.5 + seed,
        inside_east=1.0 - 0.1 * seed,
        inside_north=1.0,
        inside_up=1.0,
        n_large_outliers=10 * (seed + 1),
        n_large_rejected=10 + 9 * seed,
        good_weight=1.0 + 0.02 * seed,
        **more,
    )


RUNS = [
    a_run("oracle", 0, 1.0),
    a_run("oracle", 1, 3.0),
    a_run("oracle", 2, 5.0),
    a_run("log:5", 0, 1.2),
    a_run("log:5", 1, 3.0),
    Run("sparse10", "TACTICAL", "log:5", 2, "FAILED", "elimination failed"),
]


def test_rows_keep_order_and_count_failures() -> None:
    """A failed run counts, and is in no mean."""
    oracle, log = summarise(RUNS)
    assert (oracle.method, oracle.n_runs, oracle.n_failed) == ("oracle", 3, 0)
    assert (log.method, log.n_runs, log.n_failed) == ("log:5", 3, 1)
    assert log.statuses == "2 CONVERGED, 1 FAILED"
    assert log.iterations == 4.5
    assert log.seconds == 2.0


def test_mean_has_students_interval() -> None:
    """Two runs: one degree of freedom."""
    log = summarise(RUNS)[1].rms_horizontal_m
    half = t.ppf(0.975, 1) * np.std([1.2, 3.0], ddof=1) / math.sqrt(2.0)
    assert (log.value, log.low, log.high) == pytest.approx((2.1, 2.1 - half, 2.1 + half))


def test_ratio_is_of_the_same_runs() -> None:
    """The oracle's third run, which log failed, does not count."""
    oracle, log = summarise(RUNS)
    assert oracle.ratio == Interval(1.0, 1.0, 1.0)
    assert log.ratio.value == pytest.approx(4.2 / 4.0)
    assert (log.ratio.low, log.ratio.high) == pytest.approx((1.0, 1.2))


def test_shares_are_pooled() -> None:
    """Longer runs count more, for epochs and for outliers."""
    log = summarise(RUNS)[1]
    assert log.inside == pytest.approx(((100 * 1.0 + 200 * 0.9) / 300.0, 1.0, 1.0))
    assert log.n_large_outliers == 30
    assert log.rejected == pytest.approx(29.0 / 30.0)
    assert log.good_weight == pytest.approx(1.01)


def test_nees_is_judged_by_the_number_of_runs() -> None:
    """The interval is that of as many independent runs as finished."""
    oracle, log = summarise(RUNS)
    assert (oracle.nees_final.value, log.nees_final.value) == (1.5, 1.0)
    for row, n in ((oracle, 3), (log, 2)):
        expected = chi2.ppf([0.025, 0.975], 3 * n) / (3 * n)
        assert (row.nees_final.low, row.nees_final.high) == pytest.approx(tuple(expected))
    assert oracle.is_consistent


def test_method_that_always_fails_has_a_row() -> None:
    """And no numbers."""
    (row,) = summarise([RUNS[-1]])
    assert row.n_failed == row.n_runs == 1
    assert math.isnan(row.ratio.value)
    assert math.isnan(row.rms_horizontal_m.value)
    text = markdown([row], title="t", command="c", code="1", seeds="s")
    assert "| log:5 | 1 | 1 | – | – | – |" in text


def test_report_says_how_it_was_made() -> None:
    """Title, command and version come first, then a table for each case and grade."""
    text = markdown(
        summarise(RUNS), title="A study", command="python x.py", code="0.1+ab", seeds="seeds 0 to 2"
    )
    assert text.startswith("# A study\n\n    python x.py\n\nssm-graph 0.1+ab, gtsam ")
    assert "## sparse10, tactical" in text
    assert "| log:5 | 3 | 1 | 2.100 [" in text


def test_numbers_are_short() -> None:
    """Three decimals, or three digits; infinite intervals stay out."""
    assert [number(x) for x in (0.1234, 12.345, 1234.5, math.nan)] == [
        "0.123",
        "12.3",
        "1.23e+03",
        "–",
    ]
    assert interval(Interval(1.0, -math.inf, math.inf)) == "1.000"
