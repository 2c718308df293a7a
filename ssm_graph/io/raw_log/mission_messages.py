"""A recorded mission as the messages that a live estimator would have been sent."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.depth import DepthLog, DepthReading
from ssm_graph.sensors.dvl import DvlLog, Ping
from ssm_graph.sensors.gnss import Fix, GnssLog
from ssm_graph.sensors.imu import ImuLog, ImuSample
from ssm_graph.sensors.messages import Message

_CHUNK = 4096
"""Rows that are turned into messages at a time."""


def messages_of(mission: Mission) -> Iterator[Message]:
    """Yield all messages of a mission in order of time.

    An IMU sample stands at the end of its interval, a ping at its stamp. Of equal times the IMU
    comes first, then DVL, depth, GNSS. Rows are turned into messages as they are asked for, so that
    a day of data needs no more memory than the mission itself.
    """
    streams: list[Iterator[Message]] = [_samples(mission.imu), _pings(mission.dvl)]
    if mission.depth is not None:
        streams.append(_depths(mission.depth))
    if mission.gnss is not None:
        streams.append(_fixes(mission.gnss))
    return heapq.merge(*streams, key=lambda message: message.time_s)


def _samples(imu: ImuLog) -> Iterator[ImuSample]:
    for time_s, gx, gy, gz, ax, ay, az in _rows(imu.time_s, imu.gyro_b, imu.accel_b):
        yield ImuSample(time_s, (gx, gy, gz), (ax, ay, az))


def _pings(dvl: DvlLog) -> Iterator[Ping]:
    columns = (dvl.time_s, dvl.speed, dvl.sigma, dvl.is_water.astype(float))
    for time_s, v1, v2, v3, v4, s1, s2, s3, s4, water in _rows(*columns):
        yield Ping(time_s, (v1, v2, v3, v4), (s1, s2, s3, s4), is_water=water > 0.0)


def _depths(depth: DepthLog) -> Iterator[DepthReading]:
    for time_s, value in _rows(depth.time_s, depth.depth):
        yield DepthReading(time_s, value)


def _fixes(gnss: GnssLog) -> Iterator[Fix]:
    columns = (gnss.time_s, gnss.lat, gnss.lon, gnss.height, gnss.sigma_enu)
    for time_s, lat, lon, height, east, north, up in _rows(*columns):
        yield Fix(time_s, lat, lon, height, (east, north, up))


def _rows(*columns: Array) -> Iterator[list[float]]:
    """Yield rows of plain floats of arrays (N,) or (N, M) side by side."""
    for start in range(0, len(columns[0]), _CHUNK):
        yield from np.column_stack([c[start : start + _CHUNK] for c in columns]).tolist()
