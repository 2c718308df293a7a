"""ROS bags made of a simulated mission, for tests of their reading."""

from __future__ import annotations

import re
import sqlite3
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from rosbags import rosbag1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ssm_graph.base.frames import R_FRD, BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.io.ros.log import LAYOUTS
from ssm_graph.mission.mission import Mission

IMU, MARINE, WATER_LINKED = (
    "sensor_msgs/msg/Imu",
    "marine_acoustic_msgs/msg/Dvl",
    "dvl_msgs/msg/DVL",
)
PRESSURE, FIX = "sensor_msgs/msg/FluidPressure", "sensor_msgs/msg/NavSatFix"
EPOCH_S = 1_700_000_000


class Sent(NamedTuple):
    """One message before it is written."""

    topic: str
    type_name: str
    nanoseconds: int
    message: Any


class Ros:
    """A maker of messages by the definitions of one layout of ``dvl_msgs``."""

    def __init__(self, layout: int = 0) -> None:
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.store.register(get_types_from_msg(LAYOUTS[MARINE][0], MARINE))
        self.store.register(get_types_from_msg(LAYOUTS[WATER_LINKED][layout], WATER_LINKED))
        self.has_times = "time_of_validity" in LAYOUTS[WATER_LINKED][layout]
        self.has_cov = " cov\n" in LAYOUTS[WATER_LINKED][layout]
        self.has_covariance = " covariance\n" in LAYOUTS[WATER_LINKED][layout]

    def new(self, type_name: str, **fields: Any) -> Any:
        """Return a message of a type."""
        return self.store.types[type_name](**fields)

    def vector(self, values: Any) -> Any:
        """Return a ``geometry_msgs/Vector3``."""
        x, y, z = (float(value) for value in values)
        return self.new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def header(self, nanoseconds: int) -> Any:
        """Return a header."""
        sec, nanosec = divmod(nanoseconds, 10**9)
        stamp = self.new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id="")

    def sent(self, topic: str, type_name: str, time_s: float, **fields: Any) -> Sent:
        """Return a message with its header, recorded at the time of its stamp."""
        at = EPOCH_S * 10**9 + round(time_s * 1e9)
        return Sent(topic, type_name, at, self.new(type_name, header=self.header(at), **fields))

    def imu(self, time_s: float, gyro: Any, accel: Any, topic: str = "/imu") -> Sent:
        """Return an IMU message, vectors in the axes of the message."""
        return self.sent(
            topic,
            IMU,
            time_s,
            orientation=self.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.r_[-1.0, np.zeros(8)],
            angular_velocity=self.vector(gyro),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.vector(accel),
            linear_acceleration_covariance=np.zeros(9),
        )

    def marine(
        self, time_s: float, *, speed: Any, beams_d: Any, velocity: Any, **more: Any
    ) -> Sent:
        """Return a ``marine_acoustic_msgs/Dvl``; missing beams are 0 with range -1."""
        missing = np.isnan(speed)
        fields = {
            "velocity_mode": 1,
            "dvl_type": 0,
            "velocity": self.vector(velocity),
            "velocity_covar": np.full(9, -1.0),
            "altitude": 20.0,
            "course_gnd": 0.0,
            "speed_gnd": 0.0,
            "num_good_beams": int(np.sum(~missing)),
            "sound_speed": 1500.0,
            "beam_ranges_valid": True,
            "beam_velocities_valid": True,
            "beam_unit_vec": [self.vector(beam) for beam in beams_d],
            "range": np.where(missing, -1.0, 25.0),
            "range_covar": np.full(4, -1.0, dtype=np.float32),
            "beam_quality": np.zeros(4, dtype=np.float32),
            "beam_velocity": np.where(missing, 0.0, speed).astype(np.float32),
            "beam_velocity_covar": np.full(4, -1.0, dtype=np.float32),
        }
        return self.sent("/dvl", MARINE, time_s, **fields | more)

    def water_linked(self, time_s: float, *, speed: Any, velocity: Any) -> Sent:
        """Return a ``dvl_msgs/DVL`` of the maker's layout."""
        beams = [
            self.new(
                "dvl_msgs/msg/DVLBeam",
                id=i,
                velocity=float(np.nan_to_num(one)),
                distance=25.0,
                rssi=-30.0,
                nsd=-90.0,
                valid=bool(np.isfinite(one)),
            )
            for i, one in enumerate(speed)
        ]
        fields: dict[str, Any] = {"covariance": np.zeros(9)} if self.has_covariance else {}
        fields |= {"cov": [self.vector((0, 0, 0))] * 3} if self.has_cov else {}
        if self.has_times:
            fields |= {"time_of_validity": 17 * 10**14, "time_of_transmission": 17 * 10**14}
        return self.sent(
            "/dvl/data",
            WATER_LINKED,
            time_s,
            time=100.0,
            velocity=self.vector(velocity),
            fom=0.002,
            altitude=20.0,
            beams=beams,
            velocity_valid=True,
            status=0,
            form="json_v3.1",
            **fields,
        )

    def pressure(self, time_s: float, depth: float) -> Sent:
        """Return the pressure at a depth below a surface on the ellipsoid."""
        value = 101_325.0 + 1025.0 * 9.80665 * depth
        return self.sent("/pressure", PRESSURE, time_s, fluid_pressure=value, variance=0.0)

    def fix(self, time_s: float, lat_lon_height: Any, sigma: Any, *, status: int = 0) -> Sent:
        """Return a fix of known covariance; angles in radians."""
        lat, lon, height = lat_lon_height
        return self.sent(
            "/gps/fix",
            FIX,
            time_s,
            status=self.new("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=float(np.degrees(lat)),
            longitude=float(np.degrees(lon)),
            altitude=float(height),
            position_covariance=np.diag(np.square(sigma)).ravel(),
            position_covariance_type=2,
        )


def velocities(mission: Mission, beams_d: Array) -> Array:
    """Return what the instrument makes of its beams, 0 where one is missing."""
    return np.asarray(np.nan_to_num(mission.dvl.speed @ np.linalg.pinv(beams_d).T))


def imu_messages(mission: Mission, ros: Ros, *, axes: BodyAxes = BodyAxes.FLU) -> list[Sent]:
    """Return the inertial samples in the given axes."""
    imu, turn = mission.imu, R_FRD[axes]  # each of these is its own inverse
    rows = zip(imu.time_s, imu.gyro_b @ turn, imu.accel_b @ turn, strict=True)
    return [ros.imu(*row) for row in rows]


def marine_messages(mission: Mission, ros: Ros, **more: Any) -> list[Sent]:
    """Return the pings as ``marine_acoustic_msgs``; ``more`` may hold ``sign`` and fields."""
    beams_d = more.pop("beams_d", mission.dvl.mount.beams_d)
    sign = more.pop("sign", 1.0)
    rows = zip(
        mission.dvl.time_s,
        sign * mission.dvl.speed,
        velocities(mission, mission.dvl.mount.beams_d),
        strict=True,
    )
    return [ros.marine(t, speed=s, beams_d=beams_d, velocity=v, **more) for t, s, v in rows]


def aid_messages(mission: Mission, ros: Ros) -> list[Sent]:
    """Return pressures and fixes."""
    depth, gnss = mission.depth, mission.gnss
    assert depth is not None
    assert gnss is not None
    places = np.column_stack([gnss.lat, gnss.lon, gnss.height])
    return [
        *(ros.pressure(*row) for row in zip(depth.time_s, depth.depth, strict=True)),
        *(ros.fix(*row) for row in zip(gnss.time_s, places, gnss.sigma_enu, strict=True)),
    ]


def marine_bag(mission: Mission, ros: Ros) -> list[Sent]:
    """Return all messages of a mission."""
    return [
        *imu_messages(mission, ros),
        *marine_messages(mission, ros),
        *aid_messages(mission, ros),
    ]


def write_bag(
    path: Path, ros: Ros, sent: list[Sent], plugin: StoragePlugin = StoragePlugin.MCAP
) -> Path:
    """Write messages in the order of their recording; return the folder."""
    with Writer(path, version=8, storage_plugin=plugin) as writer:
        connections = {
            (topic, kind): writer.add_connection(topic, kind, typestore=ros.store)
            for topic, kind in dict.fromkeys((item.topic, item.type_name) for item in sent)
        }
        for item in sorted(sent, key=lambda item: item.nanoseconds):
            raw = ros.store.serialize_cdr(item.message, item.type_name)
            writer.write(connections[item.topic, item.type_name], item.nanoseconds, raw)
    return path


def ros1_bag(path: Path, mission: Mission, ros: Ros) -> Path:
    """Write a bag of ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(LAYOUTS[MARINE][0], MARINE))
    with rosbag1.Writer(path) as writer:
        connections: dict[str, Any] = {}
        for item in sorted(marine_bag(mission, ros), key=lambda one: one.nanoseconds):
            if item.topic not in connections:
                connections[item.topic] = writer.add_connection(
                    item.topic, item.type_name, typestore=store
                )
            old = deepcopy(item.message)
            stamp, frame = old.header.stamp, old.header.frame_id
            old.header = store.types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id=frame)
            raw = store.serialize_ros1(old, item.type_name)
            writer.write(connections[item.topic], item.nanoseconds, raw)
    return path


def forget_definitions(bag: Path) -> Path:
    """Take the message definitions out of a db3 bag, which Humble does not write."""
    with sqlite3.connect(bag / f"{bag.name}.db3") as database:
        database.execute("DELETE FROM message_definitions")
        database.execute("UPDATE topics SET type_description_hash = ''")
    database.close()
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(re.sub(r"RIHS01_[0-9a-f]{64}", "''", text))
    return bag


def assert_times(got: Array, wanted: Array) -> None:
    """Compare times up to the nanosecond of a stamp and the float of a Unix time."""
    np.testing.assert_allclose(got - EPOCH_S, wanted, rtol=0.0, atol=3e-7)


def assert_same(got: Mission, wanted: Mission) -> None:
    """Compare all tables; beam speeds go through 32 bits."""
    assert_times(got.imu.time_s, wanted.imu.time_s)
    assert got.imu.start_s - EPOCH_S == pytest.approx(wanted.imu.start_s, abs=1e-6)
    np.testing.assert_array_equal(got.imu.gyro_b, wanted.imu.gyro_b)
    np.testing.assert_array_equal(got.imu.accel_b, wanted.imu.accel_b)
    assert_times(got.dvl.time_s, wanted.dvl.time_s)
    np.testing.assert_allclose(got.dvl.speed, wanted.dvl.speed, rtol=6e-8)
    for log, truth in ((got.depth, wanted.depth), (got.gnss, wanted.gnss)):
        assert log is not None
        assert truth is not None
        assert_times(log.time_s, truth.time_s)
    assert got.depth is not None
    assert got.gnss is not None
    assert wanted.depth is not None
    assert wanted.gnss is not None
    np.testing.assert_allclose(got.depth.depth, wanted.depth.depth, rtol=0.0, atol=1e-9)
    for name in ("lat", "lon", "height", "sigma_enu"):
        np.testing.assert_allclose(
            getattr(got.gnss, name), getattr(wanted.gnss, name), rtol=1e-15, atol=1e-15
        )
