"""Rows of the topics of a recording, one for each message, and their order in time."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.ros.aids import AID_TYPES, aid_message
from ssm_graph.io.ros.beams import stated_beams
from ssm_graph.io.ros.frames import TF_TOPIC, Frames
from ssm_graph.io.ros.log import REQUIRED_ROLES, BagMessage, Topics, read_rosbag
from ssm_graph.io.ros.messages import (
    RosOptions,
    depth_reading,
    depth_sigma,
    dvl_report,
    fix,
    has_stated_sigma,
    imu_sample,
)
from ssm_graph.sensors.registry import BY_SECTION

WATER_LATER_S: Final = 1e-3
"""A ping off the water that has the time of one off the ground is put so much later."""


@dataclass(slots=True)
class BagTopic:
    """What one topic held: the rows of its messages, and what went wrong."""

    role: str
    names: list[str] = field(default_factory=list)
    type_name: str = ""
    frame_id: str = ""
    """Of the headers; empty where they have none."""
    rows: array[float] = field(default_factory=lambda: array("d"))
    """IMU: time, gyro, accelerometer; DVL: time, speeds, sigmas, ranges, velocity and covariance, 1
    off the water; depth: time, depth, sigma; GNSS: time, latitude, longitude, height, sigmas;
    further aids: the numbers of their live messages. SI units, FRD, NaN if unknown."""
    received: array[float] = field(default_factory=lambda: array("d"))
    """Times of recording, s, of the rows."""
    n_messages: int = 0
    refused: list[str] = field(default_factory=list)
    beams_d: Array | None = None
    """(B, 3) directions of the beams as the messages state them."""
    take_off_s: float = 0.0
    """Of the stamps, which are of a clock that is known to be ahead, s."""
    n_unstated: int = 0
    """Fixes that do not say how good they are."""

    @property
    def name(self) -> str:
        """Of the topic, or of both."""
        return " and ".join(self.names)

    def table(self, n_beams: int) -> Array:
        """Return the rows, less what is to be taken off their stamps."""
        table = np.array(self.rows, dtype=float).reshape(-1, _width(self.role, n_beams))
        table[:, 0] -= self.take_off_s
        return table


def _width(role: str, n_beams: int) -> int:
    """Return how many numbers a row has."""
    if role in AID_TYPES:
        return 1 + BY_SECTION[role].width(None)
    return {"imu": 7, "dvl": 1 + 3 * n_beams + 13, "depth": 3, "gnss": 7}[role]


def read_topics(
    bag: Path, topics: Topics, options: RosOptions, notes: list[str]
) -> tuple[dict[str, BagTopic], Frames]:
    """Return by role what the recording holds, and its frames; raises as `convert_rosbag`."""
    read, frames = {role: BagTopic(role) for role in REQUIRED_ROLES}, Frames()
    for item in read_rosbag(bag, topics, notes):
        topic = read.setdefault(item.role, BagTopic(item.role))
        if item.topic not in topic.names:
            topic.names.append(item.topic)
        topic.type_name = item.type_name
        topic.n_messages += 1
        try:
            if item.role == TF_TOPIC:
                frames.add(item.message)
                continue
            header = getattr(item.message, "header", None)
            topic.frame_id = topic.frame_id or str(getattr(header, "frame_id", ""))
            row = _row(item, topic, options)
            topic.rows.extend(row)
            topic.received.extend([item.received_s] if row else [])
        except DataError as error:
            topic.refused.append(str(error))
        except (AttributeError, TypeError, ValueError, IndexError) as error:
            # the recording's own definition of the type is damaged, or of another package
            topic.refused.append(f"no {item.type_name} as it is known: {error}")
    transforms = read.pop(TF_TOPIC, None)
    if transforms is not None and transforms.refused:
        notes.append(
            f"{transforms.name}: {len(transforms.refused)} refused: {transforms.refused[0]}"
        )
    for role in REQUIRED_ROLES:
        topic = read[role]
        if len(topic.rows) < 2 * _width(role, options.n_beams):
            raise DataError(
                f"{bag}: expected at least two messages for the {role}, got {topic.n_messages}"
                + (f", {len(topic.refused)} refused: {topic.refused[0]}" if topic.refused else "")
            )
    return read, frames


def _row(item: BagMessage, topic: BagTopic, options: RosOptions) -> Sequence[float]:
    """Return the numbers of one message, time first; nothing where it says nothing."""
    if item.role in AID_TYPES:
        said = aid_message(item.role, item.message, item.received_s, options)
        return () if said is None else BY_SECTION[item.role].numbers(said)
    if item.role == "imu":
        sample = imu_sample(item.message, item.received_s, options)
        return (sample.time_s, *sample.gyro_b, *sample.accel_b)
    if item.role == "dvl":
        report = dvl_report(item.message, item.received_s, options)
        if topic.beams_d is None and report.beams_d is not None:
            topic.beams_d = stated_beams(np.array(report.beams_d))
        sigma = report.ping.sigma or (np.nan,) * options.n_beams
        beams = (*report.ping.speed, *sigma, *report.range_m)
        velocity = (*report.velocity_d, *report.covariance_d)
        return (report.ping.time_s, *beams, *velocity, float(report.ping.is_water))
    if item.role == "depth":
        reading = depth_reading(item.message, item.received_s, options)
        return (reading.time_s, reading.depth, depth_sigma(item.message, options))
    position = fix(item.message, item.received_s, options)
    topic.n_unstated += not has_stated_sigma(item.message)
    return (position.time_s, position.lat, position.lon, position.height, *position.sigma_enu)


def _part_tracks(table: Array) -> list[str]:
    """Put pings off the water apart from those off the ground, where both have one time."""
    is_water = table[:, -1] > 0.0
    together = is_water & np.isin(table[:, 0], table[~is_water, 0])
    table[together, 0] += WATER_LATER_S
    n_together = int(together.sum())
    return [f"{n_together} off the water put 1 ms behind those off the ground"] * (n_together > 0)


def in_order(topic: BagTopic, n_beams: int) -> tuple[Array, list[str]]:
    """Return the rows with strictly increasing times, and what that took."""
    table = topic.table(n_beams)
    said = _part_tracks(table) if topic.role == "dvl" else []
    n_late = int(np.sum(np.diff(table[:, 0], prepend=-np.inf) < 0.0))
    parts = BY_SECTION[topic.role].row_key  # ranges to several beacons may have one time
    keys = table[:, : 1 + len(parts)]
    table = table[np.lexsort(keys.T[::-1])]
    keys = table[:, : 1 + len(parts)]
    again = np.all(keys == np.roll(keys, 1, axis=0), axis=1)
    again[:1] = False
    before = np.roll(table, 1, axis=0)
    alike = np.all((table == before) | (np.isnan(table) & np.isnan(before)), axis=1)
    n_repeats, n_rivals = int(np.sum(again & alike)), int(np.sum(again & ~alike))
    if topic.refused:
        said.append(f"{len(topic.refused)} refused ({topic.refused[0]})")
    if n_late:
        said.append(f"{n_late} out of order, sorted by time")
    if n_repeats:
        said.append(f"{n_repeats} exact repeats dropped")
    if n_rivals:
        said.append(f"{n_rivals} dropped that differ from another of the same time")
    head = f"{topic.name}: of {topic.n_messages} messages "
    return table[~again], [f"{head}{'; '.join(said)}."] if said else []
