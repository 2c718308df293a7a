"""One door for maps of all formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from ssm_graph.base.errors import ConfigError
from ssm_graph.systems.road_map.maps.av2 import read_av2
from ssm_graph.systems.road_map.maps.commonroad import read_commonroad
from ssm_graph.systems.road_map.maps.geojson import read_geojson
from ssm_graph.systems.road_map.maps.lanelet2 import read_lanelet2
from ssm_graph.systems.road_map.maps.opendrive import read_opendrive
from ssm_graph.systems.road_map.maps.road_map import RoadMap

READERS: Final[Mapping[str, Callable[[Path], RoadMap]]] = {
    ".osm": read_lanelet2,
    ".xml": read_commonroad,
    ".xodr": read_opendrive,
    ".json": read_av2,
    ".geojson": read_geojson,
}
"""lanelet2, CommonRoad, OpenDRIVE, Argoverse 2 and GeoJSON by the end of the file's name."""


def read_map(path: Path) -> RoadMap:
    """Return the map of a file; its format is told by the end of its name."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(
            f"{path}: expected a map that ends in {', '.join(READERS)}, got {path.suffix!r}"
        )
    return reader(path)
