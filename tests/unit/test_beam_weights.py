"""What the beams of one ping are worth where the prediction cannot tell."""

from __future__ import annotations

import numpy as np

from factors.similarity import WEIGHT_FLOOR, LogKernel
from ssm_graph.graph.beam_weights import MEMORY_PINGS, first_trust, settle_weights, updated_trust

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
    first = first_trust(trust, predicted(1.0), VARIANCE)
    np.testing.assert_array_equal(first, [1.0, WEIGHT_FLOOR, 1.0, 1.0])
    weights = settle_weights(innovation, predicted(1.0), VARIANCE, KERNEL, first=first)
    assert weights[1] < 0.1
    assert weights[[0, 2, 3]].min() > 0.5
    sound = settle_weights(innovation * [1, 0, 1, 1], predicted(1.0), VARIANCE, KERNEL, first=first)
    assert sound[1] > 0.5, "a beam that has come right counts again"


def test_a_good_prediction_judges_for_itself() -> None:
    """As it does where fewer than three beams were trusted."""
    trust = np.array([1.0, 0.0, 0.9, 0.8])
    np.testing.assert_array_equal(first_trust(trust, predicted(0.01), VARIANCE), np.ones(4))
    two = np.array([1.0, 0.0, 0.1, 0.8])
    np.testing.assert_array_equal(first_trust(two, predicted(1.0), VARIANCE), np.ones(4))


def test_trust_follows_the_weights_of_a_few_pings() -> None:
    """Beams that are missing keep theirs."""
    trust = np.ones(4)
    for _ in range(round(3 * MEMORY_PINGS)):
        trust = updated_trust(trust, np.array([1, 2]), np.array([0.0, 1.0]))
    assert trust[1] < 0.1
    np.testing.assert_allclose(trust[[0, 2, 3]], 1.0)
