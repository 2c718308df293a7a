"""Errors of a trajectory against a reference, and the numbers by which it is judged."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading, wrap_to_pi
from ssm_graph.base.frozen import Array, FrozenArrays, ShortRepr, shaped
from ssm_graph.mission.estimate import Trajectory, path_length_m
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.sensors.gnss import GnssLog

NO_REFERENCE: Final = 10.0
"""m; along an axis where its own sigma is larger a reference tells nothing, as the height of fixes
that were given one for the sake of the format."""
MIN_GAP_S: Final = 2.0
GAP_STEPS: Final = 5.0
TIME_TOLERANCE_S: Final = 1e-6
"""Times this close to a reference's sample count as inside, whatever the rounding of clocks."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSeries(FrozenArrays):
    """Estimate minus reference at every keyframe where the reference has a position.

    Axes are local east, north, up at the reference; NaN where the reference is silent.
    """

    time_s: Array = shaped("N")
    """(N,) keyframe times, s."""
    position_enu: Array = shaped("N", 3)
    """(N, 3) m; NaN along axes of which the reference tells nothing"""
    velocity_enu: Array = shaped("N", 3)
    """(N, 3) m/s"""
    roll_pitch_heading: Array = shaped("N", 3)
    """(N, 3) rad, in [-pi, pi)"""
    position_sigma_enu: Array = shaped("N", 3)
    """(N, 3) m, posterior"""
    velocity_sigma_enu: Array = shaped("N", 3)
    """(N, 3) m/s, posterior"""
    attitude_sigma: Array = shaped("N", 3)
    """(N, 3) rad, posterior, of roll, pitch and heading"""
    reference_sigma_enu: Array = shaped("N", 3)
    """(N, 3) m, of the reference's positions; zero where it counts as exact"""
    nees_position: Array = shaped("N")
    """(N,) e^T P^-1 e of position with its full covariance and that of the reference; 3 is
    expected; NaN without one."""

    @property
    def horizontal(self) -> Array:
        """(N,) length of the horizontal position error, m."""
        return np.asarray(np.hypot(self.position_enu[:, 0], self.position_enu[:, 1]))

    @property
    def inside_3_sigma(self) -> Array:
        """(N, 3) 1 where a position is within 3 sigma of both, else 0; NaN without a sigma."""
        sigma = np.hypot(self.position_sigma_enu, self.reference_sigma_enu)
        inside = np.abs(self.position_enu) <= 3.0 * sigma
        return np.where(np.isfinite(sigma + self.position_enu), inside, np.nan)


def error_series(trajectory: Trajectory, reference: Reference) -> ErrorSeries:
    """Return the errors of ``trajectory`` at its keyframes within the reference.

    The reference is interpolated (positions in a local Cartesian frame, angles unwrapped), never
    extrapolated, and not across its gaps: see :func:`interpolate_within`.

    Raises :class:`DataError`: the two have no time in common.
    """
    time_s = trajectory.time_s
    places = np.stack([reference.lat, reference.lon, reference.height])
    known = np.asarray(np.isfinite(places).all(axis=0))
    if not np.any(known):
        raise DataError("reference: it holds no position at all")
    first = int(np.argmax(known))
    frame = LocalFrame(*(float(x[first]) for x in (reference.lat, reference.lon, reference.height)))
    p_reference_n = interpolate_within(
        time_s,
        known_s=reference.time_s[known],
        values=frame.p_n_from_geodetic(reference.lat, reference.lon, reference.height)[known],
    )
    p_n = frame.p_n_from_geodetic(trajectory.lat, trajectory.lon, trajectory.height)
    kept = np.isfinite(p_reference_n).all(axis=1) & np.isfinite(p_n).all(axis=1)
    if not np.any(kept):
        raise DataError(_no_overlap(time_s, reference.time_s[known]))
    difference_n = p_n[kept] - p_reference_n[kept]
    position_enu = np.einsum("nij,ni->nj", frame.R_nl_at(p_reference_n[kept]), difference_n)
    # Up is a difference of heights: the Earth curves away from a chord by 8 cm in a kilometre.
    height = frame.geodetic_from_p_n(p_reference_n[kept])[2]
    position_enu[:, 2] = trajectory.height[kept] - height
    velocity, angles = _at(time_s, reference)
    cov = trajectory.position_cov_enu[kept]
    reference_sigma = _sigma_at(time_s[kept], reference, known)
    return ErrorSeries(
        time_s=time_s[kept],
        position_enu=np.where(reference_sigma > NO_REFERENCE, np.nan, position_enu),
        velocity_enu=(trajectory.velocity_enu - velocity)[kept],
        roll_pitch_heading=wrap_to_pi(trajectory.roll_pitch_heading - angles)[kept],
        position_sigma_enu=np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0)),
        velocity_sigma_enu=trajectory.velocity_sigma_enu[kept],
        attitude_sigma=trajectory.attitude_sigma[kept],
        reference_sigma_enu=reference_sigma,
        nees_position=normalized_error_squared(
            position_enu, cov + reference_sigma[:, :, None] ** 2 * np.eye(3)
        ),
    )


def normalized_error_squared(error: Array, cov: Array) -> Array:
    """Return ``e^T P^-1 e`` (N,) of errors (N, K) with covariances (N, K, K).

    NaN where the covariance is not positive definite or anything is not finite.
    """
    result = np.full(len(error), np.nan)
    finite = np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(error).all(axis=1)
    index = np.flatnonzero(finite)
    index = index[np.linalg.eigvalsh(cov[index])[:, 0] > 0.0]
    weighted = np.linalg.solve(cov[index], error[index][..., None])[..., 0]
    result[index] = np.sum(error[index] * weighted, axis=1)
    return result


def _sigma_at(time_s: Array, reference: Reference, known: NDArray[np.bool_]) -> Array:
    """Return sigmas (M, 3) of a reference's positions, between those that are ``known``."""
    if reference.position_sigma_enu is None:
        return np.zeros((len(time_s), 3))
    columns = reference.position_sigma_enu[known].T
    return np.column_stack([np.interp(time_s, reference.time_s[known], x) for x in columns])


def _at(time_s: Array, reference: Reference) -> tuple[Array, Array]:
    """Return velocities (M, 3) and unwrapped angles (M, 3) of the reference at ``time_s``."""
    angles = np.array(reference.roll_pitch_heading)
    for column in angles.T:
        good = np.isfinite(column)
        column[good] = np.unwrap(column[good])
    known_s = reference.time_s
    velocity = interpolate_within(time_s, known_s=known_s, values=reference.velocity_enu)
    return velocity, interpolate_within(time_s, known_s=known_s, values=angles)


def _no_overlap(time_s: Array, reference_s: Array) -> str:
    return (
        "reference: it has no time in common with the trajectory: "
        f"trajectory {_span(time_s)}, reference {_span(reference_s)}; "
        "are both on the same clock, and does a gap of the reference hide the overlap?"
    )


def _span(time_s: Array) -> str:
    if len(time_s) == 0:
        return "empty"
    return f"{time_s[0]:.3f} to {time_s[-1]:.3f} s ({len(time_s)} epochs)"


def gap_limit_s(time_s: Array) -> float:
    """Return the longest step between samples that is interpolated across, s.

    Five median steps, but never less than two seconds: a reference of 2 Hz may miss four samples.
    """
    if len(time_s) < 2:
        return MIN_GAP_S
    return max(MIN_GAP_S, GAP_STEPS * float(np.median(np.diff(time_s))))


def interpolate_within(time_s: Array, *, known_s: Array, values: Array) -> Array:
    """Return the columns of ``values`` at ``time_s``; NaN outside of the data and in its gaps.

    Monotone piecewise cubic (PCHIP) between samples that are not further apart than
    :func:`gap_limit_s`, column by column: it does not overshoot where a reference is noisy.

    Parameters
    ----------
    time_s : (M,) wanted times, s.
    known_s : (N,) times of the samples, s, strictly increasing.
    values : (N, K) samples; NaN is a missing one. Angles must be unwrapped.

    Returns
    -------
    (M, K) values.
    """
    if np.any(np.diff(known_s) <= 0.0):
        raise DataError("reference: times must increase strictly")
    result = np.full((len(time_s), values.shape[1]), np.nan)
    for column, samples in enumerate(values.T):
        good = np.isfinite(samples)
        result[:, column] = _interpolate_column(time_s, known_s[good], samples[good])
    return result


def _interpolate_column(time_s: Array, known_s: Array, samples: Array) -> Array:
    result = np.full(len(time_s), np.nan)
    if len(known_s) == 0:
        return result
    breaks = np.flatnonzero(np.diff(known_s) > gap_limit_s(known_s)) + 1
    for begin, end in pairwise([0, *breaks, len(known_s)]):
        first, last = known_s[begin], known_s[end - 1]
        inside = (time_s >= first - TIME_TOLERANCE_S) & (time_s <= last + TIME_TOLERANCE_S)
        if end - begin == 1:
            result[inside] = samples[begin]
        elif np.any(inside):
            from scipy.interpolate import PchipInterpolator  # costly to import

            # Relative times: in Unix seconds the cubic's coefficients would lose digits.
            curve = PchipInterpolator(known_s[begin:end] - first, samples[begin:end])
            result[inside] = curve(np.clip(time_s[inside], first, last) - first)
    return result


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

    Raises :class:`DataError`: the two have no time in common.
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


def reference_from_gnss(gnss: GnssLog, trajectory: Trajectory) -> Reference:
    """Return positions of the body origin from fixes of the antenna.

    The lever arm is turned with the estimate's own attitude, at the fix (``l`` local level)::

        p_origin = p_antenna - R_lb lever_arm_b

    An error of the heading moves that by no more than the lever arm's length times the error.
    Fixes outside of the trajectory, or in its gaps, are left out; velocity and attitude are NaN.
    Errors contain the noise of the fixes; their sigmas count beside those of the estimate.
    """
    angles = interpolate_within(
        gnss.valid_s,
        known_s=trajectory.time_s,
        values=np.unwrap(trajectory.roll_pitch_heading, axis=0),
    )
    kept = np.isfinite(angles).all(axis=1)
    lat, lon, height = gnss.lat[kept], gnss.lon[kept], gnss.height[kept]
    if np.any(kept) and np.any(gnss.lever_arm_b != 0.0):
        frame = LocalFrame(float(lat[0]), float(lon[0]), float(height[0]))
        antenna_n = frame.p_n_from_geodetic(lat, lon, height)
        lever_l = R_lb_from_roll_pitch_heading(*angles[kept].T) @ gnss.lever_arm_b
        lever_n = np.einsum("nij,nj->ni", frame.R_nl_at(antenna_n), lever_l)
        lat, lon, height = frame.geodetic_from_p_n(antenna_n - lever_n)
    unknown = np.full((int(kept.sum()), 3), np.nan)
    return Reference(
        time_s=gnss.valid_s[kept],
        lat=lat,
        lon=lon,
        height=height,
        velocity_enu=unknown,
        roll_pitch_heading=unknown,
        position_sigma_enu=gnss.sigma_enu[kept],
    )


def withhold_gnss(mission: Mission, until_s: float) -> tuple[Mission, GnssLog]:
    """Return the mission with fixes up to ``until_s`` after its begin alone, and the other fixes.

    Raises :class:`ConfigError`: the mission has no GNSS, or all of its fixes are on one side of
    that time.
    """
    gnss = mission.gnss
    if gnss is None:
        raise ConfigError("expected a mission with GNSS, got one without")
    used = gnss.valid_s < mission.imu.start_s + until_s
    if not used.any() or used.all():
        first, last = gnss.valid_s[[0, -1]] - mission.imu.start_s
        raise ConfigError(
            f"expected a time between the first fix at {first:.1f} s and the last at "
            f"{last:.1f} s, got {until_s:g} s"
        )
    return replace(mission, gnss=gnss.rows(used)), gnss.rows(~used)
