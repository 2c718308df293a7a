"""What holds for every update rule: laws of one step, and the Kalman filter as their limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factors.similarity import ExpKernel, LogKernel, SqrtKernel
from ssm_graph.engine.error_state import Linearised
from ssm_graph.filters.rules.correntropy import CorrentropyUpdate
from ssm_graph.filters.rules.kalman import GatedUpdate, KalmanUpdate
from ssm_graph.filters.rules.ssm import SsmUpdate
from ssm_graph.filters.rules.student import Scale, StudentUpdate
from ssm_graph.filters.rules.update import NOMINAL, Runs, UpdateRule
from tests.linear_filter import LinearModel, LinearSystem
from tests.update_fixture import (
    ALL_ROWS,
    EACH_ROW,
    N_ROWS,
    N_RUNS,
    a_system,
    assert_same,
    corrected,
    measured,
    predicted,
)

SSM = SsmUpdate(LogKernel(5.0))
RULES: dict[str, UpdateRule] = {
    "kalman": KalmanUpdate(),
    "gate": GatedUpdate(),
    "log": SSM,
    "sqrt": SsmUpdate(SqrtKernel(2.0)),
    "exp": SsmUpdate(ExpKernel(5.0)),
    "log, state too": SsmUpdate(LogKernel(5.0), LogKernel(5.0)),
    "linear log": replace(SSM, linearised=Linearised.ONCE),
    "student": StudentUpdate(),
    "student, fixed": StudentUpdate(Scale.FIXED),
    "correntropy": CorrentropyUpdate(5.0),
}
every_rule = pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
MISSING = np.full((N_RUNS, N_ROWS), np.nan)


@every_rule
@pytest.mark.parametrize("group", [EACH_ROW, ALL_ROWS], ids=["rows", "one group"])
def test_runs_do_not_know_each_other(rule: UpdateRule, group: Runs) -> None:
    """One by one, or in any order, or side by side: the same, down to the number of passes."""
    rng = np.random.default_rng(1)
    P, system, z = predicted(rng), a_system(rng), measured(rng)
    together = corrected(rule, P, system, z, group)
    order = rng.permutation(N_RUNS)
    shuffled = corrected(rule, P[order], system, z[order], group)
    assert_same(shuffled, [column[order] for column in together])
    for run in range(N_RUNS):
        one = slice(run, run + 1)
        alone = corrected(rule, P[one], system, z[one], group)
        assert_same(alone, [column[one] for column in together])


@every_rule
def test_covariance_is_one(rule: UpdateRule) -> None:
    """Symmetric and positive, whatever was measured."""
    rng = np.random.default_rng(2)
    update = corrected(rule, predicted(rng), a_system(rng), measured(rng))
    P = update.covariance
    np.testing.assert_allclose(P, np.swapaxes(P, 1, 2), atol=1e-12)
    assert np.all(np.linalg.eigvalsh(P) > 0.0)


@every_rule
def test_nothing_measured(rule: UpdateRule) -> None:
    """The prediction stays as it is."""
    rng = np.random.default_rng(3)
    P = predicted(rng)
    update = corrected(rule, P, a_system(rng), MISSING)
    np.testing.assert_array_equal(update.xi, 0.0)
    np.testing.assert_allclose(update.covariance, P, atol=1e-12)
    np.testing.assert_array_equal(update.weights, 1.0)
    np.testing.assert_allclose(update.state_weight, 1.0, atol=1e-12)


@every_rule
@pytest.mark.parametrize("group", [EACH_ROW, ALL_ROWS], ids=["rows", "one group"])
def test_missing_rows_are_not_there(rule: UpdateRule, group: Runs) -> None:
    """Rows without a measurement count neither in the state nor in the size of their group."""
    rng = np.random.default_rng(4)
    P, system, z = predicted(rng), a_system(rng), measured(rng)
    z[:, 2] = np.nan
    left = np.array([0, 1, 3])
    shorter = system._replace(H=system.H[left], R=system.R[np.ix_(left, left)])
    found = corrected(rule, P, system, z, group)
    expected = corrected(rule, P, shorter, z[:, left], group[left])
    np.testing.assert_array_equal(found.weights[:, 2], 1.0)
    rows = {
        key: getattr(found, key)[:, left] for key in ("weights", "mahalanobis_sq", "innovation")
    }
    assert_same(found._replace(**rows), expected)


@every_rule
def test_scalar_measurement(rule: UpdateRule) -> None:
    """One row: a mild innovation of a known variance gives a gain between none and the full one."""
    system = LinearSystem(np.eye(2), np.eye(2), np.array([[1.0, 0.0]]), np.array([[4.0]]))
    P = np.array([[[1.0, 0.5], [0.5, 1.0]]])
    update = corrected(rule, P, system, np.array([[3.0]]), np.array([0]))
    full = KalmanUpdate()(
        P, LinearModel(system, np.zeros((1, 2)), np.array([[3.0]]), group=ALL_ROWS[:1])
    )
    np.testing.assert_allclose(full.xi, [[0.6, 0.3]])
    assert 0.3 < update.xi[0, 0] < 1.2
    np.testing.assert_allclose(update.xi[0, 1], 0.5 * update.xi[0, 0], rtol=0.2)


@every_rule
def test_nominal_rows_count_in_full(rule: UpdateRule) -> None:
    """Rows without a group have no weight to lose, however far off."""
    rng = np.random.default_rng(5)
    z = measured(rng)
    z[:, 0] = 100.0
    group = np.array([NOMINAL, 0, 1, 2])
    update = corrected(rule, predicted(rng), a_system(rng), z, group)
    np.testing.assert_array_equal(update.weights[:, 0], 1.0)


@every_rule
def test_units_of_the_state_do_not_matter(rule: UpdateRule) -> None:
    """Variances from 1e-16 to 1e2 in one matrix, as of biases and positions."""
    rng = np.random.default_rng(10)
    P, system, z = predicted(rng), a_system(rng), measured(rng)
    unit = np.array([1e-8, 1e-5, 1e-2, 1.0, 10.0])
    found = corrected(rule, P * np.outer(unit, unit), system._replace(H=system.H / unit), z)
    xi, covariance = found.xi / unit, found.covariance / np.outer(unit, unit)
    expected = corrected(rule, P, system, z)
    assert_same(found._replace(xi=xi, covariance=covariance), expected, atol=1e-7)


@pytest.mark.parametrize("rule", [RULES["kalman"], RULES["gate"], SSM, RULES["log, state too"]])
def test_a_known_component_stays(rule: UpdateRule) -> None:
    """A component without variance is no zero to divide by."""
    rng = np.random.default_rng(11)
    P = predicted(rng).copy()
    P[:, 0], P[:, :, 0] = 0.0, 0.0
    update = corrected(rule, P, a_system(rng), measured(rng))
    np.testing.assert_array_equal(update.xi[:, 0], 0.0)
    assert all(np.all(np.isfinite(column)) for column in update)
    assert np.all(update.n_iterations < 50)


@pytest.mark.parametrize(
    "rule",
    [
        SsmUpdate(LogKernel(1e13), LogKernel(1e13)),
        SsmUpdate(SqrtKernel(1e13), SqrtKernel(1e13)),
        SsmUpdate(ExpKernel(1e7), ExpKernel(1e7)),
        StudentUpdate(Scale.FIXED, state_dof=1e13, measurement_dof=1e13),
        StudentUpdate(state_dof=1e13, measurement_dof=1e13, tau=1e13),
        CorrentropyUpdate(1e7),
        GatedUpdate(1.0 - 1e-15),
    ],
)
def test_without_tails_it_is_the_kalman_filter(rule: UpdateRule) -> None:
    """Infinite degrees of freedom, kernel width, or confidence."""
    rng = np.random.default_rng(6)
    P, system = predicted(rng), a_system(rng)
    z = rng.normal(size=(N_RUNS, N_ROWS))
    found, expected = corrected(rule, P, system, z), corrected(KalmanUpdate(), P, system, z)
    np.testing.assert_allclose(found.xi, expected.xi, atol=1e-8)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-8)


def test_kalman_in_closed_form() -> None:
    """Correlated noise, some of it missing: whitening changes nothing."""
    rng = np.random.default_rng(16)
    P, system, z = predicted(rng), a_system(rng), measured(rng)
    z[0, 2] = np.nan
    update = corrected(KalmanUpdate(), P, system, z)
    for run, is_there in enumerate(np.isfinite(z)):
        H, R = system.H[is_there], system.R[np.ix_(is_there, is_there)]
        gain = P[run] @ H.T @ np.linalg.inv(H @ P[run] @ H.T + R)
        np.testing.assert_allclose(update.xi[run], gain @ z[run, is_there], atol=1e-10)
        np.testing.assert_allclose(update.covariance[run], P[run] - gain @ H @ P[run], atol=1e-10)
