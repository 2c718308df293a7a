"""Errors of the inertial sensors as variables: which of the 27 numbers, and their values."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from factors.imu_errors import ACCEL, BY_FORCE, GYRO, SIZE, of_readings
from ssm_graph.base.frames import MATRIX_PLACES
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extra, Extras
from ssm_graph.sensors.imu_calibration import LABELS, UNITS, ImuCalibration

AS_A_TURN: Final = 1.0
"""A share of what is read bends what is measured as much as a turn by it."""
GYRO_SCALE: Final = "gyro_scale"
COLUMNS: Final = {
    GYRO_SCALE: GYRO.start + np.array(MATRIX_PLACES[3]),
    "gyro_misalignment": GYRO.start + np.array(MATRIX_PLACES[6]),
    "gyro_g_sensitivity": BY_FORCE.start + np.array(MATRIX_PLACES[9]),
    "accel_scale": ACCEL.start + np.array(MATRIX_PLACES[3]),
    "accel_misalignment": ACCEL.start + np.array(MATRIX_PLACES[6]),
}
"""By the names of the variables, their places in the errors of :mod:`factors.imu_errors`."""


def imu_extras(calibration: ImuCalibration) -> Iterator[Extra]:
    """Yield what the sigmas of a calibration ask for; of the others they are zero."""
    for name, columns in COLUMNS.items():
        shown, unit = UNITS[name]
        labels = tuple(f"{name}_{label}_{shown}" for label in LABELS[len(columns)])
        sigma = np.full(len(columns), getattr(calibration, f"{name}_sigma"))
        yield Extra(name, labels, sigma, unit=unit, as_a_turn=AS_A_TURN)


def imu_columns(extras: Extras) -> NDArray[np.intp]:
    """Return which of the 27 errors are variables (E,), in the order of the variables."""
    own = [COLUMNS[block.name] for block in extras.blocks if block.name in COLUMNS]
    return np.concatenate([np.zeros(0, np.intp), *own])


def columns_of_errors(extras: Extras) -> NDArray[np.intp]:
    """Return the columns (E,) that these have in a row."""
    own = [np.r_[extras.columns(b.name)] for b in extras.blocks if b.name in COLUMNS]
    return np.concatenate([np.zeros(0, np.intp), *own])


def imu_errors(extras: Extras, walks: Array, constants: Array) -> tuple[Array, Array]:
    """Return all errors of what the sensors read (..., 27), and how they follow the variables.

    The slope is (..., 27, E). A variable is the error as it is stated, a share of what is true; see
    :mod:`factors.imu_errors`. ``walks`` are (..., s) of the keyframes asked for, ``constants``
    (C,); of constants alone both are those of all keyframes, without the axes before.
    """
    own, which = columns_of_errors(extras) - STATE_DIM, imu_columns(extras)
    if not np.any(own < extras.n_walks):
        walks = np.zeros(extras.n_walks)
    stated = np.zeros((*walks.shape[:-1], SIZE))
    constants = np.broadcast_to(constants, (*walks.shape[:-1], len(constants)))
    stated[..., which] = np.concatenate([walks, constants], axis=-1)[..., own]
    errors, slope = of_readings(stated)
    return errors, slope[..., which]
