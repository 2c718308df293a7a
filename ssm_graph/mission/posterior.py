"""Everything a smoother knows of its keyframes, for answers between them and at other points."""

from __future__ import annotations

from dataclasses import dataclass

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, FrozenArrays, optional_shaped, shaped


@dataclass(frozen=True, slots=True, eq=False)
class Posterior(FrozenArrays):
    """States of N keyframes with the covariance of each, and of each with the next.

    An error state is rotation and position in body axes, velocity in navigation axes, biases of
    accelerometers and gyros; SI units, radians.
    """

    frame: LocalFrame
    """The navigation frame"""
    time_s: Array = shaped("N")
    R_nb: Array = shaped("N", 3, 3)
    p_n: Array = shaped("N", 3)
    """(N, 3) m"""
    v_n: Array = shaped("N", 3)
    """(N, 3) m/s"""
    bias: Array = shaped("N", 6)
    """(N, 6) accelerometer m/s^2, gyro rad/s"""
    covariance: Array = shaped("N", 15, 15)
    neighbour_covariance: Array = shaped("M", 15, 15)
    """(N - 1, 15, 15) of each with the next"""
    imu_errors: Array | None = optional_shaped("E", 27)
    """(1, 27) or (N, 27) errors of the inertial sensors, see :mod:`factors.imu_errors`, that the
    answer takes off what they read; None where they are as stated"""
