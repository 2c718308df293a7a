"""Short Monte-Carlo runs: consistent on clean missions, close to the oracle on bad ones."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.study_cases import parse_method
from benchmarks.study_runs import Job, Run, do_job
from benchmarks.study_summary import ratio_to
from ssm_graph.evaluation import chi2_interval
from ssm_graph.simulation import Grade

SEEDS = range(8)
DURATION_S = 240.0


def runs_of(case: str, grade: Grade, *methods: str) -> dict[str, list[Run]]:
    """Return the runs of every method."""
    chosen = tuple(parse_method(name) for name in methods)
    jobs = [Job(case, grade, seed, chosen, DURATION_S) for seed in SEEDS]
    done = [run for job in jobs for run in do_job(job)]
    return {name: [run for run in done if run.method == name] for name in methods}


@pytest.mark.slow
@pytest.mark.parametrize("grade", Grade)
def test_clean_missions_are_consistent(grade: Grade) -> None:
    """Least squares on Gaussian errors: NEES of the last epoch within its chi-square interval."""
    runs = runs_of("clean", grade, "gaussian")["gaussian"]
    assert {run.status for run in runs} == {"CONVERGED"}
    nees = float(np.mean([run.nees_final for run in runs]))
    assert nees in chi2_interval(3, len(runs), confidence=0.999)


@pytest.mark.slow
@pytest.mark.parametrize("grade", [Grade.NAVIGATION, Grade.TACTICAL])
@pytest.mark.parametrize("case", ["sparse10", "one_beam50"])
def test_log_is_near_the_oracle(case: str, grade: Grade) -> None:
    """The full study, with its tighter limit, is benchmarks/results/targets.md."""
    runs = runs_of(case, grade, "oracle", "log:5", "gaussian")
    assert {run.status for run in runs["log:5"]} == {"CONVERGED"}
    assert ratio_to(runs["oracle"], runs["log:5"]).value < 1.15
    assert ratio_to(runs["oracle"], runs["gaussian"]).low > 3.0
    for run in runs["log:5"]:
        assert run.n_large_rejected >= 0.99 * run.n_large_outliers
        assert 0.95 < run.good_weight < 1.10
