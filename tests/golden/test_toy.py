"""The update rules against vectors that the published filters left: ``../shared/golden``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from factors.similarity import ExpKernel, Kernel, LogKernel, SqrtKernel
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.correntropy import CorrentropyUpdate
from ssm_graph.filters.rules.kalman import KalmanUpdate
from ssm_graph.filters.rules.ssm import Floor, SsmUpdate, StopRule
from ssm_graph.filters.rules.student import Scale, StudentUpdate
from ssm_graph.filters.rules.update import UpdateRule
from tests.linear_filter import LinearModel, LinearSystem, run_linear_filter

GOLDEN = Path(__file__).parents[2] / "../shared/golden/toy_a.npz"
pytestmark = pytest.mark.skipif(not GOLDEN.is_file(), reason=f"no golden vectors in {GOLDEN}")

SEQUENCES = ("m", "pm")
"""Outliers in the measurements; in measurements and process."""
TOLERANCE = 1e-8
Vectors = Mapping[str, Array]


def published(kernel: Kernel) -> SsmUpdate:
    """Return the SSMKF with the authors' own stopping test and floor."""
    return SsmUpdate(kernel, kernel, stop=StopRule.RELATIVE, floor=Floor.ADDED)


WHOLE: Mapping[str, UpdateRule] = {
    "kf": KalmanUpdate(),
    "ssm_log": published(LogKernel(5.0)),
    "ssm_sqrt": published(SqrtKernel(5.0)),
    "rst_fixed": StudentUpdate(Scale.FIXED),
    "rst_sigma": StudentUpdate(Scale.ESTIMATED),
}
"""Filters that finish both sequences."""
FAILING: Mapping[str, UpdateRule] = {
    name: CorrentropyUpdate(width, floor=0.0)
    for name, width in (("mckf_d2", 2.0), ("mckf_d5", 5.0), ("mckfw_d2", 2.0), ("mckfw_d5", 5.0))
}
"""Filters that break off at a large outlier."""
ONE_STEP = {**WHOLE, **FAILING, "ssm_exp": published(ExpKernel(5.0))}
"""The published closed loop of ``ssm_exp`` has lost its digits: judged by single steps only."""


@pytest.fixture(scope="module")
def vectors() -> Vectors:
    """Return all arrays of the file."""
    with np.load(GOLDEN) as archive:
        return dict(archive)


def system_of(vectors: Vectors) -> LinearSystem:
    """Return the system with its nominal noise."""
    return LinearSystem(vectors["F"], vectors["Q"], vectors["H"], vectors["R"])


def rows(vectors: Vectors, sequence: str, name: str, what: str) -> Array:
    """Return a result of a filter, as far as it is valid."""
    prefix = f"{sequence}_{name}"
    n_valid = vectors.get(f"{prefix}_nvalid")
    return vectors[f"{prefix}_{what}"][: None if n_valid is None else int(n_valid[0])]


def passes(vectors: Vectors, sequence: str, name: str) -> Array:
    """Return the number of linear updates of every row; the Kalman filter makes one."""
    if name == "kf":
        return np.ones(len(vectors[f"{sequence}_z"]))
    return rows(vectors, sequence, name, "iters").ravel()


def assert_covariances_agree(found: Array, expected: Array) -> None:
    """Compare covariances (..., n, n), each relative to its largest element."""
    scale = np.abs(expected).max(axis=(-2, -1), keepdims=True)
    # ``ssm_exp`` cancels about eight digits where both of its weights are at the floor.
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("name", WHOLE)
def test_closed_loop(vectors: Vectors, name: str) -> None:
    """Both sequences side by side: means, covariances, weights, and the number of passes."""
    z, x0 = (np.stack([vectors[f"{s}_{key}"] for s in SEQUENCES], axis=-2) for key in ("z", "x0"))
    P0 = np.stack([vectors["P0"]] * 2)
    history = run_linear_filter(system_of(vectors), z, x0=x0, P0=P0, rule=WHOLE[name])
    for run, sequence in enumerate(SEQUENCES):
        expected = {what: rows(vectors, sequence, name, what) for what in ("x", "P")}
        np.testing.assert_allclose(history.x[:, run], expected["x"], rtol=0.0, atol=TOLERANCE)
        assert_covariances_agree(history.P[:, run], expected["P"])
        n_iterations = [update.n_iterations[run] for update in history.updates]
        np.testing.assert_array_equal(n_iterations, passes(vectors, sequence, name))
        if name == "kf":
            continue
        weights = [update.weights[run, 0] for update in history.updates]
        state_weights = [update.state_weight[run] for update in history.updates]
        for found, key in ((weights, "lam"), (state_weights, "xi")):
            np.testing.assert_allclose(
                found, rows(vectors, sequence, name, key).ravel(), rtol=0.0, atol=TOLERANCE
            )


@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize("name", FAILING)
def test_closed_loop_until_failure(vectors: Vectors, sequence: str, name: str) -> None:
    """The correntropy filter, as published without a floor, up to the row where it breaks off."""
    expected = {what: rows(vectors, sequence, name, what) for what in ("x", "P", "G")}
    is_near = name.startswith("mckfw")
    x0 = vectors[f"{sequence}_mckfw_x0" if is_near else f"{sequence}_x0"]
    P0 = vectors["mckfw_P0" if is_near else "P0"]
    z = vectors[f"{sequence}_z"][: len(expected["x"]), None]
    history = run_linear_filter(system_of(vectors), z, x0=x0[None], P0=P0[None], rule=FAILING[name])
    np.testing.assert_allclose(history.x[:, 0], expected["x"], rtol=0.0, atol=TOLERANCE)
    assert_covariances_agree(history.P[:, 0], expected["P"])
    n_iterations = [update.n_iterations[0] for update in history.updates]
    np.testing.assert_array_equal(n_iterations, passes(vectors, sequence, name))
    weights = [update.weights[0] for update in history.updates]
    np.testing.assert_allclose(weights, expected["G"][:, x0.size :], rtol=0.0, atol=TOLERANCE)


@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize("name", ONE_STEP)
def test_one_step(vectors: Vectors, sequence: str, name: str) -> None:
    """Every stored prediction corrected once, all of them as runs side by side."""
    keys = ("x", "P", "xprior", "Pprior")
    x, P, x_prior, P_prior = (rows(vectors, sequence, name, key) for key in keys)
    z = vectors[f"{sequence}_z"][: len(x)]
    group = np.zeros(z.shape[1], dtype=np.intp)
    model = LinearModel(system_of(vectors), x_prior, z, group=group)
    update = ONE_STEP[name](P_prior, model, mean=x_prior)
    np.testing.assert_allclose(x_prior + update.xi, x, rtol=0.0, atol=TOLERANCE)
    assert_covariances_agree(update.covariance, P)
    np.testing.assert_array_equal(update.n_iterations, passes(vectors, sequence, name))


def test_floor_prevents_the_published_failure(vectors: Vectors) -> None:
    """With floored weights the narrow kernel finishes both sequences that break off without."""
    assert all(vectors[f"{s}_mckf_d2_nvalid"][0] < len(vectors[f"{s}_z"]) for s in SEQUENCES)
    z, x0 = (np.stack([vectors[f"{s}_{key}"] for s in SEQUENCES], axis=-2) for key in ("z", "x0"))
    P0 = np.stack([vectors["P0"]] * 2)
    rule = CorrentropyUpdate(2.0)
    history = run_linear_filter(system_of(vectors), z, x0=x0, P0=P0, rule=rule)
    assert np.all(np.isfinite(history.x))
    assert np.all(np.linalg.eigvalsh(history.P) > 0.0)
