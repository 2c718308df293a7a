"""What an interrupt from the keyboard leaves behind."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ssm_graph.mission.estimate import Status
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import OutlierKind, Outliers, scenario_config, simulate
from ssm_graph.smoothers.batch import SsmSmoother


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Build half a minute of a survey with outliers."""
    outliers = Outliers(OutlierKind.SPARSE, 0.2)
    config = scenario_config("survey", duration_s=30.0, outliers=outliers)
    return build_problem(simulate(config).mission)


class _Interrupted(SsmSmoother):
    """A smoother whose user gives up after some iterations."""

    patience = 0

    def _iterate(self, *given: Any) -> Any:
        if self.patience == 0:
            raise KeyboardInterrupt
        self.patience -= 1
        return super()._iterate(*given)


def test_an_interrupt_keeps_the_last_iteration(problem: Problem) -> None:
    """The estimate is there, finite, and plainly marked."""
    smoother = _Interrupted()
    smoother.patience = 2
    estimate = smoother.solve(problem)
    assert estimate.status is Status.INTERRUPTED
    assert not estimate.status.is_good
    assert len(estimate.iterations) == 2
    assert np.all(np.isfinite(estimate.trajectory.position_cov_enu))


def test_an_interrupt_before_anything_is_found_goes_on(problem: Problem) -> None:
    """There is nothing to keep, so the program ends."""
    with pytest.raises(KeyboardInterrupt):
        _Interrupted().solve(problem)
