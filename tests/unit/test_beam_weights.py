"""What the beams of one ping are worth where the prediction cannot tell."""

from __future__ import annotations

import numpy as np

from factors.similarity import WEIGHT_FLOOR, LogKernel
from ssm_graph.graph.first_weights import MEMORY_PINGS, met_weights, updated_trust

KERNEL = LogKernel()
VARIANCE = np.full(4, 0.005**2)
BEAMS = np.array([[1.0, 1.0, 2.2], [-1.0, 1.0, 2.2], [-1.0, -1.0, 2.2], [1.0, -1.0, 2.2]]) / 2.6


def predicted(speed_sigma: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the covariance (4, 4) of the beams from that of the velocity."""
    return speed_sigma**2 * BEAMS @ BEAMS.T


def test_what_was_wrong_before_is_met_with_doubt_where_the_prediction_is_poor() -> None:
    """Any three of four beams agree with a velocity that is not known."""
    trust = np.array([1.0, 0.0, 0.9, 0.8])
    innovation = np.array([0.0, 0.4, 0.001, -0.002])
    weights = met_weights(innovation, predicted(1.0), VARIANCE, KERNEL, trust=trust)
    assert weights[1] < 0.1
    assert weights[[0, 2, 3]].min() > 0.5
    right = innovation * [1.0, 0.0, 1.0, 1.0]
    weights = met_weights(right, predicted(1.0), VARIANCE, KERNEL, trust=trust)
    assert weights[1] > 0.5, "a beam that has come right counts again"


def test_a_ping_that_nothing_decides_is_left_out() -> None:
    """All four residuals of a velocity that is not known are of one size, whichever beam it was."""
    innovation = np.array([0.0, 0.4, 0.001, -0.002])
    for trust in (np.ones(4), np.array([1.0, 0.0, 0.1, 0.8])):
        weights = met_weights(innovation, predicted(1.0), VARIANCE, KERNEL, trust=trust)
        np.testing.assert_array_equal(weights, np.full(4, WEIGHT_FLOOR))
        np.testing.assert_array_equal(updated_trust(trust, np.arange(4), weights), trust)


def test_a_good_prediction_judges_for_itself() -> None:
    """What a beam was worth before does not matter, and far beams keep their small weight."""
    trust, innovation = np.array([1.0, 0.0, 0.9, 0.8]), np.array([0.4, 0.001, 0.0, -0.002])
    weights = met_weights(innovation, predicted(0.01), VARIANCE, KERNEL, trust=trust)
    assert weights[1:].min() > 0.5
    assert WEIGHT_FLOOR < weights[0] < 0.1


def test_trust_follows_the_weights_of_a_few_pings() -> None:
    """Beams that are missing keep theirs."""
    trust = np.ones(4)
    for _ in range(round(3 * MEMORY_PINGS)):
        trust = updated_trust(trust, np.array([1, 2]), np.array([0.0, 1.0]))
    assert trust[1] < 0.1
    np.testing.assert_allclose(trust[[0, 2, 3]], 1.0)
