"""What the particles say of the first pose of a window, before its lines are asked."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEGREE
from ssm_graph.systems.road_map.locator import LocatorSettings
from ssm_graph.systems.road_map.refinement import Prior

ALONG_INFLATION: Final = 1.5
"""By which the particles' sigma along the road is too small, on routes 0 to 39: they take the
errors of the map for what tells one place from another."""
_LEAST: Final = (0.05, 0.05, 0.2 * DEGREE)
"""m, m, rad: what is added to sigmas of a few particles that lie on each other."""


def prior_of(mean: Array, cov: Array, settings: LocatorSettings, spread_m: float = 0.0) -> Prior:
    """Return the prior of a pose from mean (5,) and covariance (5, 5) of the particles.

    What is along the pose is tied to nothing else: few ancestors share all that is known along a
    road; how they happen to lie across it or turned would, once that is known to centimetres, be
    taken for knowledge of the place along it. Of the scale of the speed and the bias of the yaw
    rate those few know by chance alone: the window finds its own, from zero.

    ``spread_m`` is a sigma that is added in both axes of the plane.
    """
    c, s = np.cos(mean[2]), np.sin(mean[2])
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    own = cov[:3, :3] + np.diag(np.square([*np.hypot(_LEAST[:2], spread_m), _LEAST[2]]))
    own = turned @ own @ turned.T
    own[0, 1:], own[1:, 0] = 0.0, 0.0
    information = np.zeros((5, 5))
    information[3, 3], information[4, 4] = settings.scale_sigma**-2, settings.bias_sigma**-2
    information[:3, :3] = np.linalg.inv(ALONG_INFLATION**2 * turned.T @ own @ turned)
    return Prior(np.concatenate([mean[:3], np.zeros(2)]), information)
