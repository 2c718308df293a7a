"""A mission with a map: where it began, and the smoother that goes on from there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ssm_graph.base.earth import EARTH_RATE
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.mission import Aids, InitialState, Mission
from ssm_graph.mission.problem import ProblemConfig
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.seabed import TerrainLog
from ssm_graph.smoothers.batch import OnIteration
from ssm_graph.smoothers.mission import OnStage, smooth
from ssm_graph.smoothers.settings import SmootherConfig
from ssm_graph.systems.seabed.locate import Located, Verdict, locate
from ssm_graph.systems.seabed.track import Track, track_of

_WIDE: Final = 3.4
"""Sigmas of each axis within which a start lies in all but 0.3 percent."""
CAUTION: Final = 5.0
"""The ranges that find a start are used again by the smoother: its prior is wider by so much."""
_LEAST_M: Final = 3.0
"""No start on a map is handed on as better known."""
_LEAST_MET: Final = 0.5
"""Of the ranges; where fewer end on the map, that is said."""
_FINDS_NORTH: Final = math.radians(10.0)
"""Gyros whose bias is below this share of the Earth's turn find a safe heading."""


@dataclass(frozen=True, slots=True)
class Dive:
    """What was found of a mission on its map."""

    located: Located | None
    """None where the start was known, and nothing had to be looked for."""
    track: Track | None
    mission: Mission
    """With the start that was found; as it was where none was."""
    estimate: Estimate | None = None
    """Of the smoother, with the map where the place is known, without it otherwise."""


def without_map(mission: Mission) -> Mission:
    """Return a mission that knows no map."""
    return replace(mission, aids=Aids(*(a for a in mission.aids if not isinstance(a, TerrainLog))))


def is_in_doubt(mission: Mission) -> bool:
    """Whether a start has to be looked for: it is less well known than the map has cells."""
    log = mission.aids[TerrainLog]
    if mission.local is not None or np.isfinite(log.within_m):
        return True
    initial = mission.initial
    return initial is not None and float(initial.position_sigma_enu[:2].max()) > log.grid.cell_m


def find_start(
    mission: Mission,
    *,
    config: SmootherConfig | None = None,
    problem_config: ProblemConfig | None = None,
    on_iteration: OnIteration | None = None,
    on_stage: OnStage | None = None,
    seed: int = 0,
) -> Dive:
    """Find where a mission began, on the map among its aids.

    Raises :class:`DataError` where nothing says about where that was.
    """
    say = on_stage or (lambda _: None)
    log = mission.aids[TerrainLog]
    say("without the map")
    config = config or SmootherConfig()
    dead = smooth(
        without_map(mission),
        replace(config, fault_search=None),
        problem_config=problem_config,
        on_iteration=on_iteration,
        on_stage=on_stage,
    )
    track = track_of(dead, log, mission.frame, heading_known=_is_heading_known(mission))
    middle, radius_m = _circle(mission, log, track.x_y[0] - _begun(mission, dead))
    say(f"looking for the start within {radius_m:.0f} m")
    located = locate(log.grid, log.errors, track, middle=middle, radius_m=radius_m, seed=seed)
    if located.verdict is not Verdict.CONVERGED:
        return Dive(located, track, mission, dead)
    return Dive(located, track, _with_start(mission, log, dead, track, located), dead)


def smooth_dive(
    mission: Mission,
    config: SmootherConfig | None = None,
    *,
    problem_config: ProblemConfig | None = None,
    on_iteration: OnIteration | None = None,
    on_stage: OnStage | None = None,
    seed: int = 0,
) -> Dive:
    """Smooth a mission with its map; a start in doubt is looked for first.

    Where no start is found the answer is the one without the map, and its reason says so.
    """
    located: Located | None = None
    track: Track | None = None
    if is_in_doubt(mission):
        found = find_start(
            mission,
            config=config,
            problem_config=problem_config,
            on_iteration=on_iteration,
            on_stage=on_stage,
            seed=seed,
        )
        located, track = found.located, found.track
        assert located is not None
        said = f"seabed: {located.verdict.name}: {located.reason}"
        if located.verdict is not Verdict.CONVERGED:
            assert found.estimate is not None
            reason = f"{said}; the answer is without the map"
            estimate = replace(found.estimate, status=Status.SUSPECT, reason=reason)
            return Dive(located, track, mission, estimate)
        mission = replace(found.mission, notes=(*mission.notes, said))
    estimate = smooth(
        mission,
        config,
        problem_config=problem_config,
        on_iteration=on_iteration,
        on_stage=on_stage,
    )
    return Dive(located, track, mission, _told(mission, estimate))


def _told(mission: Mission, estimate: Estimate) -> Estimate:
    """Return an answer that says where the map of its mission said nothing."""
    log = mission.aids[TerrainLog]
    t = track_of(estimate, log, mission.frame)
    x, y = np.moveaxis(t.x_y[:, None] + t.ends[..., :2], -1, 0)
    heard = np.isfinite(x)
    counts = log.grid.between(log.grid.inside(), x[heard], y[heard])
    n_met, n = int(np.count_nonzero(counts > 0.0)), int(heard.sum())
    if n_met >= _LEAST_MET * n:
        return estimate
    said = f"[map]: {n_met} of {n} ranges end on the map"
    if n_met > 0:
        said += "; beyond it the mission is as without one"
        return replace(estimate, notes=(*estimate.notes, said))
    west, east, south, north = log.grid.extent
    off = np.maximum(np.maximum([west, south] - t.x_y, t.x_y - [east, north]), 0.0)
    far_m = float(np.hypot(*off.T).min())
    said += ", and the answer is as without one: "
    said += (
        f"the way keeps {far_m:.0f} m off it; is it the right map, its crs, and the start?"
        if far_m > 0.0
        else "its cells have no heights there"
    )
    if not estimate.status.is_good:
        return replace(estimate, reason=f"{estimate.reason}; {said}")
    return replace(estimate, status=Status.SUSPECT, reason=said)


def _is_heading_known(mission: Mission) -> bool:
    local = mission.local
    if local is None or local.is_heading_known or mission.aids.get(HeadingLog) is not None:
        return True
    turn = EARTH_RATE * math.cos(local.lat)
    return bool(mission.imu.noise.gyro_bias_sigma < _FINDS_NORTH * turn)


def _circle(mission: Mission, log: TerrainLog, gone: Array) -> tuple[Array, float]:
    """Return where the first ping may have been: middle (2,) and radius, m."""
    if mission.local is not None:
        west, east, south, north = log.grid.extent
        half = 0.5 * math.hypot(east - west, north - south)
        return log.grid.middle, min(half, log.within_m) if np.isfinite(log.within_m) else half
    initial = mission.initial
    if initial is None:
        raise DataError(
            "[map]: a start is looked for about [initial], or anywhere on the map with [local]; "
            "this mission has neither"
        )
    stated = mission.frame.p_n_from_geodetic(initial.lat, initial.lon, initial.height)[:2]
    radius = _WIDE * float(initial.position_sigma_enu[:2].max())
    if np.isfinite(log.within_m):
        radius = log.within_m
    return stated + gone, radius


def _begun(mission: Mission, dead: Estimate) -> Array:
    """Return where the dead reckoning began, (2,) m."""
    t = dead.trajectory
    return np.asarray(mission.frame.p_n_from_geodetic(t.lat[0], t.lon[0], t.height[0])[:2])


def _with_start(
    mission: Mission, log: TerrainLog, dead: Estimate, track: Track, located: Located
) -> Mission:
    """Return a mission that begins where it was found to, in the frame of the map."""
    frame, t = log.grid.frame, dead.trajectory
    x, y, turn, _ = located.hypotheses[0].pose
    c, s = math.cos(turn), math.sin(turn)
    east, north = _begun(mission, dead) - track.x_y[0]
    place = np.array([x + c * east + s * north, y - s * east + c * north, 0.0])
    lat, lon, height = frame.geodetic_from_p_n(place)
    for _ in range(2):
        place[2] += float(t.height[0]) - float(height)
        lat, lon, height = frame.geodetic_from_p_n(place)
    sigma = np.maximum(CAUTION * np.sqrt(np.diag(located.cov)[:2]), _LEAST_M)
    start = mission.initial or dead.start
    heading, attitude_sigma = start.heading, start.attitude_sigma.copy()
    velocity = start.velocity_enu.copy()
    if not math.isfinite(track.doubt.yaw):
        heading = float(t.roll_pitch_heading[0, 2] + turn) % (2.0 * math.pi)
        attitude_sigma[2] = max(CAUTION * float(np.sqrt(located.cov[2, 2])), math.radians(0.5))
        velocity[:2] = [c * velocity[0] + s * velocity[1], c * velocity[1] - s * velocity[0]]
    initial = InitialState(
        time_s=start.time_s,
        lat=float(lat),
        lon=float(lon),
        height=float(height),
        roll=start.roll,
        pitch=start.pitch,
        heading=heading,
        velocity_enu=velocity,
        position_sigma_enu=np.array([*sigma, max(float(start.position_sigma_enu[2]), 0.5)]),
        velocity_sigma_enu=start.velocity_sigma_enu,
        attitude_sigma=attitude_sigma,
    )
    known_log = replace(log, within_m=np.nan)
    return replace(
        mission, frame=frame, local=None, initial=initial, aids=mission.aids.having(known_log)
    )
