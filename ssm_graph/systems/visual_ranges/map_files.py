"""A map saved and loaded, and a camera found in it: one file, numbers and a few words, no pickles.

The archive ``map.npz`` holds the arrays of :class:`~.result.MapSnapshot` by their names, and as
``meta`` a JSON text: version, camera, metres a map unit (null where the scale is not known), and
the anchors in metres.
"""

from __future__ import annotations

import io
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import ShortRepr
from ssm_graph.base.settings import parse_json
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.loops import LoopFinder
from ssm_graph.systems.visual_ranges.ranging import RangingResult
from ssm_graph.systems.visual_ranges.relocalise import Found, relocalise
from ssm_graph.systems.visual_ranges.result import MapSnapshot, VisualResult
from ssm_graph.systems.visual_ranges.visual_map import VisualMap

Array = NDArray[np.float64]

VERSION: Final = 1
MAP_NAME: Final = "map.npz"


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap(ShortRepr):
    """A map of an earlier run."""

    camera: Camera
    scale: float
    """Metres a map unit; NaN where it is not known."""
    map: MapSnapshot
    anchors_m: dict[str, tuple[float, float, float]]
    """Places of the anchors that were known, map axes, m."""


def save_map(path: Path, result: VisualResult) -> None:
    """Write the map of a result."""
    ranging: RangingResult | None = result.ranging
    has_scale = ranging is not None and ranging.has_scale
    anchors: dict[str, list[float]] = {}
    if ranging is not None and has_scale:
        known = [a for a in ranging.anchors if np.isfinite(a.place_m).all()]
        anchors = {a.name: a.place_m.tolist() for a in known}
    meta = {
        "version": VERSION,
        "camera": asdict(result.camera),
        "m_per_map_unit": ranging.scale if ranging is not None and has_scale else None,
        "anchors_m": anchors,
    }
    arrays = {spec.name: getattr(result.map, spec.name) for spec in fields(MapSnapshot)}
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8)
    np.savez_compressed(buffer, meta=text, **arrays)
    write_through(path, buffer.getvalue())


def load_map(path: Path) -> SavedMap:
    """Read a map.

    Raises :class:`DataError` for a file that is none, is damaged, or of another version.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            meta: dict[str, Any] = parse_json(archive["meta"].tobytes())
            arrays = {spec.name: archive[spec.name] for spec in fields(MapSnapshot)}
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise DataError(
            f"{path}: expected a map that ssm-graph visual wrote ({MAP_NAME}), got a file that "
            f"cannot be read as one: {error}"
        ) from error
    if meta.get("version") != VERSION:
        raise DataError(
            f"{path}: expected a map of version {VERSION}, got {meta.get('version')}; make it anew"
        )
    camera = {**meta["camera"], "distortion": tuple(meta["camera"]["distortion"])}
    scale = meta["m_per_map_unit"]
    return SavedMap(
        Camera(**camera),
        float("nan") if scale is None else float(scale),
        MapSnapshot(**arrays),
        {name: tuple(place) for name, place in meta["anchors_m"].items()},
    )


def world_of(snapshot: MapSnapshot, camera: Camera) -> VisualMap:
    """Return a map that can be looked up and gone on with, of a snapshot; images are not kept."""
    world = VisualMap()
    n_rows, n_points = len(snapshot.point), len(snapshot.points)
    counts = np.diff(snapshot.first_row)
    world.frames.append(
        len(snapshot.time_s),
        image=snapshot.image,
        time_s=snapshot.time_s,
        R_cw=snapshot.R_cw,
        t_cw=snapshot.t_cw,
        covariance=snapshot.covariance,
        first_row=snapshot.first_row[:-1],
        last_row=snapshot.first_row[1:],
    )
    pixels = snapshot.pixels.astype(np.float64)
    row = np.full(n_points, -1, dtype=np.int64)
    seen = np.flatnonzero(snapshot.point >= 0)[::-1]
    row[snapshot.point[seen]] = seen
    frame = np.repeat(np.arange(len(counts)), counts)
    world.rows.append(
        n_rows,
        frame=frame,
        pixel=pixels,
        xy=camera.normalise(pixels) if n_rows else np.zeros((0, 2)),
        octave=snapshot.octave,
        descriptor=snapshot.descriptor,
        point=snapshot.point,
        weight=snapshot.weight,
    )
    world.points.append(
        n_points,
        place=snapshot.points,
        valid=(snapshot.points_views >= 2) & (row >= 0),
        views=snapshot.points_views,
        row=row,
        born=np.where(row >= 0, frame[row], 0) if n_rows else 0,
        grey=snapshot.points_grey,
    )
    for k in range(len(counts)):
        point = world.rows["point"][world.observations(np.array([k]))]
        if point.size:
            depth = world.points["place"][point] @ snapshot.R_cw[k][2] + snapshot.t_cw[k][2]
            world.frames["depth"][k] = float(np.median(depth))
    return world


class MapLocator:
    """Finds cameras in a saved map, image by image, without any memory of the last one."""

    def __init__(self, saved: SavedMap, camera: Camera | None = None) -> None:
        """Take a map; ``camera`` if it is another one than the map was made with."""
        self.saved = saved
        self._camera = saved.camera if camera is None else camera
        self._world = world_of(saved.map, saved.camera)
        self._finder = LoopFinder(self._camera)
        if self._world.n_frames:
            self._finder.add(self._world, self._world.n_frames - 1)

    def locate(self, image: NDArray[np.uint8], n_corners: int = 1000) -> Found | None:
        """Return where an image (H, W) was taken, in map units; None where it is not recognised."""
        return relocalise(self._world, self._finder, self._camera, image, n_corners)
