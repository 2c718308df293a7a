"""The numbers by which a trajectory is judged against a reference."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssm_graph.base.frozen import Array, ShortRepr
from ssm_graph.evaluation.errors import ErrorSeries, error_series
from ssm_graph.mission.estimate import Trajectory, path_length_m
from ssm_graph.mission.mission import Reference


@dataclass(frozen=True, slots=True, eq=False)
class Metrics(ShortRepr):
    """Summary of an :class:`ErrorSeries`; NaN where the reference lacks the quantity."""

    n_epochs: int
    """Keyframes that were compared."""
    first_s: float
    """Time of the first of them, s."""
    last_s: float
    """Time of the last of them, s."""
    rmse_horizontal_m: float
    """Root mean square of the length of the horizontal error."""
    rmse_vertical_m: float
    max_horizontal_m: float
    end_error_m: float
    """Horizontal error at the last compared epoch."""
    path_length_m: float
    """Horizontal path of the estimate from the first to the last compared epoch."""
    drift_percent: float
    """100 ``end_error_m`` / ``path_length_m``; NaN for a vehicle that did not move."""
    rmse_velocity_m_per_s: float
    """Root mean square of the length of the velocity error."""
    rmse_attitude: tuple[float, float, float]
    """Roll, pitch, heading, rad."""
    nees_position: float
    """Mean over epochs of the three-dimensional NEES, divided by 3: 1 is expected."""
    inside_3_sigma: tuple[float, float, float]
    """Share of epochs with the east, north, up error within three posterior sigmas; 0.997."""
    errors: ErrorSeries = field(repr=False)
    """The errors themselves, for figures and tests."""

    def summary_fields(self) -> dict[str, Any]:
        """Return all but the errors with the keys of ``summary.json``, angles in degrees."""
        roll, pitch, heading = np.rad2deg(self.rmse_attitude).tolist()
        return {
            "rmse_horizontal_m": self.rmse_horizontal_m,
            "rmse_vertical_m": self.rmse_vertical_m,
            "max_horizontal_m": self.max_horizontal_m,
            "end_error_m": self.end_error_m,
            "path_length_m": self.path_length_m,
            "drift_percent": self.drift_percent,
            "rmse_velocity_m_per_s": self.rmse_velocity_m_per_s,
            "rmse_roll_deg": roll,
            "rmse_pitch_deg": pitch,
            "rmse_heading_deg": heading,
            "nees_position": self.nees_position,
            "inside_3_sigma": dict(zip(("east", "north", "up"), self.inside_3_sigma, strict=True)),
            "compared_epochs": self.n_epochs,
            "compared_from_s": self.first_s,
            "compared_to_s": self.last_s,
        }


def evaluate(trajectory: Trajectory, reference: Reference) -> Metrics:
    """Compare an estimated trajectory with a reference.

    Every keyframe within the reference counts once. The path is horizontal, as the error that
    ``drift_percent`` relates to it, and the estimate's own, as a reference may be noisy or have
    gaps; without a gap of the reference it is the distance travelled.

    Raises
    ------
    DataError
        The two have no time in common.
    """
    errors = error_series(trajectory, reference)
    first_s, last_s = float(errors.time_s[0]), float(errors.time_s[-1])
    length = path_length_m(trajectory, first_s=first_s, last_s=last_s)
    end_error = float(errors.horizontal[-1])
    return Metrics(
        n_epochs=len(errors.time_s),
        first_s=first_s,
        last_s=last_s,
        rmse_horizontal_m=_rms(errors.horizontal),
        rmse_vertical_m=_rms(errors.position_enu[:, 2]),
        max_horizontal_m=float(errors.horizontal.max()),
        end_error_m=end_error,
        path_length_m=length,
        drift_percent=100.0 * end_error / length if length > 0.0 else np.nan,
        rmse_velocity_m_per_s=_rms(np.linalg.norm(errors.velocity_enu, axis=1)),
        rmse_attitude=_per_axis(np.sqrt([_mean(x**2) for x in errors.roll_pitch_heading.T])),
        nees_position=_mean(errors.nees_position) / 3.0,
        inside_3_sigma=_per_axis(np.array([_mean(x) for x in errors.inside_3_sigma.T])),
        errors=errors,
    )


def _mean(values: Array) -> float:
    """Return the mean of the finite values, NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else np.nan


def _rms(values: Array) -> float:
    return float(np.sqrt(_mean(values**2)))


def _per_axis(values: Array) -> tuple[float, float, float]:
    first, second, third = (float(x) for x in values)
    return first, second, third
