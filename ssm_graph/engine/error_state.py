"""The error state of a keyframe, and its mean and covariance at the start."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array

STATE_DIM = 15
"""Error state of a keyframe: rotation 3, position 3 (both body axes), velocity 3 (navigation
axes), accelerometer bias 3, gyro bias 3."""
ROTATION, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
ACCEL_BIAS, GYRO_BIAS = slice(9, 12), slice(12, 15)

NO_EXTRA = np.zeros(0)
NO_EXTRA.setflags(write=False)


class Linearised(Enum):
    """Where the measurements of a keyframe are linearised."""

    EACH_PASS = "at each pass anew: Gauss-Newton"
    ONCE = "at the prediction: a linear error state, as in closed-loop inertial filters"


class InitialMoments(NamedTuple):
    """Mean and covariance of the first keyframe."""

    R_nb: Array
    p_n: Array
    v_n: Array
    bias: Array
    covariance: Array
    """(15 + E, 15 + E) in the order of the error state, then of the extra variables."""
    extra: Array = NO_EXTRA
    """(E,) extra variables that are carried in the state."""
