"""What the smoother found of the current, as part of its answer."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extras
from ssm_graph.mission.current import CURRENT, CURRENT_UP
from ssm_graph.mission.estimate import CurrentTrack
from ssm_graph.smoothers.stretch import Stretch


def current_of(
    extras: Extras, time_s: Array, walks: Array, covariance: Array
) -> CurrentTrack | None:
    """Return the current of an answer with its covariance, None if it has none.

    Parameters
    ----------
    extras : what was estimated.
    time_s : (K,) s, of the keyframes.
    walks : (K, s)
    covariance : (K, s, s) of the walks of each keyframe.
    """
    if CURRENT not in extras:
        return None
    n, known = len(time_s), [*_columns(extras, CURRENT), *_columns(extras, CURRENT_UP)]
    velocity, own = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for i, a in enumerate(known):
        velocity[:, i] = walks[:, a]
        for j, b in enumerate(known):
            own[:, i, j] = covariance[:, a, b]
    return CurrentTrack(time_s, velocity, own)


def current_along(extras: Extras, track: Stretch) -> CurrentTrack | None:
    """Return the current that the keyframes of a window's track carry in their states."""
    covariance = track.covariance[:, STATE_DIM:, STATE_DIM:]
    return current_of(extras, track.time_s, track.states.walks, covariance)


def _columns(extras: Extras, name: str) -> range:
    """Return the walks of a variable, none for one that there is not."""
    if name not in extras:
        return range(0)
    columns = extras.columns(name)
    return range(columns.start - STATE_DIM, columns.stop - STATE_DIM)
