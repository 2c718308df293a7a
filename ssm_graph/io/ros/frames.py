"""Where instruments sit by ``/tf_static``: lever arms and mounting, where no vehicle file says it.

The body is the IMU. A transform has the pose of its child frame in that of its parent; frames of
messages are those of their headers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.frames import R_FRD, BodyAxes
from ssm_graph.base.frozen import Array

TF_TYPE: Final = "tf2_msgs/msg/TFMessage"
TF_TOPIC: Final = "tf_static"
_LARGEST_NUMBER: Final = 1e3
"""m, of a lever arm."""
_MOST_STEPS: Final = 50
"""From a frame to the root of its tree."""
_ABOUT_X: Final = np.diag([1.0, -1.0, -1.0])


class Pose(NamedTuple):
    """Of a frame in another one."""

    R: Array
    """(3, 3) frame to the other."""
    place: Array
    """(3,) m"""


class Frames:
    """The transforms of a recording; a later one of the same child goes before."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}

    def add(self, message: Any) -> None:
        """Take the transforms of a ``TFMessage``; one that is none is passed over."""
        for one in message.transforms:
            t, q = one.transform.translation, one.transform.rotation
            place = np.array([t.x, t.y, t.z], dtype=float)
            quaternion = np.array([q.w, q.x, q.y, q.z], dtype=float)
            length = float(np.linalg.norm(quaternion))
            is_sound = np.isfinite(place).all() and np.abs(place).max() < _LARGEST_NUMBER
            if is_sound and abs(length - 1.0) < 0.01:
                pose = Pose(_rotation(quaternion / length), place)
                self._parents[_name(one.child_frame_id)] = (_name(one.header.frame_id), pose)

    def pose(self, frame: str, within: str) -> Pose | None:
        """Return the pose of one frame in another; None where nothing joins them."""
        root, in_root = self._root(_name(frame))
        other_root, other = self._root(_name(within))
        if root != other_root:
            return None
        return Pose(other.R.T @ in_root.R, other.R.T @ (in_root.place - other.place))

    def _root(self, frame: str) -> tuple[str, Pose]:
        pose = Pose(np.eye(3), np.zeros(3))
        for _ in range(_MOST_STEPS):
            if frame not in self._parents:
                break
            frame, up = self._parents[frame]
            pose = Pose(up.R @ pose.R, up.R @ pose.place + up.place)
        return frame, pose


def seats(
    frames: Frames, frame_ids: Mapping[str, str], axes: BodyAxes
) -> tuple[dict[str, Pose], list[str]]:
    """Return the poses of instruments in the body, FRD, and a note for each.

    ``frame_ids`` are by role, that of the IMU among them; ``axes`` are those of its frame. A DVL's
    frame whose z axis points up is that of REP 103: the axes of its messages, x forward, y
    starboard, z the way it looks, are it turned about x by half a turn.
    """
    found, notes = dict[str, Pose](), list[str]()
    imu, turn = frame_ids["imu"], R_FRD[axes]
    for role, frame in frame_ids.items():
        pose = frames.pose(frame, imu) if frame and imu and role != "imu" else None
        if pose is None:
            continue
        R_b, place_b = turn @ pose.R, turn @ pose.place
        is_up = role == "dvl" and R_b[2, 2] < 0.0
        found[role] = Pose(R_b @ _ABOUT_X if is_up else R_b, place_b)
        x, y, z = (float(value) + 0.0 for value in place_b)
        mounting = ""
        if role == "dvl":
            R = found[role].R
            yaw, pitch = np.arctan2(R[1, 0], R[0, 0]), -np.arcsin(np.clip(R[2, 0], -1.0, 1.0))
            angles = np.degrees([np.arctan2(R[2, 1], R[2, 2]), pitch, yaw])
            roll, pitch, yaw = np.round(angles, 2) + 0.0
            mounting = f", mounted at {roll:.2f}, {pitch:.2f}, {yaw:.2f} deg (roll, pitch, yaw)"
            mounting += ", its frame's z axis taken to point up" if is_up else ""
        notes.append(
            f"By /{TF_TOPIC} the {role} sits at {x:.3f}, {y:.3f}, {z:.3f} m from the IMU, forward, "
            f"right, down{mounting}."
        )
    return found, notes


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _rotation(quaternion: Array) -> Array:
    """Return the matrix of a unit quaternion w, x, y, z."""
    w, v = quaternion[0], quaternion[1:]
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross)
