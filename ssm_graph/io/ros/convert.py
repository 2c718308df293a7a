"""Import of ROS bags as missions.

Times are those of the message headers, receipt where a header has none.  What messages do not say
comes from a vehicle, or is assumed and said in the mission's notes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.instruments.assumed import BEAM_SIGMA, DEPTH_SIGMA, NOISE
from ssm_graph.io.mission_folder.assembly import mission_from
from ssm_graph.io.ros.aids import AID_TYPES
from ssm_graph.io.ros.beams import Beams, known_beams, proven_beams
from ssm_graph.io.ros.clocks import ahead_of_recording, check_never_set, check_one_clock
from ssm_graph.io.ros.frames import seats
from ssm_graph.io.ros.log import Topics
from ssm_graph.io.ros.messages import (
    TWIST_TYPE,
    WATER_LINKED_TYPES,
    BeamSign,
    RosOptions,
)
from ssm_graph.io.ros.topics import BagTopic, in_order, read_topics
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.vehicle import GNSS_AT_ORIGIN, Vehicle
from ssm_graph.sensors.depth import DEEPEST_M, DEPTH, DepthLog
from ssm_graph.sensors.dvl import DvlLog, DvlMount, counted_sigma
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.sensors.registry import BY_SECTION

_ABOVE_WATER_M: Final = 2.0


def convert_rosbag(
    bag: Path,
    *,
    vehicle: Vehicle | None = None,
    topics: Topics | None = None,
    options: RosOptions | None = None,
) -> Mission:
    """Read a recording of ROS 2 or ROS 1 into a mission without reference.

    Times stay Unix seconds, body axes are forward-right-down. Everything assumed, dropped or
    sorted is in the mission's notes.

    Raises :class:`MissingExtraError`: ``rosbags`` is not installed. Raises :class:`ConfigError`: a
    choice of topics is open or wrong, or nothing says where on Earth the mission was. Raises
    :class:`DataError`: the recording is damaged, or its messages cannot be what they say they are.

    Parameters
    ----------
    bag : folder of ``.mcap`` or ``.db3`` files, one of them, or a ``.bag`` of ROS 1.
    vehicle : noise, lever arms and mounting; its beam directions go before those of the messages.
    topics : by role (``imu``, ``dvl``, ``depth``, ``gnss``), where several could serve it; two of
        the DVL where its pings off the water have a topic of their own. Further aids are read where
        their topics are named, by section (``usbl``, ``ranges`` ...) of the vehicle.
    options : axes of the IMU, water, atmosphere; None for the defaults.
    """
    bag, options = Path(bag), RosOptions() if options is None else options
    if vehicle is not None:
        options = replace(options, n_beams=vehicle.mount.n_beams)
    tables, notes = {}, list[str]()
    bare = _bare_aids(topics or {}, vehicle)
    read, frames = read_topics(bag, topics or {}, options, notes)
    read, some = _one_clock(bag, read, vehicle, options)
    notes += some
    for role, topic in read.items():
        tables[role], some = in_order(topic, options.n_beams)
        notes += some
    imu = _imu(bag, tables["imu"], vehicle, options)
    notes += _imu_notes(imu, read["imu"], vehicle)
    dvl, some = _dvl(bag, tables["dvl"], read["dvl"], vehicle, options)
    notes += some
    gnss, some = _gnss(tables.get("gnss"), read, vehicle, options)
    notes += some
    arm_b = np.zeros(3)
    if vehicle is None:
        placed, some = seats(frames, {r: topic.frame_id for r, topic in read.items()}, options.body)
        notes += some
        if "dvl" in placed:
            R_bd, dvl_arm_b = placed["dvl"]
            dvl = replace(dvl, mount=replace(dvl.mount, R_bd=R_bd, lever_arm_b=dvl_arm_b))
        if gnss is not None and "gnss" in placed:
            gnss = replace(gnss, lever_arm_b=placed["gnss"].place)
        arm_b = placed["depth"].place if "depth" in placed else arm_b
    depth, some = _depth(bag, tables.get("depth"), gnss, vehicle, arm_b, options)
    aids = [
        BY_SECTION[role].log_of(tables[role], log)
        for role, log in bare.items()
        if len(tables.get(role, ()))
    ]
    return mission_from(
        [log for log in (imu, dvl, depth, gnss, *aids) if log is not None],
        vehicle,
        source=bag,
        labels={role: f"{bag}: {topic.name}" for role, topic in read.items()},
        notes=[*notes, *some],
    )


def _bare_aids(topics: Topics, vehicle: Vehicle | None) -> dict[str, Any]:
    """Return by role what the vehicle says of the further aids that are asked for."""
    known = {} if vehicle is None else {type(log): log for log in vehicle.aids}
    wanted = [role for role in topics if role in AID_TYPES]
    for role in wanted:
        if BY_SECTION[role].log not in known:
            raise ConfigError(
                f"--topic {role}: expected a --vehicle with [{role}], which says how good it "
                "is and where it sits; got none"
            )
    return {role: known[BY_SECTION[role].log] for role in wanted}


def _one_clock(
    bag: Path, read: Mapping[str, BagTopic], vehicle: Vehicle | None, options: RosOptions
) -> tuple[dict[str, BagTopic], list[str]]:
    """Return the topics with stamps of one clock, by their times of recording, and the notes."""
    ahead = {}
    for role, topic in read.items():
        if len(topic.rows):
            stamp_s, received_s = topic.table(options.n_beams)[:, 0], np.array(topic.received)
            if role not in AID_TYPES:  # which come when they come
                check_never_set(f"{bag}: {topic.name}", stamp_s, received_s)
            ahead[role] = (topic.name, ahead_of_recording(stamp_s, received_s))
    late = {}
    if vehicle is not None:
        late = {
            "dvl": vehicle.mount.time_offset_s,
            "gnss": vehicle.gnss.calibration.time_offset_s,
        }
    take_off, notes = check_one_clock(bag, ahead, late)
    return {
        role: replace(topic, take_off_s=take_off.get(role, 0.0)) for role, topic in read.items()
    }, notes


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
            "5 mg), and DVL, depth sensor and antenna, where /tf_static says nothing else, as "
            "sitting at the IMU, the DVL's forward mark ahead."
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
        is_alone = topic.type_name == TWIST_TYPE and vehicle is None
        mount = DvlMount(np.eye(3), np.eye(3), np.zeros(3)) if vehicle is None else vehicle.mount
        if (is_alone or (vehicle and _has_axes(mount))) and np.isfinite(velocity_d).any():
            sigma_m = BEAM_SIGMA if vehicle is None else vehicle.beam_sigma
            return _velocities(table[:, 0], velocity_d, covariance, mount, sigma_m, water_track)
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
    time_s: Array,
    velocity_d: Array,
    covariance: Array,
    mount: DvlMount,
    nominal: float,
    water_track: Array | None,
) -> tuple[DvlLog, list[str]]:
    """Return velocities (N, 3) as speeds along the instrument's axes, and how they are counted."""
    turn = mount.beams_d
    matrix = turn @ covariance.reshape(-1, 3, 3) @ turn.T
    is_stated = np.asarray(np.isfinite(matrix).all(axis=(1, 2)))
    is_stated[is_stated] = np.linalg.eigvalsh(matrix[is_stated])[:, 0] > 0.0
    matrix = np.where(is_stated[:, None, None], matrix, np.nan)
    sigma = np.full(velocity_d.shape, nominal)
    sigma[is_stated] = np.sqrt(np.diagonal(matrix[is_stated], axis1=1, axis2=2))
    log = DvlLog(
        mount=mount,
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
        water_linked=topic.type_name in WATER_LINKED_TYPES,
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
    arm_b: Array,
    options: RosOptions,
) -> tuple[DepthLog | None, list[str]]:
    if table is None or len(table) == 0:
        return None, []
    typical = float(np.median(table[:, 1])) + (options.surface_height or 0.0)
    if not -_ABOVE_WATER_M < typical < DEEPEST_M:
        raise DataError(
            f"{bag}: the pressures are those of {typical:.1f} m depth; expected absolute pressure "
            f"in pascal; {_other_pressures(typical, options)}"
        )
    stated = table[np.isfinite(table[:, 2]), 2]
    sigma = float(np.median(stated)) if len(stated) else DEPTH_SIGMA
    known = None if vehicle is None else vehicle.depth
    if known is None:
        known = DepthLog(sigma=sigma, lever_arm_b=arm_b, **DEPTH.empty())
    log = replace(known, time_s=table[:, 0], depth=table[:, 1])
    notes = [
        f"Depth is pressure above {options.atmosphere:.0f} Pa in water of "
        f"{options.water_density:g} kg/m^3, with a sigma of {log.sigma:.3g} m."
    ]
    if options.surface_height is not None:
        return log, notes
    surface, note = _surface(log, gnss)
    return replace(log, depth=log.depth - surface), [*notes, note]


def _other_pressures(depth: float, options: RosOptions) -> str:
    """Return what the pressures of a depth that cannot be may be."""
    value = depth * options.weight_density + options.atmosphere
    meant = []
    for unit, pascal in (("hPa or mbar", 1e2), ("kPa", 1e3), ("dbar", 1e4), ("bar", 1e5)):
        below = (value * pascal - options.atmosphere) / options.weight_density
        if -_ABOVE_WATER_M < below < DEEPEST_M:
            meant.append(f"{below:.1f} m in {unit}")
    gauge = value / options.weight_density
    if -_ABOVE_WATER_M < gauge < DEEPEST_M:
        meant.append(
            f"{gauge:.1f} m if the sensor reads 0 at the surface (then give  --atmosphere 0)"
        )
    return f"they would be {', '.join(meant)}: mend the driver's unit" if meant else "see its unit"


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
