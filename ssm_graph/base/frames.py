"""Attitude conversions between heading-pitch-roll and rotation matrices.

Letters: ``n`` navigation frame, ``l`` local east-north-up axes at the vehicle, ``b`` body
(forward-right-down), ``d`` DVL instrument.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

R_ENU_NED: Final[Array] = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""North-east-down to east-north-up; its own inverse."""
R_ENU_NED.setflags(write=False)


class BodyAxes(Enum):
    """Body axes of the world outside; inside they are forward-right-down."""

    FRD = "FRD"
    FLU = "FLU"
    RFU = "RFU"


R_FRD: Final[Mapping[BodyAxes, Array]] = {
    BodyAxes.FRD: np.diag([1.0, 1.0, 1.0]),
    BodyAxes.FLU: np.diag([1.0, -1.0, -1.0]),
    BodyAxes.RFU: np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}
"""Rotations to forward-right-down; each is its own inverse."""


MATRIX_PLACES: Final = {3: [0, 4, 8], 6: [1, 2, 3, 5, 6, 7], 9: list(range(9))}
"""Of so many numbers of a 3 x 3 matrix, the places among its nine, row by row."""


def to_frd(vectors: Array, axes: BodyAxes) -> Array:
    """Return body vectors (..., 3) in forward-right-down."""
    return np.asarray(vectors @ R_FRD[axes].T)


def matrix_to_frd(values: Array, axes: BodyAxes) -> Array:
    """Return numbers of a matrix that takes body vectors to such, for axes FRD; its own inverse.

    They are its diagonal (3,), the rows of what is beside it (6,), or all of its rows (9,).
    """
    place = MATRIX_PLACES[len(values)]
    matrix = np.zeros(9)
    matrix[place] = values
    turn = R_FRD[axes]
    return np.asarray((turn @ matrix.reshape(3, 3) @ turn.T).ravel()[place])


def turned(vector: tuple[float, float, float], axes: BodyAxes) -> tuple[float, float, float]:
    """Return one body vector in forward-right-down, or from there, digit by digit."""
    x, y, z = vector
    if axes is BodyAxes.FLU:
        return x, -y, -z
    return (y, x, -z) if axes is BodyAxes.RFU else vector


def rotation_zyx(yaw: Array | float, pitch: Array | float, roll: Array | float) -> Array:
    """Return ``Rz(yaw) Ry(pitch) Rx(roll)``, (..., 3, 3), radians."""
    from scipy.spatial.transform import Rotation

    angles = np.stack(np.broadcast_arrays(yaw, pitch, roll), axis=-1).astype(float)
    matrix = Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix()
    return np.asarray(matrix).reshape(*angles.shape, 3)


def R_lb_from_roll_pitch_heading(
    roll: Array | float, pitch: Array | float, heading: Array | float
) -> Array:
    """Return rotations (..., 3, 3) from body to local east-north-up axes; heading from north."""
    return np.asarray(R_ENU_NED @ rotation_zyx(heading, pitch, roll))


def roll_pitch_heading_from_R_lb(R_lb: Array) -> tuple[Array, Array, Array]:
    """Return roll, pitch (-pi/2..pi/2) and heading (0..2 pi), radians."""
    R_ned_b = R_ENU_NED @ R_lb
    roll = np.arctan2(R_ned_b[..., 2, 1], R_ned_b[..., 2, 2])
    pitch = np.arcsin(np.clip(-R_ned_b[..., 2, 0], -1.0, 1.0))
    heading = np.arctan2(R_ned_b[..., 1, 0], R_ned_b[..., 0, 0]) % (2.0 * np.pi)
    # A hair below north rounds to a full turn.
    return roll, pitch, np.where(heading < 2.0 * np.pi, heading, 0.0)


def phi_D_roll_pitch_heading(roll: Array | float, pitch: Array | float) -> Array:
    """Return the Jacobian (..., 3, 3) of body-axes rotation ``phi`` to (roll, pitch, heading).

    ``R_lb(rph + d) = R_lb(rph) Exp(J d)`` to first order; singular at a pitch of 90 degrees.
    """
    roll, pitch = np.broadcast_arrays(np.asarray(roll, float), np.asarray(pitch, float))
    zero, one = np.zeros_like(roll), np.ones_like(roll)
    rows = [
        [one, zero, -np.sin(pitch)],
        [zero, np.cos(roll), np.sin(roll) * np.cos(pitch)],
        [zero, -np.sin(roll), np.cos(roll) * np.cos(pitch)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def wrap_to_pi(angle: Array | float) -> Array:
    """Return the angle in [-pi, pi)."""
    return np.asarray((np.asarray(angle) + np.pi) % (2.0 * np.pi) - np.pi)
