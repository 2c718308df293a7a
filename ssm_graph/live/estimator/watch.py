"""Whether a live answer may be used: what is remembered from keyframe to keyframe, and the verdict.

Everything is a function of the data up to a keyframe, so that late messages change the verdict as
if they had been punctual.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, VELOCITY
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.imu.thinned import MOST_MISSING
from ssm_graph.live.estimator.guard import Guarded
from ssm_graph.mission.answer import LARGEST_SPEED, LOW_WEIGHT, MISFIT, TRUSTED
from ssm_graph.mission.navigation import Health
from ssm_graph.sensors.imu import FrozenAxis
from ssm_graph.smoothers.keyframe import Keyframe
from ssm_graph.smoothers.track import Stretch
from ssm_graph.smoothers.window import Window

LOCK_LOST_S: Final = 3.0
"""Without a beam that counts for so long, bottom lock is lost."""
PROBATION_S: Final = 5.0
"""So long after trouble an answer has to agree before it is good again."""
MEMORY_S: Final = 10.0
"""Time constant of the running means."""
FORCES: Final = (8.5, 11.5)
"""m/s^2, mean specific force of any vehicle that stays under water."""
CONTRADICTED_S: Final = 600.0
"""So long after position or height had to follow a sensor against dead reckoning nothing is good,
unless they come back: one of the two was wrong, and nothing says which."""
TORN_PINGS: Final = 3
"""Pings in a row whose beams agree with each other and of which two or more are left out."""
FEW: Final = 0.5
"""Fewer of the beams that agree are too few."""
GAP_S: Final = 0.3
"""So long without an inertial sample leaves an attitude that the next pings have to confirm."""
SILENT_IMU_S: Final = 1.0
DOUBTED_DEPTH: Final = 0.5
"""A depth of which more was refused lately is left out altogether, until it has agreed for
`PROBATION_S`: one that is frozen agrees twice in every wave, and each time would pull the height a
little to where it stays."""
DEPTHS_S: Final = 1.0
"""A depth counts in that mean for the time since the one before, but for so long at most."""


class Contradicted(NamedTuple):
    """A position that was given up against dead reckoning."""

    since_s: float
    text: str
    reckoned_n: tuple[float, ...]
    """m, where dead reckoning goes on from there"""
    sigma: float
    """m, of where it began"""


class Watch(NamedTuple):
    """What is remembered from keyframe to keyframe."""

    last_beam_s: float = -math.inf
    """When a beam counted last, off the ground or off the water, s"""
    last_ground_s: float = -math.inf
    """When one off the ground did, s"""
    last_fix_s: float = -math.inf
    last_aid_s: float = -math.inf
    """When a measurement of any other aid counted, s"""
    pings_refused: int = 0
    """Pings in a row that agree with themselves and not with the prediction"""
    pings_out: int = 0
    """Pings in a row of which no beam agrees with the prediction"""
    pings_torn: int = 0
    """Pings in a row that agree with themselves and of which two beams or more are left out"""
    torn_since_s: float = math.inf
    """Since when such pings have come, s, also if the answer was begun anew meanwhile"""
    out_since_s: float = math.inf
    """Since when no beam has agreed, s, also if the answer was begun anew meanwhile"""
    fixes_refused: int = 0
    """In a row, as the next two"""
    heights_refused: int = 0
    """Fixes of which the height alone contradicts"""
    depths_refused: int = 0
    depths_followed: bool = False
    """Whether the height was begun anew where these put it"""
    depth_heard_s: float = -math.inf
    """When a depth came last, whether it counted or not, s"""
    depth_refused_s: float = -math.inf
    """When one was refused last, s"""
    refused_depth: float = 0.0
    """Running mean of the share of depths that are refused"""
    leaves_depth_out: bool = False
    """Whether none counts, since too many were"""
    last_height_s: float = -math.inf
    """When the height of a fix counted last, s"""
    last_depth_s: float = -math.inf
    """When a depth did"""
    good_share: float = 1.0
    """Running mean of the share of beams that count"""
    few_since_s: float = math.inf
    """Since when that has been less than half, s"""
    misfit: float = 1.0
    """Running mean square of what the trusted beams miss, in sigmas"""
    force: float = 9.8
    """Running mean of the specific force, m/s^2"""
    trouble_s: float = -math.inf
    """When something was last wrong with the answer"""
    trouble: str = ""
    begun_anew_s: float = -math.inf
    """When the answer was last given up and begun anew"""
    moved: tuple[float, ...] = ()
    """When it was begun anew at another position because fixes contradicted it, the last times"""
    contradicted: Contradicted | None = None
    beam_weights: tuple[float, ...] = ()
    """Of the last ping"""


def observe(
    watch: Watch,
    keyframe: Keyframe,
    window: Window,
    *,
    last_s: float,
    parity: bool,
    force: float,
    gap_s: float,
    missing: float,
    frozen: Sequence[FrozenAxis] = (),
) -> Watch:
    """Return what is remembered after one more keyframe, with which the window is settled.

    Parameters
    ----------
    last_s : time of the keyframe before, s.
    parity : whether the beams of this one agree with each other.
    force : mean specific force since the keyframe before, m/s^2.
    gap_s : longest time without an inertial sample since then.
    missing : share of the inertial samples that have not come since then.
    frozen : axes of the inertial sensors that repeat themselves.
    """
    newest, time_s = window.newest, keyframe.time_s
    kept = window.keyframes[-1]
    share = 1.0 - math.exp(-(time_s - last_s) / MEMORY_S)
    watch = watch._replace(force=watch.force + share * (force - watch.force))
    if len(newest.weight):
        watch = _with_beams(watch, newest, share, parity=parity, n_beams=keyframe.beams.n_beams)
        if counts_off_the_ground(newest, kept):
            watch = watch._replace(last_ground_s=time_s)
    few_since_s = min(watch.few_since_s, time_s) if watch.good_share < FEW else math.inf
    watch = watch._replace(few_since_s=few_since_s)
    watch = _with_heights(watch, keyframe, newest)
    of_place = (judged for name, judged in newest.aids.items() if name != DepthMeans.name)
    if any(np.any(judged.weight >= TRUSTED) for judged in of_place):
        watch = watch._replace(last_aid_s=time_s)
    if watch.contradicted is not None:
        watch = watch._replace(contradicted=_still(watch.contradicted, window))
    trouble = _repeating(frozen) or _trouble(watch, time_s, newest.states.v_n[0])
    if gap_s > GAP_S and not trouble:
        trouble = f"{gap_s:.1f} s of inertial data are missing: what was guessed has to prove right"
    elif missing > MOST_MISSING and not trouble:
        trouble = f"{100.0 * missing:.0f} % of the inertial samples are missing"
    return watch._replace(trouble_s=time_s, trouble=trouble) if trouble else watch


def _is_refused(newest: Stretch, name: str) -> bool:
    """Return whether nothing that an aid measured at the newest keyframe counts."""
    judged = newest.aids.get(name)
    return judged is None or bool(np.all(judged.weight < LOW_WEIGHT))


def _with_heights(watch: Watch, keyframe: Keyframe, newest: Stretch) -> Watch:
    """Return what is remembered after the fixes and the depth of one more keyframe."""
    time_s, fixes = keyframe.time_s, keyframe.aids.get(Fixes.name)
    if isinstance(fixes, Fixes):
        is_refused = _is_refused(newest, Fixes.name)
        watch = watch._replace(
            fixes_refused=watch.fixes_refused + 1 if is_refused else 0,
            last_fix_s=watch.last_fix_s if is_refused else time_s,
        )
        if not is_refused and fixes.has_height.any():
            used = newest.aids[Fixes.name].aid
            counts = isinstance(used, Fixes) and bool(used.has_height.any())
            watch = watch._replace(
                heights_refused=0 if counts else watch.heights_refused + 1,
                last_height_s=time_s if counts else watch.last_height_s,
            )
    if DepthMeans.name in keyframe.aids:
        is_refused = _is_refused(newest, DepthMeans.name)
        share = -math.expm1(-min(time_s - watch.depth_heard_s, DEPTHS_S) / MEMORY_S)
        refused = watch.refused_depth + share * (is_refused - watch.refused_depth)
        refused_s = time_s if is_refused else watch.depth_refused_s
        if watch.leaves_depth_out and time_s - refused_s > PROBATION_S:
            is_out, refused = False, 0.0
        else:
            is_out = watch.leaves_depth_out or refused > DOUBTED_DEPTH
        watch = watch._replace(
            depths_refused=watch.depths_refused + 1 if is_refused else 0,
            depths_followed=watch.depths_followed and is_refused,
            depth_heard_s=time_s,
            depth_refused_s=refused_s,
            refused_depth=refused,
            leaves_depth_out=is_out,
            last_depth_s=watch.last_depth_s if is_refused or is_out else time_s,
        )
    return watch


def _with_beams(
    watch: Watch, newest: Stretch, share: float, *, parity: bool, n_beams: int
) -> Watch:
    """Return what is remembered after the beams of one more keyframe; means move by ``share``."""
    time_s = float(newest.time_s[0])
    counted = newest.weight >= TRUSTED
    trusted = newest.mahalanobis_sq[counted]
    n_out = int(np.sum(newest.weight < LOW_WEIGHT))
    is_out, is_torn = n_out == len(newest.weight) > 2, n_out > 1 and parity
    weights = [math.nan] * n_beams
    for beam, weight in zip(newest.beam.tolist(), newest.weight, strict=True):
        weights[beam] = float(weight)
    watch = watch._replace(
        last_beam_s=time_s if counted.any() else watch.last_beam_s,
        pings_refused=watch.pings_refused + 1 if is_out and parity else 0,
        pings_out=watch.pings_out + 1 if is_out else 0,
        pings_torn=watch.pings_torn + 1 if is_torn else 0,
        torn_since_s=min(watch.torn_since_s, time_s) if is_torn else math.inf,
        out_since_s=min(watch.out_since_s, time_s) if is_out else math.inf,
        good_share=watch.good_share + share * (float(counted.mean()) - watch.good_share),
        beam_weights=tuple(weights),
    )
    if len(trusted):
        watch = watch._replace(misfit=watch.misfit + share * (float(trusted.mean()) - watch.misfit))
    return watch


def counts_off_the_ground(newest: Stretch, keyframe: Keyframe) -> bool:
    """Return whether a beam off the ground counts at the newest keyframe, as the window has it."""
    is_ground = ~keyframe.beams.is_water
    return bool(np.any(newest.weight[is_ground] >= TRUSTED))


def is_sound(watch: Watch, time_s: float) -> bool:
    """Return whether nothing has been wrong with the answer for a while."""
    return time_s - max(watch.trouble_s, watch.begun_anew_s) > PROBATION_S


def _still(was: Contradicted, window: Window) -> Contradicted | None:
    """Return the contradiction after one more keyframe, None once the position has come back."""
    newest, path_n = window.newest, window.states.p_n
    reckoned_n = np.add(was.reckoned_n, path_n[-1] - path_n[max(len(path_n) - 2, 0)])
    since_s = float(newest.time_s[0]) - was.since_s
    if since_s > CONTRADICTED_S:
        return None
    sigma = math.hypot(was.sigma, math.sqrt(np.trace(newest.covariance[0, POSITION, POSITION])))
    off = float(np.linalg.norm(newest.states.p_n[0] - reckoned_n))
    if since_s > 2.0 * PROBATION_S and off < 3.0 * sigma:
        return None
    return was._replace(reckoned_n=tuple(reckoned_n.tolist()))


def _repeating(frozen: Sequence[FrozenAxis]) -> str:
    """Say which axis gives one reading, if any."""
    if not frozen:
        return ""
    axis = frozen[0]
    name = "gyros" if axis.is_gyro else "accelerometers"
    return (
        f"the {name} give {axis}, since {axis.begin_s:.0f} s: look at the IMU and its link; "
        "sigmas grow meanwhile"
    )


def _trouble(watch: Watch, time_s: float, v_n: Array) -> str:
    """Say what is wrong with the answer now, if anything."""
    speed = float(np.linalg.norm(v_n))
    if speed > LARGEST_SPEED:
        return f"a speed of {speed:.0f} m/s is no underwater vehicle's"
    if not FORCES[0] < watch.force < FORCES[1]:
        return (
            f"the mean specific force is {watch.force:.2f} m/s^2, expected about 9.8: look at unit "
            "and scale of the accelerometers"
        )
    if watch.pings_refused:
        return f"{watch.pings_refused} pings in a row contradict the prediction"
    if watch.pings_out >= TORN_PINGS:
        return f"in {watch.pings_out} pings in a row no beam agrees with the prediction"
    if watch.pings_torn >= TORN_PINGS:
        return (
            f"in {watch.pings_torn} pings in a row the beams agree with each other, but not with "
            "the prediction: some are left out"
        )
    if watch.fixes_refused:
        return f"{watch.fixes_refused} GNSS fixes in a row contradict the prediction"
    if watch.heights_refused:
        return (
            f"the height of {watch.heights_refused} GNSS fixes in a row contradicts the prediction "
            "and is left out"
        )
    if watch.depths_refused and watch.leaves_depth_out:
        return "the depth contradicts the prediction again and again: left out until it agrees"
    if watch.depths_refused:
        return f"the depth contradicts the prediction, {watch.depths_refused} times in a row"
    if watch.misfit > MISFIT:
        return f"the beams that count miss the answer by {math.sqrt(watch.misfit):.1f} sigmas"
    if watch.good_share < FEW and time_s - watch.last_beam_s < LOCK_LOST_S:
        return f"only {100.0 * watch.good_share:.0f} % of the beams agree with the answer"
    return ""


class Verdict(NamedTuple):
    """What a user is told of the newest answer."""

    health: Health
    reason: str
    confidence: float
    bottom_lock: bool
    since_aid_s: float


def verdict(
    watch: Watch, guarded: Guarded, *, now_s: float, imu_s: float, covariance: Array
) -> Verdict:
    """Judge the newest answer, of the covariance (15, 15), by what is remembered.

    ``guarded`` is what the lanes say, ``now_s`` the newest time of any message, ``imu_s`` that of
    the inertial data.
    """
    since_beam_s = imu_s - watch.last_beam_s
    since_aid_s = imu_s - max(watch.last_beam_s, watch.last_fix_s, watch.last_aid_s)
    since_ground_s = imu_s - watch.last_ground_s
    has_lock = since_ground_s < LOCK_LOST_S
    velocity_sigma = math.sqrt(max(float(np.trace(covariance[VELOCITY, VELOCITY])), 0.0))
    health, reason = Health.GOOD, Health.GOOD.value
    if now_s - imu_s > SILENT_IMU_S:
        health = Health.BAD
        reason = f"no inertial data for {now_s - imu_s:.1f} s: look at the IMU and its link"
    elif not (np.all(np.isfinite(covariance)) and velocity_sigma < LARGEST_SPEED):
        health, reason = Health.BAD, "the answer has run away"
    elif imu_s - watch.begun_anew_s < PROBATION_S:
        health, reason = Health.BAD, f"being recovered: {watch.trouble}"
    elif guarded.contradiction:
        health, reason = Health.DEGRADED, guarded.contradiction
    elif imu_s - watch.trouble_s < PROBATION_S:
        health, reason = Health.DEGRADED, watch.trouble
    elif watch.contradicted is not None:
        health, reason = Health.DEGRADED, watch.contradicted.text
    elif guarded.shortfall:
        health, reason = Health.DEGRADED, guarded.shortfall
    elif not has_lock:
        health = Health.DEGRADED
        beam = "beam" if since_beam_s >= LOCK_LOST_S else "beam off the ground"
        since = f"for {since_ground_s:.0f} s" if math.isfinite(since_ground_s) else "yet"
        reason = f"no {beam} has counted {since}: bottom lock is lost, sigmas grow"
        if since_beam_s < LOCK_LOST_S:
            reason += ", though less while the water is heard"
    confidence = 0.0
    if health is not Health.BAD:
        fresh = math.exp(-max(since_aid_s, 0.0) / 60.0)
        confidence = min(1.0, watch.good_share) * fresh / max(1.0, math.sqrt(watch.misfit))
        confidence = min(confidence, 0.45) if health is Health.DEGRADED else max(confidence, 0.5)
    return Verdict(health, reason, confidence, has_lock, max(since_aid_s, 0.0))
