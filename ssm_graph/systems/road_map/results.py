"""What `ssm-graph locate` writes: result.json, track.csv and a figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.results.found_place import covariance_columns, write_found
from ssm_graph.systems.road_map.drive import Drive
from ssm_graph.systems.road_map.figures import located_figure
from ssm_graph.systems.road_map.locate import Located
from ssm_graph.systems.road_map.maps.road_map import RoadMap


def write_located(folder: Path, drive: Drive, road_map: RoadMap, found: Located) -> None:
    """Write an answer into a folder."""
    has_first = bool(np.isfinite(found.first_fix_s))
    result = {
        "verdict": found.verdict.name,
        "reason": found.reason,
        "time_s": float(found.track.time_s[-1]),
        **_place(found.pose),
        "sigma_across_m": found.sigmas[0],
        "sigma_along_m": found.sigmas[1],
        "sigma_heading_deg": float(np.degrees(found.sigmas[2])),
        "first_fix_s": found.first_fix_s if has_first else None,
        "first_fix_m": found.first_fix_m if has_first else None,
        "ms_per_update": found.cpu_ms,
    }
    t = found.track
    columns = {
        "time_s": t.time_s,
        "x_m": t.pose[:, 0],
        "y_m": t.pose[:, 1],
        "heading_deg": _heading_deg(t.pose[:, 2]),
        "driven_m": t.driven_m,
        "n_particles": t.n_particles,
        **covariance_columns(t.cov, ("x", "y", "yaw")),
    }
    rivals = [{**_place(np.array(h.pose)), **h.evidence} for h in found.hypotheses]
    write_found(folder, result, rivals, "track.csv", columns)
    located_figure(folder / "locate.png", drive, road_map, found)


def _place(pose: Array) -> dict[str, float]:
    x, y, yaw = pose
    return {"x_m": float(x), "y_m": float(y), "heading_deg": float(_heading_deg(yaw))}


def _heading_deg(yaw: Array) -> Array:
    """Return headings (...), clockwise from north, of angles from x, rad."""
    return np.asarray(np.mod(90.0 - np.degrees(yaw), 360.0))
