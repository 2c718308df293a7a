"""The paper to the letter: a SINS/DVL filter in geodetic coordinates with closed-loop feedback.

Written a second time on purpose: strapdown mechanisation, error dynamics and measurement matrix
share nothing with the preintegrated factors and their error state, so that both can be held
against each other. Many runs of equal shape are filtered at once.

References
----------
.. [1] Xu et al., "Combined navigation robust filtering method based on statistical similarity
   measurement", 2021.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factors.similarity import Kernel, LogKernel
from factors.so3 import skew
from ssm_graph.base.earth import R_el_from_lat_lon
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.engine.error_state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    STATE_DIM,
    VELOCITY,
)
from ssm_graph.filters.geodetic.measurements import (
    Rows,
    aid_rows,
    beam_rows,
    places_of,
    settle,
)
from ssm_graph.filters.geodetic.mechanisation import (
    DP,
    DV,
    EPS,
    ERROR_DIM,
    NABLA,
    PHI,
    Feedback,
    Samples,
    Track,
    advance,
    enu_D_place,
    feed_back,
    initial_moments,
    noise_densities,
    propagate,
)
from ssm_graph.filters.navigation.filter import StateHistory
from ssm_graph.filters.side_by_side import side_by_side
from ssm_graph.imu.increments import merge_samples
from ssm_graph.mission.estimate import OnKeyframe
from ssm_graph.mission.problem import Problem
from ssm_graph.sensors.imu import ImuLog


@dataclass(frozen=True, slots=True)
class GeodeticConfig:
    """How the filter runs."""

    kernel: Kernel = field(default_factory=LogKernel)
    """Similarity kernel of beams, depths and fixes."""
    feedback: Feedback = Feedback.COMPLETE
    """What closes the loop; the paper's own serves up to tactical grade."""
    merge_rate_hz: float = 20.0
    """Rate to which raw inertial samples are merged."""
    tolerance: float = 1e-8
    """The weights of a ping have settled when the state moves by less, relative to itself."""
    max_iterations: int = 50

    def __post_init__(self) -> None:
        if not (np.isfinite(self.tolerance) and self.tolerance > 0.0):
            raise ConfigError(f"tolerance: expected a number above zero, got {self.tolerance}")
        if self.max_iterations < 1:
            raise ConfigError(f"max_iterations: expected 1 or more, got {self.max_iterations}")


@dataclass(frozen=True, slots=True, eq=False)
class GeodeticHistory(ReadOnlyArrays):
    """Posteriors of B runs at K keyframes, after feedback."""

    lat: Array
    """(B, K) rad"""
    lon: Array
    """(B, K) rad"""
    height: Array
    """(B, K) m"""
    velocity_enu: Array
    """(B, K, 3) m/s"""
    R_lb: Array
    """(B, K, 3, 3) body to local east-north-up axes"""
    gyro_bias: Array
    """(B, K, 3) rad/s"""
    accel_bias: Array
    """(B, K, 3) m/s^2"""
    covariance: Array
    """(B, K, 15, 15) of the errors of :mod:`ssm_graph.filters.geodetic.mechanisation`"""
    weight: Array
    """(B, K, n) of n beams; NaN where there is none, as in the two that follow"""
    mahalanobis_sq: Array
    """(B, K, n) t at the posterior"""
    innovation: Array
    """(B, K, n) measured minus predicted before the update, m/s"""
    iterations: NDArray[np.intp]
    """(B, K) 0 where there is no beam"""


def run_geodetic(
    problems: Sequence[Problem],
    imu: Sequence[ImuLog],
    config: GeodeticConfig | None = None,
    *,
    on_keyframe: OnKeyframe | None = None,
) -> GeodeticHistory:
    """Filter runs side by side: mechanise, propagate, update, feed back, keyframe by keyframe.

    The loop is closed at every keyframe, with measurements or without. No run looks at another; a
    run that runs away ends in NaN.

    Raises :class:`ConfigError` where the runs differ in shape: filter them one by one.

    Parameters
    ----------
    problems : runs with equally many keyframes.
    imu : their inertial data, merging into equally many samples between keyframes.
    config : kernel and stopping rule.
    on_keyframe : called after each keyframe.
    """
    config = config or GeodeticConfig()
    samples, first = _merged(problems, imu, rate_hz=config.merge_rate_hz)
    measured = side_by_side(problems)
    places = places_of(measured.fixes, [problem.frame for problem in problems])
    state, P = initial_moments(
        [problem.start for problem in problems],
        [problem.imu_noise_bias_sigma for problem in problems],
    )
    density = noise_densities([log.noise for log in imu], state)
    X = np.zeros((len(problems), ERROR_DIM))
    steps: list[tuple[Array, ...]] = []
    track: Track | None = None
    n_keyframes = problems[0].n_keyframes
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for k in range(n_keyframes):
            if k > 0:
                track = advance(state, Samples(*(a[:, first[k - 1] : first[k]] for a in samples)))
                X, P = propagate(X, P, track, density)
                state = track.end
            aids = aid_rows(measured, places, k, state, track, X)
            rows, has_beam = (
                beam_rows(measured.beams, k, state),
                np.isfinite(measured.beams.sigma[k]),
            )
            X, P, of_beams = _update(X, P, rows, has_beam, aids, config)
            state, X, P = feed_back(state, X, P, config.feedback)
            biases = state.gyro_bias + X[:, EPS], state.accel_bias + X[:, NABLA]
            steps.append((*state[:5], *biases, P, *of_beams))
            if on_keyframe is not None:
                on_keyframe(k + 1, n_keyframes)
    return GeodeticHistory(*(np.stack(column, axis=1) for column in zip(*steps, strict=True)))


def _merged(
    problems: Sequence[Problem], imu: Sequence[ImuLog], *, rate_hz: float
) -> tuple[Samples, NDArray[np.intp]]:
    if len(problems) == 0 or len(problems) != len(imu):
        raise ConfigError(
            f"expected one or more runs with their inertial data, got {len(problems)} problems and "
            f"{len(imu)} logs"
        )
    merged = [
        merge_samples(log.calibrated, problem.keyframe_s, rate_hz=rate_hz)
        for problem, log in zip(problems, imu, strict=True)
    ]
    first = merged[0].first
    for run, other in enumerate(merged):
        if not np.array_equal(other.first, first):
            raise ConfigError(
                f"run {run} has another number of keyframes, or of samples between them, than run "
                "0: expected equal ones; filter such runs one by one"
            )
    return Samples(
        *(np.stack([getattr(m, name) for m in merged]) for name in Samples._fields)
    ), first


def _update(
    X: Array,
    P: Array,
    rows: Rows,
    has_beam: NDArray[np.bool_],
    aids: Rows | None,
    config: GeodeticConfig,
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Correct by beams, depth and fix, together.

    Returns errors, covariance, and what :class:`GeodeticHistory` keeps of the beams.
    """
    innovation = np.where(has_beam, (rows.H @ X[..., None])[..., 0] - rows.Z, np.nan)
    if aids is None and not has_beam.any():
        nothing = np.full(has_beam.shape, np.nan)
        return X, P, (nothing, nothing, innovation, np.zeros(len(X), np.intp))
    settled = settle(
        X,
        P,
        rows if aids is None else rows.followed_by(aids),
        kernel=config.kernel,
        tolerance=config.tolerance,
        max_iterations=config.max_iterations,
    )
    of_rows = (settled.weight, settled.mahalanobis_sq)
    found = (np.where(has_beam, own[:, : has_beam.shape[1]], np.nan) for own in of_rows)
    iterations = np.where(has_beam.any(axis=1), settled.iterations, 0)
    return settled.X, settled.P, (*found, innovation, iterations)


def to_navigation(problem: Problem, history: GeodeticHistory, run: int) -> StateHistory:
    """Return one run (K, ...) in the navigation frame of its problem, with its covariances.

    Errors there are true relative to estimated, ``R_nb Exp(phi_b)``, ``p_n + R_nb dp_b``,
    ``v_n + dv_n``. With ``theta = (dlat, -dlon cos(lat), -dlon sin(lat))``, the turn from the
    estimated place's local axes to the true ones::

        phi_b = R_lb' (phi + theta),  dp_b = -R_lb' D dp,  dv_n = R_nl (theta x v - dv)
    """
    lat, lon, height = history.lat[run], history.lon[run], history.height[run]
    v_l, R_lb = history.velocity_enu[run], history.R_lb[run]
    R_nl = problem.frame.R_en.T @ R_el_from_lat_lon(lat, lon)
    R_bl = np.swapaxes(R_lb, 1, 2)
    theta_D_p = np.zeros((len(lat), 3, 3))
    theta_D_p[:, 0, 0] = 1.0
    theta_D_p[:, 1, 1], theta_D_p[:, 2, 1] = -np.cos(lat), -np.sin(lat)
    J = np.zeros((len(lat), STATE_DIM, ERROR_DIM))
    J[:, ROTATION, PHI] = R_bl
    J[:, ROTATION, DP] = R_bl @ theta_D_p
    J[:, POSITION, DP] = -R_bl @ enu_D_place(lat, height)
    J[:, VELOCITY, DP] = -R_nl @ skew(v_l) @ theta_D_p
    J[:, VELOCITY, DV] = -R_nl
    J[:, ACCEL_BIAS, NABLA] = np.eye(3)
    J[:, GYRO_BIAS, EPS] = np.eye(3)
    return StateHistory(
        R_nb=R_nl @ R_lb,
        p_n=problem.frame.p_n_from_geodetic(lat, lon, height),
        v_n=(R_nl @ v_l[..., None])[..., 0],
        bias=np.concatenate([history.accel_bias[run], history.gyro_bias[run]], axis=-1),
        covariance=np.asarray(J @ history.covariance[run] @ np.swapaxes(J, 1, 2)),
    )
