"""A ROS 2 node around the live estimator: IMU, DVL and aids in, Odometry and fixes out.

    python3 ssm_graph_node.py --ros-args -p vehicle:=vehicle.toml -p imu_topic:=/imu/data

Needs a sourced ROS 2 with ``rclpy``, and the package of the DVL's messages. Parameters, each with
its default, are `PARAMETERS`. Published are ``~/odometry`` (pose in east-north-up about the
vehicle's origin or the first answer, body axes forward-left-up) and ``~/fix``, both only while the
answer may be used; what happens on the way goes to the log.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from fractions import Fraction
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError, SsmGraphError
from ssm_graph.base.frames import (
    R_FRD,
    BodyAxes,
    R_lb_from_roll_pitch_heading,
    phi_D_roll_pitch_heading,
)
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import SEA_WATER, STANDARD_ATMOSPHERE
from ssm_graph.io.mission_folder.vehicle import read_vehicle
from ssm_graph.io.ros.aids import AID_TYPES, aid_message
from ssm_graph.io.ros.messages import (
    CONVERTERS,
    FIX_TYPE,
    IMU_TYPE,
    MARINE_DVL_TYPE,
    PRESSURE_TYPE,
    WATER_LINKED_TYPE,
    BeamSign,
    RosOptions,
)
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.sensors.messages import Message

ODOMETRY_TYPE: Final = "nav_msgs/msg/Odometry"
DVL_TYPES: Final = (MARINE_DVL_TYPE, WATER_LINKED_TYPE)
QUEUE: Final = 500
"""Messages that may wait; a fast IMU must not lose samples while an update runs."""
UNKNOWN_VARIANCE: Final = 1e6
"""Of the turn rate, which is not published."""
R_FRD_FLU: Final = R_FRD[BodyAxes.FLU]

PARAMETERS: Final[Mapping[str, str | float | bool]] = {
    "vehicle": "vehicle.toml",
    "imu_topic": "/imu/data",
    "dvl_topic": "/dvl/data",
    "dvl_type": MARINE_DVL_TYPE,
    "pressure_topic": "/pressure",
    "fix_topic": "/gps/fix",
    "usbl_topic": "",
    "ranges_topic": "",
    "heading_topic": "",
    "heading_type": AID_TYPES["heading"][0],
    "magnetometer_topic": "",
    "at_rest_topic": "",
    "body": BodyAxes.FLU.value,
    "beams_against": False,
    "water_density": SEA_WATER,
    "atmosphere": STANDARD_ATMOSPHERE,
    "surface_height": 0.0,
    "map_frame": "map",
    "body_frame": "base_link",
    "rate_hz": 10.0,
}
"""An empty topic is not subscribed to; numbers are written with a decimal point. What a further aid
is, ``vehicle.toml`` says in the section of its name."""


class Estimator(Protocol):
    """What the node needs of ``ssm_graph.live.estimator.FixedLagSmoother``."""

    def push(self, message: Message) -> None:
        """Take one message; bad ones become events."""

    def newest(self) -> Navigation | None:
        """Return the newest answer."""

    def take_events(self) -> tuple[Event, ...]:
        """Return what happened since the last call."""


class Subscription(NamedTuple):
    """A topic, the type of its messages, and what makes them ours."""

    topic: str
    type_name: str
    convert: Callable[[Any, float, RosOptions], Message | None]


def subscriptions(parameters: Mapping[str, Any]) -> tuple[Subscription, ...]:
    """Return what to subscribe to; a type of messages that is not known is a ConfigError."""
    for name, known in (("dvl_type", DVL_TYPES), ("heading_type", AID_TYPES["heading"])):
        if parameters[name] not in known:
            raise ConfigError(f"{name}: expected {' or '.join(known)}, got {parameters[name]!r}")
    types = {
        "imu": IMU_TYPE,
        "dvl": parameters["dvl_type"],
        "pressure": PRESSURE_TYPE,
        "fix": FIX_TYPE,
    }
    own = [
        Subscription(parameters[f"{x}_topic"], kind, CONVERTERS[kind]) for x, kind in types.items()
    ]
    aids = [
        Subscription(
            parameters[f"{section}_topic"],
            parameters.get(f"{section}_type", kinds[0]),
            partial(aid_message, section),
        )
        for section, kinds in AID_TYPES.items()
    ]
    return tuple(one for one in (*own, *aids) if one.topic)


def ros_options(parameters: Mapping[str, Any]) -> RosOptions:
    """Return what the messages do not say."""
    return RosOptions(
        body=BodyAxes(parameters["body"]),
        beam_sign=BeamSign.AGAINST if parameters["beams_against"] else BeamSign.ALONG,
        water_density=float(parameters["water_density"]),
        atmosphere=float(parameters["atmosphere"]),
        surface_height=float(parameters["surface_height"]),
    )


def fill_odometry(
    message: Any, navigation: Navigation, *, frame: LocalFrame, map_frame: str, body_frame: str
) -> Any:
    """Fill a ``nav_msgs/Odometry`` and return it.

    The pose is that of the body (forward-left-up) in ``frame`` (east-north-up), its covariance
    about the axes of ``frame``; the twist is in body axes. Covariances are 6x6, row by row; that of
    the turn rate, which is left zero, is `UNKNOWN_VARIANCE`.
    """
    p_n = frame.p_n_from_geodetic(navigation.lat, navigation.lon, navigation.height)
    R_nl = frame.R_nl_at(p_n)
    roll, pitch, heading = navigation.roll_pitch_heading
    R_nb = R_nl @ R_lb_from_roll_pitch_heading(roll, pitch, heading)
    R_nf = R_nb @ R_FRD_FLU
    R_lf = R_nl.T @ R_nf
    pose, twist = np.zeros((6, 6)), UNKNOWN_VARIANCE * np.eye(6)
    pose[:3, :3] = R_nl @ np.diag(navigation.position_sigma_enu**2) @ R_nl.T
    phi = R_nb @ phi_D_roll_pitch_heading(roll, pitch)
    pose[3:, 3:] = phi @ np.diag(navigation.attitude_sigma**2) @ phi.T
    twist[:3, :3] = R_lf.T @ np.diag(navigation.velocity_sigma_enu**2) @ R_lf
    _stamp(message, navigation.time_s, map_frame)
    message.child_frame_id = body_frame
    _set(message.pose.pose.position, "xyz", p_n)
    _set(message.pose.pose.orientation, "xyzw", Rotation.from_matrix(R_nf).as_quat())
    message.pose.covariance = pose.ravel().tolist()
    _set(message.twist.twist.linear, "xyz", R_lf.T @ navigation.velocity_enu)
    message.twist.covariance = twist.ravel().tolist()
    return message


def fill_fix(message: Any, navigation: Navigation, *, body_frame: str) -> Any:
    """Fill a ``sensor_msgs/NavSatFix`` of the body's origin and return it."""
    _stamp(message, navigation.time_s, body_frame)
    message.status.status = 0
    message.latitude = float(np.degrees(navigation.lat))
    message.longitude = float(np.degrees(navigation.lon))
    message.altitude = float(navigation.height)
    message.position_covariance = np.diag(navigation.position_sigma_enu**2).ravel().tolist()
    message.position_covariance_type = 2  # the diagonal is known
    return message


class Bridge:
    """Between topics and estimator; knows no ROS but the node it is given."""

    def __init__(
        self,
        node: Any,
        estimator: Estimator,
        *,
        parameters: Mapping[str, Any],
        message_class: Callable[[str], Any],
        frame: LocalFrame | None,
        quality: Any = QUEUE,
    ) -> None:
        """Subscribe and advertise.

        ``frame`` is that of the pose, None for one about the first answer; ``quality`` is the
        subscriptions' quality of service.
        """
        self.node, self.estimator, self.frame = node, estimator, frame
        self.parameters, self.message_class = parameters, message_class
        self.options = ros_options(parameters)
        self.refused: dict[str, int] = {}
        self.published_s = -np.inf
        for one in subscriptions(parameters):
            receive = partial(self.receive, one)
            node.create_subscription(message_class(one.type_name), one.topic, receive, quality)
        self.odometry = node.create_publisher(message_class(ODOMETRY_TYPE), "~/odometry", 10)
        self.fix = node.create_publisher(message_class(FIX_TYPE), "~/fix", 10)
        node.create_timer(1.0 / float(parameters["rate_hz"]), self.publish)

    def receive(self, wanted: Subscription, message: Any) -> None:
        """Convert one message and pass it on; the first that a topic has refused is logged."""
        received_s, topic = self.node.get_clock().now().nanoseconds / 1e9, wanted.topic
        try:
            converted = wanted.convert(message, received_s, self.options)
        except DataError as error:
            self.refused[topic] = self.refused.get(topic, 0) + 1
            if self.refused[topic] == 1:
                self.node.get_logger().warning(f"{topic}: {error}; further ones are only counted")
            return
        if converted is not None:
            self.estimator.push(converted)

    def publish(self) -> None:
        """Publish the newest answer, if it is new and may be used, and log what happened."""
        for event in self.estimator.take_events():
            logger = self.node.get_logger()
            log = {
                Severity.INFO: logger.info,
                Severity.WARNING: logger.warning,
                Severity.ERROR: logger.error,
            }
            log[event.severity](f"{event.time_s:.3f} s, {event.kind}: {event.text}")
        navigation = self.estimator.newest()
        if navigation is None or navigation.health in (Health.ALIGNING, Health.BAD):
            return
        if navigation.time_s <= self.published_s:
            return
        self.published_s = navigation.time_s
        if self.frame is None:
            self.frame = LocalFrame(navigation.lat, navigation.lon, navigation.height)
        odometry, fix = self.message_class(ODOMETRY_TYPE)(), self.message_class(FIX_TYPE)()
        map_frame, body_frame = self.parameters["map_frame"], self.parameters["body_frame"]
        fill_odometry(
            odometry, navigation, frame=self.frame, map_frame=map_frame, body_frame=body_frame
        )
        self.odometry.publish(odometry)
        self.fix.publish(fill_fix(fix, navigation, body_frame=body_frame))


def ros_class(type_name: str) -> Any:
    """Return the class of ``package/msg/Name``."""
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def main() -> int:
    """Run the node until it is stopped; 2 is returned where ROS or a setting is missing."""
    try:
        rclpy, qos = import_module("rclpy"), import_module("rclpy.qos")
        stopped = (KeyboardInterrupt, import_module("rclpy.executors").ExternalShutdownException)
    except ImportError:
        print("this node needs ROS 2 with rclpy: source its setup.bash first", file=sys.stderr)
        return 2
    rclpy.init(args=sys.argv)
    node = rclpy.create_node("ssm_graph")
    try:
        parameters = {
            name: node.declare_parameter(name, default).value
            for name, default in PARAMETERS.items()
        }
        vehicle = read_vehicle(Path(parameters["vehicle"]))
        estimator = import_module("ssm_graph.live.estimator").FixedLagSmoother(vehicle)
        quality = qos.QoSProfile(depth=QUEUE, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
        Bridge(
            node,
            estimator,
            parameters=parameters,
            message_class=ros_class,
            frame=vehicle.frame,
            quality=quality,
        )
        rclpy.spin(node)
    except (SsmGraphError, ImportError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except stopped:
        pass
    finally:
        node.destroy_node()
        if rclpy.ok():
            rclpy.shutdown()
    return 0


def _stamp(message: Any, time_s: float, frame_id: str) -> None:
    sec, nanosec = divmod(round(Fraction(time_s) * 10**9), 10**9)
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    message.header.frame_id = frame_id


def _set(target: Any, names: str, values: Array) -> None:
    for name, value in zip(names, values, strict=True):
        setattr(target, name, float(value))


if __name__ == "__main__":
    sys.exit(main())
