"""Scale factors, misalignments and g-sensitivity of inertial sensors: 27 numbers at most.

An error is a share of what is *read*, so that it acts on each sample as a bias that is known::

    rate  = gyro  - W gyro  - G accel - gyro_bias
    force = accel - A accel           - accel_bias

For people they are a share of what is true, ``gyro = (I + S_g) rate + S_f force + bias`` and
``accel = (I + S_a) force + bias``: the same but for the square of the error, see :func:`stated`.
The columns of all are, row by row, those of ``W``, ``A`` and ``G``.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from factors.so3 import Array, skew

SIZE: Final = 27
GYRO: Final = slice(0, 9)
"""``W``, the rows of a 3 x 3 matrix one after the other; so are the next."""
ACCEL: Final = slice(9, 18)
"""``A``"""
BY_FORCE: Final = slice(18, 27)
"""``G``, rad/s per m/s^2"""
NONE: Final = np.zeros(SIZE)
NONE.setflags(write=False)
_TERMS: Final = 9
"""Of the exponential series of one sample: at a turn of 1 rad the next is 3e-7."""


def matrices(errors: Array) -> tuple[Array, Array, Array]:
    """Return ``W``, ``A`` and ``G``, (..., 3, 3) each, of errors (..., 27)."""
    shape = (*errors.shape[:-1], 3, 3)
    W, A, G = (errors[..., part].reshape(shape) for part in (GYRO, ACCEL, BY_FORCE))
    return W, A, G


def taken_off(errors: Array, gyro_b: Array, accel_b: Array) -> tuple[Array, Array]:
    """Return readings (N, 3) of both sensors without errors (27,) or (N, 27)."""
    W, A, G = matrices(errors)
    gyro, accel = gyro_b[:, :, None], accel_b[:, :, None]
    return gyro_b - (W @ gyro + G @ accel)[..., 0], accel_b - (A @ accel)[..., 0]


def put_on(errors: Array, gyro_b: Array, accel_b: Array) -> tuple[Array, Array]:
    """Return what reads (N, 3) without errors (27,) as it was with them."""
    W, A, G = matrices(errors)
    accel = accel_b @ np.linalg.inv(np.eye(3) - A).T
    return (gyro_b + accel @ G.T) @ np.linalg.inv(np.eye(3) - W).T, accel


def stated(errors: Array) -> tuple[Array, Array]:
    """Return errors (27,) of what is read as such of what is true, and the slope (27, 27).

    ``I + S_g = (I - W)^-1``, ``I + S_a = (I - A)^-1``, ``S_f = (I + S_g) G (I + S_a)``. The inverse
    is the same but for signs: ``-stated(-errors)``.
    """
    W, A, G = matrices(errors)
    gyro, accel = np.linalg.inv(np.eye(3) - W), np.linalg.inv(np.eye(3) - A)
    by_force = gyro @ G @ accel
    slope = np.zeros((SIZE, SIZE))
    # Row by row, the derivative of X M Y is that of Kronecker.
    slope[GYRO, GYRO], slope[ACCEL, ACCEL] = np.kron(gyro, gyro.T), np.kron(accel, accel.T)
    slope[BY_FORCE, GYRO] = np.kron(gyro, by_force.T)
    slope[BY_FORCE, ACCEL] = np.kron(by_force, accel.T)
    slope[BY_FORCE, BY_FORCE] = np.kron(gyro, accel.T)
    parts = gyro - np.eye(3), accel - np.eye(3), by_force
    return np.concatenate([part.ravel() for part in parts]), slope


def increment_jacobians(
    errors: Array, *, dt: Array, gyro_b: Array, accel_b: Array, first: Array, bias: Array
) -> Array:
    """Return how preintegrated increments follow the errors, (I, 9, 27).

    Rotation, position and velocity in body axes at the end, as for biases in
    :class:`factors.inertial.Intervals`. An error ``xi`` of what a sample starts from grows by
    ``xi' = F xi - (rate error, 0, force error)`` while rate and force are constant.

    Parameters
    ----------
    errors : (27,) that are taken off already.
    dt : (M,) s, of the samples.
    gyro_b, accel_b : (M, 3) rad/s and m/s^2, with the errors taken off and the biases not.
    first : (I + 1,) index of the first sample of each interval, and M.
    bias : (6,) accelerometer and gyro, that the increments are made about.
    """
    count = np.diff(first)
    made = np.zeros((len(count), 9, SIZE))
    for step in range(int(count.max(initial=0))):
        now = np.flatnonzero(count > step)
        sample = first[now] + step
        gyro, accel = gyro_b[sample], accel_b[sample]
        led, pushed = _sample(gyro - bias[3:], accel - bias[:3], dt[sample])
        made[now] = led @ made[now]
        # Of a matrix row by row: rate error i is that row times the readings.
        gyro, accel = (column[:, None, :] for column in put_on(errors, gyro, accel))
        for part, columns, read in (
            (GYRO, slice(0, 3), gyro),
            (ACCEL, slice(3, 6), accel),
            (BY_FORCE, slice(0, 3), accel),
        ):
            block = pushed[:, :, columns, None] * read[:, None]
            made[now, :, part] -= block.reshape(len(now), 9, 9)
    return made


def _sample(rate: Array, force: Array, dt: Array) -> tuple[Array, Array]:
    """Return how an error is led through samples (M, 9, 9), and what readings add (M, 9, 6)."""
    eye = np.eye(3)
    F = np.zeros((len(dt), 9, 9))
    turning = -skew(rate)
    for k in (0, 3, 6):
        F[:, k : k + 3, k : k + 3] = turning
    F[:, 3:6, 6:9] = eye
    F[:, 6:9, :3] = -skew(force)
    F *= dt[:, None, None]
    power = np.broadcast_to(np.eye(9), F.shape)
    led, mean = power.copy(), power.copy()
    for k in range(1, _TERMS + 1):
        power = power @ F / k
        led += power
        mean += power / (k + 1)
    mean *= dt[:, None, None]
    return led, np.concatenate([mean[:, :, :3], mean[:, :, 6:]], axis=2)
