"""MCAP for Foxglove: location, pose and scalars as JSON messages with Foxglove's schemas."""

from __future__ import annotations

import json
import math
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import MissingExtraError
from ssm_graph.base.progress import told
from ssm_graph.io.export.track import Track

_NUMBER: Final = {"type": "number"}
_TIME: Final = {
    "type": "object",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_TEXT: Final = {"type": "string"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_SCHEMAS: Final = {
    "/location": (
        "foxglove.LocationFix",
        _object(
            timestamp=_TIME,
            frame_id=_TEXT,
            latitude=_NUMBER,
            longitude=_NUMBER,
            altitude=_NUMBER,
            position_covariance={"type": "array", "items": _NUMBER},
            position_covariance_type={"type": "integer"},
        ),
    ),
    "/pose": (
        "foxglove.PoseInFrame",
        _object(
            timestamp=_TIME,
            frame_id=_TEXT,
            pose=_object(
                position=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER),
                orientation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
            ),
        ),
    ),
    "/navigation": (
        "ssm_graph.Navigation",
        _object(
            timestamp=_TIME,
            speed_m_per_s=_NUMBER,
            course_deg=_NUMBER,
            heading_deg=_NUMBER,
            roll_deg=_NUMBER,
            pitch_deg=_NUMBER,
            height_m=_NUMBER,
            sigma_horizontal_m=_NUMBER,
            sigma_up_m=_NUMBER,
            sigma_heading_deg=_NUMBER,
            suspect={"type": "boolean"},
        ),
    ),
}
_DIAGONAL_KNOWN: Final = 2
"""Of LocationFix: the diagonal of the covariance is known."""


def write_mcap(track: Track, path: Path) -> None:
    """Write the topics ``/location``, ``/pose`` (local east, north, up) and ``/navigation``.

    Without UTC the log's times are those of the track, from 1970 on.
    """
    try:
        writing: Any = import_module("mcap.writer")
    except ImportError as error:
        raise MissingExtraError("mcap", extra="mcap", purpose="an MCAP file") from error
    time_ns = np.rint((track.time_s + (track.epoch_s or 0.0)) * 1e9).astype(np.int64)
    columns = _columns(track)
    with path.open("wb") as stream:
        writer = writing.Writer(stream)
        writer.start(profile="", library="ssm-graph")
        channels = {
            topic: writer.register_channel(
                topic,
                "json",
                writer.register_schema(name, "jsonschema", json.dumps(schema).encode()),
            )
            for topic, (name, schema) in _SCHEMAS.items()
        }
        for i, when in told(enumerate(time_ns.tolist()), len(time_ns)):
            stamp = {"sec": when // 10**9, "nsec": when % 10**9}
            for topic, content in _messages(columns, i).items():
                data = json.dumps({"timestamp": stamp, **content}).encode()
                writer.add_message(channels[topic], when, data, when, sequence=i)
        writer.add_metadata("ssm_graph", {"mission": track.name, "about": track.about})
        writer.finish()


def _columns(track: Track) -> dict[str, Any]:
    """Return lists of Python numbers, None for what is not finite."""
    east, north = track.velocity_enu[:, :2].T
    arrays: dict[str, NDArray[Any]] = {
        "lat": np.degrees(track.lat),
        "lon": np.degrees(track.lon),
        "height": track.height,
        "local": track.local_enu,
        "quaternion": track.quaternion,
        "variance": track.position_sigma_enu**2,
        "speed": np.hypot(east, north),
        "course": np.degrees(np.arctan2(east, north)) % 360.0,
        "angles": np.degrees(track.roll_pitch_heading),
        "sigma_horizontal": np.linalg.norm(track.position_sigma_enu[:, :2], axis=1),
        "sigma_up": track.position_sigma_enu[:, 2],
        "sigma_heading": np.degrees(track.attitude_sigma[:, 2]),
        "suspect": track.is_suspect,
    }
    return {name: [_known(row) for row in values.tolist()] for name, values in arrays.items()}


def _known(value: Any) -> Any:
    """Return a number or a list of them, None for what is not finite."""
    if isinstance(value, list):
        return [_known(part) for part in value]
    return value if math.isfinite(value) else None


def _messages(columns: dict[str, Any], i: int) -> dict[str, dict[str, Any]]:
    """Return one row's messages by topic."""
    value = {name: of[i] for name, of in columns.items()}
    east, north, up = value["variance"]
    roll, pitch, heading = value["angles"]
    return {
        "/location": {
            "frame_id": "earth",
            "latitude": value["lat"],
            "longitude": value["lon"],
            "altitude": value["height"],
            "position_covariance": [east, 0.0, 0.0, 0.0, north, 0.0, 0.0, 0.0, up],
            "position_covariance_type": _DIAGONAL_KNOWN if None not in (east, north, up) else 0,
        },
        "/pose": {
            "frame_id": "local_enu",
            "pose": {
                "position": dict(zip("xyz", value["local"], strict=True)),
                "orientation": dict(zip("xyzw", value["quaternion"], strict=True)),
            },
        },
        "/navigation": {
            "speed_m_per_s": value["speed"],
            "course_deg": value["course"],
            "heading_deg": heading % 360.0,
            "roll_deg": roll,
            "pitch_deg": pitch,
            "height_m": value["height"],
            "sigma_horizontal_m": value["sigma_horizontal"],
            "sigma_up_m": value["sigma_up"],
            "sigma_heading_deg": value["sigma_heading"],
            "suspect": value["suspect"],
        },
    }
