"""The Earth's magnetic field as a three-axis magnetometer on an iron vehicle reads it."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from factors.checks import check_numbers, checked_array
from factors.so3 import Array, skew, times

_ROWS, _COLUMNS = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
"""Where the six numbers of soft iron stand: xx, yy, zz, xy, xz, yz."""
_BASIS = np.zeros((6, 3, 3))
_BASIS[np.arange(6), _ROWS, _COLUMNS] = _BASIS[np.arange(6), _COLUMNS, _ROWS] = 1.0


class FieldResidual(NamedTuple):
    """Residuals of readings and their Jacobian blocks; leading axes broadcast.

    That of the hard iron is the identity.
    """

    error: Array
    """(..., 3) T, predicted minus measured."""
    error_D_rotation: Array
    """(..., 3, 3) with respect to ``phi`` in ``R_nb @ Exp(phi)``."""
    error_D_field_n: Array
    """(..., 3, 3)"""
    error_D_soft_iron: Array
    """(..., 3, 6)"""


def field_residual(
    R_nb: Array, *, field_n: Array, hard_iron_b: Array, soft_iron: Array, reading_b: Array
) -> FieldResidual:
    """Return residuals of a magnetometer with Jacobians of attitude, field and iron.

    Iron that is magnetised turns with the vehicle and adds ``h`` (hard); iron that the field
    magnetises bends it by a symmetric ``S`` (soft) [1]_::

        error = (1 + S) R_nb' field_n + h - reading

    Parameters
    ----------
    R_nb : (..., 3, 3) rotation, body to navigation.
    field_n : (..., 3) the Earth's field at the vehicle, T.
    hard_iron_b : (..., 3) body axes, T.
    soft_iron : (..., 6) of ``S``: xx, yy, zz, xy, xz, yz, 1.
    reading_b : (..., 3) measured, body axes, T.

    References
    ----------
    .. [1] D. Gebre-Egziabher, G. H. Elkaim, J. D. Powell, B. W. Parkinson, "Calibration of
       Strapdown Magnetometers in Magnetic Field Domain", Journal of Aerospace Engineering 19(2),
       2006.
    """
    field_b = times(np.swapaxes(R_nb, -1, -2), field_n)
    bent = np.eye(3) + np.tensordot(soft_iron, _BASIS, axes=(-1, 0))
    return FieldResidual(
        error=times(bent, field_b) + hard_iron_b - reading_b,
        # R_nb' field becomes Exp(-phi) R_nb' field: field_b x phi to first order.
        error_D_rotation=bent @ skew(field_b),
        error_D_field_n=bent @ np.swapaxes(R_nb, -1, -2),
        error_D_soft_iron=np.moveaxis(_BASIS @ field_b[..., None, :, None], -3, -1)[..., 0, :],
    )


def magnetic_field_factor(
    pose: int, *, sigma: float, reading_b: Array, field_n: Array, weight: float = 1.0
) -> gtsam.CustomFactor:
    """Wrap :func:`field_residual` as a factor on a ``Pose3``, of a vehicle without iron.

    Parameters
    ----------
    pose : key.
    sigma : nominal standard deviation of each axis, T.
    reading_b, field_n : as in :func:`field_residual`, for one reading.
    weight : similarity weight; the effective variance is ``sigma^2 / weight``.

    Raises
    ------
    ValueError
        If a number is not finite, or ``sigma`` or ``weight`` is not above zero.
    """
    name = "magnetic_field_factor"
    check_numbers(name, sigma=sigma, weight=weight)
    read = checked_array(name, "reading_b", reading_b, (3,))
    field = checked_array(name, "field_n", field_n, (3,))

    def evaluate(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        R_nb = values.atPose3(this.keys()[0]).rotation().matrix()
        if jacobians is None:
            return np.asarray(R_nb.T @ field - read)
        found = field_residual(
            R_nb, field_n=field, hard_iron_b=np.zeros(3), soft_iron=np.zeros(6), reading_b=read
        )
        jacobians[0] = np.hstack([found.error_D_rotation, np.zeros((3, 3))])
        return np.asarray(found.error)

    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma / np.sqrt(weight))
    return gtsam.CustomFactor(noise, [pose], evaluate)
