"""Many simulated dives over seabeds: how often a start is found, how well, and what is said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.consistency import rate_with_interval
from ssm_graph.evaluation.errors import evaluate
from ssm_graph.mission.problem import ProblemConfig
from ssm_graph.sensors.seabed import MapErrors
from ssm_graph.simulation import Grade, SimulationConfig
from ssm_graph.smoothers.mission import smooth
from ssm_graph.smoothers.settings import SmootherConfig
from ssm_graph.study.ledger import ERROR, Key, Row
from ssm_graph.systems.seabed.dive import find_start, without_map
from ssm_graph.systems.seabed.locate import Located, Verdict
from ssm_graph.systems.seabed.simulate import (
    DIVE,
    DiveSettings,
    SimulatedDive,
    mission_with_map,
    simulate_dive,
)
from ssm_graph.systems.seabed.terrain import FLAT, ROUGH, SurveySettings, TerrainSettings

TERRAINS: Final[Mapping[str, TerrainSettings]] = {
    "rough": ROUGH,
    "gentle": replace(ROUGH, relief_m=2.0),
    "fractal": replace(ROUGH, relief_m=4.0, corner_m=1500.0, hurst=0.6),
    "ripples": replace(ROUGH, relief_m=1.5, corner_m=120.0, hurst=1.0),
    "hillside": replace(ROUGH, relief_m=4.0, corner_m=800.0, slope=(0.12, -0.08)),
    "poor map": ROUGH,
    "flat": FLAT,
    "slope": replace(FLAT, slope=(0.03, -0.04)),
}
"""By name: 6 m and 2 m of relief; long and short waves with another spectrum; a slope of 14 percent
with hills on it; the rough ground again, of which there is a poor map; flat ground, and a plane of
5 percent."""
_POOR: Final = SurveySettings(
    cell_m=25.0,
    errors=MapErrors(sigma_m=0.5, smooth_sigma_m=0.8, smooth_m=300.0, bias_sigma_m=2.0),
    tide_m=2.0,
)
SURVEYS: Final[Mapping[str, SurveySettings]] = {"poor map": _POOR}
"""Of those seabeds whose map is not the usual one: cells of 25 m, a tide of 2 m."""
FIRST_HELD_OUT: Final = 1000
"""Settings were chosen on seeds below 100 only."""
IMU_HZ: Final = 50.0
PING_S: Final = 2.0
LONG_PING_S: Final = 4.0
"""Of dives, and of long missions"""
GRAPH: Final = ProblemConfig(keyframe_interval_s=PING_S)
SMOOTHED: Final = 5
"""Of so many dives one is smoothed on the map as well."""


def dive_of(terrain: str, grade: str, seed: int, duration_s: float = 600.0) -> SimulatedDive:
    """Return a dive of the study; the same key gives the same one."""
    mission = _mission(grade, seed, duration_s, PING_S)
    survey = SURVEYS.get(terrain, SurveySettings())
    return simulate_dive(DiveSettings(mission=mission, terrain=TERRAINS[terrain], survey=survey))


def _mission(grade: str, seed: int, duration_s: float, ping_s: float) -> SimulationConfig:
    return replace(
        DIVE,
        seed=seed,
        grade=Grade[grade],
        imu_rate_hz=IMU_HZ,
        duration_s=duration_s,
        dvl=replace(DIVE.dvl, rate_hz=1.0 / ping_s),
    )


def trial(key: Key) -> Row:
    """Do one dive: its terrain, grade and seed are the key."""
    terrain, grade, seed = str(key[0]), str(key[1]), int(key[2])
    dive = dive_of(terrain, grade, seed)
    mission = mission_with_map(dive)
    found = find_start(mission, problem_config=GRAPH)
    located = found.located
    assert located is not None
    truth = _truth(dive, located.track.time_s[[0, -1]])
    off = located.start - truth[0]
    row: dict[str, Any] = {
        "verdict": located.verdict.name,
        "reason": located.reason,
        "begin_m": float(np.hypot(*off)),
        "begin_sigmas": float(np.sqrt(off @ np.linalg.solve(located.cov[:2, :2], off))),
        "end_m": float(np.hypot(*(located.way[-1] - truth[1]))),
        "particles_m": float(np.hypot(*(located.track.x_y[-1] - truth[1]))),
        "particles_s": settled_s(located),
        "cpu_s": located.cpu_s,
    }
    if located.verdict is Verdict.CONVERGED and seed % SMOOTHED == 0:
        estimate = smooth(found.mission, SmootherConfig(), problem_config=GRAPH)
        assert mission.reference is not None
        scored = evaluate(estimate.trajectory, mission.reference)
        row |= {
            "smoothed_rms_m": scored.rmse_horizontal_m,
            "smoothed_end_m": scored.end_error_m,
            "smoothed_nees": scored.nees_position,
        }
    return row


SMOOTHED_HEADER: Final = ("seabed", "dives", "rms, median (m)", "rms, largest (m)", "NEES / 3")


def smoothed_summary(rows: Mapping[Key, Row]) -> list[tuple[str, ...]]:
    """Return the errors of those dives that were smoothed on the map, by their seabeds."""
    lines = []
    for terrain in dict.fromkeys(str(key[0]) for key in rows):
        own = [r for k, r in rows.items() if k[0] == terrain and "smoothed_rms_m" in r]
        if own:
            rms, nees = ([row[f"smoothed_{n}"] for row in own] for n in ("rms_m", "nees"))
            cells = (np.median(rms), np.max(rms), np.mean(nees))
            lines.append((terrain, str(len(own)), *(f"{cell:.2f}" for cell in cells)))
    return lines


def settled_s(located: Located, sigma_m: float = 15.0) -> float:
    """Return from when on the particles' sigma stayed below so much, s; NaN if it never did."""
    t = located.track
    sigma = np.sqrt(np.linalg.eigvalsh(t.cov)[:, -1])
    wide = np.flatnonzero(sigma >= sigma_m)
    first = 0 if len(wide) == 0 else int(wide[-1]) + 1
    return float(t.time_s[first]) if first < len(sigma) else float("nan")


def drift_trial(key: Key) -> Row:
    """Do one long mission whose start is known: with the map and without."""
    terrain, grade, seed, hours = str(key[0]), str(key[1]), int(key[2]), float(key[3])
    terrain_settings = replace(TERRAINS[terrain], side_m=6000.0)
    mission = _mission(grade, seed, 3600.0 * hours, LONG_PING_S)
    dive = simulate_dive(DiveSettings(mission=mission, terrain=terrain_settings, start_m=0.0))
    known = mission_with_map(dive)
    row: dict[str, Any] = {}
    for name, one in (("with", known), ("without", without_map(known))):
        graph = ProblemConfig(keyframe_interval_s=LONG_PING_S)
        estimate = smooth(one, SmootherConfig(), problem_config=graph)
        assert one.reference is not None
        scored = evaluate(estimate.trajectory, one.reference)
        row |= {
            f"{name}_rms_m": scored.rmse_horizontal_m,
            f"{name}_largest_m": scored.max_horizontal_m,
            f"{name}_end_m": scored.end_error_m,
            f"{name}_nees": scored.nees_position,
            f"{name}_status": estimate.status.name,
        }
    return row


def _truth(dive: SimulatedDive, time_s: Array) -> Array:
    r = dive.mission.reference
    assert r is not None
    lat, lon, height = (np.interp(time_s, r.time_s, a) for a in (r.lat, r.lon, r.height))
    return np.asarray(dive.map.frame.p_n_from_geodetic(lat, lon, height)[:, :2])


def keys_of(n_rough: int, first_seed: int = FIRST_HELD_OUT) -> list[Key]:
    """Return the keys of so many dives over rough ground, and of a tenth each over the others.

    Grades take turns, and a study that is cut short has some of all.
    """
    grades = [grade.name for grade in Grade]
    keys: list[Key] = []
    for number in range(n_rough):
        seed, grade = first_seed + number, grades[number % len(grades)]
        keys.append(("rough", grade, seed))
        if number % 10 == 0:
            others = (name for name in TERRAINS if name != "rough")
            keys += [(name, grades[number // 10 % len(grades)], seed) for name in others]
    return keys


HEADER: Final = (
    *("seabed", "grade", "dives", "converged", "within 3 sigma", "wrong"),
    *("ambiguous", "unresolved", "failed", "begin, median (m)", "begin, 95 % (m)"),
    *("particles below 15 m, median (s)", "processor (s)"),
)


def is_found(row: Row) -> bool:
    """Whether a dive's start was declared, and is within three of its sigmas (in the plane)."""
    return bool(row["verdict"] == Verdict.CONVERGED.name and row["begin_sigmas"] <= PLANE_3_SIGMA)


PLANE_3_SIGMA: Final = 3.44
"""As improbable in a plane as three sigmas along a line: chi-square of two, 0.27 percent."""


def is_wrong(row: Row) -> bool:
    """Whether a start was declared that is none: farther off than three sigmas."""
    return bool(row["verdict"] == Verdict.CONVERGED.name and not is_found(row))


def summary(rows: Mapping[Key, Row]) -> list[tuple[str, ...]]:
    """Return a line of the table for each seabed and grade, and one for all grades."""
    kinds = list(dict.fromkeys((str(k[0]), str(k[1])) for k in rows))
    lines = [_line(t, g, [r for k, r in rows.items() if k[:2] == (t, g)]) for t, g in kinds]
    for terrain in dict.fromkeys(t for t, _ in kinds):
        lines.append(_line(terrain, "all", [r for k, r in rows.items() if k[0] == terrain]))
    return lines


def _line(terrain: str, grade: str, rows: Sequence[Row]) -> tuple[str, ...]:
    good = [row for row in rows if ERROR not in row]
    done = [row for row in good if row["verdict"] == Verdict.CONVERGED.name]

    def share(happened: list[bool]) -> str:
        found = rate_with_interval(happened)
        return f"{100.0 * found.value:.1f} % ({100.0 * found.low:.1f} to {100.0 * found.high:.1f})"

    def number(values: list[float], q: float) -> str:
        values = [v for v in values if np.isfinite(v)]
        return f"{np.quantile(values, q):.2f}" if values else ""

    named = [sum(row["verdict"] == v.name for row in good) for v in Verdict]
    begin = [row["begin_m"] for row in done]
    return (
        *(terrain, grade.lower(), str(len(rows)), str(named[0])),
        *(share([ERROR not in r and is_found(r) for r in rows]),),
        *(share([ERROR not in r and is_wrong(r) for r in rows]),),
        *(str(named[1]), str(named[2]), str(named[3] + len(rows) - len(good))),
        *(number(begin, 0.5), number(begin, 0.95)),
        *(number([r["particles_s"] for r in done], 0.5), number([r["cpu_s"] for r in good], 0.5)),
    )
