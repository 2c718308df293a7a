"""A mission of the simulator over a simulated seabed: ranges from it, and a start in doubt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.base.usual import SEABED_DIVE_S
from ssm_graph.mission.mission import InitialState, Mission
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.seabed import MapErrors, SeabedGrid, terrain_log
from ssm_graph.simulation import SimulationConfig, SurveyRoute, checked, simulate
from ssm_graph.simulation.routes import DepthProfile
from ssm_graph.systems.seabed.terrain import (
    ROUGH,
    SurveySettings,
    TerrainSettings,
    met,
    seabed,
    surveyed,
)

LONGEST_M = 200.0
"""Reach of the DVL along a beam."""
DIVE = SimulationConfig(
    name="dive over rough ground",
    route=SurveyRoute(line_m=250.0, depth=DepthProfile(40.0, 40.0)),
    duration_s=SEABED_DIVE_S,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class DiveSettings(checked.Settings):
    """A mission over a seabed."""

    mission: SimulationConfig = DIVE
    terrain: TerrainSettings = ROUGH
    survey: SurveySettings = SurveySettings()
    start_m: float = checked.not_negative(300.0, hint="0 for a start that is known")
    """The stated start is off by up to this much, evenly over a circle."""
    gross: float = checked.fraction(0.02, hint="fish, wake and plants")
    """Share of ranges that end early: at 30 to 95 percent of the way."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDive:
    """A mission as it may be seen, its map, and the seabed as it is."""

    mission: Mission
    """Its ``initial`` is off by up to ``start_m``."""
    map: SeabedGrid
    errors: MapErrors
    """What is stated of the map."""
    seabed: SeabedGrid
    settings: DiveSettings = DiveSettings()


def simulate_dive(settings: DiveSettings) -> SimulatedDive:
    """Simulate a mission over a seabed; the same settings give the same dive."""
    simulated = simulate(settings.mission)
    mission, seed = simulated.mission, settings.mission.seed
    truth = simulated.truth_at(simulated.ping_time_s)
    p_n = mission.frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
    middle = 0.5 * (p_n.min(axis=0) + p_n.max(axis=0))[:2]
    terrain = seabed(settings.terrain, mission.frame, middle, np.random.default_rng([seed, 1]))
    chart, stated = surveyed(terrain, settings.survey, np.random.default_rng([seed, 2]))
    rpy = truth.roll_pitch_heading
    R_nb = mission.frame.R_nl_at(p_n) @ R_lb_from_roll_pitch_heading(
        rpy[:, 0], rpy[:, 1], rpy[:, 2]
    )
    ranges = _ranges(mission, terrain, p_n, R_nb)
    rng = np.random.default_rng([seed, 3])
    errors = settings.survey.errors
    ranges = ranges + errors.range_sigma(ranges) * rng.standard_normal(ranges.shape)
    early = rng.random(ranges.shape) < settings.gross
    ranges = np.where(early, ranges * rng.uniform(0.3, 0.95, ranges.shape), ranges)
    ranges[~np.isfinite(mission.dvl.speed)] = np.nan
    mission = replace(mission, dvl=replace(mission.dvl, range_m=ranges))
    return SimulatedDive(
        replace(
            _with_tide(mission, settings.survey, rng),
            initial=_in_doubt(mission, settings.start_m, rng),
        ),
        chart,
        stated,
        terrain,
        settings,
    )


def _ranges(mission: Mission, terrain: SeabedGrid, p_n: Array, R_nb: Array) -> Array:
    """Return the true ranges (N, B), m."""
    mount = mission.dvl.mount
    from_n = p_n + R_nb @ mount.lever_arm_b
    beams_n = np.einsum("nij,bj->nbi", R_nb, mount.beams_d @ mount.R_bd.T)
    from_n = np.broadcast_to(from_n[:, None], beams_n.shape)
    return met(terrain, from_n, beams_n, LONGEST_M)


def _with_tide(mission: Mission, survey: SurveySettings, rng: np.random.Generator) -> Mission:
    """Return a mission whose depths are below the water as it stands, and which says so."""
    depth: DepthLog | None = mission.depth
    if depth is None or survey.tide_m == 0.0:
        return mission
    phase = rng.uniform(0.0, 2.0 * np.pi)
    tide = survey.tide_m * np.sin(2.0 * np.pi * depth.time_s / survey.tide_period_s + phase)
    # A sine of this amplitude, alike for a radian of its turn.
    drift = Drift(survey.tide_m / np.sqrt(2.0), survey.tide_period_s / (2.0 * np.pi), 1.0)
    stated = replace(depth.calibration, drift=drift)
    return replace(mission, depth=replace(depth, depth=depth.depth + tide, calibration=stated))


def _in_doubt(mission: Mission, start_m: float, rng: np.random.Generator) -> InitialState | None:
    """Return a start whose place is off by up to so much, and says so."""
    initial = mission.initial
    if initial is None or start_m == 0.0:
        return initial
    off = start_m * np.sqrt(rng.random())
    turn = rng.uniform(0.0, 2.0 * np.pi)
    p_n = mission.frame.p_n_from_geodetic(initial.lat, initial.lon, initial.height)
    p_n = p_n + off * np.array([np.cos(turn), np.sin(turn), 0.0])
    lat, lon, _ = mission.frame.geodetic_from_p_n(p_n)
    # The sigma of each axis of an even circle is half its radius.
    sigma = np.array([0.5 * start_m, 0.5 * start_m, initial.position_sigma_enu[2]])
    return replace(initial, lat=float(lat), lon=float(lon), position_sigma_enu=sigma)


def mission_with_map(dive: SimulatedDive) -> Mission:
    """Return the mission of a dive with its map, and within what it began."""
    start_m = dive.settings.start_m
    within_m = start_m if start_m > 0.0 else np.nan
    log = terrain_log(dive.map, dive.mission.dvl, dive.errors, within_m=within_m)
    return replace(dive.mission, aids=dive.mission.aids.having(log))
