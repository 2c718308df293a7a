"""Strapdown mechanisation in geodetic coordinates, east-north-up, for many runs at once.

Letters: ``l`` local east-north-up axes at the vehicle, ``b`` body. The leading axis of every array
is the run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from factors import so3
from factors.so3 import cross
from ssm_graph.base.earth import EARTH_RATE, normal_gravity, radii_of_curvature
from ssm_graph.base.frozen import Array

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
