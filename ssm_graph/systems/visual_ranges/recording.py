"""A result as a recording for the viewer of rerun: map, path, images, anchors, ranges over time."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import MissingExtraError
from ssm_graph.systems.visual_ranges.outputs import ANCHOR_COLOUR, PATH_COLOUR, metres
from ssm_graph.systems.visual_ranges.ranging import RangingResult
from ssm_graph.systems.visual_ranges.result import VisualResult
from ssm_graph.systems.visual_ranges.sequence import Sequence

Array = NDArray[np.float64]

RECORDING_NAME: Final = "recording.rrd"
TIMELINE: Final = "time"
"""Seconds since the first image."""
SIGMAS: Final = 3.0
"""Of the ellipsoids about the anchors."""
QUALITY: Final = 75
"""Of the key frames' images as JPEG, of 100: a tenth of their size."""


def rerun() -> Any:
    """Return rerun's module, or say how to install it."""
    try:
        return importlib.import_module("rerun")
    except ImportError:
        raise MissingExtraError("rerun", extra="rerun", purpose="a recording for rerun") from None


def write_recording(path: Path, sequence: Sequence, result: VisualResult) -> None:
    """Write all of a result; lengths are metres where the scale is known, else map units.

    Images are those of the key frames.
    """
    rr = rerun()
    scale = metres(result)
    stream = rr.RecordingStream("ssm-graph visual", recording_id=sequence.name)
    stream.save(path)
    stream.log("map", rr.ViewCoordinates.RDF, static=True)
    _map(rr, stream, result, scale)
    _camera(rr, stream, sequence, result, scale)
    ranging: RangingResult | None = result.ranging
    if ranging is not None:
        _anchors(rr, stream, ranging)
        _over_time(rr, stream, sequence, ranging)
    for event in result.events:
        when, _, text = event.partition(" s: ")
        stream.set_time(TIMELINE, duration=float(when))
        stream.log("events", rr.TextLog(text))
    stream.flush()
    stream.disconnect()


def _map(rr: Any, stream: Any, result: VisualResult, scale: float) -> None:
    world, place = result.map, scale * result.position
    seen = world.points_views >= 2
    grey = np.repeat(world.points_grey[seen, None], 3, axis=1)
    stream.log("map/points", rr.Points3D(scale * world.points[seen], colors=grey), static=True)
    known = np.asarray(np.isfinite(place).all(axis=1))
    pieces = np.split(np.arange(len(place)), np.flatnonzero(np.diff(known)) + 1)
    strips = [place[piece] for piece in pieces if known[piece[0]]]
    stream.log("map/path", rr.LineStrips3D(strips, colors=[PATH_COLOUR]), static=True)


def _camera(rr: Any, stream: Any, sequence: Sequence, result: VisualResult, scale: float) -> None:
    camera, world, place = result.camera, result.map, scale * result.position
    lens = rr.Pinhole(
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx, camera.cy],
        resolution=[camera.width, camera.height],
    )
    stream.log("map/camera", lens, static=True)
    key_of = {int(image): k for k, image in enumerate(world.image)}
    for i in np.flatnonzero(np.isfinite(place).all(axis=1)).tolist():
        stream.set_time(TIMELINE, duration=float(result.time_s[i] - result.time_s[0]))
        stream.log("map/camera", rr.Transform3D(translation=place[i], mat3x3=result.R_cw[i].T))
        stream.log("tracking/points", rr.Scalars(float(result.n_tracked[i])))
        if i in key_of:
            rows = slice(*world.first_row[key_of[i] : key_of[i] + 2].tolist())
            on = world.pixels[rows][world.point[rows] >= 0]
            image = rr.Image(sequence.images(i)).compress(jpeg_quality=QUALITY)
            stream.log("map/camera/image", image)
            stream.log("map/camera/image/points", rr.Points2D(on, colors=[PATH_COLOUR]))


def _anchors(rr: Any, stream: Any, ranging: RangingResult) -> None:
    for one in ranging.anchors:
        if not np.isfinite(one.place_m).all():
            continue
        square, axes = np.linalg.eigh(one.covariance)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        half = SIGMAS * np.sqrt(np.maximum(square, 0.0))
        name = rr.new_entity_path(["map", "anchors", one.name])
        shape = rr.Ellipsoids3D(half_sizes=[half], colors=[ANCHOR_COLOUR])
        turned = rr.Transform3D(translation=one.place_m, mat3x3=axes)
        label = f"{one.name}, {one.state.name.lower()}"
        stream.log(name, turned, static=True)
        stream.log(name, shape, static=True)
        stream.log(
            f"{name}/place", rr.Points3D([[0, 0, 0]], labels=[label], colors=[ANCHOR_COLOUR]),
            static=True,
        )  # fmt: skip
        if len(one.alternatives_m):
            others = rr.Points3D(one.alternatives_m, labels=[f"{one.name}, or here"])
            stream.log(["map", "anchors", f"{one.name} else"], others, static=True)


def _over_time(rr: Any, stream: Any, sequence: Sequence, ranging: RangingResult) -> None:
    begin_s = float(sequence.time_s[0])

    def curve(parts: list[str], time_s: Array, values: Array) -> None:
        known = np.isfinite(values)
        if known.any():
            time = rr.TimeColumn(TIMELINE, duration=time_s[known] - begin_s)
            name = rr.new_entity_path(parts)  # anchors may be called anything
            stream.send_columns(name, [time], rr.Scalars.columns(scalars=values[known]))

    for j, one in enumerate(ranging.anchors):
        own = ranging.anchor_of == j
        time_s = sequence.ranges.time_s[own]
        curve(["ranges", "error_m", one.name], time_s, ranging.error_m[own])
        curve(["ranges", "weight", one.name], time_s, ranging.weight[own])
    history = ranging.scale_history
    curve(["scale", "m_per_map_unit"], history[:, 0], history[:, 1])
    curve(["scale", "relative_sigma"], history[:, 0], history[:, 2])
