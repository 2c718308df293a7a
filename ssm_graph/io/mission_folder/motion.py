"""Check that the sensors tell of one motion: the sign of depth, of beam speeds, of turn rates.

Turn rates are checked against the accelerometer: signs, units, biases.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.earth import EARTH_RATE
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEG_PER_H
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl_readings import COUNTS
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog, ImuNoise, imu_gaps

_UPWARD_M: Final = 2.0
_WINDOW_S: Final = 2.0
_SLOWEST: Final = 0.05
"""m/s rms: slower vertical motion says nothing."""
_FEWEST_FIXES: Final = 10
_FEWEST_PINGS: Final = 30
_OPPOSITE: Final = -0.8
_CONTRADICTION: Final = 0.3
_MOST_ORDERED: Final = 5
"""Beams of which every order is tried."""
_LAGS_S: Final = np.arange(-0.5, 0.51, 0.02)
_NOTED_LAG_S: Final = 0.05
_OPPOSITE_TILT: Final = -0.85
_TINY_GAIN: Final = 0.04
_SMALLEST_TILT: Final = 0.02
"""rad rms in one window."""
_TILT_STEP_S: Final = 1.0
_TILT_NOISE: Final = 0.1
"""rad, of the tilt by the accelerometer at either end of a mission, waves included."""
_BIAS_SIGMAS: Final = 4.0
_REST_S: Final = 10.0
_REST_FORCE: Final = 0.05
"""m/s^2, scatter of the specific force of a vehicle at rest."""
_REST_RATE: Final = 0.01
"""rad/s, scatter of its turn rates."""
_REST_SPEED: Final = 0.03
"""m/s along the beams"""


def check_motion(mission: Mission, labels: dict[str, str]) -> list[str]:
    """Compare the sensors' signs; ``labels`` name the tables.  Return the notes.

    Pings off the water are left out.
    """
    mission, notes = replace(mission, dvl=mission.dvl.of_ground()), []
    ping_s = mission.dvl.valid_s
    pings = _velocities(mission, ping_s)
    if mission.depth is not None:
        notes += _depth_sign(mission, mission.depth, labels["depth"])
        notes += _depth_surface(mission, mission.depth, labels["depth"])
        notes += _vertical_speed(mission, mission.depth, pings, labels)
    notes += _turn_signs(mission, pings, labels["imu"])
    notes += _rates_at_rest(mission, ping_s, labels["imu"])
    notes += _beams_agree(mission, labels["dvl"])
    return notes


def _depth_sign(mission: Mission, depth: DepthLog, label: str) -> list[str]:
    """Refuse heights given as depths."""
    expected = "expected depth, positive down; change its sign"
    median = float(np.median(depth.true_depth))
    if median < -_UPWARD_M and max(_known_heights(mission)) < -0.5 * median:
        raise DataError(
            f"{label}: column 'depth_m' has a median of {median:.2f} m, and no known height is "
            f"near {-median:.2f} m; {expected}"
        )
    for name, log in (("reference", mission.reference), ("gnss", mission.gnss)):
        if log is None:
            continue
        time_s = log.valid_s if isinstance(log, GnssLog) else log.time_s
        both = (time_s >= depth.time_s[0]) & (time_s <= depth.time_s[-1])
        height, down = log.height[both], np.interp(time_s[both], depth.time_s, depth.true_depth)
        if both.sum() < _FEWEST_FIXES or min(np.std(height), np.std(down)) < 1.0:
            continue
        correlation = float(np.corrcoef(height, down)[0, 1])
        if correlation > -_OPPOSITE:
            raise DataError(
                f"{label}: column 'depth_m' rises with the height of [{name}] (correlation "
                f"{correlation:.2f}); {expected}"
            )
    return []


def _known_heights(mission: Mission) -> Iterator[float]:
    if mission.gnss is not None:
        yield from mission.gnss.height
    if mission.reference is not None:
        yield from mission.reference.height
    if mission.initial is not None:
        yield mission.initial.height
    yield mission.frame.height


def _depth_surface(mission: Mission, depth: DepthLog, label: str) -> list[str]:
    """Note a depth that counts from another surface than the GNSS heights."""
    gnss = mission.gnss
    if gnss is None:
        return []
    both = (gnss.valid_s >= depth.time_s[0]) & (gnss.valid_s <= depth.time_s[-1])
    if not both.any():
        return []
    total = gnss.height[both] + np.interp(gnss.valid_s[both], depth.time_s, depth.true_depth)
    offset, sigma = float(np.median(total)), float(np.median(gnss.sigma_enu[both, 2]))
    if abs(offset) < max(5.0, 3.0 * sigma):
        return []
    return [
        f"{label}: depth and GNSS height do not cancel: their sum is {offset:.1f} m; depth is "
        "minus the height above the ellipsoid, not the distance to the surface"
    ]


def _vertical_speed(
    mission: Mission, depth: DepthLog, pings: tuple[Array, Array], labels: dict[str, str]
) -> list[str]:
    """Compare the DVL's downward speed with the change of depth, down being against the force."""
    imu = mission.imu
    half = 0.5 * max(_WINDOW_S, 2.0 * float(np.median(np.diff(depth.time_s, prepend=-np.inf))))
    begin = max(imu.time_s[0], depth.time_s[0]) + half
    end = min(imu.time_s[-1], depth.time_s[-1]) - half
    begin, end = begin + _LAGS_S[-1], end + _LAGS_S[0]
    time_s, v_b = pings
    inside = (time_s > begin) & (time_s < end)
    if inside.sum() < _FEWEST_PINGS:
        return []
    time_s, v_b = time_s[inside], v_b[inside]
    speed = -np.sum(_force_direction(mission, time_s, half) * v_b, axis=1)
    rate = _difference(time_s, half, depth.time_s, depth.true_depth) / (2.0 * half)
    if min(np.std(speed), np.std(rate)) < _SLOWEST:
        return []
    correlation = float(np.corrcoef(speed, rate)[0, 1])
    if correlation < _OPPOSITE:
        raise DataError(
            f"{labels['dvl']}: the DVL's downward speed is opposite to the change of "
            f"{labels['depth']} (correlation {correlation:.2f}); expected beam speeds that are "
            "positive when the instrument moves along the beam, and depth positive down; change "
            "the sign of one of them, or correct mounting_rpy_deg"
        )
    ratio = float(np.std(rate) / np.std(speed))
    if correlation > 0.9 and not 0.7 < ratio < 1.5:
        return [
            f"{labels['depth']}: the depth changes {ratio:.2f} times as fast as the DVL goes down; "
            "check the unit of the beam speeds and beam_janus_deg"
        ]
    return _vertical_lag(time_s, speed, half, depth, labels) if correlation > 0.5 else []


def _vertical_lag(
    time_s: Array, speed: Array, half: float, depth: DepthLog, labels: dict[str, str]
) -> list[str]:
    """Note a downward speed that fits the change of depth at another time far better."""
    rates = [_difference(time_s - lag, half, depth.time_s, depth.true_depth) for lag in _LAGS_S]
    misfit = 1.0 - np.array([np.corrcoef(speed, rate)[0, 1] for rate in rates]) ** 2
    best = int(np.argmin(misfit))
    lag = float(_LAGS_S[best])
    now = misfit[np.argmin(np.abs(_LAGS_S))]
    if abs(lag) < _NOTED_LAG_S or not misfit[best] < min(0.5 * now, 0.2):
        return []
    return [
        f"{labels['dvl']}: the DVL's downward speed fits the change of {labels['depth']} best "
        f"{abs(lag):.2f} s {'earlier' if lag > 0.0 else 'later'} than it is stamped; one of the "
        "two is late: time_offset_s of [dvl] can say so"
    ]


def _beams_agree(mission: Mission, label: str) -> list[str]:
    """Note beams that contradict each other, and the order in which they would not."""
    n_beams = mission.dvl.mount.n_beams
    speed = mission.dvl.speed[np.isfinite(mission.dvl.speed).all(axis=1)]
    if len(speed) < _FEWEST_PINGS or n_beams < 4:
        return []
    tried = permutations(range(n_beams)) if n_beams <= _MOST_ORDERED else [tuple(range(n_beams))]
    orders = [list(order) for order in tried]
    errors = [float(np.median(_left_over(mission, speed[:, order]))) for order in orders]
    best, sigma = int(np.argmin(errors)), float(np.median(mission.dvl.sigma))
    typical = float(np.median(np.linalg.norm(speed, axis=1)))
    is_better = 3.0 * max(errors[best], sigma) < errors[0]
    if not is_better and errors[0] < max(_CONTRADICTION * typical, 10.0 * sigma):
        return []
    hint = "check the beam directions"
    if is_better:  # several orders fit alike: name the one that moves the fewest beams
        fits = [o for o, error in zip(orders, errors, strict=True) if error < 1.5 * errors[best]]
        order = max(fits, key=lambda o: sum(o[beam] == beam for beam in range(n_beams)))
        hint = f"they would fit in the order {', '.join(str(beam + 1) for beam in order)}, for one"
    return [
        f"{label}: the {COUNTS[n_beams]} beams contradict each other by {errors[0]:.3f} m/s in "
        f"half of the pings at typical speeds of {typical:.2f} m/s; {hint}"
    ]


def _turn_signs(mission: Mission, pings: tuple[Array, Array], label: str) -> list[str]:
    """Compare turn rates with the accelerometer: tilting the vehicle tilts the specific force."""
    imu = mission.imu
    half = 0.5 * _TILT_STEP_S
    time_s = np.arange(imu.time_s[0] + 2.0 * half, imu.time_s[-1] - 2.0 * half, 2.0 * half)
    if len(time_s) < _FEWEST_PINGS:
        return []
    # Windows touch: the end of one step is the begin of the next.
    edges = np.append(time_s - half, time_s[-1] + half)
    force = _force_direction(mission, edges, half)
    before, after = force[:-1], force[1:]
    turn = _gained(mission, mission.imu.gyro_b, time_s, half)
    predicted, seen = -np.cross(turn, 0.5 * (before + after)), after - before
    notes, is_seen = [], _is_seen(imu, time_s, 2.0 * half)
    if is_seen.sum() < _FEWEST_PINGS:
        return []
    for axis, motion in enumerate(("pitches", "rolls")):
        of_motion = f"{label}: the vehicle {motion}"
        notes += _tilt_agrees(seen[is_seen, axis], predicted[is_seen, axis], of_motion)
    # What moves the vehicle is in the force as well, and turns with it: only gravity stays behind.
    ping_s, velocity = pings
    if len(ping_s) < _FEWEST_PINGS:
        return notes
    gravity = _gravity_direction(mission, edges, half, ping_s=ping_s, velocity=velocity)
    before, after = gravity[:-1], gravity[1:]
    drift = (after - before + np.cross(turn, 0.5 * (before + after)))[is_seen].mean(axis=0)
    return notes + _level_bias(mission, drift / (2.0 * half), label)


def _is_seen(imu: ImuLog, time_s: Array, half: float) -> NDArray[np.bool_]:
    """Return about which times (N,) no inertial samples are missing."""
    begin_s, end_s = imu_gaps(imu)
    before = (end_s[:, None] <= time_s - half) | (begin_s[:, None] >= time_s + half)
    return np.asarray(before.all(axis=0))


def _level_bias(mission: Mission, drift: Array, label: str) -> list[str]:
    """Note gyros about the level axes that read far more than the vehicle tilts.

    ``drift`` (3,) is how fast the direction of the specific force leaves the one by the gyros, 1/s;
    that is ``bias x force``.
    """
    force = np.median(mission.imu.accel_b, axis=0)
    bias = np.cross(force / np.linalg.norm(force), drift)
    noise, span = mission.imu.noise, float(mission.imu.time_s[-1] - mission.imu.start_s)
    spread = (noise.gyro_density / np.sqrt(span), _TILT_NOISE / span)
    size, limit = float(np.linalg.norm(bias)), float(np.hypot(*spread))
    if size < EARTH_RATE + _BIAS_SIGMAS * np.hypot(noise.gyro_bias_sigma, limit):
        return []
    return [
        f"{label}: over the mission the gyros turn by {_deg_per_h(bias)} deg/h about x, y, z more "
        "than the vehicle tilts, far beyond gyro_bias_deg_per_h = "
        f"{_stated(noise)}: that is a bias, and the axis along gravity, which "
        "this does not see, may have one too; take it off or state it"
    ]


def _rates_at_rest(mission: Mission, ping_s: Array, label: str) -> list[str]:
    """Note gyros that turn while the accelerometer and the DVL are still."""
    imu, noise = mission.imu, mission.imu.noise
    spread = np.hypot(noise.gyro_bias_sigma, noise.gyro_density / _REST_S**0.5)
    limit = EARTH_RATE + _BIAS_SIGMAS * float(spread)
    begins = np.arange(imu.start_s, imu.time_s[-1] - _REST_S, _REST_S)
    samples, pings = (
        np.searchsorted(time_s, np.column_stack([begins, begins + _REST_S]), side="right")
        for time_s in (imu.time_s, ping_s)
    )
    for begin, of_imu, of_dvl in zip(begins, samples.tolist(), pings.tolist(), strict=True):
        now, speed = slice(*of_imu), mission.dvl.speed[slice(*of_dvl)]
        if of_imu[1] - of_imu[0] < _FEWEST_PINGS or not np.isfinite(speed).any():
            continue
        is_still = np.max(np.std(imu.accel_b[now], axis=0)) < _REST_FORCE
        is_still &= np.max(np.std(imu.gyro_b[now], axis=0)) < _REST_RATE
        mean = imu.gyro_b[now].mean(axis=0)
        if is_still and np.nanmedian(np.abs(speed)) < _REST_SPEED and np.abs(mean).max() > limit:
            return [
                f"{label}: from {begin:z.1f} s on the vehicle lies still for {_REST_S:g} s by "
                f"accelerometer and DVL, and the gyros read {_deg_per_h(mean)} deg/h about x, y, "
                f"z; gyro_bias_deg_per_h = {_stated(noise)}: a bias, or a "
                "steady turn on the spot"
            ]
    return []


def _tilt_agrees(seen: Array, predicted: Array, subject: str) -> list[str]:
    """Refuse or note a tilt that the accelerometer sees otherwise than the gyros."""
    seen_sq, predicted_sq = float(np.mean(seen**2)), float(np.mean(predicted**2))
    if min(seen_sq, predicted_sq) < _SMALLEST_TILT**2:
        return []
    product = float(np.mean(seen * predicted))
    correlation = product / np.sqrt(seen_sq * predicted_sq)
    text = (
        f"{subject} by the gyros and the other way by the accelerometer (correlation "
        f"{correlation:.2f}); expected one motion; check the signs of the gyros and [frames] body"
    )
    if correlation < _OPPOSITE_TILT:
        raise DataError(text)
    if correlation > -_OPPOSITE_TILT and product / predicted_sq < _TINY_GAIN:
        raise DataError(
            f"{subject} {predicted_sq / product:.0f} times as far by the gyros as by the "
            "accelerometer; expected rad/s; are the turn rates in deg/s?"
        )
    return [text] if correlation < -0.5 else []


def _stated(noise: ImuNoise) -> str:
    return f"{noise.gyro_bias_sigma / DEG_PER_H:.3g}"


def _deg_per_h(rate: Array) -> str:
    return ", ".join(f"{x + 0.0:.0f}" for x in rate / DEG_PER_H)


def _difference(time_s: Array, half: float, known_s: Array, values: Array) -> Array:
    """Return ``values(time_s + half) - values(time_s - half)``."""
    later = np.interp(time_s + half, known_s, values)
    return np.asarray(later - np.interp(time_s - half, known_s, values))


def _left_over(mission: Mission, speed: Array) -> Array:
    """Return what beams (..., B) measure beyond three components of velocity, m/s."""
    beyond = np.linalg.svd(mission.dvl.mount.beams_d)[0][:, 3:]
    return np.asarray(np.linalg.norm(speed @ beyond, axis=-1))


def _velocities(mission: Mission, ping_s: Array) -> tuple[Array, Array]:
    """Return times (N,) and body velocities (N, 3) by all beams, without most of the outliers."""
    dvl = mission.dvl
    used = np.isfinite(dvl.speed).all(axis=1)
    if not used.any() or dvl.mount.n_beams < 3:
        return np.zeros(0), np.zeros((0, 3))
    if dvl.mount.n_beams > 3:
        left = _left_over(mission, dvl.speed)
        used &= left <= 3.0 * np.median(left[used])
    return ping_s[used], dvl.speed[used] @ np.linalg.pinv(dvl.mount.beams_b).T


def _force_direction(mission: Mission, time_s: Array, half: float) -> Array:
    """Return the unit vector (N, 3) of the mean specific force around each time."""
    return _unit(_gained(mission, mission.imu.accel_b, time_s, half))


def _gravity_direction(
    mission: Mission, time_s: Array, half: float, *, ping_s: Array, velocity: Array
) -> Array:
    """Return the unit vector (N, 3) of the mean specific force less the acceleration.

    ``ping_s`` (P,) and ``velocity`` (P, 3) are those of :func:`velocities`.
    """
    v_b = np.column_stack([np.interp(time_s, ping_s, axis) for axis in velocity.T])
    gained = np.column_stack([_difference(time_s, half, ping_s, axis) for axis in velocity.T])
    gravity = _gained(mission, mission.imu.accel_b, time_s, half) - gained
    gravity = gravity - np.cross(_gained(mission, mission.imu.gyro_b, time_s, half), v_b)
    return _unit(gravity)


def _gained(mission: Mission, values: Array, time_s: Array, half: float) -> Array:
    """Return the integral (N, 3) of an IMU quantity from ``half`` before to ``half`` after."""
    steps = np.diff(mission.imu.time_s, prepend=mission.imu.start_s)
    sums = np.cumsum(values * steps[:, None], axis=0)
    columns = [_difference(time_s, half, mission.imu.time_s, column) for column in sums.T]
    return np.column_stack(columns)


def _unit(vectors: Array) -> Array:
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(size, 1e-9))
