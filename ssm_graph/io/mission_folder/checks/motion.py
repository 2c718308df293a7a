"""Check that the sensors tell of one motion: the sign of depth, of beam speeds, of turn rates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.checks.motion_series import (
    difference,
    force_direction,
    left_over,
    velocities,
)
from ssm_graph.io.mission_folder.checks.turns import rates_at_rest, turn_signs
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import N_BEAMS

_UPWARD_M: Final = 2.0
_WINDOW_S: Final = 2.0
_SLOWEST: Final = 0.05
"""m/s rms: slower vertical motion says nothing."""
_FEWEST_FIXES: Final = 10
_FEWEST_PINGS: Final = 30
_OPPOSITE: Final = -0.8
_CONTRADICTION: Final = 0.3
_LAGS_S: Final = np.arange(-0.5, 0.51, 0.02)
_NOTED_LAG_S: Final = 0.05


def check_motion(mission: Mission, labels: dict[str, str]) -> list[str]:
    """Compare the sensors' signs; ``labels`` name the tables.  Return the notes.

    Pings off the water are left out.
    """
    mission, notes = replace(mission, dvl=mission.dvl.of_ground()), []
    if mission.depth is not None:
        notes += _depth_sign(mission, mission.depth, labels["depth"])
        notes += _depth_surface(mission, mission.depth, labels["depth"])
        notes += _vertical_speed(mission, mission.depth, labels)
    notes += turn_signs(mission, labels["imu"])
    notes += rates_at_rest(mission, labels["imu"])
    notes += _beams_agree(mission, labels["dvl"])
    return notes


def _depth_sign(mission: Mission, depth: DepthLog, label: str) -> list[str]:
    """Refuse heights given as depths."""
    expected = "expected depth, positive down; change its sign"
    median = float(np.median(depth.depth))
    if median < -_UPWARD_M and max(_known_heights(mission)) < -0.5 * median:
        raise DataError(
            f"{label}: column 'depth_m' has a median of {median:.2f} m, and no known height is "
            f"near {-median:.2f} m; {expected}"
        )
    for name, log in (("reference", mission.reference), ("gnss", mission.gnss)):
        if log is None:
            continue
        both = (log.time_s >= depth.time_s[0]) & (log.time_s <= depth.time_s[-1])
        height, down = log.height[both], np.interp(log.time_s[both], depth.time_s, depth.depth)
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
    both = (gnss.time_s >= depth.time_s[0]) & (gnss.time_s <= depth.time_s[-1])
    if not both.any():
        return []
    total = gnss.height[both] + np.interp(gnss.time_s[both], depth.time_s, depth.depth)
    offset, sigma = float(np.median(total)), float(np.median(gnss.sigma_enu[both, 2]))
    if abs(offset) < max(5.0, 3.0 * sigma):
        return []
    return [
        f"{label}: depth and GNSS height do not cancel: their sum is {offset:.1f} m; depth is "
        "minus the height above the ellipsoid, not the distance to the surface"
    ]


def _vertical_speed(mission: Mission, depth: DepthLog, labels: dict[str, str]) -> list[str]:
    """Compare the DVL's downward speed with the change of depth, down being against the force."""
    imu = mission.imu
    half = 0.5 * max(_WINDOW_S, 2.0 * float(np.median(np.diff(depth.time_s, prepend=-np.inf))))
    begin = max(imu.time_s[0], depth.time_s[0]) + half
    end = min(imu.time_s[-1], depth.time_s[-1]) - half
    begin, end = begin + _LAGS_S[-1], end + _LAGS_S[0]
    time_s, v_b = velocities(mission)
    inside = (time_s > begin) & (time_s < end)
    if inside.sum() < _FEWEST_PINGS:
        return []
    time_s, v_b = time_s[inside], v_b[inside]
    speed = -np.sum(force_direction(mission, time_s, half) * v_b, axis=1)
    rate = difference(time_s, half, depth.time_s, depth.depth) / (2.0 * half)
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
    rates = [difference(time_s - lag, half, depth.time_s, depth.depth) for lag in _LAGS_S]
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
    speed = mission.dvl.speed[np.isfinite(mission.dvl.speed).all(axis=1)]
    if len(speed) < _FEWEST_PINGS:
        return []
    orders = [list(order) for order in permutations(range(N_BEAMS))]
    errors = [float(np.median(left_over(mission, speed[:, order]))) for order in orders]
    best, sigma = int(np.argmin(errors)), float(np.median(mission.dvl.sigma))
    typical = float(np.median(np.linalg.norm(speed, axis=1)))
    is_better = 3.0 * max(errors[best], sigma) < errors[0]
    if not is_better and errors[0] < max(_CONTRADICTION * typical, 10.0 * sigma):
        return []
    hint = "check the beam directions"
    if is_better:  # several orders fit alike: name the one that moves the fewest beams
        fits = [o for o, error in zip(orders, errors, strict=True) if error < 1.5 * errors[best]]
        order = max(fits, key=lambda o: sum(o[beam] == beam for beam in range(N_BEAMS)))
        hint = f"they would fit in the order {', '.join(str(beam + 1) for beam in order)}, for one"
    return [
        f"{label}: the four beams contradict each other by {errors[0]:.3f} m/s in half of the "
        f"pings at typical speeds of {typical:.2f} m/s; {hint}"
    ]
