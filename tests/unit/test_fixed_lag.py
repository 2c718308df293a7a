"""The fixed-lag smoother: its window, its prior, and the batch smoother as its limit."""

from __future__ import annotations

import numpy as np
import pytest

from factors.similarity import GaussianKernel, LogKernel
from ssm_graph.base.errors import ConfigError
from ssm_graph.engine.chain import Chain
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.problem import Problem, build_problem, start_of, with_dvl
from ssm_graph.simulation import Grade, OutlierKind, Outliers
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, run_fixed_lag, solve_fixed_lag
from ssm_graph.smoothers.keyframe import keyframes_of, sensors_of
from ssm_graph.smoothers.window import Window
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
    newest, delayed = solve_fixed_lag(problem, FixedLagConfig(lag_s=12.0, tolerance=1e-7))
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
        run_fixed_lag(problem, FixedLagConfig(lag_s=lag, kernel=GaussianKernel())).newest
        for lag in (0.0, 3.0, 12.0)
    ]
    sigma = np.sqrt(np.diagonal(runs[-1].covariance, axis1=1, axis2=2))
    for run in runs[:-1]:
        assert np.max(np.abs(run.states.v_n - runs[-1].states.v_n) / sigma[:, 6:9]) < 0.02
        np.testing.assert_allclose(
            np.diagonal(run.covariance, axis1=1, axis2=2), sigma**2, rtol=0.01
        )


def test_the_window_is_the_graph() -> None:
    """At any states and weights, its rows lead to the step and the covariances of the graph."""
    problem = problem_of(duration_s=6.0)
    first, *others = keyframes_of(problem)
    window = Window(sensors_of(problem), FixedLagConfig(lag_s=6.0), first, start_of(problem))
    for keyframe in others:
        window.advance(keyframe)
    window.iterate()
    states = window.states
    linearizer = GraphLinearizer(problem)
    linearizer.follow(states)
    judged = window.all.aids
    of_aids = np.concatenate([judged[aid.name].weight for aid in linearizer.weighted.all])
    rows = linearizer.beam_rows(states)
    step = linearizer.solve(states, rows, window.all.weight, of_aids)
    covariance = step.covariance(15)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.max(np.abs(step.step) / sigma) < 1e-6
    unit = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose((window.all.covariance - covariance) / unit, 0.0, atol=1e-6)


def test_what_did_not_change_need_not_be_eliminated_again() -> None:
    """The chain from any keyframe on, or from the first, is the same; what is dropped is kept."""
    rng = np.random.default_rng(0)
    carried = np.column_stack([np.eye(15), rng.normal(size=15)])
    rows = [rng.normal(size=(n, 16)) for n in (4, 0, 3, 5)]
    between = [
        np.column_stack([rng.normal(size=(15, 15)), np.eye(15), rng.normal(size=15)])
        for _ in range(3)
    ]
    whole, parts = Chain(15), Chain(15)
    whole.eliminate(carried, rows, between, begin=0)
    parts.eliminate(carried, rows[:2], between[:1], begin=0)
    parts.eliminate(parts.carried[1], rows[1:], between[1:], begin=1)
    for mine, other in zip(parts.solve(), whole.solve(), strict=True):
        np.testing.assert_array_equal(mine, other)
    dense = np.zeros((15 + 12 + 45, 60))
    dense[:15, :15], b = carried[:, :15], [carried[:, 15]]
    at = 15
    for k, own in enumerate(rows):
        dense[at : at + len(own), 15 * k : 15 * k + 15] = own[:, :15]
        b.append(own[:, 15])
        at += len(own)
    for k, pair in enumerate(between):
        dense[at : at + 15, 15 * k : 15 * k + 30] = pair[:, :30]
        b.append(pair[:, 30])
        at += 15
    expected = np.linalg.lstsq(dense, np.concatenate(b))[0]
    np.testing.assert_allclose(whole.solve().step.ravel(), expected, rtol=1e-9)
    covariance = np.linalg.inv(dense.T @ dense)
    np.testing.assert_allclose(whole.solve().conditional[1], covariance[15:30, 15:30], rtol=1e-9)
    before = whole.solve()
    whole.drop(2)
    np.testing.assert_array_equal(whole.solve().step, before.step[2:])
    np.testing.assert_array_equal(whole.solve().conditional, before.conditional[2:])


def test_a_successor_goes_its_own_way() -> None:
    """Going on with one leaves the other as it was; both end alike, given the same."""
    problem = problem_of()
    first, *others = keyframes_of(problem)
    window = Window(sensors_of(problem), FixedLagConfig(lag_s=4.0), first, start_of(problem))
    for keyframe in others[:8]:
        window.advance(keyframe)
        window.iterate()
    before = window.all
    ends = []
    for one in (window.successor(), window):
        for keyframe in others[8:]:
            one.advance(keyframe)
            one.iterate()
        ends.append(one.newest)
        if one is not window:
            np.testing.assert_array_equal(window.all.states.p_n, before.states.p_n)
            np.testing.assert_array_equal(window.all.weight, before.weight)
    sigma = np.sqrt(np.diagonal(ends[0].covariance[0]))
    assert (
        np.max(np.abs(ends[0].states.navigation.deviation_of(ends[1].states.navigation)) / sigma)
        < 1e-6
    )


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
    weight = run_fixed_lag(problem, config).delayed.weight
    assert weight.min() < 0.01
    assert np.median(weight) > 0.9
