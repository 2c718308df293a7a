"""Images and ranges in bags of ROS 1 and 2: plain topics, and messages of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.systems.visual_ranges.readers.source import read_sequence

cv2 = pytest.importorskip("cv2")
rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

UWB = "std_msgs/Header header\nmy_msgs/One[] ranges\n"
ONE = "int32 to\nfloat32 distance_mm\nfloat32 std_mm\n"
TOML = """
image_topic = "/cam0/image_raw"
[[ranges]]
topic = "/uwb"
each = "ranges"
anchor = "to"
range = "distance_mm"
sigma = "std_mm"
unit = "mm"
"""


def picture(index: int) -> NDArray[np.uint8]:
    """Return an image that is like no other."""
    return np.random.default_rng(index).integers(0, 255, (72, 96), dtype=np.uint8)


def messages(store: Any, *, is_ros1: bool) -> list[tuple[str, str, int, Any]]:
    """Return topic, type, time and message of a short recording."""
    types = store.types
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    region = types["sensor_msgs/msg/RegionOfInterest"]
    sequence = {"seq": 0} if is_ros1 else {}

    def head(ns: int) -> Any:
        return header(**sequence, stamp=time(ns // 10**9, ns % 10**9), frame_id="cam")

    k = np.array([80.0, 0, 47.5, 0, 81.0, 35.5, 0, 0, 1])
    names = {x: (x.upper() if is_ros1 else x) for x in "dkrp"}
    matrices = {names["d"]: np.array([-0.1, 0.02, 0.001, -0.002]), names["k"]: k}
    matrices |= {names["r"]: np.eye(3).ravel(), names["p"]: np.zeros(12)}
    found: list[tuple[str, str, int, Any]] = []
    for i in range(6):
        ns = 1_000_000_000 + 50_000_000 * i
        image = picture(i)
        encoding, data = "mono8", image.ravel()
        if i % 2:
            encoding, data = "rgb8", np.repeat(image.ravel(), 3)
        message = types["sensor_msgs/msg/Image"](
            head(ns), 72, 96, encoding, 0, 96 * (3 if i % 2 else 1), data
        )
        found.append(("/cam0/image_raw", "sensor_msgs/msg/Image", ns + 7, message))
        info = types["sensor_msgs/msg/CameraInfo"](
            header=head(ns), height=72, width=96, distortion_model="plumb_bob", **matrices,
            binning_x=0, binning_y=0, roi=region(0, 0, 0, 0, do_rectify=False),
        )  # fmt: skip
        found.append(("/cam0/camera_info", "sensor_msgs/msg/CameraInfo", ns + 8, info))
        extra = {} if is_ros1 or "variance" not in _fields(types) else {"variance": 0.0}
        near = types["sensor_msgs/msg/Range"](head(ns), 0, 0.1, 0.0, 50.0, 2.0 + i, **extra)
        found.append(("/anchor_a", "sensor_msgs/msg/Range", ns + 9, near))
        one = types["my_msgs/msg/One"]
        both = [one(5, 2100.0 + i, 50.0), one(8, 3200.0, 80.0)]
        found.append(("/uwb", "my_msgs/msg/Uwb", ns + 9, types["my_msgs/msg/Uwb"](head(ns), both)))
    return found


def _fields(types: Any) -> set[str]:
    return set(types["sensor_msgs/msg/Range"].__dataclass_fields__)


def made_store(kind: Any) -> Any:
    """Return the message types of ROS with our own."""
    store = typesys.get_typestore(kind)
    store.register(typesys.get_types_from_msg(ONE, "my_msgs/msg/One"))
    store.register(typesys.get_types_from_msg(UWB, "my_msgs/msg/Uwb"))
    return store


def write_ros2(path: Path, without: str = "") -> Path:
    """Write a bag of ROS 2."""
    store = made_store(typesys.Stores.ROS2_HUMBLE)
    with rosbag2.Writer(path, version=9) as writer:
        topics: dict[str, Any] = {}
        for topic, kind, ns, message in messages(store, is_ros1=False):
            if topic == without:
                continue
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(topics[topic], ns, store.serialize_cdr(message, kind))
    return path


def write_ros1(path: Path) -> Path:
    """Write a bag of ROS 1."""
    store = made_store(typesys.Stores.ROS1_NOETIC)
    with rosbag1.Writer(path) as writer:
        topics: dict[str, Any] = {}
        for topic, kind, ns, message in messages(store, is_ros1=True):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(topics[topic], ns, store.serialize_ros1(message, kind))
    return path


@pytest.mark.parametrize("version", [1, 2])
def test_images_camera_and_ranges_of_a_bag(tmp_path: Path, version: int) -> None:
    """Both encodings, forwards and back; each Range topic is an anchor; times of the headers."""
    path = write_ros1(tmp_path / "run.bag") if version == 1 else write_ros2(tmp_path / "run")
    found = read_sequence(path)
    np.testing.assert_allclose(found.time_s, 1.0 + 0.05 * np.arange(6))
    assert found.camera.distortion == (-0.1, 0.02, 0.001, -0.002)
    for k in (0, 1, 4, 2):
        np.testing.assert_array_equal(found.images(k), picture(k))
    assert found.ranges.names == ("/anchor_a",)
    np.testing.assert_allclose(found.ranges.range_m, 2.0 + np.arange(6))


def test_ranges_of_a_message_of_ones_own(tmp_path: Path) -> None:
    """A list within the message, millimetres, sigmas, named in a TOML beside the bag."""
    path = write_ros2(tmp_path / "run")
    (tmp_path / "ranges.toml").write_text(TOML)
    found = read_sequence(path)
    assert found.ranges.names == ("5", "8")
    own = found.ranges.of("5")
    np.testing.assert_allclose(own.range_m, 2.1 + 1e-3 * np.arange(6), atol=1e-6)
    np.testing.assert_allclose(own.sigma_m, 0.05, atol=1e-7)
    (tmp_path / "ranges.toml").write_text(TOML.replace('"distance_mm"', '"distance"'))
    with pytest.raises(ConfigError, match=r"have no field 'distance'.*did you mean 'distance_mm'"):
        read_sequence(path)
    (tmp_path / "ranges.toml").write_text(TOML.replace("/cam0/image_raw", "/cam1/image_raw"))
    with pytest.raises(ConfigError, match=r"no image topic /cam1/image_raw; did you mean '/cam0"):
        read_sequence(path)


def test_a_bag_that_cannot_be_used(tmp_path: Path) -> None:
    """Without images, without calibration, damaged."""
    with pytest.raises(ConfigError, match="no images; name one"):
        read_sequence(write_ros2(tmp_path / "blind", without="/cam0/image_raw"))
    with pytest.raises(DataError, match=r"no calibration \(camera info\); give one with --camera"):
        read_sequence(write_ros2(tmp_path / "bare", without="/cam0/camera_info"))
    cut = write_ros1(tmp_path / "cut.bag")
    cut.write_bytes(cut.read_bytes()[:3000])
    with pytest.raises(DataError, match="not a complete recording of ROS"):
        read_sequence(cut)
