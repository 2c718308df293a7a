"""How much each component of a keyframe's state bends what is measured there."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extras
from ssm_graph.mission.calibration import (
    DVL_BEAM_SCALE,
    DVL_LEVER_ARM,
    DVL_MOUNTING,
    DVL_SCALE,
    GNSS_LEVER_ARM,
    GNSS_TIME_OFFSET,
)

_STRAIGHT: Final = 1e6
_AS_A_TURN: Final = {
    DVL_MOUNTING: 1.0,
    DVL_SCALE: 1.0,
    DVL_BEAM_SCALE: 1.0,
    DVL_LEVER_ARM: 1e2,
    GNSS_LEVER_ARM: 1e2,
    GNSS_TIME_OFFSET: 1e1,
}
"""Rad, shares, metres and seconds; of others the measurements are linear functions."""


class Bends(NamedTuple):
    """Of n components."""

    share: Array
    """(n,) of what the attitude bends, by the same number of sigmas"""
    as_a_turn: Array
    """(n,) what bends as much as a turn of 1 rad: metres, metres per second, biases ..."""


def bends_of(extras: Extras) -> Bends:
    """Return those of the error state and of the extra variables behind it."""
    share = np.full(extras.width, 0.1)
    share[:3] = 1.0
    as_a_turn = np.full(extras.width, _STRAIGHT)
    as_a_turn[:9] = np.repeat([1.0, 1e4, 1e2], 3)
    for name, amount in _AS_A_TURN.items():
        if name in extras:
            as_a_turn[extras.columns(name)] = amount
    return Bends(share, as_a_turn)
