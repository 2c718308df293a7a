"""Graduated non-convexity: the published formulas by hand, then short missions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from factors.kernels import GeneralKernel, HuberKernel, TruncatedKernel
from factors.similarity import WEIGHT_FLOOR, GaussianKernel, LogKernel
from ssm_graph.base.errors import ConfigError
from ssm_graph.engine.reweighting import (
    GncSchedule,
    GncStart,
    Graduation,
    Schedule,
    first_mu,
)
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import OutlierKind, Outliers
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from tests.helpers import estimated_states, simulated, state_errors

SPARSE = Outliers(OutlierKind.SPARSE, rate=0.1)
each_start = pytest.mark.parametrize("start", GncStart, ids=lambda start: start.name)


def graduated(problem: Problem, *, width: float | None = None, **settings: Any) -> Estimate:
    """Return the estimate of truncated least squares by graduation."""
    kernel = TruncatedKernel() if width is None else TruncatedKernel(width)
    config = SmootherConfig(kernel=kernel, graduation=Graduation(**settings))
    return SsmSmoother(config).solve(problem)


def test_first_mu_by_hand() -> None:
    """Remark 5: ``c^2 / (2 max r^2 - c^2)``."""
    assert first_mu(100.0, 2.0) == pytest.approx(4.0 / 196.0)
    assert first_mu(1e12, 2.0) == 1e-6
    assert math.isinf(first_mu(2.0, 2.0))


def test_schedule_by_hand() -> None:
    """Least squares until it is near, then mu by the remark, then 1.4 times as much each time."""
    schedule: Schedule = GncSchedule.begin(TruncatedKernel(2.0), Graduation(), LogKernel())
    t = np.array([0.01, 1.0, 100.0])
    ones = schedule.first_weights(np.array([1.0, 0.5, 1e-8]))
    np.testing.assert_array_equal(ones, 1.0)
    schedule, far = schedule.after(ones, ones, t=t, update_sigmas=5.0)
    np.testing.assert_array_equal(far, 1.0)
    assert str(schedule.kernel) == "gaussian"
    assert not schedule.may_end(ones)
    mu = 4.0 / 196.0
    for _ in range(3):
        schedule, weights = schedule.after(ones, ones, t=t, update_sigmas=0.5)
        assert schedule.kernel == TruncatedKernel(2.0, mu=mu)
        # eq. (14), in the words of the paper.
        for r, weight in zip(np.sqrt(t), weights, strict=True):
            if r**2 <= mu / (mu + 1.0) * 4.0:
                assert weight == 1.0
            elif r**2 >= (mu + 1.0) / mu * 4.0:
                assert weight == WEIGHT_FLOOR
            else:
                assert weight == pytest.approx(2.0 / r * math.sqrt(mu * (mu + 1.0)) - mu)
        mu *= 1.4


def test_weights_stay_while_their_solution_is_far_but_not_for_ever() -> None:
    """Five passes at most, for least squares on outliers may never settle."""
    width = TruncatedKernel().width
    schedule: Schedule = GncSchedule.begin(TruncatedKernel(), Graduation(mu_step=2.0), LogKernel())
    t = np.array([1.0, 1e4])
    used = np.array([0.7, 0.3])
    for mu in (None, first_mu(1e4, width)):
        for _ in range(4):
            schedule, kept = schedule.after(used, np.ones(2), t=t, update_sigmas=7.0)
            np.testing.assert_array_equal(kept, np.ones(2) if mu is None else used)
            kernel = str(schedule.kernel)
            assert kernel == ("gaussian" if mu is None else str(TruncatedKernel(mu=mu)))
        schedule, _ = schedule.after(used, np.ones(2), t=t, update_sigmas=7.0)
    assert schedule.kernel == TruncatedKernel(mu=2.0 * first_mu(1e4, width))
    schedule, _ = schedule.after(used, np.ones(2), t=t, update_sigmas=0.9)
    assert schedule.kernel == TruncatedKernel(mu=4.0 * first_mu(1e4, width))


def test_only_binary_weights_are_an_answer() -> None:
    """The floor counts as 0."""
    schedule: Schedule = GncSchedule.begin(TruncatedKernel(), Graduation(), LogKernel())
    schedule, _ = schedule.after(np.ones(2), np.ones(2), t=np.array([1.0, 1e4]), update_sigmas=0.0)
    assert schedule.may_end(np.array([1.0, WEIGHT_FLOOR, 0.99995]))
    assert not schedule.may_end(np.array([1.0, 0.999, WEIGHT_FLOOR]))
    assert not schedule.may_end(np.array([1.0, 0.01]))


def test_a_gated_start_keeps_the_weights_of_the_forward_pass() -> None:
    """And the warm kernel, until it is near."""
    schedule: Schedule = GncSchedule.begin(
        TruncatedKernel(), Graduation(GncStart.GATED), LogKernel()
    )
    gated = np.array([1.0, 1e-8])
    assert schedule.first_weights(gated) is gated
    assert schedule.kernel == LogKernel()


@each_start
def test_weights_end_binary_and_outliers_without(start: GncStart) -> None:
    """Outliers of 100 sigma and more are found; 1 % of the good beams pays for it."""
    sim = simulated(outliers=SPARSE)
    estimate = graduated(build_problem(sim.mission), start=start)
    assert estimate.status is Status.CONVERGED, estimate.reason
    weight = estimate.beams.weight
    assert set(np.unique(weight)) <= {WEIGHT_FLOOR, 1.0}
    bad = sim.is_outlier[np.isfinite(sim.mission.dvl.speed)]
    assert np.all(weight[bad] == WEIGHT_FLOOR)
    assert 0.95 < weight[~bad].mean() < 1.0
    assert estimate.kernel == f"gnc-tls(width=2.57583, start={start.name.lower()}, step=1.4)"
    kernels = [iteration.kernel for iteration in estimate.iterations]
    first = "gaussian" if start is GncStart.ONES else "log(dof=5)"
    assert kernels[0] == first
    assert "mu=" in kernels[-1]
    # Half the truncated squares of the beams are part of the cost.
    assert estimate.cost >= 0.5 * TruncatedKernel().width ** 2 * bad.sum()


def test_clean_data_are_least_squares() -> None:
    """With a width that no residual reaches nothing is truncated: the plain answer."""
    problem = build_problem(simulated(depth=None).mission)
    estimate = graduated(problem, width=6.0)
    plain = SsmSmoother(SmootherConfig(kernel=GaussianKernel())).solve(problem)
    assert estimate.status is plain.status is Status.CONVERGED
    np.testing.assert_array_equal(estimate.beams.weight, 1.0)
    states = (estimated_states(problem, e.trajectory) for e in (estimate, plain))
    assert np.abs(state_errors(*states)).max() < 1e-6


def test_a_limit_within_the_graduation_is_said() -> None:
    """Ten passes are not enough for outliers of 100 sigma: the status is no success."""
    problem = build_problem(simulated(outliers=SPARSE).mission)
    config = SmootherConfig(kernel=TruncatedKernel(), graduation=Graduation(), max_iterations=10)
    estimate = SsmSmoother(config).solve(problem)
    assert not estimate.status.is_good
    assert "iteration limit" in estimate.reason


def test_bad_settings_are_refused() -> None:
    """A step that does not grow, and a graduation towards a kernel that has none."""
    for mu_step in (1.0, 0.5, math.nan, math.inf):
        with pytest.raises(ConfigError, match="mu_step: expected a number above 1"):
            Graduation(mu_step=mu_step)
    with pytest.raises(ConfigError, match="graduation: expected with a TruncatedKernel, got huber"):
        SmootherConfig(kernel=HuberKernel(), graduation=Graduation())


def test_the_adaptive_loss_finds_its_shape_and_settles() -> None:
    """Least squares without outliers, a loss that ends with some, and in the name of the answer."""
    for outliers, is_plain in ((Outliers(), True), (SPARSE, False)):
        sim = simulated(outliers=outliers, duration_s=60.0)
        config = SmootherConfig(kernel=GeneralKernel(), adapt_shape=True)
        estimate = SsmSmoother(config).solve(build_problem(sim.mission))
        assert estimate.status is Status.CONVERGED, estimate.reason
        assert estimate.kernel == "adaptive(width=1)"
        text = estimate.iterations[-1].kernel
        last = float(text.removeprefix("general(alpha=").partition(",")[0])
        assert (last > 1.5) if is_plain else (last < 0.0)
        bad = sim.is_outlier[np.isfinite(sim.mission.dvl.speed)]
        assert np.all(estimate.beams.weight[bad] < 0.01)
        assert np.median(estimate.beams.weight[~bad]) > 0.7
