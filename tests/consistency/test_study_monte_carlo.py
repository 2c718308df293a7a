"""Short Monte-Carlo runs: consistent on clean missions, close to the oracle on bad ones."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.evaluation.statistics import chi2_interval, paired_ratio
from ssm_graph.simulation import Grade, OutlierKind, Outliers
from ssm_graph.study.cells import Cell
from ssm_graph.study.jobs import Job, do_job
from ssm_graph.study.scoring import Row

SEEDS = tuple(range(8))
CLEAN = Cell("clean", "survey", 240.0)
SPARSE = Cell("sparse10", "survey", 240.0, Outliers(OutlierKind.SPARSE, 0.1))
ONE_BEAM = Cell("one_beam50", "survey", 240.0, Outliers(OutlierKind.ONE_BEAM, 0.5))


def runs_of(cell: Cell, grade: Grade, *methods: str) -> dict[str, list[Row]]:
    """Return the runs of every method."""
    rows = do_job(Job("test", cell, grade, SEEDS, methods)).rows.values()
    return {name: [row for row in rows if row["method"] == name] for name in methods}


def values(rows: list[Row], column: str) -> list[float]:
    """Return a column of numbers."""
    return [float(row[column]) for row in rows]


@pytest.mark.slow
@pytest.mark.parametrize("grade", [Grade.NAVIGATION, Grade.MEMS])
def test_clean_missions_are_consistent(grade: Grade) -> None:
    """Least squares on Gaussian errors: NEES of the last epoch within its chi-square interval."""
    runs = runs_of(CLEAN, grade, "smoother-gaussian")["smoother-gaussian"]
    assert {row["status"] for row in runs} == {"CONVERGED"}
    nees = float(np.mean(values(runs, "nees_position_final")))
    assert nees in chi2_interval(3, len(runs), confidence=0.999)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cell", "grade"),
    [(SPARSE, Grade.TACTICAL), (ONE_BEAM, Grade.NAVIGATION)],
    ids=lambda value: getattr(value, "case", value),
)
def test_log_is_near_the_oracle(cell: Cell, grade: Grade) -> None:
    """The full study, with its tighter limit, is benchmarks/results/targets.md."""
    runs = runs_of(cell, grade, "oracle", "smoother-log", "smoother-gaussian")
    told, log, gaussian = (values(rows, "horizontal_rms_m") for rows in runs.values())
    rng = np.random.default_rng(0)
    assert {row["status"] for row in runs["smoother-log"]} == {"CONVERGED"}
    assert paired_ratio(log, told, rng).value < 1.15
    assert paired_ratio(gaussian, told, rng).low > 3.0
    assert min(values(runs["smoother-log"], "outliers_rejected")) >= 0.99
    for weight in values(runs["smoother-log"], "good_weight"):
        assert 0.95 < weight < 1.10
