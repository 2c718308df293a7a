"""Scale factors, misalignments and g-sensitivity of inertial sensors: 27 numbers at most.

An error is a share of what is *read*, so that it acts on each sample as a bias that is known::

    rate  = gyro  - W gyro  - G accel - gyro_bias
    force = accel - A accel           - accel_bias

As variables, and for people, they are a share of what is true, ``gyro = (I + S_g) rate + S_f force
+ bias`` and ``accel = (I + S_a) force + bias``: the same but for the square of the error, see
:func:`of_readings`. The columns of all are, row by row, those of ``W``, ``A`` and ``G``.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from factors.so3 import Array, skew, times

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


def of_readings(stated: Array) -> tuple[Array, Array]:
    """Return errors (..., 27) of what is read from those of what is true, and the slope.

    ``stated`` (..., 27) are ``S_g``, ``S_a`` and ``S_f``: ``W = I - (I + S_g)^-1``,
    ``A = I - (I + S_a)^-1``, ``G = (I + S_g)^-1 S_f (I + S_a)^-1``. The slope is (..., 27, 27).
    """
    S_g, S_a, S_f = matrices(stated)
    eye = np.eye(3)
    gyro, accel = (np.asarray(np.linalg.inv(eye + S), np.float64) for S in (S_g, S_a))
    by_force = gyro @ S_f @ accel
    slope = np.zeros((*stated.shape, SIZE))
    slope[..., GYRO, GYRO], slope[..., ACCEL, ACCEL] = _around(gyro, gyro), _around(accel, accel)
    slope[..., BY_FORCE, GYRO] = -_around(gyro, by_force)
    slope[..., BY_FORCE, ACCEL] = -_around(by_force, accel)
    slope[..., BY_FORCE, BY_FORCE] = _around(gyro, accel)
    parts = (part.reshape(*stated.shape[:-1], 9) for part in (eye - gyro, eye - accel, by_force))
    return np.concatenate([*parts], axis=-1), slope


def _around(left: Array, right: Array) -> Array:
    """Return the derivative (..., 9, 9) of ``left M right`` by ``M``, row by row."""
    product = np.einsum("...ij,...kl->...iljk", left, right)
    return np.asarray(product.reshape(*left.shape[:-2], 9, 9))


def noise_scale(errors: Array) -> Array:
    """Return what becomes of the noise of increments, (..., 15, 15), once errors are taken off.

    Of rotation by ``I - W``, of position and velocity by ``I - A``; biases are those of what is
    left. The turn within an interval is not looked at: it matters where axes differ by much.
    """
    W, A, _ = matrices(errors)
    scale = np.zeros((*errors.shape[:-1], 15, 15))
    scale[...] = np.eye(15)
    scale[..., :3, :3] -= W
    scale[..., 3:6, 3:6] -= A
    scale[..., 6:9, 6:9] -= A
    return scale


def by_noise_scale(errors: Array, error: Array) -> Array:
    """Return how errors (I, 3, 3) of increments follow through the noise that they are counted in.

    Whitened by the inverse of :func:`noise_scale`, ``T(x) e`` has the slope ``T (e' + E T e)`` with
    ``E`` that of ``W`` or ``A``: this is the second part, (I, 3, 3, 27).
    """
    W, A, _ = matrices(errors)
    eye = np.eye(3)
    turn, force = (np.asarray(np.linalg.inv(eye - M), np.float64) for M in (W, A))
    made = np.zeros((*error.shape, SIZE))
    turned = times(turn, error[:, 0])
    pushed = error[:, 1:] @ force.mT
    for i in range(3):
        own = 3 * i + np.arange(3)
        made[:, 0, i, GYRO.start + own] = turned
        made[:, 1:, i, ACCEL.start + own] = pushed
    return made


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
