"""The fixed-lag smoother: its window, its prior, and the batch smoother as its limit."""

from __future__ import annotations

import numpy as np
import pytest

from factors.similarity import GaussianKernel, LogKernel
from ssm_graph.errors import ConfigError
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.graph.marginal_prior import prior_on_last
from ssm_graph.graph.solve import marginal_covariances, solve_linear
from ssm_graph.graph.states import retract, states_from_arrays
from ssm_graph.problem.problem import Problem, build_problem, with_dvl
from ssm_graph.problem.window import window_of
from ssm_graph.simulation import Grade, OutlierKind, Outliers
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, FixedLagSmoother
from tests.helpers import simulated


def problem_of(duration_s: float = 12.0, **changes: object) -> Problem:
    """Return a short tactical-grade mission with outliers and dropouts."""
    settings: dict[str, object] = {
        "grade": Grade.TACTICAL,
        "outliers": Outliers(OutlierKind.SPARSE, rate=0.2),
        "dropout_rate": 0.1,
        "seed": 4,
    }
    return build_problem(simulated(duration_s=duration_s, **(settings | changes)).mission)


def test_a_lag_as_long_as_the_mission_is_the_batch_smoother() -> None:
    """Nothing is ever marginalised: same states, covariances and weights."""
    problem = problem_of()
    batch = SsmSmoother(SmootherConfig(tolerance=1e-7)).solve(problem)
    newest, delayed = FixedLagSmoother(FixedLagConfig(lag_s=12.0, tolerance=1e-7)).solve(problem)
    mine, other = delayed.trajectory, batch.trajectory
    sigma = other.velocity_sigma_enu
    assert np.max(np.abs(mine.velocity_enu - other.velocity_enu) / sigma) < 1e-5
    np.testing.assert_allclose(mine.height, other.height, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(mine.velocity_sigma_enu, sigma, rtol=1e-6)
    np.testing.assert_allclose(delayed.beams.weight, batch.beams.weight, rtol=0.0, atol=1e-6)
    # The last state is the newest of both; the first one did not know what came later.
    assert newest.trajectory.velocity_enu[-1] == pytest.approx(mine.velocity_enu[-1])
    assert np.all(newest.trajectory.velocity_sigma_enu[2] > mine.velocity_sigma_enu[2])


def test_gaussian_windows_of_any_lag_end_alike() -> None:
    """Marginalising loses nothing of a linear problem: the newest states do not see the lag.

    Attitude makes this one slightly nonlinear: 1 % of a sigma.
    """
    problem = problem_of(outliers=Outliers(), grade=Grade.NAVIGATION, depth=None)
    runs = [
        FixedLagSmoother(FixedLagConfig(lag_s=lag, kernel=GaussianKernel())).run(problem).newest
        for lag in (0.0, 3.0, 12.0)
    ]
    sigma = np.sqrt(np.diagonal(runs[-1].covariance, axis1=1, axis2=2))
    for run in runs[:-1]:
        assert np.max(np.abs(run.v_n - runs[-1].v_n) / sigma[:, 6:9]) < 0.02
        np.testing.assert_allclose(
            np.diagonal(run.covariance, axis1=1, axis2=2), sigma**2, rtol=0.01
        )


def test_marginal_prior_says_what_the_marginalised_graph_said() -> None:
    """The last keyframe has the same step and covariance alone as with all before it."""
    problem = problem_of(duration_s=6.0)
    track = FixedLagSmoother(FixedLagConfig(lag_s=6.0)).run(problem).delayed
    columns = (track.R_nb, track.p_n + 0.3, track.v_n, track.bias)
    whole = states_from_arrays(*columns)
    linearizer = GraphLinearizer(problem)
    linearizer.follow(whole)
    weights = np.ones(len(problem.beams.speed))
    linear = linearizer.linearize(whole, linearizer.beam_rows(whole), weights)
    solution = solve_linear(linear, linearizer.ordering, n_keyframes=problem.n_keyframes)
    prior = prior_on_last(whole, solution.R[-1], step=solution.last_step())
    last = states_from_arrays(*(column[-1:] for column in columns))
    n = problem.n_keyframes
    alone = window_of(problem, range(n - 1, n), measured=range(n - 1, n - 1))
    single = GraphLinearizer(alone, prior=prior)
    again = single.linearize(last, single.beam_rows(last), np.zeros(0))
    solved = solve_linear(again, single.ordering, n_keyframes=1)
    np.testing.assert_allclose(solved.last_step(), solution.last_step(), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(
        marginal_covariances(solved)[0], marginal_covariances(solution)[-1], rtol=1e-9, atol=1e-20
    )
    # The prior is a function of the state, wherever it is linearised: its minimum is found.
    for _ in range(4):
        last, _ = retract(last, solved.delta)
        again = single.linearize(last, single.beam_rows(last), np.zeros(0))
        solved = solve_linear(again, single.ordering, n_keyframes=1)
    assert np.linalg.norm(prior.whitened(last)) < 1e-6


def test_a_window_is_a_problem_of_its_own() -> None:
    """Rows, readings and intervals of the keyframes asked for, counted from zero."""
    problem = problem_of()
    window = window_of(problem, range(3, 8), measured=range(4, 7))
    assert window.n_keyframes == 5
    np.testing.assert_array_equal(window.keyframe_s, problem.keyframe_s[3:8])
    assert len(window.chain.measurements) == 4
    assert set(window.beams.keyframe.tolist()) == {1, 2, 3}
    assert window.depths is not None
    assert window.depths.gyro_b.shape == (5, 3)
    inside = (problem.beams.keyframe >= 4) & (problem.beams.keyframe < 7)
    np.testing.assert_array_equal(window.beams.speed, problem.beams.speed[inside])


def test_another_dvl_log_of_the_same_run() -> None:
    """The chain is kept, the beams are those of a problem built from scratch."""
    clean, bad = (
        simulated(duration_s=6.0, seed=2, outliers=outliers).mission
        for outliers in (Outliers(), Outliers(OutlierKind.SPARSE, rate=0.5))
    )
    problem = build_problem(clean)
    other, scratch = with_dvl(problem, bad), build_problem(bad)
    assert other.chain is problem.chain
    for name in ("keyframe", "beam", "speed", "sigma", "gyro_b", "beam_b"):
        np.testing.assert_array_equal(getattr(other.beams, name), getattr(scratch.beams, name))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"lag_s": -1.0}, "lag_s"),
        ({"lag_s": np.nan}, "lag_s"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"tolerance": 0.0}, "tolerance"),
    ],
)
def test_settings_out_of_range_are_refused(setting: dict[str, float], message: str) -> None:
    """With the name of the setting."""
    with pytest.raises(ConfigError, match=message):
        FixedLagConfig(**setting)  # type: ignore[arg-type]


def test_large_outliers_lose_their_weight_within_the_window() -> None:
    """A beam 3 m/s off ends near zero, the others near one."""
    problem = problem_of(duration_s=20.0, outliers=Outliers(OutlierKind.SPARSE, 0.2, (3.0, 3.0)))
    config = FixedLagConfig(lag_s=5.0, kernel=LogKernel())
    weight = FixedLagSmoother(config).run(problem).delayed.weight
    assert weight.min() < 0.01
    assert np.median(weight) > 0.9
