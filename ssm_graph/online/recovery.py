"""Beginning anew where the answer can no longer be right, with what is still known."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.data import Array
from ssm_graph.online.watch import LOCKED_OUT_DEPTHS, LOCKED_OUT_FIXES, LOCKED_OUT_PINGS, Watch
from ssm_graph.problem.error_state import POSITION, ROTATION, VELOCITY, InitialMoments
from ssm_graph.smoothers.keyframe import Keyframe
from ssm_graph.smoothers.window import Window

SPEED_SIGMA: Final = 3.0
"""m/s, what a vehicle's velocity can be."""
POSITION_SIGMA: Final = 50.0
"""m, how far a position is doubted that GNSS or depth contradict."""
LONGEST_DOUBT_S: Final = 60.0
BENT_SPEED: Final = 1.0
"""m/s, with the next: so uncertain a velocity is not corrected along with so uncertain an attitude;
that would take the one for the other."""
BENT_TURN: Final = 0.05
"""rad"""
SILENCE_S: Final = 10.0
LONGEST_FEW_S: Final = 25.0
ATTITUDE_FACTOR: Final = 2.0
"""Attitude is doubted as well, by so many of its sigmas."""


def what_to_forget(watch: Watch, sigma: Array, keyframe: Keyframe) -> str | None:
    """Say why the prediction of a keyframe cannot be gone on from; None if it can.

    ``sigma`` (15,) are those of the keyframe before.
    """
    if is_adrift(watch, sigma, keyframe):
        return (
            "after a silence of the beams the prediction is too uncertain to be corrected: the "
            "beams set the velocity anew"
        )
    if watch.pings_refused >= LOCKED_OUT_PINGS:
        return (
            f"{watch.pings_refused} pings in a row, whose beams agree with each other, contradict "
            "the velocity"
        )
    if len(keyframe.beams.speed) > 2 and keyframe.time_s - watch.few_since_s > LONGEST_FEW_S:
        return (
            f"most beams have contradicted the answer for {keyframe.time_s - watch.few_since_s:.0f}"
            " s: perhaps it follows the wrong ones"
        )
    if watch.fixes_refused >= LOCKED_OUT_FIXES:
        return f"{watch.fixes_refused} GNSS fixes in a row contradict the position"
    if watch.depths_refused == LOCKED_OUT_DEPTHS:  # once: if that does not help, it is the sensor
        return f"the depth has contradicted the height {watch.depths_refused} times in a row"
    return None


def is_adrift(watch: Watch, sigma: Array, keyframe: Keyframe) -> bool:
    """Return whether beams are back after a silence that left the prediction beyond correction."""
    return bool(
        len(keyframe.beams.speed) > 2
        and keyframe.time_s - watch.last_beam_s > SILENCE_S
        and np.linalg.norm(sigma[ROTATION]) > BENT_TURN
        and np.linalg.norm(sigma[VELOCITY]) > BENT_SPEED
    )


def reanchored(window: Window, keyframe: Keyframe, watch: Watch) -> Window:
    """Return a window that begins at ``keyframe``, where the inertial data lead from the last one.

    What was contradicted is forgotten: the velocity after a failed solution or pings that agree
    with each other, the position after fixes, the height after depths. Where the velocity was wrong
    the position is doubted by what that may have done since all was sound. Attitude is kept,
    with larger sigmas.
    """
    predicted, covariance = window.predicted(keyframe)
    P = covariance.copy()
    is_silent = is_adrift(watch, window.newest_sigma, keyframe)
    if not is_silent:
        P[ROTATION, ROTATION] *= ATTITUDE_FACTOR**2
    by_position = watch.fixes_refused >= LOCKED_OUT_FIXES
    by_depth = watch.depths_refused == LOCKED_OUT_DEPTHS
    R_nb, p_n, v_n, bias = (column[0] for column in predicted)
    if by_position:
        P[POSITION, POSITION] += POSITION_SIGMA**2 * np.eye(3)
    elif by_depth:
        P[POSITION, POSITION] += POSITION_SIGMA**2 * np.outer(R_nb[2], R_nb[2])
    else:
        P[VELOCITY, :] = P[:, VELOCITY] = 0.0
        P[VELOCITY, VELOCITY] = SPEED_SIGMA**2 * np.eye(3)
        since_s = keyframe.time_s - min(watch.sound_s, keyframe.time_s)
        since_s = max(since_s, min(keyframe.time_s - watch.last_beam_s, LONGEST_DOUBT_S))
        if not is_silent:
            P[POSITION, POSITION] += (SPEED_SIGMA * since_s) ** 2 * np.eye(3)
    if not by_position and np.linalg.norm(v_n) > SPEED_SIGMA:
        v_n = v_n * (SPEED_SIGMA / np.linalg.norm(v_n))
    start = InitialMoments(R_nb, p_n, v_n, bias, _regular(P))
    # The first keyframe of a window meets no gate: depth and fixes count from the next one on.
    first = keyframe.without("depth").without("fix")
    begun = Window(window.sensors, window.config, first, start)
    begun.iterate()
    return begun


def _regular(P: Array) -> Array:
    """Return a symmetric covariance whose Cholesky factor exists."""
    P = 0.5 * (P + P.T)
    scale = np.sqrt(np.diag(P))
    correlation = P / np.outer(scale, scale) + 1e-12 * np.eye(len(P))
    return np.asarray(correlation * np.outer(scale, scale))
