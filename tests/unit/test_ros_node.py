"""The ROS 2 node of the examples, on a fake node: what goes in, what comes out."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from examples.ros2_node import ssm_graph_node as node_module
from examples.ros2_node.ssm_graph_node import (
    PARAMETERS,
    UNKNOWN_VARIANCE,
    Bridge,
    fill_fix,
    fill_odometry,
    main,
    ros_class,
    subscriptions,
)
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.ros.messages import IMU_TYPE, WATER_LINKED_TYPE
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from tests.helpers import simulated

FRAME = LocalFrame(math.radians(45.7), math.radians(126.6), 10.0)


def blank(type_name: str = "") -> Any:
    """Return an Odometry and a NavSatFix in one, as `rclpy` makes them: all fields there."""

    def vector() -> SimpleNamespace:
        return SimpleNamespace(x=0.0, y=0.0, z=0.0)

    pose = SimpleNamespace(position=vector(), orientation=SimpleNamespace(**vars(vector()), w=1.0))
    twist = SimpleNamespace(linear=vector(), angular=vector())
    return SimpleNamespace(
        kind=type_name,
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id=""),
        child_frame_id="",
        pose=SimpleNamespace(pose=pose, covariance=[]),
        twist=SimpleNamespace(twist=twist, covariance=[]),
        status=SimpleNamespace(status=-1, service=0),
        latitude=0.0,
        longitude=0.0,
        altitude=0.0,
        position_covariance=[],
        position_covariance_type=0,
    )


def navigation(
    *, attitude_deg: tuple[float, float, float] = (0.0, 0.0, 90.0), **changes: Any
) -> Navigation:
    """Return an answer 100 m east, 50 m north and 7 m below the origin of the frame."""
    lat, lon, height = FRAME.geodetic_from_p_n(np.array([100.0, 50.0, -7.0]))
    fields: dict[str, Any] = {
        "time_s": 1_700_000_000.25,
        "lat": float(lat),
        "lon": float(lon),
        "height": float(height),
        "health": Health.GOOD,
        "reason": "all agree",
        "confidence": 1.0,
        "bottom_lock": True,
        "since_aid_s": 0.1,
        "latency_s": 0.01,
        "velocity_enu": [1.0, 2.0, 0.5],
        "roll_pitch_heading": np.radians(attitude_deg),
        "position_sigma_enu": [1.0, 2.0, 3.0],
        "velocity_sigma_enu": [0.1, 0.2, 0.3],
        "attitude_sigma": [0.01, 0.02, 0.03],
        "gyro_bias": np.zeros(3),
        "accel_bias": np.zeros(3),
        "beam_weights": np.ones(4),
    }
    return Navigation(**fields | changes)


def odometry(answer: Navigation) -> Any:
    """Return the answer as a filled message."""
    return fill_odometry(blank(), answer, frame=FRAME, map_frame="map", body_frame="base_link")


def rotation_of(message: Any) -> Rotation:
    """Return the orientation of a message."""
    q = message.pose.pose.orientation
    return Rotation.from_quat([q.x, q.y, q.z, q.w])


def test_pose_is_east_north_up() -> None:
    """Position about the frame's origin, stamp to the nanosecond, names of both frames."""
    message = odometry(navigation())
    position = message.pose.pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], [100, 50, -7], atol=1e-6)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 250_000_000)
    assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")


@pytest.mark.parametrize(
    ("attitude_deg", "forward", "left"),
    [
        ((0.0, 0.0, 90.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
        ((0.0, 30.0, 90.0), (math.sqrt(0.75), 0.0, 0.5), (0.0, 1.0, 0.0)),
        ((30.0, 0.0, 90.0), (1.0, 0.0, 0.0), (0.0, math.sqrt(0.75), 0.5)),
    ],
)
def test_orientation_is_forward_left_up(
    attitude_deg: tuple[float, float, float],
    forward: tuple[float, float, float],
    left: tuple[float, float, float],
) -> None:
    """REP 103: heading east is no turn; nose up raises forward, starboard down raises left."""
    axes = rotation_of(odometry(navigation(attitude_deg=attitude_deg))).as_matrix()
    np.testing.assert_allclose(axes[:, 0], forward, atol=1e-4)  # 100 m off, the level is another
    np.testing.assert_allclose(axes[:, 1], left, atol=1e-4)


def test_twist_is_in_body_axes() -> None:
    """Heading north, moving north is forward, moving east is to starboard: left is minus."""
    message = odometry(navigation(attitude_deg=(0.0, 0.0, 0.0)))
    linear = message.twist.twist.linear
    np.testing.assert_allclose([linear.x, linear.y, linear.z], [2.0, -1.0, 0.5], atol=1e-4)
    covariance = np.reshape(message.twist.covariance, (6, 6))
    np.testing.assert_allclose(np.diag(covariance)[:3], [0.04, 0.01, 0.09], rtol=1e-3)
    assert np.all(np.diag(covariance)[3:] == UNKNOWN_VARIANCE)


@pytest.mark.parametrize(
    ("heading_deg", "about_xyz"), [(90.0, [0.01, 0.02, 0.03]), (0.0, [0.02, 0.01, 0.03])]
)
def test_pose_covariance_is_about_fixed_axes(heading_deg: float, about_xyz: list[float]) -> None:
    """Row by row; roll turns about east when heading east, about north when heading north."""
    message = odometry(navigation(attitude_deg=(0.0, 0.0, heading_deg)))
    assert len(message.pose.covariance) == 36
    assert all(type(value) is float for value in message.pose.covariance)
    covariance = np.reshape(message.pose.covariance, (6, 6))
    np.testing.assert_allclose(np.diag(covariance)[:3], [1.0, 4.0, 9.0], rtol=1e-4)
    np.testing.assert_allclose(np.diag(covariance)[3:], np.square(about_xyz), rtol=1e-3)
    np.testing.assert_allclose(covariance, covariance.T)


def test_pose_covariance_against_differences() -> None:
    """At a large tilt: angles moved by one sigma each, seen as turns about the fixed axes."""
    attitude, sigma = np.array([25.0, -40.0, 130.0]), np.degrees([0.01, 0.02, 0.03])
    middle = rotation_of(odometry(navigation(attitude_deg=tuple(attitude))))
    total = np.zeros((3, 3))
    for axis in np.diag(sigma) * 1e-3:
        moved = rotation_of(odometry(navigation(attitude_deg=tuple(attitude + axis))))
        turn = (moved * middle.inv()).as_rotvec() * 1e3
        total += np.outer(turn, turn)
    message = odometry(navigation(attitude_deg=tuple(attitude)))
    got = np.reshape(message.pose.covariance, (6, 6))[3:, 3:]
    np.testing.assert_allclose(got, total, rtol=1e-3, atol=1e-7)


def test_fix_is_the_position() -> None:
    """Degrees and ellipsoidal height, diagonal covariance, status of a fix."""
    answer = navigation()
    message = fill_fix(blank(), answer, body_frame="base_link")
    assert message.latitude == pytest.approx(math.degrees(answer.lat))
    assert message.longitude == pytest.approx(math.degrees(answer.lon))
    assert message.altitude == answer.height
    assert message.position_covariance == [1.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0]
    assert (message.position_covariance_type, message.status.status) == (2, 0)


class FakeEstimator:
    """Keeps what it is given."""

    def __init__(self) -> None:
        self.pushed: list[Message] = []
        self.answer: Navigation | None = None
        self.events: tuple[Event, ...] = ()

    def push(self, message: Message) -> None:
        """Keep a message."""
        self.pushed.append(message)

    def newest(self) -> Navigation | None:
        """Return the answer."""
        return self.answer

    def take_events(self) -> tuple[Event, ...]:
        """Hand the events over."""
        events, self.events = self.events, ()
        return events


class FakeNode:
    """The part of an ``rclpy`` node that the bridge uses."""

    def __init__(self) -> None:
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.published: dict[str, list[Any]] = {}
        self.timers: list[tuple[float, Callable[[], None]]] = []
        self.log: list[tuple[str, str]] = []
        self.set_parameters: dict[str, Any] = {}

    def create_subscription(
        self, _: Any, topic: str, callback: Callable[[Any], None], __: Any
    ) -> None:
        """Keep the callback."""
        self.callbacks[topic] = callback

    def create_publisher(self, _: Any, topic: str, __: int) -> Any:
        """Return what keeps messages."""
        sent = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=sent.append)

    def create_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        """Keep the timer."""
        self.timers.append((period_s, callback))

    def declare_parameter(self, name: str, default: Any) -> Any:
        """Return a parameter as it was set, else its default."""
        return SimpleNamespace(value=self.set_parameters.get(name, default))

    def destroy_node(self) -> None:
        """Go."""

    def get_clock(self) -> Any:
        """Return a clock that stands still."""
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=5_500_000_000))

    def get_logger(self) -> Any:
        """Return what keeps texts."""

        def level(name: str) -> Callable[[str], None]:
            return lambda text: self.log.append((name, text))

        return SimpleNamespace(info=level("info"), warning=level("warning"), error=level("error"))


@pytest.fixture
def setup() -> tuple[FakeNode, FakeEstimator, Bridge]:
    """Return a bridge between fakes."""
    node, estimator = FakeNode(), FakeEstimator()
    bridge = Bridge(
        node,
        estimator,
        parameters=PARAMETERS,
        message_class=lambda type_name: lambda: blank(type_name),
        frame=FRAME,
    )
    return node, estimator, bridge


def imu_message(rate: float = 0.1) -> Any:
    """Return an IMU message without stamp."""
    message = blank()
    message.angular_velocity = SimpleNamespace(x=rate, y=0.2, z=0.3)
    message.linear_acceleration = SimpleNamespace(x=0.0, y=0.0, z=9.8)
    message.angular_velocity_covariance = message.linear_acceleration_covariance = [0.0] * 9
    return message


def test_subscriptions_are_data() -> None:
    """All four by default; an empty topic is left out; the DVL's type is a parameter."""
    assert len(subscriptions(PARAMETERS)) == 4
    fewer = {**PARAMETERS, "fix_topic": "", "dvl_type": WATER_LINKED_TYPE}
    assert [one.type_name for one in subscriptions(fewer)][1] == WATER_LINKED_TYPE
    assert len(subscriptions(fewer)) == 3
    with pytest.raises(ConfigError, match="dvl_type: expected marine_acoustic_msgs"):
        subscriptions({**PARAMETERS, "dvl_type": "nav_msgs/msg/Odometry"})


def test_messages_reach_the_estimator(setup: tuple[FakeNode, FakeEstimator, Bridge]) -> None:
    """Converted, with the node's clock where the stamp is zero."""
    node, estimator, _ = setup
    node.callbacks["/imu/data"](imu_message())
    assert estimator.pushed == [ImuSample(5.5, (0.1, -0.2, -0.3), (0.0, 0.0, -9.8))]


def test_refused_messages_are_logged_once(setup: tuple[FakeNode, FakeEstimator, Bridge]) -> None:
    """A broken driver must not fill the log."""
    node, estimator, bridge = setup
    for _ in range(3):
        node.callbacks["/imu/data"](imu_message(math.nan))
    assert estimator.pushed == []
    assert [level for level, _ in node.log] == ["warning"]
    assert bridge.refused == {"/imu/data": 3}


def test_answers_are_published_once(setup: tuple[FakeNode, FakeEstimator, Bridge]) -> None:
    """New ones only, at the asked rate, and none that must not be used."""
    node, estimator, _ = setup
    ((period_s, publish),) = node.timers
    assert period_s == pytest.approx(0.1)
    publish()
    for health in (Health.ALIGNING, Health.BAD):
        estimator.answer = navigation(health=health)
        publish()
    assert node.published == {"~/odometry": [], "~/fix": []}
    estimator.answer = navigation(health=Health.DEGRADED)
    publish()
    publish()
    assert [message.kind for message in node.published["~/odometry"]] == ["nav_msgs/msg/Odometry"]
    assert len(node.published["~/fix"]) == 1
    assert node.published["~/odometry"][0].pose.pose.position.x == pytest.approx(100.0)


def test_without_origin_the_first_answer_is_one() -> None:
    """Then the pose begins at zero."""
    node, estimator = FakeNode(), FakeEstimator()
    Bridge(
        node,
        estimator,
        parameters=PARAMETERS,
        message_class=lambda type_name: lambda: blank(type_name),
        frame=None,
    )
    estimator.answer = navigation()
    node.timers[0][1]()
    assert node.published["~/odometry"][0].pose.pose.position.x == pytest.approx(0.0, abs=1e-6)


def test_events_are_logged(setup: tuple[FakeNode, FakeEstimator, Bridge]) -> None:
    """Each with its severity."""
    node, estimator, bridge = setup
    estimator.events = tuple(
        Event(1.0, severity, "bottom_lost", "no beam since 3 s") for severity in Severity
    )
    bridge.publish()
    bridge.publish()
    assert [level for level, _ in node.log] == ["info", "warning", "error"]
    assert node.log[0][1] == "1.000 s, bottom_lost: no beam since 3 s"


def test_message_classes_come_from_their_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """``package/msg/Name`` is ``package.msg.Name``."""
    package, module = ModuleType("sensor_msgs"), ModuleType("sensor_msgs.msg")
    vars(module)["Imu"] = SimpleNamespace
    monkeypatch.setitem(sys.modules, "sensor_msgs", package)
    monkeypatch.setitem(sys.modules, "sensor_msgs.msg", module)
    assert ros_class(IMU_TYPE) is SimpleNamespace


def test_without_ros_it_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One sentence, exit code 2."""

    def absent(name: str) -> ModuleType:
        raise ImportError(name)

    monkeypatch.setattr(node_module, "import_module", absent)
    assert main() == 2
    assert "source its setup.bash" in capsys.readouterr().err


def test_main_wires_everything(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Parameters, vehicle, estimator and topics; stopped by hand it ends with 0."""
    write_mission(tmp_path, simulated(duration_s=2.0).mission)
    node, spun = FakeNode(), []

    class StoppedError(Exception):
        """As `rclpy` raises when it is told to stop."""

    def spin(_: Any) -> None:
        spun.append(sorted(node.callbacks))
        raise StoppedError

    modules: dict[str, Any] = {
        "rclpy": SimpleNamespace(
            init=lambda args: args, create_node=lambda _: node, spin=spin, ok=lambda: False
        ),
        "rclpy.qos": SimpleNamespace(
            QoSProfile=dict, ReliabilityPolicy=SimpleNamespace(BEST_EFFORT=2)
        ),
        "rclpy.executors": SimpleNamespace(ExternalShutdownException=StoppedError),
        "ssm_graph.live.estimator": SimpleNamespace(FixedLagSmoother=lambda _: FakeEstimator()),
    }
    classes = dict.fromkeys(("Imu", "Dvl", "FluidPressure", "NavSatFix", "Odometry"), blank)
    monkeypatch.setattr(
        node_module, "import_module", lambda name: modules.get(name, SimpleNamespace(**classes))
    )
    node.set_parameters = {"vehicle": str(tmp_path), "fix_topic": ""}
    assert main() == 0
    assert spun == [["/dvl/data", "/imu/data", "/pressure"]]
    node.set_parameters = {"vehicle": str(tmp_path / "nowhere.toml")}
    assert main() == 2
    assert "nowhere.toml" in capsys.readouterr().err
