"""The section ``[map]`` of a mission: which map its DVL's ranges are compared with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.settings import FILE_KEY, Key, Settings, build, optional_key, sigma_key, written
from ssm_graph.io.seabed.raster import LOCAL
from ssm_graph.io.seabed.read import read_seabed
from ssm_graph.io.seabed.text import write_ascii_grid
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.seabed import MapErrors, TerrainLog, terrain_log

_TEXT: Final = Key(shape=None, required=False)
_METRES: Final = "the unit is metres"
_SHARE: Final = "write a percent as 0.01"
MAP_KEYS: Final = {
    "file": FILE_KEY,
    "sigma_file": _TEXT,
    "crs": _TEXT,
    "values": _TEXT,
    "datum_m": optional_key("", -12_000.0, 12_000.0, _METRES),
    "within_m": sigma_key("", 100_000.0, _METRES, required=False),
    "sigma_m": sigma_key("sigma_m", 1000.0, _METRES, required=False),
    "smooth_sigma_m": optional_key("smooth_sigma_m", 0.0, 1000.0, _METRES),
    "smooth_m": sigma_key("smooth_m", 1e6, _METRES, required=False),
    "bias_sigma_m": optional_key("bias_sigma_m", 0.0, 1000.0, _METRES),
    "bias_correlation_s": sigma_key(
        "bias_correlation_s", 1e9, "the unit is seconds", required=False
    ),
    "range_noise_m": sigma_key("range_noise_m", 100.0, _METRES, required=False),
    "range_noise_share": optional_key("range_noise_share", 0.0, 1.0, _SHARE),
}
"""Of the section ``[map]``."""
_FILE: Final = "seabed.asc"
_SIGMA_FILE: Final = "seabed-sigma.asc"


def with_map(mission: Mission, settings: Settings, folder: Path) -> Mission:
    """Return a mission with the map that its section states.

    Raises :class:`ConfigError` and :class:`DataError` for a map that cannot be read, lies
    elsewhere, or is not met by any range.
    """
    is_down = None
    if "values" in settings:
        word = settings.text("values")
        if word not in ("heights", "depths"):
            raise settings.fault("values", f"expected heights or depths, got {word!r}")
        is_down = word == "depths"
    sigma = folder / settings.text("sigma_file") if "sigma_file" in settings else None
    crs = settings.text("crs") if "crs" in settings else ""
    grid = read_seabed(
        folder / settings.text("file"),
        frame_for(mission, crs),
        crs=crs,
        is_down=is_down,
        datum_m=settings.number("datum_m"),
        sigma=sigma,
    )
    within = settings.number("within_m") if "within_m" in settings else np.nan
    log = terrain_log(grid, mission.dvl, build(MapErrors, settings.given()), within_m=within)
    return replace(mission, aids=mission.aids.having(log))


def with_map_file(mission: Mission, path: Path) -> Mission:
    """Return a mission with the map of a file, in the place of that which it has.

    The errors and ``within_m`` that are stated of that one hold for this one, too; its ``crs``,
    ``values`` and ``datum_m`` do not: the file has to say them. Without any, errors are the usual.
    """
    before = mission.aids.get(TerrainLog)
    grid = read_seabed(path, frame_for(mission))
    errors, within = MapErrors(), np.nan
    if before is not None:
        errors, within = before.errors, before.within_m
    log = terrain_log(grid, mission.dvl, errors, within_m=within)
    return replace(mission, aids=mission.aids.having(log))


def frame_for(mission: Mission, crs: str = "") -> LocalFrame | None:
    """Return the frame that a map is wanted about; None for its own, where no place is known."""
    return mission.frame if mission.local is None or crs.lower() == LOCAL else None


def map_settings(log: TerrainLog) -> dict[str, Any]:
    """Return the section that describes a map written by :func:`write_map`."""
    found: dict[str, Any] = {"file": _FILE, "crs": LOCAL, "values": "heights"}
    if log.grid.sigma is not None:
        found["sigma_file"] = _SIGMA_FILE
    if np.isfinite(log.within_m):
        found["within_m"] = log.within_m
    return found | written(log.errors, MAP_KEYS)


def write_map(folder: Path, log: TerrainLog) -> None:
    """Write a map into a mission folder, with all digits."""
    write_ascii_grid(folder / _FILE, log.grid, log.grid.height)
    if log.grid.sigma is not None:
        write_ascii_grid(folder / _SIGMA_FILE, log.grid, log.grid.sigma)
