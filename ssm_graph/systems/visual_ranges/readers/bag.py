"""Recordings of ROS 1 and 2: images, camera info, and ranges of any message, named in a TOML.

``ranges.toml`` beside the bag (or ``--ranges`` FILE.toml) says what is not of itself clear::

    image_topic = "/cam0/image_raw"
    camera_info_topic = "/cam0/camera_info"
    definitions = ["UwbRange.msg"]         # message texts, for bags that carry none

    [[ranges]]
    topic = "/uwb/ranges"
    type = "my_msgs/msg/UwbRange"          # of the definition, where the bag has none
    anchor = "anchor_id"                   # a field, or with name = "A1" always the same
    range = "range_m"
    sigma = "std"                          # optional
    time = "header.stamp"                  # optional: else the time of recording
    each = "ranges"                        # optional: a list within the message

Without it the only image topic is taken, and every topic of ``sensor_msgs/Range`` is an anchor.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, DataError, MissingExtraError, nearest_hint
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import Key, read_settings, read_toml
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.extras import opencv
from ssm_graph.systems.visual_ranges.ranges import Ranges, screened_ranges
from ssm_graph.systems.visual_ranges.readers.calibration import make_camera, read_camera
from ssm_graph.systems.visual_ranges.readers.images import WatchedImages
from ssm_graph.systems.visual_ranges.readers.layouts import chosen_images
from ssm_graph.systems.visual_ranges.readers.options import ReadOptions
from ssm_graph.systems.visual_ranges.readers.range_text import LENGTHS, read_ranges
from ssm_graph.systems.visual_ranges.readers.times import increasing
from ssm_graph.systems.visual_ranges.sequence import Sequence

MAPPING_NAME: Final = "ranges.toml"
IMAGE_TYPES: Final = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE: Final = "sensor_msgs/msg/CameraInfo"
RANGE_TYPE: Final = "sensor_msgs/msg/Range"
ENCODINGS: Final[Mapping[str, tuple[Any, int, str]]] = {
    "mono8": (np.uint8, 1, ""),
    "8uc1": (np.uint8, 1, ""),
    "mono16": (np.uint16, 1, ""),
    "16uc1": (np.uint16, 1, ""),
    "bgr8": (np.uint8, 3, ""),
    "8uc3": (np.uint8, 3, ""),
    "rgb8": (np.uint8, 3, "rgb"),
    "bgra8": (np.uint8, 4, ""),
    "rgba8": (np.uint8, 4, "rgb"),
    **{f"bayer_{p}8": (np.uint8, 1, p) for p in ("rggb", "bggr", "gbrg", "grbg")},
}
"""Pixel type, channels, and order of colours or pattern by ``Image.encoding``."""
_TEXT: Final = Key(shape=None, required=False)
TOP_KEYS: Final = {"image_topic": _TEXT, "camera_info_topic": _TEXT}
RANGE_KEYS: Final[Mapping[str, Key]] = {
    "topic": Key(shape=None),
    "type": _TEXT,
    "anchor": _TEXT,
    "name": _TEXT,
    "range": Key(shape=None),
    "sigma": _TEXT,
    "time": _TEXT,
    "each": _TEXT,
    "unit": _TEXT,
}


@dataclass(frozen=True, slots=True)
class RangeTopic:
    """Where a range is in the messages of a topic; fields by dotted path."""

    topic: str
    range: str = "range"
    anchor: str = ""
    name: str = ""
    """Of the anchor, where no field says it; without both it is that of the topic."""
    sigma: str = ""
    time: str = "header.stamp"
    each: str = ""
    """A list in the message whose members hold the ranges."""
    type: str = ""
    unit: str = "m"


@dataclass(frozen=True, slots=True)
class BagMapping:
    """Which topics hold what."""

    image_topic: str = ""
    camera_info_topic: str = ""
    ranges: tuple[RangeTopic, ...] = ()
    definitions: tuple[Path, ...] = field(default=())


def read_mapping(path: Path) -> BagMapping:
    """Read a mapping; see the head of this module.

    Raises :class:`ConfigError` with the key that is wrong.
    """
    raw = read_toml(path)
    listed, texts = raw.pop("ranges", []), raw.pop("definitions", [])
    top = read_settings("", raw, known=TOP_KEYS, file=path.name)
    topics = []
    for number, one in enumerate(listed, 1):
        settings = read_settings(f"[[ranges]] {number}", one, known=RANGE_KEYS, file=path.name)
        found = RangeTopic(**{key: settings.text(key) for key in settings.values})
        if found.unit not in LENGTHS:
            raise settings.fault("unit", f"expected one of {', '.join(LENGTHS)}, got {found.unit}")
        topics.append(found)
    return BagMapping(
        top.text("image_topic") if "image_topic" in top else "",
        top.text("camera_info_topic") if "camera_info_topic" in top else "",
        tuple(topics),
        tuple(path.parent / str(name) for name in texts),
    )


def read_bag(path: Path, options: ReadOptions) -> Sequence:
    """Read images, camera and ranges of a recording.

    Raises :class:`MissingExtraError` without rosbags; :class:`ConfigError` where topics have to be
    chosen; :class:`DataError` for a damaged recording.
    """
    is_table = options.ranges is not None and options.ranges.suffix != ".toml"
    file = options.ranges if options.ranges is not None and not is_table else _beside(path)
    mapping = read_mapping(file) if file is not None else BagMapping()
    bag = _Bag(path, mapping)
    topic = bag.image_topic()
    stamps, keys = bag.stamps(topic)
    order, note = increasing(stamps, topic)
    order = order[chosen_images(len(order), options)]
    time_s = stamps[order]
    images = _images(bag, topic, [keys[i] for i in order])
    camera = _camera(bag, options, images)
    if (camera.width, camera.height) != (images.width, images.height):
        raise DataError(
            f"{path}: images are {images.width} x {images.height} pixels, the calibration is for "
            f"{camera.width} x {camera.height}; scale one of them"
        )
    if is_table and options.ranges is not None:
        ranges = read_ranges(options.ranges, time_s, sigma_m=options.sigma_m)
    else:
        ranges = bag.ranges(options.sigma_m)
    lever = options.lever_arm_m or (0.0, 0.0, 0.0)
    notes = tuple(text for text in (note, *ranges.notes) if text)
    return Sequence(path.stem, camera, time_s, images, ranges, lever, notes=notes)


def _beside(path: Path) -> Path | None:
    places = (path / MAPPING_NAME, path.with_suffix(".toml"), path.parent / MAPPING_NAME)
    return next((place for place in places if place.is_file()), None)


class _Bag:
    """A recording that stays open: images are read when they are asked for."""

    def __init__(self, path: Path, mapping: BagMapping) -> None:
        try:
            highlevel = import_module("rosbags.highlevel")
            types = import_module("rosbags.typesys")
        except ImportError as error:
            raise MissingExtraError("rosbags", extra="ros", purpose="reading ROS bags") from error
        self.path, self._mapping = path, mapping
        store = types.get_typestore(types.Stores.ROS2_HUMBLE)
        for text in mapping.definitions:
            named = {one.type for one in mapping.ranges if one.type}
            for name in named:
                store.register(types.get_types_from_msg(text.read_text(encoding="utf-8"), name))
        try:
            self._reader = highlevel.AnyReader([path], default_typestore=store)
            self._reader.open()
        except Exception as error:  # of rosbags: damage raises many kinds
            raise DataError(
                f"{path}: not a complete recording of ROS ({type(error).__name__}: {error}); if it "
                "was cut off, try  ros2 bag reindex,  or  rosbag reindex  for ROS 1"
            ) from error

        weakref.finalize(self, self._reader.close)
        self._open: tuple[str, Iterator[Any], int] | None = None
        """Topic, messages still to come, and the earliest time that is among them."""

    def image_topic(self) -> str:
        """Return the topic of the images."""
        found = sorted({x.topic for x in self._reader.connections if x.msgtype in IMAGE_TYPES})
        wanted = self._mapping.image_topic
        if wanted:
            if wanted not in found:
                raise ConfigError(
                    f"{self.path}: there is no image topic {wanted}; {nearest_hint(wanted, found)}"
                )
            return wanted
        if len(found) != 1:
            told = f"{len(found)} topics hold images: {', '.join(found)}" if found else "no images"
            raise ConfigError(
                f"{self.path}: {told}; name one in {MAPPING_NAME}: image_topic = "
                f'"{found[0] if found else "/cam0/image_raw"}"'
            )
        return str(found[0])

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield time of recording, ns, and message of a topic."""
        wanted = [x for x in self._reader.connections if x.topic == topic]
        if not wanted:
            known = sorted({x.topic for x in self._reader.connections})
            raise ConfigError(
                f"{self.path}: there is no topic {topic}; {nearest_hint(topic, known)}"
            )
        for connection, stamp, raw in self._reader.messages(connections=wanted):
            try:
                yield stamp, self._reader.deserialize(raw, connection.msgtype)
            except Exception as error:  # of rosbags: other layouts raise many kinds
                raise DataError(
                    f"{self.path}: topic {topic} holds a message at {stamp / 1e9:.3f} s that is no "
                    f"{connection.msgtype} ({type(error).__name__}: {error}); give its definition "
                    f"in {MAPPING_NAME}"
                ) from error

    def stamps(self, topic: str) -> tuple[Array, list[int]]:
        """Return the header's time of each message, s, and its time of recording, ns."""
        found = [(_seconds(message.header.stamp), stamp) for stamp, message in self.messages(topic)]
        if len(found) < 2:
            raise DataError(f"{self.path}: expected at least 2 images in {topic}, got {len(found)}")
        times = np.array([time for time, _ in found])
        if not np.any(times):
            times = np.array([stamp for _, stamp in found]) * 1e-9
        return times, [stamp for _, stamp in found]

    def message_at(self, topic: str, stamp: int) -> Any:
        """Return the message of a topic that was recorded at a time, ns; going back costs most."""
        if self._open is None or self._open[0] != topic or stamp < self._open[2]:
            wanted = [x for x in self._reader.connections if x.topic == topic]
            self._open = (topic, self._reader.messages(connections=wanted, start=stamp), stamp)
        for connection, at, raw in self._open[1]:
            if at >= stamp:
                self._open = (topic, self._open[1], at + 1)
                return self._reader.deserialize(raw, connection.msgtype)
        raise DataError(f"{self.path}: topic {topic} ended before {stamp / 1e9:.3f} s")

    def camera_info(self, image_topic: str) -> Any | None:
        """Return the first camera info: of the topic named, else of the image's namespace."""
        found = sorted({x.topic for x in self._reader.connections if x.msgtype == INFO_TYPE})
        wanted = self._mapping.camera_info_topic
        if not wanted:
            space = image_topic.rpartition("/")[0].removesuffix("/image_raw")
            near = [topic for topic in found if topic.rpartition("/")[0] == space]
            wanted = near[0] if near else found[0] if len(found) == 1 else ""
        return next((m for _, m in self.messages(wanted)), None) if wanted else None

    def ranges(self, sigma_m: float | None) -> Ranges:
        """Return the ranges of all topics that hold some."""
        topics: Iterable[RangeTopic] = self._mapping.ranges
        if not topics:
            plain = sorted({x.topic for x in self._reader.connections if x.msgtype == RANGE_TYPE})
            topics = [RangeTopic(topic) for topic in plain]
        time, name, value, sigma = [], [], [], []
        for one in topics:
            for stamp, message in self.messages(one.topic):
                at = _field(message, one.time, self.path, one) if one.time else None
                for part in _field(message, one.each, self.path, one) if one.each else [message]:
                    time.append(stamp * 1e-9 if at is None else _seconds(at) or stamp * 1e-9)
                    value.append(float(_field(part, one.range, self.path, one)) * LENGTHS[one.unit])
                    name.append(
                        str(_field(part, one.anchor, self.path, one))
                        if one.anchor
                        else one.name or one.topic
                    )
                    stated = float(_field(part, one.sigma, self.path, one)) if one.sigma else np.nan
                    sigma.append(stated * LENGTHS[one.unit])
        own = np.array(sigma)
        if sigma_m is not None:
            own = np.where(np.isfinite(own) & (own > 0.0), own, sigma_m)
        return screened_ranges(time, name, value, own, source=self.path.name)


def _seconds(stamp: Any) -> float:
    """Return seconds of a stamp of ROS 1 or 2, or of a number of seconds or nanoseconds."""
    for seconds, nanoseconds in (("sec", "nanosec"), ("secs", "nsecs")):
        if hasattr(stamp, seconds):
            return float(getattr(stamp, seconds)) + 1e-9 * float(getattr(stamp, nanoseconds))
    value = float(stamp)
    return value * 1e-9 if value > 1e16 else value


def _field(message: Any, dotted: str, path: Path, one: RangeTopic) -> Any:
    for part in dotted.split("."):
        if not hasattr(message, part):
            known = [name for name in dir(message) if not name.startswith("_")]
            raise ConfigError(
                f"{path}: messages of {one.topic} have no field {part!r} of {dotted!r}; "
                f"{nearest_hint(part, known)}; name it in {MAPPING_NAME}"
            )
        message = getattr(message, part)
    return message


def _images(bag: _Bag, topic: str, stamps: list[int]) -> WatchedImages:
    def load(index: int) -> NDArray[Any] | None:
        return pixels_of(bag.message_at(topic, stamps[index]))

    first = bag.message_at(topic, stamps[0])
    pixels = pixels_of(first)
    if pixels is None:
        raise DataError(f"{bag.path}: the first image of {topic} cannot be decoded")
    encoding = ENCODINGS.get(getattr(first, "encoding", "").lower())
    bayer = encoding[2] if encoding is not None and len(encoding[2]) == 4 else ""
    label = lambda k: f"image at {stamps[k] / 1e9:.3f} s"  # noqa: E731
    return WatchedImages(load, pixels.shape[1], pixels.shape[0], label, bayer)


def pixels_of(message: Any) -> NDArray[Any] | None:
    """Return the pixels of an ``Image`` or ``CompressedImage``, None where they are damaged.

    Raises :class:`DataError` for an encoding that is not known.
    """
    data = np.asarray(message.data, dtype=np.uint8)
    if not hasattr(message, "encoding"):
        cv2 = opencv()
        found = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
        return None if found is None else np.asarray(found)
    known = ENCODINGS.get(message.encoding.lower())
    if known is None:
        raise DataError(
            f"image encoding {message.encoding!r}: expected one of {', '.join(ENCODINGS)}"
        )
    kind, channels, order = known
    row = int(message.step) // np.dtype(kind).itemsize
    if len(data) < message.height * message.step:
        return None
    pixels = data[: message.height * message.step].view(kind)
    if message.is_bigendian and np.dtype(kind).itemsize > 1:
        pixels = pixels.byteswap()
    pixels = pixels.reshape(message.height, row)[:, : message.width * channels]
    if channels > 1:
        pixels = pixels.reshape(message.height, message.width, channels)
    return np.asarray(pixels[..., [2, 1, 0]] if order == "rgb" else pixels)


def _camera(bag: _Bag, options: ReadOptions, images: WatchedImages) -> Camera:
    size = images.width, images.height
    if options.camera is not None:
        return read_camera(options.camera, size)
    info = bag.camera_info(bag.image_topic())
    matrix = None if info is None else np.asarray(getattr(info, "k", getattr(info, "K", [])))
    if info is None or matrix is None or not np.any(matrix):
        raise DataError(
            f"{bag.path}: no calibration (camera info); give one with --camera, or its topic in "
            f"{MAPPING_NAME}: camera_info_topic"
        )
    distortion = np.asarray(getattr(info, "d", getattr(info, "D", []))).tolist()
    own_size = int(info.width) or size[0], int(info.height) or size[1]
    where = f"{bag.path}: camera info"
    return make_camera(
        where, own_size, matrix[[0, 4, 2, 5]].tolist(), info.distortion_model, distortion
    )
