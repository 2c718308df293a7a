"""What `ssm-graph locate` writes: result.json, track.csv and a figure."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ssm_graph.io.tables.files import write_table
from ssm_graph.systems.road_map.drive import Drive
from ssm_graph.systems.road_map.figures import located_figure
from ssm_graph.systems.road_map.locate import Located
from ssm_graph.systems.road_map.maps.road_map import RoadMap


def write_located(folder: Path, drive: Drive, road_map: RoadMap, found: Located) -> None:
    """Write an answer into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    x, y, yaw = map(float, found.pose)
    has_first = bool(np.isfinite(found.first_fix_s))
    result = {
        "verdict": found.verdict.name,
        "reason": found.reason,
        "time_s": float(found.track.time_s[-1]),
        "x_m": x,
        "y_m": y,
        "heading_deg": float(np.mod(90.0 - np.degrees(yaw), 360.0)),
        "sigma_across_m": found.sigmas[0],
        "sigma_along_m": found.sigmas[1],
        "sigma_heading_deg": float(np.degrees(found.sigmas[2])),
        "first_fix_s": found.first_fix_s if has_first else None,
        "first_fix_m": found.first_fix_m if has_first else None,
        "ms_per_update": found.cpu_ms,
        "hypotheses": [
            {
                "x_m": h.pose[0],
                "y_m": h.pose[1],
                "heading_deg": float(np.mod(90.0 - np.degrees(h.pose[2]), 360.0)),
                "share": h.share,
                "log_evidence": h.log_evidence,
            }
            for h in found.hypotheses[:20]
        ],
    }
    text = json.dumps(result, indent=2, allow_nan=False)
    (folder / "result.json").write_text(text + "\n", encoding="utf-8")
    t = found.track
    columns = {
        "time_s": t.time_s,
        "x_m": t.pose[:, 0],
        "y_m": t.pose[:, 1],
        "heading_deg": np.mod(90.0 - np.degrees(t.pose[:, 2]), 360.0),
        "driven_m": t.driven_m,
        "n_particles": t.n_particles,
        **{
            f"cov_{a}{b}": t.cov[:, i, j]
            for i, a in enumerate(("x", "y", "yaw"))
            for j, b in enumerate(("x", "y", "yaw"))
            if j >= i
        },
    }
    write_table(folder / "track.csv", columns)
    located_figure(folder / "locate.png", drive, road_map, found)
