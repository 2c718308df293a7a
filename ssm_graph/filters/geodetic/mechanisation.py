"""Strapdown mechanisation in geodetic coordinates, and its 15 errors; for many runs at once.

Letters: ``l`` local east-north-up axes at the vehicle, ``b`` body. The leading axis of every array
is the run. Errors are computed minus true::

    X = (phi, dv, dp, eps, nabla)

``phi`` misalignment, ``R_lb_computed = (I - [phi x]) R_lb``, rad; ``dv`` velocity east, north, up,
m/s; ``dp`` latitude and longitude, rad, and height, m; ``eps`` gyro drift, rad/s, and ``nabla``
accelerometer bias, m/s^2, both body axes.

References
----------
.. [1] Xu et al., "Combined navigation robust filtering method based on statistical similarity
   measurement", 2021, step 2.
.. [2] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems",
   2nd ed., 2013, chapter 14.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from factors import so3
from factors.so3 import cross, skew
from ssm_graph.base.earth import EARTH_RATE, SEMI_MAJOR_AXIS, normal_gravity, radii_of_curvature
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading, phi_D_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.imu.preintegration import INTEGRATION_DENSITY
from ssm_graph.mission.mission import InitialState
from ssm_graph.sensors.imu import ImuNoise

ERROR_DIM = 15
PHI, DV, DP = slice(0, 3), slice(3, 6), slice(6, 9)
EPS, NABLA = slice(9, 12), slice(12, 15)
LAT, LON, HEIGHT = 6, 7, 8

PIECE_S = 0.25
"""Longest piece of an interval over which the error dynamics are averaged."""
BIAS_WALK_FLOOR = 1e-3 / 60.0
"""Least walk of a bias, in its turn-on sigmas a root second; the graph's inertial factors have the
same."""
N_PASSES = 2
"""Velocity enters its own Coriolis acceleration and the turn of the local axes, both about 1e-4 of
what it is; two passes over an interval of 1 s leave 1e-8."""


class GeodeticState(NamedTuple):
    """What the mechanisation holds of B runs."""

    lat: Array
    """(B,) rad"""
    lon: Array
    """(B,) rad"""
    height: Array
    """(B,) m above the ellipsoid"""
    velocity_enu: Array
    """(B, 3) m/s over ground"""
    R_lb: Array
    """(B, 3, 3) body to local east-north-up axes"""
    gyro_bias: Array
    """(B, 3) taken off the gyro readings, rad/s"""
    accel_bias: Array
    """(B, 3) taken off the accelerometer readings, m/s^2"""


class Samples(NamedTuple):
    """Merged inertial samples of one interval between keyframes."""

    dt: Array
    """(B, N) s"""
    gyro_b: Array
    """(B, N, 3) rad/s"""
    accel_b: Array
    """(B, N, 3) m/s^2"""


class Track(NamedTuple):
    """An interval as mechanised."""

    end: GeodeticState
    middle: GeodeticState
    """Mean velocity, position half way; attitude that of the begin."""
    elapsed_s: Array
    """(B, N + 1) begin and ends of the samples, s since the begin."""
    height: Array
    """(B, N + 1) m at these times"""
    turned: Array
    """(B, N + 1, 3, 3) body axes at these times to body axes at the begin."""
    gained: Array
    """(B, N, 3) velocity gained from specific force in each sample, local axes, m/s."""


class EarthTerms(NamedTuple):
    """What the place and the velocity make of the Earth, local axes."""

    meridian: Array
    """(B,) ``R_M + h``, m"""
    prime_vertical: Array
    """(B,) ``R_N + h``, m"""
    omega_ie: Array
    """(B, 3) Earth rate, rad/s"""
    omega_en: Array
    """(B, 3) transport rate, rad/s"""


def earth_terms(state: GeodeticState) -> EarthTerms:
    """Return radii, Earth rate and transport rate at a state."""
    meridian, prime_vertical = (r + state.height for r in radii_of_curvature(state.lat))
    east, north = state.velocity_enu[:, 0], state.velocity_enu[:, 1]
    sin, cos = np.sin(state.lat), np.cos(state.lat)
    omega_ie = EARTH_RATE * np.stack([np.zeros_like(sin), cos, sin], axis=-1)
    turn = east / prime_vertical
    omega_en = np.stack([-north / meridian, turn, turn * sin / cos], axis=-1)
    return EarthTerms(meridian, prime_vertical, omega_ie, omega_en)


def advance(state: GeodeticState, samples: Samples) -> Track:
    """Mechanise one interval between keyframes.

    With constant rate and specific force in body axes within each sample::

        R_lb' = R_lb [omega_ib_b x] - [(omega_ie + omega_en) x] R_lb
        v'    = R_lb f_b - (2 omega_ie + omega_en) x v - (0, 0, gamma)
        lat'  = v_n / (R_M + h),  lon' = v_e / ((R_N + h) cos(lat)),  h' = v_u

    The turn of the body is composed sample by sample, each exact; specific force turns with the
    body within its sample. Rates of the local axes, gravity and radii are those half way.

    Parameters
    ----------
    state : at the begin.
    samples : with coning and sculling taken into account already.
    """
    elapsed = _from_zero(np.cumsum(samples.dt, axis=1))
    turned, gained_b = _body_frame_steps(samples, state)
    # Local axes at the begin; they turn on below.
    gained_0 = gained_b @ np.swapaxes(state.R_lb, 1, 2)
    span = elapsed[:, -1:]
    half_way = 0.5 * (elapsed[:, 1:] + elapsed[:, :-1])[..., None]
    dt = samples.dt[..., None]

    velocity = np.repeat(state.velocity_enu[:, None], elapsed.shape[1], axis=1)
    middle = state
    for _ in range(N_PASSES):
        # Positions along east, north, up since the begin, m.
        mean_velocity = 0.5 * (velocity[:, 1:] + velocity[:, :-1])
        moved = np.sum(mean_velocity * dt, axis=1)
        middle = _moved(state, 0.5 * moved, middle)._replace(velocity_enu=moved / span)
        earth = earth_terms(middle)
        gained = _turned_back(gained_0, earth.omega_ie + earth.omega_en, half_way)
        coriolis = (2.0 * earth.omega_ie + earth.omega_en)[:, None]
        gravity = np.zeros_like(state.velocity_enu)[:, None]
        gravity[..., 2] = -normal_gravity(middle.lat, middle.height)[:, None]
        step = gained + (gravity - cross(coriolis, mean_velocity)) * dt
        velocity = state.velocity_enu[:, None] + _from_zero(np.cumsum(step, axis=1))

    climbed = np.cumsum(0.5 * (velocity[:, 1:, 2] + velocity[:, :-1, 2]) * samples.dt, axis=1)
    moved = np.sum(0.5 * (velocity[:, 1:] + velocity[:, :-1]) * dt, axis=1)
    turn_l = -(earth.omega_ie + earth.omega_en) * span
    R_lb = so3.exp(turn_l) @ state.R_lb @ turned[:, -1]
    end = _moved(state, moved, middle)._replace(velocity_enu=velocity[:, -1], R_lb=R_lb)
    height = state.height[:, None] + _from_zero(climbed)
    return Track(end, middle, elapsed, height, turned, gained)


def _moved(state: GeodeticState, moved_enu: Array, middle: GeodeticState) -> GeodeticState:
    """Return the place after a short way along east, north, up, with the radii at ``middle``."""
    meridian, prime_vertical = (r + middle.height for r in radii_of_curvature(middle.lat))
    return state._replace(
        lat=state.lat + moved_enu[:, 1] / meridian,
        lon=state.lon + moved_enu[:, 0] / (prime_vertical * np.cos(middle.lat)),
        height=state.height + moved_enu[:, 2],
    )


def _turned_back(vectors: Array, omega: Array, time_s: Array) -> Array:
    """Return ``Exp(-omega t) vectors`` to second order; the angle is about 1e-4."""
    angle = omega[:, None] * time_s
    first = cross(angle, vectors)
    return np.asarray(vectors - first + 0.5 * cross(angle, first))


def _body_frame_steps(samples: Samples, state: GeodeticState) -> tuple[Array, Array]:
    """Return ``turned`` of :class:`Track`, and velocity gained in body axes of the begin, m/s.

    Within a sample of rotation vector ``theta`` the force gives ``J_l(theta) f dt``, with the left
    Jacobian of SO(3).
    """
    theta = (samples.gyro_b - state.gyro_bias[:, None]) * samples.dt[..., None]
    impulse = (samples.accel_b - state.accel_bias[:, None]) * samples.dt[..., None]
    gained = (so3.left_jacobian(theta) @ impulse[..., None])[..., 0]
    step = so3.exp(theta)
    n_runs, n_samples = samples.dt.shape
    turned = np.empty((n_runs, n_samples + 1, 3, 3))
    turned[:, 0] = np.eye(3)
    for i in range(n_samples):
        np.matmul(turned[:, i], step[:, i], out=turned[:, i + 1])
    return turned, np.asarray((turned[:, :-1] @ gained[..., None])[..., 0])


def _from_zero(values: Array) -> Array:
    """Return (B, N + 1, ...) with a zero put before the first."""
    return np.concatenate([np.zeros_like(values[:, :1]), values], axis=1)


def error_dynamics(state: GeodeticState, force_l: Array, R_lb: Array) -> Array:
    """Return ``F`` of ``X' = F X + noise``, (B, P, 15, 15), for P pieces of an interval.

    With ``w_in = w_ie + w_en``, latitude L, and ``d w_ie, d w_en`` from ``dv`` and ``dp``::

        phi'   = phi x w_in + d w_in - R_lb eps
        dv'    = f x phi + R_lb nabla + v x (2 d w_ie + d w_en) - (2 w_ie + w_en) x dv + d g
        dlat'  = dv_n / (R_M + h) - v_n dh / (R_M + h)^2
        dlon'  = (dv_e + v_e tan(L) dlat - v_e dh / (R_N + h)) / ((R_N + h) cos(L))
        dh'    = dv_u
        d g    = (0, 0, 2 gamma dh / a)

    Parameters
    ----------
    state : place and velocity, the same for all pieces; its attitude is not looked at.
    force_l : (B, P, 3) mean specific force, local axes, m/s^2.
    R_lb : (B, P, 3, 3) mean of the rotation, body to local axes.
    """
    earth = earth_terms(state)
    rates_D_p, transport_D_v, transport_D_p = _rate_jacobians(state, earth)
    v, coriolis = state.velocity_enu, 2.0 * earth.omega_ie + earth.omega_en
    slow = np.zeros((len(v), 1, ERROR_DIM, ERROR_DIM))
    F = slow[:, 0]
    F[:, PHI, PHI] = -skew(earth.omega_ie + earth.omega_en)
    F[:, PHI, DV] = transport_D_v
    F[:, PHI, DP] = rates_D_p + transport_D_p
    F[:, DV, DV] = skew(v) @ transport_D_v - skew(coriolis)
    F[:, DV, DP] = skew(v) @ (2.0 * rates_D_p + transport_D_p)
    F[:, 5, HEIGHT] += 2.0 * normal_gravity(state.lat, state.height) / SEMI_MAJOR_AXIS
    _place_rows(F, state, earth)
    F_pieces = np.repeat(slow, force_l.shape[1], axis=1)
    F_pieces[..., PHI, EPS] = -R_lb
    F_pieces[..., DV, PHI] = skew(force_l)
    F_pieces[..., DV, NABLA] = R_lb
    return F_pieces


def _rate_jacobians(state: GeodeticState, earth: EarthTerms) -> tuple[Array, Array, Array]:
    """Return Earth rate by ``dp``, and transport rate by ``dv`` and by ``dp``, (B, 3, 3) each."""
    r_m, r_n = earth.meridian, earth.prime_vertical
    tan, sec_sq = np.tan(state.lat), 1.0 / np.cos(state.lat) ** 2
    east = state.velocity_enu[:, 0]
    earth_D_p, transport_D_v, transport_D_p = np.zeros((3, len(r_m), 3, 3))
    earth_D_p[:, 1, 0] = -earth.omega_ie[:, 2]
    earth_D_p[:, 2, 0] = earth.omega_ie[:, 1]
    transport_D_v[:, 0, 1] = -1.0 / r_m
    transport_D_v[:, 1, 0] = 1.0 / r_n
    transport_D_v[:, 2, 0] = tan / r_n
    transport_D_p[:, 2, 0] = east * sec_sq / r_n
    transport_D_p[:, :, 2] = -earth.omega_en / np.stack([r_m, r_n, r_n], axis=-1)
    return earth_D_p, transport_D_v, transport_D_p


def _place_rows(F: Array, state: GeodeticState, earth: EarthTerms) -> None:
    """Fill the rows of latitude, longitude and height into ``F`` (B, 15, 15)."""
    r_m, r_n = earth.meridian, earth.prime_vertical
    east, north = state.velocity_enu[:, 0], state.velocity_enu[:, 1]
    sec = 1.0 / np.cos(state.lat)
    F[:, LAT, 4] = 1.0 / r_m
    F[:, LAT, HEIGHT] = -north / r_m**2
    F[:, LON, 3] = sec / r_n
    F[:, LON, LAT] = east * sec * np.tan(state.lat) / r_n
    F[:, LON, HEIGHT] = -east * sec / r_n**2
    F[:, HEIGHT, 5] = 1.0


def noise_densities(noises: Sequence[ImuNoise], state: GeodeticState) -> Array:
    """Return the diagonal (B, 15) of the continuous process noise.

    Noise of three like axes is the same in body and in local axes. What integration itself loses
    enters the position, as in the graph's inertial factors; gaps in the inertial data do not.
    """
    place_D = place_D_enu(state.lat, state.height)
    q = np.zeros((len(noises), ERROR_DIM))
    q[:, PHI] = [[noise.gyro_density] * 3 for noise in noises]
    q[:, DV] = [[noise.accel_density] * 3 for noise in noises]
    q[:, DP] = INTEGRATION_DENSITY * place_D.max(axis=-1)
    q[:, EPS] = [[max(n.gyro_bias_walk, BIAS_WALK_FLOOR * n.gyro_bias_sigma)] * 3 for n in noises]
    q[:, NABLA] = [
        [max(n.accel_bias_walk, BIAS_WALK_FLOOR * n.accel_bias_sigma)] * 3 for n in noises
    ]
    return q**2


def propagate(X: Array, P: Array, track: Track, density: Array) -> tuple[Array, Array]:
    """Carry errors (B, 15) and covariance (B, 15, 15) over an interval as mechanised.

    The interval is cut into pieces of at most about :data:`PIECE_S`, each with its mean dynamics;
    the integral is taken by Simpson's rule::

        Phi = I + F t + (F t)^2 / 2 + (F t)^3 / 6,   Q = int Phi(s) Q_c Phi(s)' ds
    """
    F, piece_s = _piecewise(track)
    Ft = F * piece_s[..., None, None]
    Ft_sq = Ft @ Ft
    eye = np.eye(ERROR_DIM)
    Phi = eye + Ft + Ft_sq @ (0.5 * eye + Ft / 6.0)
    Phi_half = eye + 0.5 * Ft + 0.125 * Ft_sq
    q = density[:, None, None, :] * (piece_s[..., None, None] / 6.0)
    Q = (4.0 * q * Phi_half) @ Phi_half.mT + (q * Phi) @ Phi.mT + q * eye
    for piece in range(F.shape[1]):
        X = (Phi[:, piece] @ X[..., None])[..., 0]
        P = Phi[:, piece] @ P @ Phi[:, piece].mT + Q[:, piece]
    return X, P


def _piecewise(track: Track) -> tuple[Array, Array]:
    """Return ``F`` (B, P, 15, 15) and the lengths (B, P) of the pieces of an interval, s."""
    n_samples = track.gained.shape[1]
    longest_s = float(np.max(track.elapsed_s[:, -1]))
    n_pieces = min(n_samples, max(1, math.ceil(longest_s / PIECE_S - 1e-6)))
    edges = np.arange(n_pieces + 1) * n_samples // n_pieces
    piece_s = np.diff(track.elapsed_s[:, edges], axis=1)
    dt = np.diff(track.elapsed_s, axis=1)[..., None, None]
    mean_turned = 0.5 * dt * (track.turned[:, 1:] + track.turned[:, :-1])
    turned = np.add.reduceat(mean_turned, edges[:-1], axis=1) / piece_s[..., None, None]
    force_l = np.add.reduceat(track.gained, edges[:-1], axis=1) / piece_s[..., None]
    return error_dynamics(track.middle, force_l, track.middle.R_lb[:, None] @ turned), piece_s


class Feedback(Enum):
    """What closes the loop after an update."""

    PAPER = "attitude, velocity and position; biases stay errors, the covariance as it is"
    COMPLETE = "biases as well, and the covariance follows the corrected attitude"


def feed_back(
    state: GeodeticState, X: Array, P: Array, feedback: Feedback
) -> tuple[GeodeticState, Array, Array]:
    """Return the corrected state, the errors that are left, and their covariance.

    Step 6 of [1]_ corrects attitude, velocity and position, and leaves gyro drift and
    accelerometer bias in ``X``. Then ``F`` and ``H`` look at specific force and velocity with the
    biases in them: an error of second order, but what a velocity tells of the heading is as small.
    Nor is the covariance of ``phi`` that of what is left of it after a turn, ``J_l(phi) (phi_true -
    phi)`` with the left Jacobian of SO(3). ``benchmarks/results/equivalence.md`` has both loops
    in numbers: the better the grade, the less they differ.
    """
    corrected = GeodeticState(
        lat=state.lat - X[:, LAT],
        lon=state.lon - X[:, LON],
        height=state.height - X[:, HEIGHT],
        velocity_enu=state.velocity_enu - X[:, DV],
        R_lb=so3.exp(X[:, PHI]) @ state.R_lb,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
    )
    left = X.copy()
    left[:, :9] = 0.0
    if feedback is Feedback.PAPER:
        return corrected, left, P
    corrected = corrected._replace(
        gyro_bias=state.gyro_bias + X[:, EPS], accel_bias=state.accel_bias + X[:, NABLA]
    )
    J = so3.left_jacobian(X[:, PHI])
    P = P.copy()
    P[:, PHI] = J @ P[:, PHI]
    P[:, :, PHI] = P[:, :, PHI] @ J.mT
    return corrected, np.zeros_like(X), P


def initial_moments(
    starts: Sequence[InitialState], bias_sigmas: Sequence[Array]
) -> tuple[GeodeticState, Array]:
    """Return the initial states and the covariances (B, 15, 15) of their errors.

    Parameters
    ----------
    starts : one for each run, sigmas along east, north, up and of roll, pitch, heading.
    bias_sigmas : (6,) each, turn-on sigmas, accelerometer then gyro.
    """
    roll, pitch, heading = (
        np.array([getattr(start, name) for start in starts])
        for name in ("roll", "pitch", "heading")
    )
    state = GeodeticState(
        lat=np.array([start.lat for start in starts]),
        lon=np.array([start.lon for start in starts]),
        height=np.array([start.height for start in starts]),
        velocity_enu=np.array([start.velocity_enu for start in starts]),
        R_lb=R_lb_from_roll_pitch_heading(roll, pitch, heading),
        gyro_bias=np.zeros((len(starts), 3)),
        accel_bias=np.zeros((len(starts), 3)),
    )
    phi_D_angles = state.R_lb @ phi_D_roll_pitch_heading(roll, pitch)
    root = np.zeros((len(starts), ERROR_DIM, ERROR_DIM))
    root[:, PHI, PHI] = phi_D_angles * np.array([s.attitude_sigma for s in starts])[:, None]
    root[:, DV, DV] = np.eye(3) * np.array([s.velocity_sigma_enu for s in starts])[:, None]
    position_sigma = np.array([start.position_sigma_enu for start in starts])
    root[:, DP, DP] = place_D_enu(state.lat, state.height) * position_sigma[:, None]
    sigma = np.array(bias_sigmas)[:, None]
    root[:, EPS, EPS] = np.eye(3) * sigma[..., 3:]
    root[:, NABLA, NABLA] = np.eye(3) * sigma[..., :3]
    return state, np.asarray(root @ root.mT)


def enu_D_place(lat: Array, height: Array) -> Array:
    """Return (B, 3, 3): metres along east, north, up per latitude, longitude (rad), height (m)."""
    meridian, prime_vertical = (r + height for r in radii_of_curvature(lat))
    jacobian = np.zeros((len(lat), 3, 3))
    jacobian[:, 0, 1] = prime_vertical * np.cos(lat)
    jacobian[:, 1, 0] = meridian
    jacobian[:, 2, 2] = 1.0
    return jacobian


def place_D_enu(lat: Array, height: Array) -> Array:
    """Return (B, 3, 3): latitude, longitude (rad), height (m) per metre east, north, up."""
    forward = enu_D_place(lat, height)
    inverse = np.zeros_like(forward)
    inverse[:, 0, 1] = 1.0 / forward[:, 1, 0]
    inverse[:, 1, 0] = 1.0 / forward[:, 0, 1]
    inverse[:, 2, 2] = 1.0
    return inverse
