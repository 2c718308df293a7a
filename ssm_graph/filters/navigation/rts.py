"""Rauch-Tung-Striebel smoothing over the history of any filter.

References
----------
.. [1] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic
   systems", AIAA Journal 3, 1965.
"""

from __future__ import annotations

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.filters.navigation.history import FilterHistory, StateHistory


def smooth_history(history: FilterHistory) -> StateHistory:
    """Return the states given all measurements, by one pass backwards in time.

    Error states of successive keyframes are related by the filter's own transitions; what the
    smoothed states differ from the predicted ones goes back through the gain ``P F' P_pred^-1``.
    """
    posterior, predicted = history.posterior, history.predicted
    n_keyframes, n_runs = posterior.p_n.shape[:2]
    smoothed = StateHistory.empty(n_keyframes, n_runs)
    states, covariance = posterior.at(n_keyframes - 1), posterior.covariance[-1]
    smoothed.put(n_keyframes - 1, states, covariance)
    for k in range(n_keyframes - 2, -1, -1):
        gain = _gain(posterior.covariance[k], history.transition[k], predicted.covariance[k + 1])
        missed = predicted.at(k + 1).deviation_of(states)
        states = posterior.at(k).displaced((gain @ missed[..., None])[..., 0])
        change = covariance - predicted.covariance[k + 1]
        covariance = posterior.covariance[k] + gain @ change @ np.swapaxes(gain, 1, 2)
        covariance = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
        smoothed.put(k, states, covariance)
    return smoothed


def _gain(posterior: Array, transition: Array, predicted: Array) -> Array:
    """Return ``P F' P_pred^-1`` (B, 15, 15), solved in correlation form."""
    scale = np.sqrt(np.diagonal(predicted, axis1=1, axis2=2))
    correlation = predicted / (scale[:, :, None] * scale[:, None, :])
    cross = transition @ posterior / scale[:, :, None]
    return np.swapaxes(np.linalg.solve(correlation, cross) / scale[:, :, None], 1, 2)
