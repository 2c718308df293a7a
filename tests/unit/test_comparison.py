"""Methods compared on tables made by hand and by chance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import t, wilcoxon

from ssm_graph.base.errors import DataError
from ssm_graph.evaluation.comparison import compare_methods
from ssm_graph.evaluation.statistics import (
    chi2_interval,
    holm,
    mean_with_interval,
    paired_difference,
    signed_rank,
)

RMS = "horizontal_rms_m"


def a_row(method: str, seed: int, rms: float, **more: object) -> dict[str, Any]:
    """Return one run of one case; only what is told is there."""
    return {
        "case": "sparse10",
        "grade": "TACTICAL",
        "kind": "sparse",
        "rate": 0.1,
        "duration_s": 1200.0,
        "seed": seed,
        "method": method,
        "status": "CONVERGED",
        "failed": 0,
        RMS: rms,
    } | more


def rows_of(method: str, rms: Any, **more: object) -> list[dict[str, Any]]:
    """Return runs with the seeds 0, 1, 2, ..."""
    return [a_row(method, seed, float(value), **more) for seed, value in enumerate(rms)]


def test_comparisons_use_common_seeds_only() -> None:
    """Seeds that only one of the methods has are in its mean, and in no comparison."""
    rows = rows_of("oracle", [1.0, 2.0, 3.0]) + rows_of("ssm-log", [1.5, 2.5, 4.5])
    rows += rows_of("ekf", [2.0, 3.0, 5.0, 1000.0, 1000.0])
    (cell,) = compare_methods(rows).cells
    measure = cell["ekf"].measures[RMS]
    assert measure.n == 5
    assert measure.mean.value == pytest.approx(402.0)
    assert measure.baseline.n_pairs == 3
    assert measure.baseline.difference.value == pytest.approx(0.5)
    assert measure.to_oracle.value == pytest.approx(10.0 / 6.0)
    assert measure.to_baseline.value == pytest.approx(10.0 / 8.5)
    assert measure.to_oracle.low <= measure.to_oracle.value <= measure.to_oracle.high


def test_best_is_chosen_over_common_seeds() -> None:
    """Easy missions that the other method never saw make no method the best."""
    rng = np.random.default_rng(3)
    hard = 10.0 + rng.normal(size=12)
    rows = rows_of("graph", hard) + rows_of(
        "ekf", [*(hard + 1.0 + 0.1 * rng.random(12)), *[0.1] * 50]
    )
    (cell,) = compare_methods(rows, baseline="graph").cells
    graph, ekf = (cell[name].measures[RMS] for name in ("graph", "ekf"))
    assert ekf.mean.value < graph.mean.value
    assert graph.is_leading
    assert not ekf.is_leading
    assert ekf.best.other == "graph"
    assert ekf.best.is_worse


def test_oracles_do_not_lead_and_equals_do() -> None:
    """The oracle is told too much; what differs by chance only shares the lead."""
    rng = np.random.default_rng(0)
    base = 2.0 + rng.random(20)
    rows = rows_of("oracle", 0.5 * base) + rows_of("ssm-log", base)
    rows += rows_of("same", base + 1e-3 * rng.normal(size=20)) + rows_of("worse", 2.0 * base)
    (cell,) = compare_methods(rows).cells
    leading = {r.method for r in cell.methods if r.measures[RMS].is_leading}
    assert leading == {"ssm-log", "same"}
    # Holm: the oracle is one of the three compared with the baseline, but not with the best.
    assert cell["worse"].measures[RMS].baseline.p_holm == pytest.approx(3.0 * 2.0**-19)
    assert cell["oracle"].measures[RMS].best.n_pairs == 0


def test_holm_by_hand() -> None:
    """Holm (1979): 4, 3, 2, 1 times the sorted p values, never falling, at most 1."""
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm([0.6, 0.7]), [1.0, 1.0])
    np.testing.assert_allclose(holm([0.02, np.nan, 0.03]), [0.04, np.nan, 0.04])
    assert len(holm([])) == 0


def test_holm_is_applied_within_a_cell() -> None:
    """The corrected values of a cell are Holm's of its own tests, the baseline left out."""
    rng = np.random.default_rng(4)
    base = rng.gamma(4.0, size=15)
    rows = rows_of("ssm-log", base)
    for i in range(4):
        rows += rows_of(f"m{i}", base + 0.3 * i + rng.normal(size=15))
    (cell,) = compare_methods(rows).cells
    pairs = [cell[f"m{i}"].measures[RMS].baseline for i in range(4)]
    np.testing.assert_allclose([p.p_holm for p in pairs], holm([p.p for p in pairs]))
    assert math.isnan(cell["ssm-log"].measures[RMS].baseline.p)


@pytest.mark.parametrize("n", [7, 30, 100])
def test_wilcoxon_agrees_with_scipy(n: int) -> None:
    """The p value is SciPy's own, through all of the bookkeeping by seed."""
    rng = np.random.default_rng(n)
    a, b = rng.gamma(4.0, size=n), rng.gamma(4.5, size=n)
    rows = rows_of("ssm-log", b) + list(reversed(rows_of("m", a)))
    paired = compare_methods(rows).cells[0]["m"].measures[RMS].baseline
    assert paired.p == pytest.approx(wilcoxon(a, b).pvalue)
    assert -1.0 <= paired.effect <= 1.0


def test_signed_rank_of_zeros_and_signs() -> None:
    """Equal results are no evidence; the effect tells the direction."""
    assert signed_rank([0.0, 0.0]).p == 1.0
    assert signed_rank([0.0, 0.0]).effect == 0.0
    assert signed_rank([1.0, 2.0, 3.0]).effect == 1.0
    assert signed_rank([-1.0, -2.0, 0.0]).effect == -1.0
    assert signed_rank([1.0, -2.0, 3.0]).effect == pytest.approx(1.0 / 3.0)
    rows = rows_of("ssm-log", [1.0, 2.0]) + rows_of("same", [1.0, 2.0])
    paired = compare_methods(rows).cells[0]["same"].measures[RMS].baseline
    assert (paired.p, paired.p_holm, paired.is_worse) == (1.0, 1.0, False)
    with pytest.raises(DataError, match="as many a as b"):
        paired_difference([1.0], [1.0, 2.0], other="b")


def test_intervals_cover_the_truth() -> None:
    """95 % intervals of mean and paired difference contain the true value in 95 % of studies."""
    rng = np.random.default_rng(5)
    n_studies, hits, paired_hits = 1000, 0, 0
    for _ in range(n_studies):
        shared = rng.normal(size=10)
        a, b = 5.0 + shared + rng.normal(size=10), 4.0 + shared + rng.normal(size=10)
        hits += 5.0 in mean_with_interval(a)
        paired_hits += 1.0 in mean_with_interval(a - b)
    # Four standard deviations of a binomial count.
    assert abs(hits - 950) < 28
    assert abs(paired_hits - 950) < 28


def test_interval_of_the_paired_difference_is_students() -> None:
    """Mean and standard error of the differences, not of the two methods."""
    rows = rows_of("ssm-log", [1.0, 5.0, 9.0]) + rows_of("m", [1.1, 5.3, 9.2])
    shown = compare_methods(rows).cells[0]["m"].measures[RMS].baseline.difference
    half = t.ppf(0.975, 2) * 0.1 / math.sqrt(3.0)
    assert shown.value == pytest.approx(0.2)
    assert shown.half_width == pytest.approx(half)


def test_failed_runs_are_counted_and_in_no_mean() -> None:
    """Whatever number a failed run left behind."""
    rows = rows_of("ssm-log", [1.0, 2.0, 3.0, 4.0]) + rows_of("m", [1.0, 2.0, 3.0])
    rows.append(a_row("m", 3, 1e9, failed=1, status="FAILED", error="singular"))
    rows += [a_row("dead", s, math.nan, failed="True", status="FAILED") for s in range(4)]
    (cell,) = compare_methods(rows).cells
    m, dead = cell["m"], cell["dead"]
    assert (m.n_runs, m.n_failed, m.measures[RMS].n) == (4, 1, 3)
    assert m.measures[RMS].mean.value == pytest.approx(2.0)
    assert m.measures[RMS].baseline.n_pairs == 3
    assert dict(m.failures) == {"singular": 1}
    assert dict(m.statuses) == {"CONVERGED": 3, "FAILED": 1}
    assert (dead.n_failed, dead.measures[RMS].n) == (4, 0)
    assert math.isnan(dead.measures[RMS].mean.value)
    assert not dead.measures[RMS].is_leading


def test_unknown_values_are_tolerated() -> None:
    """NaN, None, empty strings of a CSV and absent columns; a missing verdict is a failure."""
    rows = [
        a_row("ssm-log", 0, 1.0, wall_s="2.5", duration_s=math.nan),
        a_row("ssm-log", 1, math.nan, wall_s="", duration_s=float("nan")),
        a_row("ssm-log", 2, math.inf, wall_s=None, duration_s=None),
        a_row("ssm-log", 3, 2.0, failed=math.nan, duration_s=math.nan),
    ]
    (cell,) = compare_methods(rows).cells
    result = cell["ssm-log"]
    assert (result.n_runs, result.n_failed, result.measures[RMS].n) == (4, 1, 1)
    assert result.measures[RMS].mean.half_width == math.inf
    assert result.means["wall_s"] == 2.5
    assert math.isnan(result.means["good_weight"])
    assert math.isnan(result.nees_final.value)
    assert result.is_consistent


def test_no_oracle_no_ratio() -> None:
    """Nor a ratio to an oracle without common seeds, nor to a zero."""
    rows = rows_of("ssm-log", [1.0, 2.0]) + rows_of("m", [0.0, 1.0])
    rows.append(a_row("ekf-oracle", 7, 1.0))
    (cell,) = compare_methods(rows, baseline="m").cells
    measure = cell["ssm-log"].measures[RMS]
    assert math.isnan(measure.to_oracle.value)
    assert math.isnan(measure.to_filter_oracle.value)
    assert math.isnan(measure.to_baseline.value)
    assert measure.baseline.n_pairs == 2


def test_nees_has_the_bounds_of_its_number_of_runs() -> None:
    """The interval is where the mean should lie for the runs there are."""
    rows = rows_of("ssm-log", [1.0] * 20, nees_position_final=1.0)
    rows += rows_of("proud", [1.0] * 20, nees_position_final=2.0)
    (cell,) = compare_methods(rows).cells
    bounds = chi2_interval(3, 20)
    assert (cell["proud"].nees_final.low, cell["proud"].nees_final.high) == (
        bounds.low,
        bounds.high,
    )
    assert cell["ssm-log"].is_consistent
    assert not cell["proud"].is_consistent


def test_order_and_baseline() -> None:
    """First come, first told; durations are cells of their own."""
    rows = rows_of("z", [1.0]) + rows_of("a", [1.0]) + rows_of("z", [1.0], duration_s=60.0)
    comparison = compare_methods(rows)
    assert (comparison.baseline, comparison.methods) == ("z", ("z", "a"))
    assert [cell.duration_s for cell in comparison.cells] == [1200.0, 60.0]
    more = rows + rows_of("smoother-log", [1.0])
    assert compare_methods(more).baseline == "smoother-log"
    assert compare_methods(more + rows_of("ssm-log", [1.0])).baseline == "ssm-log"
    assert compare_methods(more, baseline="a").baseline == "a"
    assert repr(compare_methods(more)) == repr(compare_methods(more))


def test_refusals() -> None:
    """What cannot be compared is said."""
    rows = rows_of("z", [1.0])
    with pytest.raises(DataError, match="no rows"):
        compare_methods([])
    with pytest.raises(DataError, match="baseline 'y'"):
        compare_methods(rows, baseline="y")
    with pytest.raises(DataError, match="seed 0 of z twice"):
        compare_methods(rows + rows)


def test_equal_differences_share_their_rank() -> None:
    """Ranks 1, 2.5, 2.5, 4 of which the second is negative."""
    assert signed_rank([1.0, -2.0, 2.0, 3.0]).effect == pytest.approx(0.5)
