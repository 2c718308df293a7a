"""Reading of Blueye X3 logs: MCAP files with protobuf schemas inside, as tables of messages."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import DataError, MissingExtraError
from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.io.blueye.vehicle import BEAM_AZIMUTH

PREFIX: Final = "blueye.protocol."
TOPICS: Final = tuple(
    PREFIX + name for name in ("Imu2Tel", "DvlVelocityTel", "DepthTel", "PositionEstimateTel")
)
WITNESS: Final = PREFIX + "Imu1Tel"
"""The vehicle's other IMU, which a log need not have."""
GNSS_SENSOR_ID: Final = 4
DVL_SENSOR_ID: Final = 1
"""The dead reckoning that the DVL does by itself."""


class BlueyeTables(NamedTuple):
    """The topics as they were logged, repeats included; first columns are arrival times, Unix s."""

    imu: Array
    """(N, 7) time, gyro x, y, z and accelerometer x, y, z in the log's units, of Imu2Tel."""
    witness: Array
    """(N, 7) the same of Imu1Tel; no rows where the log has none."""
    dvl: Array
    """(N, 19) time, delta_time in ms, water track, status, then of beams 1 to 4 the speeds in m/s,
    validity and ranges in m, then the velocity in m/s, forward-right-down."""
    depth: Array
    """(N, 2) time, depth in m."""
    yaw_rate: Array
    """(N, 2) time, yaw rate of the vehicle's own estimator in rad/s."""
    gnss: Array
    """(N, 4) time, latitude and longitude in deg, sigma in m; valid fixes only."""
    dvl_heading: Array
    """(N, 2) time, heading in rad of the DVL's own dead reckoning, from no known origin; no rows
    where the log has none."""


def read_blueye_tables(log: Path) -> BlueyeTables:
    """Return the messages of a log as arrays, in order of arrival; raises as `convert_blueye`."""
    rows: dict[str, list[tuple[float, ...]]] = {
        name: [] for name in ("imu", "witness", "dvl", "depth", "yaw_rate", "gnss", "dvl_heading")
    }
    for topic, time_s, message in _messages(log):
        try:
            _append(rows, topic.removeprefix(PREFIX), time_s, message)
        except (AttributeError, IndexError) as error:
            raise DataError(f"{log}: topic {topic} has an unknown layout: {error}") from error
    empty = [name for name in ("imu", "dvl", "depth") if len(rows[name]) < 2]
    if empty:
        raise DataError(f"{log}: no data of {', '.join(empty)}: is the log empty?")
    if not all(np.isfinite(rows[name]).all() for name in ("imu", "depth", "gnss")):
        raise DataError(f"{log}: IMU, depth or GNSS hold values that are not finite")
    return BlueyeTables(
        imu=_by_time(rows["imu"], 7),
        witness=_by_time(rows["witness"], 7),
        dvl=_by_time(rows["dvl"], 19),
        depth=_by_time(rows["depth"], 2),
        yaw_rate=_by_time(rows["yaw_rate"], 2),
        gnss=_by_time(rows["gnss"], 4),
        dvl_heading=_by_time(rows["dvl_heading"], 2),
    )


def _by_time(rows: list[tuple[float, ...]], n_columns: int) -> Array:
    table = np.array(rows, dtype=float).reshape(-1, n_columns)
    return np.asarray(table[np.argsort(table[:, 0], kind="stable")])


def _messages(log: Path) -> Iterator[tuple[str, float, Any]]:
    """Yield topic, arrival time in s and decoded message, in the order of the file.

    All failures become DataError.
    """
    try:
        from mcap.reader import NonSeekingReader, SeekingReader
        from mcap_protobuf.decoder import DecoderFactory
    except ImportError as error:
        name = "mcap-protobuf-support"
        raise MissingExtraError(name, extra="blueye", purpose="reading Blueye logs") from error
    try:
        with log.open("rb") as stream:
            summary = SeekingReader(stream).get_summary()
            found = {channel.topic for channel in summary.channels.values()} if summary else set()
            missing = [topic for topic in TOPICS if topic not in found]
            if missing:
                raise DataError(
                    f"{log}: expected the topics of a Blueye X3 log, {', '.join(missing)} missing; "
                    f"found: {', '.join(sorted(found)) or 'none'}"
                )
            stream.seek(0)
            reader = NonSeekingReader(stream, decoder_factories=[DecoderFactory()])
            wanted = (*TOPICS, WITNESS)
            # By the library's queue the order of times takes as long as all else.
            decoded = reader.iter_decoded_messages(topics=wanted, log_time_order=False)
            for _, channel, raw, message in told(decoded, _count(summary, wanted)):
                yield channel.topic, raw.log_time * 1e-9, message
    except OSError as error:
        raise DataError(f"{log}: cannot be read: {error.strerror or error}") from error
    except DataError:
        raise
    except Exception as error:  # of mcap, protobuf, lz4 or zstd: damage raises many kinds
        raise DataError(
            f"{log}: not a complete MCAP file ({type(error).__name__}: {error}); "
            "if the recording was cut off, try  mcap recover"
        ) from error


def _count(summary: Any, topics: Collection[str]) -> float:
    """Return how many messages of some topics the end of a file promises; 0 where it does not."""
    counts = summary.statistics.channel_message_counts if summary.statistics else {}
    of = {number for number, channel in summary.channels.items() if channel.topic in topics}
    return float(sum(count for number, count in counts.items() if number in of))


def _append(rows: dict[str, list[tuple[float, ...]]], topic: str, time: float, msg: Any) -> None:
    if topic in ("Imu1Tel", "Imu2Tel"):
        gyro, accel = msg.imu.gyroscope, msg.imu.accelerometer
        rows["imu" if topic == "Imu2Tel" else "witness"].append(
            (time, gyro.x, gyro.y, gyro.z, accel.x, accel.y, accel.z)
        )
    elif topic == "DvlVelocityTel":
        dvl = msg.dvl_velocity
        beams = sorted(dvl.transducers, key=lambda beam: int(beam.id))
        if [beam.id for beam in beams] != list(range(len(BEAM_AZIMUTH))):
            raise IndexError(f"expected transducers 0 to 3, got {[beam.id for beam in beams]}")
        columns = zip(
            *((beam.velocity, beam.beam_valid, beam.distance) for beam in beams), strict=True
        )
        values = [value for column in columns for value in column]
        velocity = (dvl.velocity.x, dvl.velocity.y, dvl.velocity.z)
        head = (time, dvl.delta_time, dvl.is_water_tracking, dvl.status)
        rows["dvl"].append((*head, *values, *velocity))
    elif topic == "DepthTel":
        rows["depth"].append((time, msg.depth.value))
    else:
        position = msg.position_estimate
        rows["yaw_rate"].append((time, position.yaw_rate))
        for sensor in position.navigation_sensors:
            if sensor.sensor_id == GNSS_SENSOR_ID and sensor.is_valid:
                point = sensor.global_position
                rows["gnss"].append((time, point.latitude, point.longitude, sensor.std))
            elif sensor.sensor_id == DVL_SENSOR_ID and sensor.is_valid:
                rows["dvl_heading"].append((time, sensor.heading))
