"""The update rules of the literature, each for itself: weights, gates, floors, curvature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2

from factors import so3
from factors.similarity import WEIGHT_FLOOR, ExpKernel, LogKernel, Similarity
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import Linearised
from ssm_graph.filters.rules.correntropy import CorrentropyUpdate
from ssm_graph.filters.rules.kalman import GatedUpdate, KalmanUpdate
from ssm_graph.filters.rules.ssm import Floor, SsmUpdate, StopRule
from ssm_graph.filters.rules.update import NOMINAL, Iterate, Runs
from tests.linear_filter import LinearModel, LinearSystem
from tests.update_fixture import (
    ALL_ROWS,
    EACH_ROW,
    N_ROWS,
    N_RUNS,
    N_STATES,
    a_system,
    assert_same,
    corrected,
    measured,
    predicted,
)

SSM = SsmUpdate(LogKernel(5.0))


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


each_grouping = pytest.mark.parametrize("group", [EACH_ROW, ALL_ROWS], ids=["rows", "one group"])


@each_grouping
def test_gate_at_its_limit(group: Runs) -> None:
    """Just inside passes in full; just outside is as if it had not been measured."""
    rng = np.random.default_rng(12)
    P, system, z = predicted(rng), a_system(rng), rng.normal(size=(N_RUNS, N_ROWS))
    z[:, 2] = np.nan
    prior = LinearModel(system, np.zeros(P.shape[:2]), z, group=EACH_ROW).at(np.zeros(P.shape[:2]))
    S = prior.jacobian @ P @ np.swapaxes(prior.jacobian, 1, 2) + np.eye(N_ROWS)
    square = prior.innovation**2 / np.einsum("bii->bi", S)
    limit = chi2.ppf(0.9973, 1)
    if group is ALL_ROWS:
        nu = prior.innovation[..., None]
        square, limit = (np.swapaxes(nu, 1, 2) @ np.linalg.solve(S, nu))[:, 0], chi2.ppf(0.9973, 3)
    at_limit = np.sqrt(limit / square.max(axis=1, keepdims=True)) * z
    inside = corrected(GatedUpdate(), P, system, 0.999 * at_limit, group)
    assert_same(inside, corrected(KalmanUpdate(), P, system, 0.999 * at_limit, group))
    outside = corrected(GatedUpdate(), P, system, 1.001 * at_limit, group)
    if group is ALL_ROWS:
        np.testing.assert_array_equal(outside.weights, np.where(np.isfinite(z), 0.0, 1.0))
        np.testing.assert_allclose(outside.xi, 0.0, atol=1e-9)
        np.testing.assert_allclose(outside.covariance, P, atol=1e-9)
    else:
        worst = square == square.max(axis=1, keepdims=True)
        np.testing.assert_array_equal(outside.weights, np.where(worst, 0.0, 1.0))


@each_grouping
def test_gate_passes_its_share(group: Runs) -> None:
    """Of good measurements, as many are rejected as the confidence says."""
    rng = np.random.default_rng(13)
    n_runs, confidence = 5_000, 0.98
    P = np.broadcast_to(predicted(rng)[:1], (n_runs, N_STATES, N_STATES))
    system = a_system(rng)
    S = system.H @ P[0] @ system.H.T + system.R
    z = rng.normal(size=(n_runs, N_ROWS)) @ np.linalg.cholesky(S).T
    passed = corrected(GatedUpdate(confidence), P, system, z, group).weights.mean()
    assert passed == pytest.approx(confidence, abs=4.0 * np.sqrt(0.02 * 0.98 / n_runs))


def test_floored_correntropy_outlives_underflow() -> None:
    """Beyond 38 kernel widths the published weights underflow; floored, the rule only rejects."""
    rng = np.random.default_rng(14)
    P, z = predicted(rng), np.full((N_RUNS, N_ROWS), 1e3)
    update = corrected(CorrentropyUpdate(2.0, max_iterations=50), P, a_system(rng), z)
    np.testing.assert_array_equal(update.weights, WEIGHT_FLOOR)
    assert np.all(np.abs(update.xi) < 1e-2 * np.sqrt(np.einsum("bii->bi", P)))


def test_without_floor_a_far_row_is_as_good_as_absent() -> None:
    """As published, its weight underflows to zero and its noise to infinity: nothing breaks.

    What breaks is a prediction so far from rows that always count: its covariance is infinite.
    """
    eye = np.eye(2)
    system = LinearSystem(eye, eye, eye, eye)
    P, mean, far = eye[None], np.zeros((1, 2)), np.array([[1e3, 0.5]])
    rule = CorrentropyUpdate(2.0, floor=0.0)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        robust = rule(P, LinearModel(system, mean, far, group=EACH_ROW[:2]))
        nominal = rule(P, LinearModel(system, mean, far, group=np.array([NOMINAL, 0])))
    absent = LinearModel(system, mean, np.array([[np.nan, 0.5]]), group=EACH_ROW[:2])
    np.testing.assert_array_equal(robust.weights[:, 0], 0.0)
    np.testing.assert_allclose(robust.xi, rule(P, absent).xi)
    np.testing.assert_allclose(robust.covariance, rule(P, absent).covariance)
    assert np.all(np.isnan(nominal.covariance))


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
