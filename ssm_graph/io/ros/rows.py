"""The messages of a recording as tables of numbers, ordered by time."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.ros.beams import stated_beams
from ssm_graph.io.ros.log import REQUIRED_ROLES, BagMessage, read_rosbag
from ssm_graph.io.ros.messages import (
    RosOptions,
    depth_reading,
    depth_sigma,
    dvl_report,
    fix,
    has_stated_sigma,
    imu_sample,
)
from ssm_graph.sensors.dvl import N_BEAMS

WATER_LATER_S: Final = 1e-3
"""A ping off the water that has the time of one off the ground is put so much later."""
_WIDTHS: Final = {"imu": 7, "dvl": 1 + 3 * N_BEAMS + 4, "depth": 3, "gnss": 7}


@dataclass(slots=True)
class BagTopic:
    """What one topic held: the rows of its messages, and what went wrong."""

    role: str
    name: str = ""
    type_name: str = ""
    rows: array[float] = field(default_factory=lambda: array("d"))
    """IMU: time, gyro, accelerometer; DVL: time, speeds, sigmas, ranges, velocity, 1 off the water;
    depth: time, depth, sigma; GNSS: time, latitude, longitude, height, sigmas. SI units, FRD, NaN
    if unknown."""
    n_messages: int = 0
    refused: list[str] = field(default_factory=list)
    beams_d: Array | None = None
    """(4, 3) directions of the beams as the messages state them."""
    n_unstated: int = 0
    """Fixes that do not say how good they are."""


def read_topics(bag: Path, topics: Mapping[str, str], options: RosOptions) -> dict[str, BagTopic]:
    """Return by role what the recording holds; raises as `convert_rosbag`."""
    read = {role: BagTopic(role) for role in REQUIRED_ROLES}
    for item in read_rosbag(bag, topics):
        topic = read.setdefault(item.role, BagTopic(item.role))
        topic.name, topic.type_name = item.topic, item.type_name
        topic.n_messages += 1
        try:
            topic.rows.extend(_row(item, topic, options))
        except DataError as error:
            topic.refused.append(str(error))
    for role in REQUIRED_ROLES:
        topic = read[role]
        if len(topic.rows) < 2 * _WIDTHS[role]:
            raise DataError(
                f"{bag}: expected at least two messages for the {role}, got {topic.n_messages}"
                + (f", {len(topic.refused)} refused: {topic.refused[0]}" if topic.refused else "")
            )
    return read


def _row(item: BagMessage, topic: BagTopic, options: RosOptions) -> Sequence[float]:
    """Return the numbers of one message, time first."""
    if item.role == "imu":
        sample = imu_sample(item.message, item.received_s, options)
        return (sample.time_s, *sample.gyro_b, *sample.accel_b)
    if item.role == "dvl":
        report = dvl_report(item.message, item.received_s, options)
        if topic.beams_d is None and report.beams_d is not None:
            topic.beams_d = stated_beams(np.array(report.beams_d))
        sigma = report.ping.sigma or (np.nan,) * N_BEAMS
        beams = (*report.ping.speed, *sigma, *report.range_m)
        return (report.ping.time_s, *beams, *report.velocity_d, float(report.ping.is_water))
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


def in_order(topic: BagTopic) -> tuple[Array, list[str]]:
    """Return the rows with strictly increasing times, and what that took."""
    table = np.array(topic.rows, dtype=float).reshape(-1, _WIDTHS[topic.role])
    said = _part_tracks(table) if topic.role == "dvl" else []
    n_late = int(np.sum(np.diff(table[:, 0], prepend=-np.inf) < 0.0))
    table = table[np.argsort(table[:, 0], kind="stable")]
    again = np.diff(table[:, 0], prepend=-np.inf) == 0.0
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
