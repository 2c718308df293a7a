"""Many drives over a map by several methods: in which lane they end, and what they say of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.consistency import rate_with_interval
from ssm_graph.study.ledger import ERROR, Key, Row
from ssm_graph.systems.road_map.av2_log import MAP, POSES, av2_poses
from ssm_graph.systems.road_map.camera import CameraModel
from ssm_graph.systems.road_map.cases import CASES, METHODS
from ssm_graph.systems.road_map.drive import Drive, Poses
from ssm_graph.systems.road_map.hypotheses import apart, aside, is_same_lane
from ssm_graph.systems.road_map.locate import locate
from ssm_graph.systems.road_map.maps.index import LineIndex
from ssm_graph.systems.road_map.maps.read import read_map
from ssm_graph.systems.road_map.maps.road_map import LineKind, RoadMap
from ssm_graph.systems.road_map.patent import Normalisation, PatentSettings, locate_by_patent
from ssm_graph.systems.road_map.simulate import (
    DriveModel,
    damaged,
    driven,
    indices_of,
    mirrored,
    random_route,
    simulate_drive,
)

BESIDE_M: Final = 4.0
"""Lines farther from a vehicle are not those of its lane."""
LANE_M: Final = 1.75
"""Across: a vehicle nearer to where it is held to be is in that lane."""
FIRST_HELD_OUT: Final = 1000
"""Seeds from here on have chosen nothing; those below 100 have."""


def model_of(case: str) -> DriveModel:
    """Return how a case's drives are made."""
    if case not in CASES:
        raise ConfigError(f"--case: expected one of {', '.join(CASES)}, got {case!r}")
    if case == "motorway":
        return DriveModel(length_m=400.0, speed=25.0)
    if case == "short":
        return DriveModel(length_m=80.0)
    if case == "traffic":
        return DriveModel(camera=CameraModel(p_occluded=0.3, p_false=0.03))
    return DriveModel()


@lru_cache(maxsize=4)
def _map_of(
    path: str, *, is_mirrored: bool = False
) -> tuple[RoadMap, dict[LineKind, LineIndex], Poses | None]:
    folder = Path(path)
    is_log = folder.is_dir()
    road_map = read_map(folder / MAP if is_log else folder)
    if is_mirrored:
        road_map = mirrored(road_map)
    return road_map, indices_of(road_map), av2_poses(folder / POSES) if is_log else None


def drive_of(
    path: str, case: str, seed: int
) -> tuple[Drive, RoadMap, dict[LineKind, LineIndex], Poses]:
    """Return a simulated drive, the map that the vehicle has with its index, and the truth.

    ``path`` is a map, or the folder of an Argoverse 2 log, whose way is then driven.
    """
    true_map, indices, truth = _map_of(path, is_mirrored=case == "left-hand")
    model = model_of(case)
    if truth is not None and case == "left-hand":
        truth = Poses(truth.time_s, truth.x_y * [1.0, -1.0], -truth.yaw)
    if truth is None:
        rng = np.random.default_rng([seed, 0])
        truth = driven(random_route(true_map, model.length_m, rng), model, rng)
    name = f"{Path(path).name} {case} {seed}"
    drive = simulate_drive(name, truth, indices, model, np.random.default_rng([seed, 1]))
    if case == "no course":
        drive = replace(drive, gnss=replace(drive.gnss, yaw=None))
    if case != "damaged":
        return drive, true_map, indices, truth
    rng = np.random.default_rng([seed, 4])
    worn = damaged(true_map.within(truth.x_y, 150.0), rng, missing=0.05, shifted=0.02, by_m=0.5)
    return drive, worn, indices_of(worn), truth


def trial(key: Key) -> Row:
    """Do the trial of a key (path, case, method, seed)."""
    path, case, method, seed = str(key[0]), str(key[1]), str(key[2]), int(key[3])
    drive, road_map, indices, truth = drive_of(path, case, seed)
    if method == "annealed":
        return _annealed(drive, road_map, indices, truth, seed)
    names = {"patent": "MAX", "patent-min-max": "MIN_MAX", "patent-sum": "SUM"}
    if method not in names:
        raise ConfigError(f"--methods: expected one of {', '.join(METHODS)}, got {method!r}")
    settings = PatentSettings(normalisation=Normalisation[names[method]])
    answer = locate_by_patent(drive, indices, settings, seed)
    last = float(drive.curves.time_s[-1])
    across, along, turn = apart(truth.at(np.array([last]))[0], answer.pose)
    fine, _, _ = apart(truth.at(np.array([last]))[0], answer.refined)
    first = np.nan
    if np.isfinite(answer.converged_s):
        then = truth.at(np.array([answer.converged_s + drive.chassis.time_s[0]]))[0]
        first = apart(then, answer.converged)[0]
    has = bool(np.isfinite(answer.converged_s))
    return {
        "across_m": across,
        "along_m": along,
        "yaw_deg": float(np.degrees(turn)),
        "refined_across_m": fine,
        "has_lane": has,
        "verdict": "CONVERGED" if has else "AMBIGUOUS",
        "first_s": answer.converged_s,
        "first_m": answer.converged_s * float(np.mean(drive.chassis.speed)),
        "first_across_m": first,
    }


def _annealed(
    drive: Drive,
    road_map: RoadMap,
    indices: dict[LineKind, LineIndex],
    truth: Poses,
    seed: int,
) -> Row:
    found = locate(drive, road_map, seed=seed, indices=indices)
    last = truth.at(found.track.time_s[-1:])[0]
    across, along, turn = apart(last, found.pose)
    first = np.nan
    if np.isfinite(found.first_fix_s):
        then = truth.at(np.array([found.first_fix_s + drive.chassis.time_s[0]]))[0]
        first = aside(then, found.first_fix)
    beside = aside_of_lines(last, indices) - aside_of_lines(found.pose, indices)[:, None]
    in_lane = float(np.abs(beside).min()) if beside.size else np.nan
    rival = [h.share for h in found.hypotheses if not is_same_lane(h, found.pose)]
    return {
        "across_m": across,
        "along_m": along,
        "yaw_deg": float(np.degrees(turn)),
        "refined_across_m": across if found.refined is not None else np.nan,
        "in_lane_m": in_lane if found.refined is not None else np.nan,
        "sigma_across_m": found.sigmas[0],
        "sigma_along_m": found.sigmas[1],
        "sigma_yaw_deg": float(np.degrees(found.sigmas[2])),
        "has_lane": found.verdict.has_lane,
        "verdict": found.verdict.name,
        "first_s": found.first_fix_s,
        "first_m": found.first_fix_m,
        "first_across_m": first,
        "rival": max(rival, default=0.0),
        "cpu_ms": found.cpu_ms,
    }


def aside_of_lines(pose: Array, indices: Mapping[LineKind, LineIndex]) -> Array:
    """Return how far a pose (3,) lies to the left of lines that run beside it, (n,) m.

    Of lane lines where there are some, else of boundaries: what a vehicle keeps while it drives
    along, however far along it is held to be.
    """
    found = {}
    index = indices.get(LineKind.LANE_LINE, indices.get(LineKind.BOUNDARY))
    assert index is not None
    for point in index.tree.query_ball_point(pose[:2], BESIDE_M):
        piece = int(index.owner[point])
        off = pose[:2] - index.start[piece]
        share = off @ index.step[piece] / np.square(index.step[piece]).sum()
        normal = index.normal[piece]
        turn = np.cos(pose[2]) * normal[1] - np.sin(pose[2]) * normal[0]
        if 0.0 <= share <= 1.0 and abs(turn) > 0.9:
            found[piece] = float(np.sign(turn) * (normal @ off))
    return np.array(list(found.values()))


HEADER: Final = (
    "map",
    "case",
    "method",
    "drives",
    "right lane, %",
    "lane declared, %",
    "declared wrong, %",
    "first fix wrong, %",
    "first fix, s",
    "first fix, m",
    "across, m, median / 90 %",
    "in the lane, m, median / 90 %",
    "along, m, median / 90 %",
    "within 2 sigma across, along, %",
    "yaw, deg, median",
    "ms per update",
)


def summary(rows: Mapping[Key, Row]) -> list[tuple[str, ...]]:
    """Return a line of cells, as of `HEADER`, for every map, case and method."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for key, row in rows.items():
        group = (Path(str(key[0])).name, str(key[1]), str(key[2]))
        groups.setdefault(group, []).append(row)
    return [(*group, *_cells(found)) for group, found in sorted(groups.items())]


def _column(rows: Sequence[Row], name: str) -> Array:
    return np.array([float(row.get(name, np.nan)) for row in rows])


def _cells(rows: Sequence[Row]) -> tuple[str, ...]:
    good = [row for row in rows if ERROR not in row]
    n = str(len(rows)) if len(good) == len(rows) else f"{len(good)} of {len(rows)}"
    if not good:
        return (n, *["–"] * (len(HEADER) - 4))
    across, along = np.abs(_column(good, "across_m")), np.abs(_column(good, "along_m"))
    is_right = across < LANE_M
    says = np.array([bool(row["has_lane"]) for row in good])
    first = np.abs(_column(good, "first_across_m"))
    fine = np.abs(_column(good, "refined_across_m"))[is_right]
    within = [
        _percent(error[is_right] < 2.0 * _column(good, name)[is_right])
        for error, name in ((across, "sigma_across_m"), (along, "sigma_along_m"))
        if name in good[0]
    ]
    has_first = np.isfinite(first)
    return (
        n,
        _rate(is_right),
        _percent(says),
        _rate(says & ~is_right),
        _rate(has_first & (first > LANE_M)),
        _quantiles(_column(good, "first_s"), (0.5,), 1),
        _quantiles(_column(good, "first_m"), (0.5,), 0),
        _quantiles(fine, (0.5, 0.9), 3),
        _quantiles(_column(good, "in_lane_m")[is_right], (0.5, 0.9), 3),
        _quantiles(along[is_right], (0.5, 0.9), 2),
        ", ".join(within) or "–",
        _quantiles(np.abs(_column(good, "yaw_deg"))[is_right], (0.5,), 3),
        _quantiles(_column(good, "cpu_ms"), (0.5,), 1),
    )


def _percent(happened: ArrayLike) -> str:
    values = np.asarray(happened, dtype=bool)
    return f"{100.0 * float(np.mean(values)):.1f}" if values.size else "–"


def _rate(happened: ArrayLike) -> str:
    rate = rate_with_interval(happened)
    return f"{100 * rate.value:.1f} ({100 * rate.low:.1f} to {100 * rate.high:.1f})"


def _quantiles(values: Array, at: Sequence[float], digits: int) -> str:
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return "–"
    return " / ".join(f"{q:.{digits}f}" for q in np.quantile(finite, at))


def keys_of(
    paths: Sequence[Path], case: str, methods: Sequence[str], seeds: Sequence[int]
) -> list[Key]:
    """Return the keys of all trials."""
    return [
        (str(path.resolve()), case, method, seed)
        for path in paths
        for method in methods
        for seed in seeds
    ]


def settings_of(case: str) -> dict[str, Any]:
    """Return what must be the same for all trials of a ledger."""
    return {"case": case, "model": repr(model_of(case))}
