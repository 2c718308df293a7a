"""Where features are, from all of their sightings along a first track: a start for the estimate."""

from __future__ import annotations

from typing import Final

import numpy as np

from factors.similarity import LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.features import FeatureSightings, feature_name
from ssm_graph.graph.measurements import Measurements

SIGMA_OF_MEDIAN: Final = 1.4826
"""A Gaussian's standard deviation over its median absolute value."""
ROUNDS: Final = 20
SETTLED_M: Final = 1e-3
_KERNEL: Final = LogKernel()


def find_features(
    states: States, aids: Measurements, extras: Extras, weights: Array
) -> tuple[States, Array]:
    """Return the states with all features where most of their sightings put them.

    With them come the weights (M,) of all measurements. What the track is off by widens the scale
    that places are judged by.
    """
    constants, weights = states.constants.copy(), weights.copy()
    for aid in aids.all:
        if not isinstance(aid, FeatureSightings):
            continue
        seen_n, own = aid.places_n(aids.at_keyframes(aid, states)), aids.of(aid, weights)
        spread = np.column_stack([np.ones(len(aid)), aid.range_m, aid.range_m]) / aid.root
        sigma = np.linalg.norm(spread, axis=1) / np.sqrt(3.0)
        for number in np.unique(aid.feature).tolist():
            its = aid.feature == number
            place, own[its] = _middle(seen_n[its], sigma[its])
            first = extras.columns(feature_name(number)).start - extras.state_dim
            constants[first : first + 3] = place
    return states._replace(constants=constants), weights


def _middle(places: Array, sigma: Array) -> tuple[Array, Array]:
    """Return where places (N, 3) with sigmas (N,) lie for the most part, and weights (N,)."""
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    at = places[int(np.argmin(np.median(apart, axis=1)))]
    weight = np.ones(len(places))
    for _ in range(ROUNDS):
        off = np.linalg.norm(places - at, axis=1)
        scale = np.maximum(sigma, SIGMA_OF_MEDIAN / np.sqrt(3.0) * float(np.median(off)))
        weight = _KERNEL.weight((off / scale) ** 2, dim=3)
        share = weight / scale**2
        moved = (share @ places) / share.sum()
        step, at = float(np.linalg.norm(moved - at)), moved
        if step < SETTLED_M:
            break
    return at, weight
