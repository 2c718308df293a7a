"""Import of ROS 2 bags as missions.

Times are those of the message headers, receipt where a header has none.  What messages do not say
comes from a vehicle, or is assumed and said in the mission's notes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.ros.beams import Beams, known_beams, proven_beams
from ssm_graph.io.ros.messages import STANDARD_GRAVITY, WATER_LINKED_TYPE, BeamSign, RosOptions
from ssm_graph.io.ros.rows import BagTopic, in_order, read_topics
from ssm_graph.mission.mission import InitialState, Mission
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.depth import DEEPEST_M, DepthCalibration, DepthLog
from ssm_graph.sensors.dvl import DvlLog, DvlMount
from ssm_graph.sensors.gnss import GnssCalibration, GnssLog
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

_GAP_STEPS: Final = 5.0
_GRAVITY_SHARE: Final = 0.1
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

    Parameters
    ----------
    bag : folder with ``metadata.yaml``, or a single ``.mcap`` or ``.db3`` file.
    vehicle : noise, lever arms and mounting; its beam directions go before those of the messages.
    topics : by role (``imu``, ``dvl``, ``depth``, ``gnss``), where several could serve it.
    options : axes of the IMU, water, atmosphere; None for the defaults.

    Raises
    ------
    MissingExtraError
        ``rosbags`` is not installed.
    ConfigError
        A choice of topics is open or wrong, or nothing says where on Earth the mission was.
    DataError
        The recording is damaged, or its messages cannot be what they say they are.
    """
    bag, options = Path(bag), RosOptions() if options is None else options
    read = read_topics(bag, topics or {}, options)
    tables, notes = {}, []
    for role, topic in read.items():
        tables[role], some = in_order(topic)
        notes += some
    imu = _imu(bag, tables["imu"], vehicle, options)
    notes += _imu_notes(imu, read["imu"], vehicle)
    dvl, some = _dvl(bag, tables["dvl"], read["dvl"], vehicle, options)
    _check_same_clock(bag, imu, dvl, read)
    notes += some
    gnss, some = _gnss(tables.get("gnss"), read, vehicle, options)
    notes += some
    depth, some = _depth(bag, tables.get("depth"), gnss, vehicle, options)
    initial, initial_notes = _initial(imu, vehicle)
    return Mission(
        name=bag.stem,
        frame=_frame(bag, vehicle, gnss),
        imu=imu,
        dvl=dvl,
        depth=depth,
        gnss=gnss,
        initial=initial,
        notes=(*notes, *some, *initial_notes),
    )


def _imu(bag: Path, table: Array, vehicle: Vehicle | None, options: RosOptions) -> ImuLog:
    if len(table) < 2:
        raise DataError(f"{bag}: the IMU's messages all have the same time")
    _check_force(bag, table[:, 4:7], options)
    time_s = table[:, 0]
    return ImuLog(
        start_s=float(time_s[0] - np.median(np.diff(time_s))),
        noise=NOISE if vehicle is None else vehicle.imu_noise,
        time_s=time_s,
        gyro_b=table[:, 1:4],
        accel_b=table[:, 4:7],
    )


def _check_force(bag: Path, accel_b: Array, options: RosOptions) -> None:
    """Refuse accelerations that are no specific force in m/s^2, or in other axes than stated."""
    size = float(np.median(np.linalg.norm(accel_b, axis=1)))
    down = float(np.median(accel_b[:, 2]))
    if abs(size / STANDARD_GRAVITY - 1.0) > _GRAVITY_SHARE:
        in_g = abs(size - 1.0) < _GRAVITY_SHARE
        hint = "are they in g?" if in_g else "did the driver take gravity out, or scale them?"
        raise DataError(
            f"{bag}: linear_acceleration has a median length of {size:.4g}; expected about "
            f"{STANDARD_GRAVITY:.2f} m/s^2 (specific force, REP 145); {hint}"
        )
    if down > 0.5 * size:
        raise DataError(
            f"{bag}: in {options.body.value} axes, linear_acceleration points down at rest; "
            "expected specific force, which points up; are the axes other ones: try  --body FRD  "
            "or  --body FLU"
        )


def _imu_notes(imu: ImuLog, topic: BagTopic, vehicle: Vehicle | None) -> list[str]:
    steps = np.diff(imu.time_s)
    notes = [
        f"{topic.name}: {1.0 / np.median(steps):.1f} samples per second, each taken as the mean "
        "over the interval that ends at its stamp."
    ]
    gaps = steps > _GAP_STEPS * np.median(steps)
    if gaps.any():
        row = int(np.argmax(steps))
        notes.append(
            f"{topic.name}: {gaps.sum()} gaps, the longest {steps[row]:.2f} s, "
            f"{imu.time_s[row] - imu.start_s:.1f} s after the begin."
        )
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
    _, speed, sigma, ranges, velocity_d, water = np.split(table, [1, 5, 9, 13, 16], axis=1)
    if not np.isfinite(speed).any():
        raise DataError(
            f"{bag}: topic {topic.name} holds {len(table)} messages and not one beam speed; "
            "expected the speeds of the beams, not only the velocity made of them (for "
            "marine_acoustic_msgs: beam_velocities_valid, num_good_beams and beam_velocity; for "
            "dvl_msgs: velocity_valid and beams)"
        )
    try:
        beams = _beams(topic, vehicle, options, speed=speed, velocity_d=velocity_d)
    except DataError as error:
        raise DataError(f"{bag}: topic {topic.name}: {error}") from None
    nominal = BEAM_SIGMA if vehicle is None else vehicle.beam_sigma
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
        sigma=np.where(np.isnan(sigma), nominal, sigma),
        range_m=ranges if np.isfinite(ranges).any() else None,
        water_track=water[:, 0] if water.any() else None,
    )
    return log, notes


def _beams(topic: BagTopic, vehicle: Vehicle | None, options: RosOptions, **data: Array) -> Beams:
    if vehicle is not None:
        return known_beams(vehicle.mount.beams_d, **data)
    return proven_beams(
        topic.beams_d,
        water_linked=topic.type_name == WATER_LINKED_TYPE,
        may_turn=options.beam_sign is BeamSign.ALONG,
        **data,
    )


def _check_same_clock(bag: Path, imu: ImuLog, dvl: DvlLog, read: Mapping[str, BagTopic]) -> None:
    if dvl.time_s[-1] < imu.start_s or dvl.time_s[0] > imu.time_s[-1]:
        raise DataError(
            f"{bag}: the stamps of {read['dvl'].name} run from {dvl.time_s[0]:.3f} to "
            f"{dvl.time_s[-1]:.3f} s, those of {read['imu'].name} from {imu.start_s:.3f} to "
            f"{imu.time_s[-1]:.3f} s; expected one clock; is one stamped by the instrument's own?"
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
    known = GnssCalibration() if vehicle is None else vehicle.gnss_calibration
    log = GnssLog(
        time_s=table[:, 0] - known.time_offset_s,
        lat=table[:, 1],
        lon=table[:, 2],
        height=table[:, 3],
        sigma_enu=table[:, 4:7],
        lever_arm_b=np.zeros(3) if vehicle is None else vehicle.gnss_lever_arm_b,
        calibration=known,
    )
    return log, notes


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
    known = DepthCalibration() if vehicle is None else vehicle.depth_calibration
    log = DepthLog(
        sigma=sigma if vehicle is None or vehicle.depth_sigma is None else vehicle.depth_sigma,
        time_s=table[:, 0],
        depth=table[:, 1] - known.offset,
        lever_arm_b=np.zeros(3) if vehicle is None else vehicle.depth_lever_arm_b,
        calibration=known,
    )
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
        both = (gnss.time_s >= depth.time_s[0]) & (gnss.time_s <= depth.time_s[-1])
        if both.any():
            below = np.interp(gnss.time_s[both], depth.time_s, depth.depth)
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


def _initial(imu: ImuLog, vehicle: Vehicle | None) -> tuple[InitialState | None, list[str]]:
    if vehicle is None or vehicle.initial is None:
        return None, []
    if imu.start_s <= vehicle.initial.time_s <= imu.time_s[-1]:
        return vehicle.initial, []
    return None, [
        f"[initial] of the vehicle file is for {vehicle.initial.time_s:.3f} s, outside the "
        "recording, and not used."
    ]


def _frame(bag: Path, vehicle: Vehicle | None, gnss: GnssLog | None) -> LocalFrame:
    if vehicle is not None and vehicle.frame is not None:
        return vehicle.frame
    if gnss is not None:
        return LocalFrame(float(gnss.lat[0]), float(gnss.lon[0]), float(gnss.height[0]))
    raise ConfigError(
        f"{bag}: nothing says where on Earth the recording was made: it holds no usable NavSatFix; "
        "give  --vehicle FILE  with [origin]"
    )
