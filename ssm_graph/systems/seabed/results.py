"""What ``ssm-graph seabed`` writes: result.json, particles.csv and a figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.results.found_place import covariance_columns, write_found
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.seabed import SeabedGrid, TerrainLog
from ssm_graph.systems.seabed.dive import Dive
from ssm_graph.systems.seabed.figures import seabed_figure
from ssm_graph.systems.seabed.locate import Located


def place_of(mission: Mission, found: Located) -> dict[str, float]:
    """Return the place at the first ping, for people and files."""
    grid = mission.aids[TerrainLog].grid
    lat, lon = _degrees(grid, found.start)
    sigma = np.sqrt(np.diag(found.cov))
    return {
        "lat_deg": lat,
        "lon_deg": lon,
        "x_m": float(found.start[0]),
        "y_m": float(found.start[1]),
        "sigma_x_m": float(sigma[0]),
        "sigma_y_m": float(sigma[1]),
        "heading_error_deg": float(np.degrees(found.hypotheses[0].pose[2])),
        "sigma_heading_deg": float(np.degrees(sigma[2])),
    }


def _degrees(grid: SeabedGrid, x_y: Array) -> tuple[float, float]:
    """Return latitude and longitude of a place (2,) of the map, degrees."""
    height = float(np.nan_to_num(grid.height_at(*x_y[:, None]))[0])
    up = height
    for _ in range(2):
        lat, lon, above = grid.frame.geodetic_from_p_n(np.array([*x_y, up]))
        up += height - float(above)
    return float(np.degrees(lat)), float(np.degrees(lon))


def write_located(folder: Path, mission: Mission, dive: Dive) -> None:
    """Write an answer into a folder."""
    found = dive.located
    assert found is not None
    grid = mission.aids[TerrainLog].grid
    result = {
        "verdict": found.verdict.name,
        "reason": found.reason,
        **place_of(mission, found),
        "map_too_low_m": found.bias_m,
        "searched_radius_m": found.radius_m,
        "processor_s": found.cpu_s,
    }
    rivals = []
    for h in found.hypotheses:
        lat, lon = _degrees(grid, np.array(h.pose[:2]))
        place = {"x_m": h.pose[0], "y_m": h.pose[1], "lat_deg": lat, "lon_deg": lon}
        turn = {"heading_error_deg": float(np.degrees(h.pose[2]))}
        rivals.append({**place, **turn, **h.evidence})
    t = found.track
    columns = {
        "time_s": t.time_s,
        "x_m": t.x_y[:, 0],
        "y_m": t.x_y[:, 1],
        **covariance_columns(t.cov, ("x", "y")),
        "n_particles": t.n_particles,
    }
    write_found(folder, result, rivals, "particles.csv", columns)
    seabed_figure(folder / "seabed.png", mission, dive)
