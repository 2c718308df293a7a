"""The update rules of the literature: laws, limits, and a curved measurement."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2

from factors import so3
from factors.similarity import WEIGHT_FLOOR, ExpKernel, LogKernel, Similarity, SqrtKernel
from ssm_graph.data import Array
from ssm_graph.filters.correntropy import CorrentropyUpdate
from ssm_graph.filters.kalman import Gate, GatedUpdate, KalmanUpdate
from ssm_graph.filters.linear import LinearModel, LinearSystem
from ssm_graph.filters.model import NOMINAL, Iterate, Runs, Update, UpdateRule
from ssm_graph.filters.ssm import Floor, SsmUpdate, StopRule
from ssm_graph.filters.student import Scale, StudentUpdate
from ssm_graph.problem.error_state import Linearised

N_STATES, N_ROWS, N_RUNS = 5, 4, 6
EACH_ROW, ALL_ROWS = np.arange(N_ROWS), np.zeros(N_ROWS, dtype=np.intp)
SSM = SsmUpdate(LogKernel(5.0))
RULES: dict[str, UpdateRule] = {
    "kalman": KalmanUpdate(),
    "ping gate": GatedUpdate(Gate.PING),
    "beam gate": GatedUpdate(Gate.BEAM),
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


def a_system(rng: np.random.Generator) -> LinearSystem:
    """Return a system with correlated noise."""
    H, root = rng.normal(size=(N_ROWS, N_STATES)), rng.normal(size=(N_ROWS, N_ROWS))
    Q = F = np.eye(N_STATES)
    return LinearSystem(F, Q, H, np.diag([0.5, 1.0, 2.0, 3.0]) + 0.05 * root @ root.T)


def predicted(rng: np.random.Generator) -> Array:
    """Return covariances (N_RUNS, n, n) of predictions."""
    root = rng.normal(size=(N_RUNS, N_STATES, N_STATES))
    P = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(N_STATES)
    P.setflags(write=False)
    return P


def measured(rng: np.random.Generator) -> Array:
    """Return measurements (N_RUNS, m) of a state that is predicted as zero, one run far off."""
    z = 2.0 * rng.normal(size=(N_RUNS, N_ROWS))
    z[0, 1] += 60.0
    return z


def corrected(
    rule: UpdateRule, P: Array, system: LinearSystem, z: Array, group: Runs = EACH_ROW
) -> Update:
    """Correct predictions of zero."""
    return rule(P, LinearModel(system, np.zeros(P.shape[:2]), z, group=group))


def assert_same(found: Update, expected: Iterable[NDArray[Any]], *, atol: float = 1e-9) -> None:
    """Compare all that two updates have to say, in the order of the runs."""
    for column, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(column, other, rtol=1e-9, atol=atol)


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
    """Depth and GNSS have no weight to lose, however far off."""
    rng = np.random.default_rng(5)
    z = measured(rng)
    z[:, 0] = 100.0
    group = np.array([NOMINAL, 0, 1, 2])
    update = corrected(rule, predicted(rng), a_system(rng), z, group)
    np.testing.assert_array_equal(update.weights[:, 0], 1.0)


@pytest.mark.parametrize(
    "rule",
    [
        SsmUpdate(LogKernel(1e13), LogKernel(1e13)),
        SsmUpdate(SqrtKernel(1e13), SqrtKernel(1e13)),
        SsmUpdate(ExpKernel(1e7), ExpKernel(1e7)),
        StudentUpdate(Scale.FIXED, state_dof=1e13, measurement_dof=1e13),
        StudentUpdate(state_dof=1e13, measurement_dof=1e13, tau=1e13),
        CorrentropyUpdate(1e7),
        GatedUpdate(Gate.PING, 1.0 - 1e-15),
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


def test_one_bad_row_keeps_the_others() -> None:
    """A weight for each row drops the bad one; one for all drops the good ones with it."""
    rng = np.random.default_rng(7)
    P, system = predicted(rng), a_system(rng)._replace(R=np.eye(N_ROWS))
    z = 0.5 * rng.normal(size=(N_RUNS, N_ROWS))
    without, bad = z.copy(), z.copy()
    without[:, 1], bad[:, 1] = np.nan, 1e4
    each = corrected(SSM, P, system, bad)
    clean = corrected(SSM, P, system, without)
    sigma = np.sqrt(np.einsum("bii->bi", clean.covariance))
    assert np.all(np.abs(each.xi - clean.xi) < 0.02 * sigma)
    assert np.all(each.weights[:, 1] < 1e-5)
    assert np.all(np.delete(each.weights, 1, axis=1) > 0.5)
    assert np.all(corrected(SSM, P, system, bad, ALL_ROWS).weights < 1e-3)


@pytest.mark.parametrize("similarity", Similarity)
@pytest.mark.parametrize("linearised", Linearised)
def test_weights_are_those_of_the_result(similarity: Similarity, linearised: Linearised) -> None:
    """At the end each weight follows from the ``t`` that the estimate itself gives."""
    rng = np.random.default_rng(8)
    P, system, z = predicted(rng), a_system(rng), measured(rng)
    rule = replace(SSM, similarity=similarity, linearised=linearised, max_iterations=500)
    update = corrected(rule, P, system, z)
    H = LinearModel(system, np.zeros(P.shape[:2]), z, group=EACH_ROW).at(update.xi).jacobian
    spread = np.einsum("bij,bjk,bik->bi", H, update.covariance, H)
    t = update.innovation**2 + (spread if similarity is Similarity.EXPECTED else 0.0)
    np.testing.assert_allclose(update.mahalanobis_sq, t, rtol=1e-6)
    np.testing.assert_allclose(update.weights, LogKernel(5.0).weight(t), rtol=1e-6)
    information = np.linalg.inv(P) + np.swapaxes(H, 1, 2) @ (update.weights[..., None] * H)
    np.testing.assert_allclose(update.covariance, np.linalg.inv(information), rtol=1e-6, atol=1e-9)


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


def test_state_weight_is_that_of_the_result() -> None:
    """At the end it follows from how far the estimate went from the prediction."""
    rng = np.random.default_rng(17)
    P, kernel = predicted(rng), LogKernel(5.0)
    rule = SsmUpdate(kernel, kernel, max_iterations=500)
    update = corrected(rule, P, a_system(rng), measured(rng))
    moment = update.xi[:, :, None] * update.xi[:, None, :] + update.covariance
    t = np.trace(np.linalg.solve(P, moment), axis1=1, axis2=2)
    np.testing.assert_allclose(update.state_weight, kernel.weight(t, dim=N_STATES), rtol=1e-6)


def test_correntropy_covariance_is_of_the_nominal_noise() -> None:
    """Joseph's form: a scalar tells its gain, and the gain its covariance."""
    one = np.eye(1)
    system = LinearSystem(one, one, one, 4.0 * one)
    P, z = np.full((3, 1, 1), 2.0), np.array([[1.0], [6.0], [50.0]])
    update = corrected(CorrentropyUpdate(2.0), P, system, z, ALL_ROWS[:1])
    gain = update.xi / z
    joseph = (1.0 - gain) ** 2 * 2.0 + gain**2 * 4.0
    np.testing.assert_allclose(update.covariance[:, 0], joseph)


def test_stop_and_floor_are_details() -> None:
    """Both stopping tests end at the same estimate; floors differ only where weights vanish."""
    rng = np.random.default_rng(9)
    P, system, z = predicted(rng), a_system(rng), measured(rng)
    ours = corrected(replace(SSM, max_iterations=200), P, system, z)
    theirs = replace(SSM, max_iterations=200, stop=StopRule.RELATIVE, floor=Floor.ADDED)
    np.testing.assert_allclose(ours.xi, corrected(theirs, P, system, z).xi, atol=1e-6)
    assert len(set(ours.n_iterations)) > 1, "runs should stop at different passes"
    assert np.all(corrected(replace(SSM, max_iterations=3), P, system, z).n_iterations == 3)
    t, dim = np.array([0.0, 2000.0, 1e5]), np.ones(3)
    clipped, added = (floor.applied_to(ExpKernel(5.0), t, dim) for floor in Floor)
    np.testing.assert_allclose(clipped[1:], WEIGHT_FLOOR)
    np.testing.assert_allclose(added, [clipped[0], WEIGHT_FLOOR, WEIGHT_FLOOR], rtol=1e-6)


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


@pytest.mark.parametrize(
    "rule", [RULES["kalman"], RULES["beam gate"], SSM, RULES["log, state too"]]
)
def test_a_known_component_stays(rule: UpdateRule) -> None:
    """A component without variance is no zero to divide by."""
    rng = np.random.default_rng(11)
    P = predicted(rng).copy()
    P[:, 0], P[:, :, 0] = 0.0, 0.0
    update = corrected(rule, P, a_system(rng), measured(rng))
    np.testing.assert_array_equal(update.xi[:, 0], 0.0)
    assert all(np.all(np.isfinite(column)) for column in update)
    assert np.all(update.n_iterations < 50)


@pytest.mark.parametrize("gate", Gate)
def test_gate_at_its_limit(gate: Gate) -> None:
    """Just inside passes in full; just outside is as if it had not been measured."""
    rng = np.random.default_rng(12)
    P, system, z = predicted(rng), a_system(rng), rng.normal(size=(N_RUNS, N_ROWS))
    z[:, 2] = np.nan
    prior = LinearModel(system, np.zeros(P.shape[:2]), z, group=EACH_ROW).at(np.zeros(P.shape[:2]))
    S = prior.jacobian @ P @ np.swapaxes(prior.jacobian, 1, 2) + np.eye(N_ROWS)
    square = prior.innovation**2 / np.einsum("bii->bi", S)
    limit = chi2.ppf(0.9973, 1)
    if gate is Gate.PING:
        nu = prior.innovation[..., None]
        square, limit = (np.swapaxes(nu, 1, 2) @ np.linalg.solve(S, nu))[:, 0], chi2.ppf(0.9973, 3)
    at_limit = np.sqrt(limit / square.max(axis=1, keepdims=True)) * z
    inside = corrected(GatedUpdate(gate), P, system, 0.999 * at_limit)
    assert_same(inside, corrected(KalmanUpdate(), P, system, 0.999 * at_limit))
    outside = corrected(GatedUpdate(gate), P, system, 1.001 * at_limit)
    if gate is Gate.PING:
        np.testing.assert_array_equal(outside.weights, np.where(np.isfinite(z), 0.0, 1.0))
        np.testing.assert_allclose(outside.xi, 0.0, atol=1e-9)
        np.testing.assert_allclose(outside.covariance, P, atol=1e-9)
    else:
        worst = square == square.max(axis=1, keepdims=True)
        np.testing.assert_array_equal(outside.weights, np.where(worst, 0.0, 1.0))


@pytest.mark.parametrize("gate", Gate)
def test_gate_passes_its_share(gate: Gate) -> None:
    """Of good measurements, as many are rejected as the confidence says."""
    rng = np.random.default_rng(13)
    n_runs, confidence = 5_000, 0.98
    P = np.broadcast_to(predicted(rng)[:1], (n_runs, N_STATES, N_STATES))
    system = a_system(rng)
    S = system.H @ P[0] @ system.H.T + system.R
    z = rng.normal(size=(n_runs, N_ROWS)) @ np.linalg.cholesky(S).T
    passed = corrected(GatedUpdate(gate, confidence), P, system, z).weights.mean()
    assert passed == pytest.approx(confidence, abs=4.0 * np.sqrt(0.02 * 0.98 / n_runs))


def test_floored_correntropy_outlives_underflow() -> None:
    """Beyond 38 kernel widths the published weights underflow; floored, the rule only rejects."""
    rng = np.random.default_rng(14)
    P, z = predicted(rng), np.full((N_RUNS, N_ROWS), 1e3)
    update = corrected(CorrentropyUpdate(2.0, max_iterations=50), P, a_system(rng), z)
    np.testing.assert_array_equal(update.weights, WEIGHT_FLOOR)
    assert np.all(np.abs(update.xi) < 1e-2 * np.sqrt(np.einsum("bii->bi", P)))


class Directions:
    """Unit vectors seen from rotations ``R_nb = R0 Exp(xi)``: two sights, three rows each."""

    group = np.arange(6)
    sigma = 0.2
    seen_n = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])

    def __init__(self, R0_nb: Array, seen_b: Array) -> None:
        self.R0_nb, self.seen_b = R0_nb, seen_b
        self.present = np.ones((len(R0_nb), 6), dtype=bool)

    def at(self, xi: Array) -> Iterate:
        """Return all runs at rotations ``xi`` from their predictions."""
        return self._at(xi, np.arange(len(xi)))

    def move(self, iterate: Iterate, step: Array, runs: Runs) -> Iterate:
        """Return where turns about the body axes lead."""
        return self._at(so3.log(so3.exp(iterate.xi) @ so3.exp(step)), runs)

    def _at(self, xi: Array, runs: Runs) -> Iterate:
        R_nb = self.R0_nb[runs] @ so3.exp(xi)
        expected_b = self.seen_n @ R_nb
        jacobian = so3.skew(expected_b).reshape(len(xi), 6, 3)
        innovation = (self.seen_b[runs] - expected_b).reshape(len(xi), 6)
        J = so3.left_jacobian(-xi)
        return Iterate(xi, innovation / self.sigma, jacobian / self.sigma, J)


def curved_runs() -> tuple[Array, Directions]:
    """Return covariances and sights of turns of half a radian, one row of each run far off."""
    rng = np.random.default_rng(15)
    P = np.diag([0.3, 0.2, 0.4]) + 0.02 * np.ones((N_RUNS, 3, 3))
    R0_nb = so3.exp(rng.normal(size=(N_RUNS, 3)))
    turn = 0.5 * rng.normal(size=(N_RUNS, 3))
    seen_b = Directions.seen_n @ (R0_nb @ so3.exp(turn))
    seen_b += Directions.sigma * rng.normal(size=seen_b.shape)
    seen_b[:, 0, 1] += 3.0
    return P, Directions(R0_nb, seen_b)


def test_curved_measurement_leads_to_the_maximum_a_posteriori() -> None:
    """With plain residuals the fixed point minimises ``xi' P^-1 xi / 2 - sum f(t)``."""
    P, model = curved_runs()
    rule = replace(SSM, similarity=Similarity.PLAIN, max_iterations=500, tolerance=1e-9)
    update = rule(P, model)
    for run in range(N_RUNS):
        alone = Directions(model.R0_nb[run : run + 1], model.seen_b[run : run + 1])
        information = np.linalg.inv(P[run])

        def cost(xi: Array, alone: Directions = alone, Y: Array = information) -> float:
            t = alone.at(xi[None]).innovation[0] ** 2
            return float(0.5 * xi @ Y @ xi - LogKernel(5.0).similarity(t).sum())

        found = minimize(cost, update.xi[run] + 0.05, method="BFGS", options={"gtol": 1e-6})
        np.testing.assert_allclose(update.xi[run], found.x, atol=1e-5)
    assert np.abs(update.xi).max() > 0.5


def test_curved_covariance_is_that_of_the_local_error() -> None:
    """Prediction and weighted rows add up as information about turns of the estimate itself."""
    P, model = curved_runs()
    update = replace(SSM, max_iterations=500)(P, model)
    end = model.at(update.xi)
    xi_D_local = np.linalg.inv(so3.left_jacobian(-update.xi))
    prior = np.swapaxes(xi_D_local, 1, 2) @ np.linalg.inv(P) @ xi_D_local
    rows = np.swapaxes(end.jacobian, 1, 2) @ (update.weights[..., None] * end.jacobian)
    np.testing.assert_allclose(update.covariance, np.linalg.inv(prior + rows), rtol=1e-5, atol=1e-9)
    spread = np.einsum("bij,bjk,bik->bi", end.jacobian, update.covariance, end.jacobian)
    t = end.innovation**2 + spread
    np.testing.assert_allclose(update.weights, LogKernel(5.0).weight(t), rtol=1e-5)
