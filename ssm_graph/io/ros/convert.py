"""Import of ROS 2 bags as missions.

Times are those of the message headers, receipt where a header has none.  What messages do not say
comes from a vehicle, or is assumed and said in the mission's notes.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.assembly import mission_from
from ssm_graph.io.ros.beams import Beams, known_beams, proven_beams, stated_beams
from ssm_graph.io.ros.log import REQUIRED_ROLES, BagMessage, read_rosbag
from ssm_graph.io.ros.messages import (
    WATER_LINKED_TYPE,
    BeamSign,
    RosOptions,
    depth_reading,
    depth_sigma,
    dvl_report,
    fix,
    has_stated_sigma,
    imu_sample,
)
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.vehicle import GNSS_AT_ORIGIN, Vehicle
from ssm_graph.sensors.depth import DEEPEST_M, DEPTH, DepthLog
from ssm_graph.sensors.dvl import DvlLog, DvlMount, counted_sigma
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog, ImuNoise

NOISE: Final = ImuNoise(
    gyro_density=1.2e-4,
    accel_density=1.5e-3,
    gyro_bias_sigma=4.8e-4,
    accel_bias_sigma=0.05,
    gyro_bias_density=2.4e-6,
    accel_bias_density=1.6e-4,
)
"""A consumer MEMS unit: 100 deg/h, 0.4 deg/sqrt(h), 5 mg."""
BEAM_SIGMA: Final = 0.02
"""m/s"""
DEPTH_SIGMA: Final = 0.1
"""m"""

WATER_LATER_S: Final = 1e-3
"""A ping off the water that has the time of one off the ground is put so much later."""
_ABOVE_WATER_M: Final = 2.0


def convert_rosbag(
    bag: Path,
    *,
    vehicle: Vehicle | None = None,
    topics: Mapping[str, str] | None = None,
    options: RosOptions | None = None,
) -> Mission:
    """Read a rosbag2 recording into a mission without reference.

    Times stay Unix seconds, body axes are forward-right-down. Everything assumed, dropped or
    sorted is in the mission's notes.

    Raises :class:`MissingExtraError`: ``rosbags`` is not installed. Raises :class:`ConfigError`: a
    choice of topics is open or wrong, or nothing says where on Earth the mission was. Raises
    :class:`DataError`: the recording is damaged, or its messages cannot be what they say they are.

    Parameters
    ----------
    bag : folder with ``metadata.yaml``, or a single ``.mcap`` or ``.db3`` file.
    vehicle : noise, lever arms and mounting; its beam directions go before those of the messages.
    topics : by role (``imu``, ``dvl``, ``depth``, ``gnss``), where several could serve it.
    options : axes of the IMU, water, atmosphere; None for the defaults.
    """
    bag, options = Path(bag), RosOptions() if options is None else options
    if vehicle is not None:
        options = replace(options, n_beams=vehicle.mount.n_beams)
    read = _read_topics(bag, topics or {}, options)
    tables, notes = {}, []
    for role, topic in read.items():
        tables[role], some = _in_order(topic, options.n_beams)
        notes += some
    imu = _imu(bag, tables["imu"], vehicle, options)
    notes += _imu_notes(imu, read["imu"], vehicle)
    dvl, some = _dvl(bag, tables["dvl"], read["dvl"], vehicle, options)
    notes += some
    gnss, some = _gnss(tables.get("gnss"), read, vehicle, options)
    notes += some
    depth, some = _depth(bag, tables.get("depth"), gnss, vehicle, options)
    return mission_from(
        [log for log in (imu, dvl, depth, gnss) if log is not None],
        vehicle,
        source=bag,
        labels={role: f"{bag}: {topic.name}" for role, topic in read.items()},
        notes=[*notes, *some],
    )


def _imu(bag: Path, table: Array, vehicle: Vehicle | None, options: RosOptions) -> ImuLog:
    if len(table) < 2:
        raise DataError(f"{bag}: the IMU's messages all have the same time")
    time_s, accel_b = table[:, 0], table[:, 4:7]
    if np.median(accel_b[:, 2]) > 0.5 * np.median(np.linalg.norm(accel_b, axis=1)):
        raise DataError(
            f"{bag}: in {options.body.value} axes, linear_acceleration points down at rest; "
            "expected specific force, which points up; are the axes other ones: try  --body FRD  "
            "or  --body FLU"
        )
    return ImuLog(
        start_s=float(time_s[0] - np.median(np.diff(time_s))),
        noise=NOISE if vehicle is None else vehicle.imu_noise,
        time_s=time_s,
        gyro_b=table[:, 1:4],
        accel_b=accel_b,
    )


def _imu_notes(imu: ImuLog, topic: BagTopic, vehicle: Vehicle | None) -> list[str]:
    steps = np.diff(imu.time_s)
    notes = [
        f"{topic.name}: {1.0 / np.median(steps):.1f} samples per second, each taken as the mean "
        "over the interval that ends at its stamp."
    ]
    if vehicle is None:
        notes.append(
            "No --vehicle: the IMU is taken for a consumer MEMS unit (100 deg/h, 0.4 deg/sqrt(h), "
            "5 mg), and DVL, depth sensor and antenna as sitting at the IMU, the DVL's forward "
            "mark ahead."
        )
    return notes


def _dvl(
    bag: Path, table: Array, topic: BagTopic, vehicle: Vehicle | None, options: RosOptions
) -> tuple[DvlLog, list[str]]:
    n = options.n_beams
    edges = np.cumsum([1, n, n, n, 3, 9])
    _, speed, sigma, ranges, velocity_d, covariance, water = np.split(table, edges, axis=1)
    water_track = water[:, 0] if water.any() else None
    if not np.isfinite(speed).any():
        if vehicle is not None and _has_axes(vehicle.mount) and np.isfinite(velocity_d).any():
            return _velocities(table[:, 0], velocity_d, covariance, vehicle, water_track)
        raise DataError(
            f"{bag}: topic {topic.name} holds {len(table)} messages and not one beam speed; "
            "expected the speeds of the beams, not only the velocity made of them (for "
            "marine_acoustic_msgs: beam_velocities_valid, num_good_beams and beam_velocity; for "
            "dvl_msgs: velocity_valid and beams); for an instrument that has only the velocity, "
            "give a --vehicle whose beam_vectors are its three axes"
        )
    try:
        beams = _beams(topic, vehicle, options, speed=speed, velocity_d=velocity_d)
    except DataError as error:
        raise DataError(f"{bag}: topic {topic.name}: {error}") from None
    notes = list(beams.notes)
    if vehicle is None and np.isnan(sigma).any():
        notes.append(f"Beam speeds without a stated variance are given {BEAM_SIGMA} m/s.")
    mount = (
        DvlMount(beams_d=beams.beams_d, R_bd=np.eye(3), lever_arm_b=np.zeros(3))
        if vehicle is None
        else replace(vehicle.mount, beams_d=beams.beams_d)
    )
    log = DvlLog(
        mount=mount,
        time_s=table[:, 0],
        speed=beams.sign * speed,
        sigma=counted_sigma(
            sigma,
            water[:, 0] > 0.0,
            ground_sigma=BEAM_SIGMA if vehicle is None else vehicle.beam_sigma,
            water_sigma=None if vehicle is None else vehicle.water_sigma,
        ),
        range_m=ranges if np.isfinite(ranges).any() else None,
        water_track=water_track,
    )
    return log, notes


def _has_axes(mount: DvlMount) -> bool:
    """Return whether an instrument has its three axes for beams: a velocity alone."""
    beams_d = mount.beams_d
    return mount.n_beams == 3 and np.allclose(beams_d @ beams_d.T, np.eye(3), atol=1e-6)


def _velocities(
    time_s: Array, velocity_d: Array, covariance: Array, vehicle: Vehicle, water_track: Array | None
) -> tuple[DvlLog, list[str]]:
    """Return velocities (N, 3) as speeds along the instrument's axes, and how they are counted."""
    turn = vehicle.mount.beams_d
    matrix = turn @ covariance.reshape(-1, 3, 3) @ turn.T
    is_stated = np.asarray(np.isfinite(matrix).all(axis=(1, 2)))
    is_stated[is_stated] = np.linalg.eigvalsh(matrix[is_stated])[:, 0] > 0.0
    matrix = np.where(is_stated[:, None, None], matrix, np.nan)
    sigma = np.full(velocity_d.shape, vehicle.beam_sigma)
    sigma[is_stated] = np.sqrt(np.diagonal(matrix[is_stated], axis1=1, axis2=2))
    log = DvlLog(
        mount=vehicle.mount,
        time_s=time_s,
        speed=velocity_d @ turn.T,
        sigma=sigma,
        water_track=water_track,
        covariance=matrix if is_stated.any() else None,
    )
    return log, [
        f"The DVL's messages hold no beam speeds: its velocity counts, with the covariance that "
        f"{is_stated.sum()} of {len(time_s)} messages state."
    ]


def _beams(topic: BagTopic, vehicle: Vehicle | None, options: RosOptions, **data: Array) -> Beams:
    if vehicle is not None:
        return known_beams(vehicle.mount.beams_d, **data)
    return proven_beams(
        topic.beams_d,
        water_linked=topic.type_name == WATER_LINKED_TYPE,
        may_turn=options.beam_sign is BeamSign.ALONG,
        **data,
    )


def _gnss(
    table: Array | None, read: Mapping[str, BagTopic], vehicle: Vehicle | None, options: RosOptions
) -> tuple[GnssLog | None, list[str]]:
    if table is None or len(table) == 0:
        return None, []
    topic, sigma = read["gnss"], options.fix_sigma_enu
    notes = []
    if topic.n_unstated:
        notes.append(
            f"{topic.name}: {topic.n_unstated} fixes do not say how good they are and are given "
            f"{sigma[0]:g}, {sigma[1]:g}, {sigma[2]:g} m east, north, up."
        )
    known = GNSS_AT_ORIGIN if vehicle is None else vehicle.gnss
    time_s, lat, lon, height, *sigmas = table.T
    sigma_enu = np.column_stack(sigmas)
    place = {"lat": lat, "lon": lon, "height": height, "sigma_enu": sigma_enu}
    return replace(known, time_s=time_s, **place), notes


def _depth(
    bag: Path,
    table: Array | None,
    gnss: GnssLog | None,
    vehicle: Vehicle | None,
    options: RosOptions,
) -> tuple[DepthLog | None, list[str]]:
    if table is None or len(table) == 0:
        return None, []
    typical = float(np.median(table[:, 1])) + (options.surface_height or 0.0)
    if not -_ABOVE_WATER_M < typical < DEEPEST_M:
        raise DataError(
            f"{bag}: the pressures are those of {typical:.1f} m depth; expected absolute pressure "
            f"in pascal; for a sensor that reads 0 at the surface try  --atmosphere 0"
        )
    stated = table[np.isfinite(table[:, 2]), 2]
    sigma = float(np.median(stated)) if len(stated) else DEPTH_SIGMA
    known = None if vehicle is None else vehicle.depth
    if known is None:
        known = DepthLog(sigma=sigma, lever_arm_b=np.zeros(3), **DEPTH.empty())
    log = replace(known, time_s=table[:, 0], depth=table[:, 1])
    notes = [
        f"Depth is pressure above {options.atmosphere:.0f} Pa in water of "
        f"{options.water_density:g} kg/m^3, with a sigma of {log.sigma:.3g} m."
    ]
    if options.surface_height is not None:
        return log, notes
    surface, note = _surface(log, gnss)
    return replace(log, depth=log.depth - surface), [*notes, note]


def _surface(depth: DepthLog, gnss: GnssLog | None) -> tuple[float, str]:
    """Return the height of the water's surface above the ellipsoid by the fixes, and how."""
    if gnss is not None:
        both = (gnss.valid_s >= depth.time_s[0]) & (gnss.valid_s <= depth.time_s[-1])
        if both.any():
            below = np.interp(gnss.valid_s[both], depth.time_s, depth.true_depth)
            lower = depth.lever_arm_b[2] - gnss.lever_arm_b[2]  # of a level vehicle
            surface = float(np.median(gnss.height[both] + below - lower))
            return surface, (
                f"The water's surface is {surface:.2f} m above the ellipsoid, by {both.sum()} "
                "fixes and the pressure at their times; state it with  --surface-height  if it "
                "is known."
            )
    return 0.0, (
        "No fix shows the height of the water's surface: it is taken as 0 m above the ellipsoid."
    )


@dataclass(slots=True)
class BagTopic:
    """What one topic held: the rows of its messages, and what went wrong."""

    role: str
    name: str = ""
    type_name: str = ""
    rows: array[float] = field(default_factory=lambda: array("d"))
    """IMU: time, gyro, accelerometer; DVL: time, speeds, sigmas, ranges, velocity and covariance, 1
    off the water; depth: time, depth, sigma; GNSS: time, latitude, longitude, height, sigmas. SI
    units, FRD, NaN if unknown."""
    n_messages: int = 0
    refused: list[str] = field(default_factory=list)
    beams_d: Array | None = None
    """(B, 3) directions of the beams as the messages state them."""
    n_unstated: int = 0
    """Fixes that do not say how good they are."""


def _width(role: str, n_beams: int) -> int:
    """Return how many numbers a row has."""
    return {"imu": 7, "dvl": 1 + 3 * n_beams + 13, "depth": 3, "gnss": 7}[role]


def _read_topics(bag: Path, topics: Mapping[str, str], options: RosOptions) -> dict[str, BagTopic]:
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
        if len(topic.rows) < 2 * _width(role, options.n_beams):
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


def _in_order(topic: BagTopic, n_beams: int) -> tuple[Array, list[str]]:
    """Return the rows with strictly increasing times, and what that took."""
    table = np.array(topic.rows, dtype=float).reshape(-1, _width(topic.role, n_beams))
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
