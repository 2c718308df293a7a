"""A mission as an estimation problem: keyframes, inertial chain, measurements, initial state."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from factors.imu_errors import NONE
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading, phi_D_roll_pitch_heading
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.base.stepwise import Steps, at_once
from ssm_graph.base.times import MIN_SPACING_S, Indices, is_inside, nearest
from ssm_graph.base.usual import KEYFRAME_INTERVAL_S, MERGE_RATE_HZ
from ssm_graph.engine.error_state import POSITION, ROTATION, STATE_DIM, VELOCITY, InitialMoments
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.aids import AIDS
from ssm_graph.graph.aids.aid import Aid, Keyframes, Table
from ssm_graph.graph.aids.depth import DEPTH_DRIFT, Depths
from ssm_graph.graph.aids.gnss import GNSS_DRIFT, Fixes
from ssm_graph.imu.missing_notes import notes_of_missing
from ssm_graph.imu.ping_motion import MotionBefore, mean_gyro
from ssm_graph.imu.preintegration import InertialChain, preintegrate_steps
from ssm_graph.mission.calibration import (
    CURRENT,
    CURRENTS,
    DVL_DRIFT,
    current_note,
    extras_of,
    needs_motion,
)
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.mission import Aids, InitialState, Mission
from ssm_graph.mission.timeline import Timeline, build_timeline
from ssm_graph.mission.usable import require_usable
from ssm_graph.sensors.dvl import DvlMount
from ssm_graph.sensors.dvl_readings import stuck_beams
from ssm_graph.sensors.frozen import frozen_runs
from ssm_graph.sensors.imu import frozen_axes
from ssm_graph.sensors.seabed import TerrainLog

SHORTEST_INTERVAL_S = 0.01
SLOWEST_MERGE_HZ = 5.0
"""In waves heights are as good as from 20 Hz; from 1 Hz half of them are beyond three sigma."""
NO_EXTRAS = Extras()
A = TypeVar("A", bound=Aid)


@dataclass(frozen=True, slots=True)
class ProblemConfig:
    """How a mission becomes a graph."""

    merge_rate_hz: float = MERGE_RATE_HZ
    """Raw inertial samples are merged to this rate before preintegration."""
    keyframe_interval_s: float = KEYFRAME_INTERVAL_S
    """Longest time between keyframes while DVL and GNSS are silent."""

    def __post_init__(self) -> None:
        for name in ("merge_rate_hz", "keyframe_interval_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ConfigError(f"{name}: expected a number above zero, got {value}")
        if self.merge_rate_hz < SLOWEST_MERGE_HZ:
            raise ConfigError(
                f"merge_rate_hz: expected {SLOWEST_MERGE_HZ:g} Hz or more, got "
                f"{self.merge_rate_hz:g}; how waves move the vehicle would be merged away"
            )
        if self.keyframe_interval_s < SHORTEST_INTERVAL_S:
            raise ConfigError(
                f"keyframe_interval_s: expected {SHORTEST_INTERVAL_S:g} s or more, got "
                f"{self.keyframe_interval_s:g}; no more keyframes are needed than there are "
                "inertial samples"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Beams(Table):
    """Every valid beam speed as one row, in the order of its keyframe."""

    SHARED = frozenset({"lever_arm_b", "R_bd", "n_beams", "motion", "white_share"})

    beam: NDArray[np.intp]
    """(M,) from 0"""
    speed: Array
    """(M,) m/s"""
    sigma: Array
    """(M,) m/s"""
    gyro_b: Array
    """(M, 3) rad/s, mean over the ping"""
    beam_b: Array
    """(M, 3) beam directions, longer than one by the known scale errors"""
    lever_arm_b: Array
    """(3,) m"""
    R_bd: Array
    """(3, 3) mounting, instrument to body"""
    ping: NDArray[np.intp]
    """(M,) the ping of each, counted from 0"""
    is_water: NDArray[np.bool_]
    """(M,) off the water instead of the ground: relative to its current"""
    n_beams: int
    """Of the instrument, B"""
    motion: MotionBefore | None = None
    """Inertial readings about the pings, where the DVL's clock or lever arm is in doubt."""
    white_share: float = 1.0
    """Of the sigmas off the ground, what is white where the drift of the DVL is a variable"""

    @classmethod
    def of_mount(cls, mount: DvlMount) -> Beams:
        """Return no row of an instrument."""
        none, none_b, index = np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.intp)
        return cls(
            keyframe=index,
            beam=index,
            speed=none,
            sigma=none,
            gyro_b=none_b,
            beam_b=none_b,
            lever_arm_b=mount.lever_arm_b,
            R_bd=mount.R_bd,
            ping=index,
            is_water=np.zeros(0, bool),
            n_beams=mount.n_beams,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Problem(ReadOnlyArrays):
    """Everything an estimator needs of one mission."""

    frame: LocalFrame
    start: InitialState
    keyframe_s: Array
    chain: InertialChain
    beams: Beams
    depths: Depths | None
    fixes: Fixes | None
    imu_noise_bias_sigma: Array
    """(6,) turn-on bias sigmas, accelerometer (m/s^2) then gyro (rad/s)."""
    extras: Extras = NO_EXTRAS
    """What else is to be estimated; an estimator that takes it as exact says so."""
    aids: tuple[Aid, ...] = ()
    """What the smoothers are aided by besides; another estimator says that it is not."""
    notes: tuple[str, ...] = ()
    faults: tuple[DetectedFault, ...] = ()
    """What is plain from the readings alone"""

    def aid(self, kind: type[A]) -> A | None:
        """Return the aid of a kind, None if there is none."""
        return next((aid for aid in self.aids if isinstance(aid, kind)), None)

    @property
    def n_keyframes(self) -> int:
        """Number of keyframes."""
        return len(self.keyframe_s)


def build_problem_steps(
    mission: Mission,
    config: ProblemConfig | None = None,
    *,
    start: InitialState | None = None,
    begin_s: float | None = None,
) -> Steps[Problem]:
    """Turn a mission into an estimation problem.

    Parameters
    ----------
    mission : the recorded run.
    config : rates and intervals.
    start : initial state with sigmas; the mission's own when left out. A mission without one
        needs :func:`ssm_graph.mission.start.alignment.align` first.
    begin_s : when errors of aids that grow are counted from, s; from the first reading of each when
        left out.
    """
    require_usable(mission)
    mission = replace(mission, imu=mission.imu.calibrated)
    mission, stuck_note = _without_stuck_beams(mission)
    mission, frozen = without_frozen(mission)
    config = config or ProblemConfig()
    start = start or mission.initial
    if start is None:
        raise ConfigError(
            "mission.toml: no [initial], and no start was given; expected one of them; "
            "let align(mission) find the start"
        )
    mission, lost_note = _without_lost_map(mission, start)
    timeline = build_timeline(mission, start_s=start.time_s, interval_s=config.keyframe_interval_s)
    extras = extras_of(mission)
    chain = yield from preintegrate_steps(
        mission.imu,
        timeline.keyframe_s,
        frame=mission.frame,
        rate_hz=config.merge_rate_hz,
        errors=NONE if mission.imu.calibration.is_asked else None,
    )
    noise, depth = mission.imu.noise, mission.depth
    keyframes = Keyframes(mission.frame, mission.imu, timeline.keyframe_s, begin_s)
    aids = (kind.of(mission.aids, keyframes) for kind in AIDS)
    return Problem(
        frame=mission.frame,
        start=start,
        keyframe_s=timeline.keyframe_s,
        chain=chain,
        beams=_beams(mission, timeline.ping, timeline.ping_keyframe, extras),
        depths=None if depth is None else Depths.of(depth, mission.imu, timeline.keyframe_s),
        fixes=_fixes(mission, timeline),
        imu_noise_bias_sigma=np.repeat([noise.accel_bias_sigma, noise.gyro_bias_sigma], 3),
        extras=extras,
        aids=tuple(aid for aid in aids if aid is not None),
        notes=(
            *timeline.notes,
            *notes_of_missing(mission.imu, timeline.keyframe_s),
            *stuck_note,
            *lost_note,
            *current_note(mission),
        ),
        faults=frozen,
    )


build_problem = at_once(build_problem_steps)


def start_of(problem: Problem) -> InitialMoments:
    """Return mean and covariance of the first keyframe."""
    return initial_moments(problem.start, problem.frame, bias_sigma=problem.imu_noise_bias_sigma)


def with_dvl(problem: Problem, mission: Mission) -> Problem:
    """Return the problem with the beams of another DVL log of the same run.

    The inertial chain, most of the work, is kept; so the pings have to be at keyframes.
    """
    mission = replace(mission, imu=mission.imu.calibrated)
    mission, _ = _without_stuck_beams(mission)
    keyframe_s, ping_s = problem.keyframe_s, mission.dvl.valid_s
    is_used = np.isfinite(mission.dvl.speed).any(axis=1)
    is_used &= is_inside(ping_s, keyframe_s[0], keyframe_s[-1])
    ping = np.flatnonzero(is_used)
    keyframe = nearest(keyframe_s, ping_s[ping])
    off = np.abs(keyframe_s[keyframe] - ping_s[ping])
    if np.any(off > MIN_SPACING_S):
        raise DataError(
            f"with_dvl: expected pings at the keyframes, got one {off.max():.3f} s away at "
            f"{ping_s[ping][np.argmax(off)]:.3f} s; build a problem of its own"
        )
    beams = _beams(mission, ping, keyframe, problem.extras)
    if beams.is_water.any() and CURRENT not in problem.extras:
        raise DataError(
            "with_dvl: expected pings off the ground, as those of the problem, got some off the "
            "water, whose current it does not have; build a problem of its own"
        )
    return replace(problem, beams=beams)


def with_white_noise(problem: Problem) -> Problem:
    """Return what an estimator whose variables are the drifts, too, makes of a problem, once.

    A problem states the noise of beams, fixes and depths with all that changes slowly; here their
    sigmas are those of white noise alone, all of which is white.
    """
    beams, fixes, depths = problem.beams, problem.fixes, problem.depths
    if DVL_DRIFT in problem.extras:
        share = np.where(beams.is_water, 1.0, beams.white_share)
        beams = replace(beams, sigma=beams.sigma * share, white_share=1.0)
    if fixes is not None and GNSS_DRIFT in problem.extras:
        covariance_n = fixes.covariance_n * fixes.white_share**2
        fixes = replace(fixes, covariance_n=covariance_n, white_share=1.0)
    if depths is not None and DEPTH_DRIFT in problem.extras:
        depths = replace(depths, sigma=depths.sigma * depths.white_share, white_share=1.0)
    return replace(problem, beams=beams, fixes=fixes, depths=depths)


LOST_M = 100.0
"""Less well known than this, a start is on no slope of a seabed that could lead it anywhere."""


def _without_lost_map(mission: Mission, start: InitialState) -> tuple[Mission, tuple[str, ...]]:
    """Return the mission without a map on which its place has yet to be found, and a note."""
    log = mission.aids.get(TerrainLog)
    if log is None:
        return mission, ()
    sigma = float(start.position_sigma_enu[:2].max())
    if mission.local is None and not np.isfinite(log.within_m) and sigma < LOST_M:
        return mission, ()
    note = (
        "the map of the seabed is left out: where on it the mission began is not known; "
        "ssm-graph smooth and ssm-graph seabed look for it"
    )
    others = (aid for aid in mission.aids if aid is not log)
    return replace(mission, aids=Aids(*others)), (note,)


def _without_stuck_beams(mission: Mission) -> tuple[Mission, tuple[str, ...]]:
    """Return the mission without the speeds of beams that repeat themselves, and a note."""
    dvl = mission.dvl
    is_stuck = stuck_beams(dvl.speed)
    count = is_stuck.sum(axis=0)
    if not count.any():
        return mission, ()
    beams = ", ".join(f"beam {b + 1}: {count[b]}" for b in np.flatnonzero(count))
    first_s = float(dvl.valid_s[is_stuck.any(axis=1)][0])
    note = (
        f"speeds of a beam that repeats one reading while the others change are left out: {beams}; "
        f"the first at {first_s:.3f} s"
    )
    speed = np.where(is_stuck, np.nan, dvl.speed)
    return replace(mission, dvl=replace(dvl, speed=speed)), (note,)


FROZEN_S = 5.0
FROZEN_READINGS = 5
"""So many fixes, or depths, in a row, and for so long, repeat one reading: they are none."""


def without_frozen(mission: Mission) -> tuple[Mission, tuple[DetectedFault, ...]]:
    """Return the mission without fixes and depths that repeat one reading, and what does so.

    Axes of the inertial sensors that do are unseen motion, see
    :func:`ssm_graph.imu.preintegration.preintegrate`.
    """
    found: list[DetectedFault] = []
    gnss, depth = mission.gnss, mission.depth
    if gnss is not None:
        kept = _measured("GNSS", gnss.time_s, np.column_stack([gnss.lat, gnss.lon]), found)
        gnss = gnss if kept.all() else gnss.rows(kept)
    if depth is not None:
        kept = _measured("depth", depth.time_s, depth.depth[:, None], found)
        depth = depth if kept.all() else depth.rows(kept)
    for axis in frozen_axes(mission.imu):
        name = "gyros" if axis.is_gyro else "accelerometers"
        found.append(_repeating(name, str(axis), axis.begin_s, axis.end_s, Treatment.COVERED))
    return replace(mission, gnss=gnss, depth=depth), tuple(found)


def _measured(
    sensor: str, time_s: Array, values: Array, found: list[DetectedFault]
) -> NDArray[np.bool_]:
    """Return which readings (N, d) do not repeat one, and note those that do."""
    kept = np.ones(len(time_s), bool)
    for begin, end in frozen_runs(time_s, values, least_s=FROZEN_S, least_count=FROZEN_READINGS):
        kept[begin + 1 : end + 1] = False
        span_s = float(time_s[begin]), float(time_s[end])
        found.append(_repeating(sensor, "repeats one reading", *span_s, Treatment.LEFT_OUT))
    return kept


def _repeating(
    sensor: str, what: str, begin_s: float, end_s: float, treatment: Treatment
) -> DetectedFault:
    return DetectedFault(sensor, what, begin_s, end_s, chi_sq=np.inf, dof=1, treatment=treatment)


def _fixes(mission: Mission, timeline: Timeline) -> Fixes | None:
    log = mission.gnss
    if log is None:
        return None
    fixes = Fixes.of_log(
        log,
        timeline.fix,
        time_s=log.valid_s[timeline.fix],
        keyframe=timeline.fix_keyframe,
        frame=mission.frame,
        imu=mission.imu,
    )
    return replace(fixes, white_share=log.calibration.drift.white_share)


def _beams(mission: Mission, ping: Indices, ping_keyframe: Indices, extras: Extras) -> Beams:
    dvl, is_water = mission.dvl, mission.dvl.is_water[ping]
    speed, sigma, beams_b = (rows[ping] for rows in dvl.independent())
    row, beam = np.nonzero(np.isfinite(speed))
    gyro_b = mean_gyro(mission.imu, dvl.valid_s[ping]) if len(ping) else np.zeros((0, 3))
    return Beams(
        keyframe=ping_keyframe[row],
        beam=beam,
        speed=speed[row, beam],
        sigma=sigma[row, beam],
        gyro_b=gyro_b[row],
        beam_b=beams_b[row, beam],
        lever_arm_b=dvl.mount.lever_arm_b,
        R_bd=dvl.mount.R_bd,
        ping=row,
        is_water=is_water[row],
        n_beams=dvl.mount.n_beams,
        motion=MotionBefore(mission.imu, dvl.valid_s[ping]) if needs_motion(extras) else None,
        white_share=dvl.mount.drift.white_share,
    )


def without_water_track(problem: Problem) -> Problem:
    """Return the problem with the pings off the ground alone, and a note of those left out."""
    beams = problem.beams
    if not beams.is_water.any():
        return problem
    kept = ~beams.is_water
    note = (
        f"{len(np.unique(beams.ping[beams.is_water]))} pings off the water are left out: this "
        "estimator has no current, and would take them for pings off the ground; ssm-graph smooth "
        "uses them"
    )
    rows = {
        name: getattr(beams, name)[kept]
        for name in ("keyframe", "beam", "speed", "sigma", "gyro_b", "beam_b", "ping", "is_water")
    }
    return replace(
        problem,
        beams=replace(beams, **rows),
        extras=problem.extras.without(CURRENTS),
        notes=(*problem.notes, note),
    )


def require_bottom_track(problem: Problem) -> None:
    """Raise :class:`ConfigError` for a problem with pings off the water."""
    if problem.beams.is_water.any():
        raise ConfigError(
            "this estimator has no current: expected pings off the ground, got some off the water; "
            "leave them out by without_water_track"
        )


def initial_moments(start: InitialState, frame: LocalFrame, *, bias_sigma: Array) -> InitialMoments:
    """Turn an initial state in geodetic terms into the first keyframe's mean and covariance.

    Parameters
    ----------
    start : initial state with sigmas along east, north, up and of roll, pitch, heading.
    frame : navigation frame.
    bias_sigma : (6,) turn-on bias sigmas, accelerometer then gyro.
    """
    p_n = frame.p_n_from_geodetic(start.lat, start.lon, start.height)
    R_nl = frame.R_nl_at(p_n)
    R_lb = R_lb_from_roll_pitch_heading(start.roll, start.pitch, start.heading)
    R_nb = R_nl @ R_lb
    J = phi_D_roll_pitch_heading(start.roll, start.pitch)
    covariance = np.zeros((STATE_DIM, STATE_DIM))
    covariance[ROTATION, ROTATION] = J @ np.diag(start.attitude_sigma**2) @ J.T
    covariance[POSITION, POSITION] = R_lb.T @ np.diag(start.position_sigma_enu**2) @ R_lb
    covariance[VELOCITY, VELOCITY] = R_nl @ np.diag(start.velocity_sigma_enu**2) @ R_nl.T
    covariance[9:, 9:] = np.diag(bias_sigma**2)
    return InitialMoments(R_nb, p_n, R_nl @ start.velocity_enu, np.zeros(6), covariance)
