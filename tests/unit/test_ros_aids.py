"""Further aids as messages of ROS: out of a bag as they went in, on the vehicle as in the batch."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from examples.ros2_node.ssm_graph_node import PARAMETERS, Bridge
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import R_FRD, BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.io.ros.aids import AID_TYPES, aid_message
from ssm_graph.io.ros.convert import convert_rosbag
from ssm_graph.io.ros.messages import RosOptions
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.mission.mission import Aids, Mission
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.acoustic import AcousticRange, RangeLog, UsblFix, UsblLog
from ssm_graph.sensors.compass import HeadingLog, HeadingReading
from ssm_graph.sensors.magnetometer import MagneticReading, MagnetometerLog
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.standstill import RestLog, RestReading, Standstill
from ssm_graph.simulation import GnssSettings
from ssm_graph.smoothers.fixed_lag import solve_fixed_lag
from tests.aids_fixture import with_every_aid
from tests.rosbag_fixture import EPOCH_S, Ros, Sent, marine_bag, write_bag

TOPICS = {section: f"/{section}" for section in AID_TYPES}
REST_S = np.array([3.0, 3.5, 4.0])


@pytest.fixture(scope="module")
def mission() -> Mission:
    """Return a mission with all of them, who is on board saying that it stands."""
    gnss = GnssSettings(windows=((0.0, 9.0),))
    found = with_every_aid(duration_s=12.0, gnss=gnss).mission
    rest = RestLog(0.5, REST_S, np.full(3, np.nan))
    others = (log for log in found.aids if not isinstance(log, Standstill))
    return replace(found, aids=Aids(*others, rest))


def quaternion(heading: float) -> dict[str, float]:
    """Return the orientation of a level body, forward-left-up, in east-north-up."""
    half = 0.5 * (0.5 * math.pi - heading)
    return {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)}


def aid_bag(mission: Mission, ros: Ros) -> list[Sent]:
    """Return the aids of a mission as drivers publish them; acoustics come late."""
    usbl, ranges = mission.aids[UsblLog], mission.aids[RangeLog]
    compass, magnetic = mission.aids[HeadingLog], mission.aids[MagnetometerLog]
    sent = []
    places = np.column_stack([usbl.lat, usbl.lon, usbl.height])
    for row in zip(usbl.valid_s, places, usbl.sigma_enu, usbl.delay_s, strict=True):
        one = ros.fix(*row[:3])
        late = one.nanoseconds + round(1e9 * row[3])
        sent.append(one._replace(topic="/usbl", nanoseconds=late))
    for time_s, number, reach in zip(ranges.time_s, ranges.beacon, ranges.range_m, strict=True):
        kind, fields = AID_TYPES["ranges"][0], dict.fromkeys(("field_of_view", "max_range"), 0.0)
        fields |= {"radiation_type": 0, "min_range": 0.0, "range": float(reach)}
        one = ros.sent("/ranges", kind, time_s, **fields)
        one.message.header.frame_id = f"beacon_{number:.0f}"
        sent.append(one)
    for time_s, heading in zip(compass.time_s, compass.heading, strict=True):
        turn = ros.new("geometry_msgs/msg/Quaternion", **quaternion(float(heading)))
        sent.append(ros.sent("/heading", AID_TYPES["heading"][0], time_s, quaternion=turn))
    covariance = {"magnetic_field_covariance": np.zeros(9)}
    for time_s, field_b in zip(magnetic.time_s, magnetic.field_b, strict=True):
        field = ros.vector(R_FRD[BodyAxes.FLU] @ field_b)
        kind = AID_TYPES["magnetometer"][0]
        sent.append(ros.sent("/magnetometer", kind, time_s, magnetic_field=field, **covariance))
    for time_s in REST_S.tolist():
        at, message = round(1e9 * (EPOCH_S + time_s)), ros.new(AID_TYPES["at_rest"][0], data=True)
        sent.append(Sent("/at_rest", AID_TYPES["at_rest"][0], at, message))
    return sent


def of_epoch(time_s: Array) -> Array:
    """Return times since the begin of the mission."""
    return np.asarray(time_s - EPOCH_S)


def test_a_bag_has_the_aids_that_are_named(mission: Mission, tmp_path: Path) -> None:
    """As the vehicle describes them; nothing is guessed, and none is read that is not named."""
    ros = Ros()
    bag = write_bag(tmp_path / "bag", ros, [*marine_bag(mission, ros), *aid_bag(mission, ros)])
    with pytest.raises(ConfigError, match="2 topics could be the gnss: /gps/fix, /usbl"):
        convert_rosbag(bag, vehicle=vehicle_of(mission))
    with pytest.raises(ConfigError, match=r"expected a --vehicle with \[usbl\]"):
        convert_rosbag(bag, topics=TOPICS)
    found = convert_rosbag(bag, vehicle=replace(vehicle_of(mission), initial=None), topics=TOPICS)
    assert found.gnss is not None
    times: dict[type, str] = dict.fromkeys(
        (RangeLog, HeadingLog, MagnetometerLog, RestLog), "time_s"
    )
    for kind, name in (times | {UsblLog: "valid_s"}).items():
        own_s, other_s = (getattr(one.aids[kind], name) for one in (found, mission))
        np.testing.assert_allclose(of_epoch(own_s), other_s, rtol=0.0, atol=3e-7)
    turn = found.aids[HeadingLog].heading - mission.aids[HeadingLog].heading
    np.testing.assert_allclose(np.sin(turn), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cos(turn), 1.0, atol=1e-12)
    field_b = mission.aids[MagnetometerLog].field_b
    np.testing.assert_allclose(found.aids[MagnetometerLog].field_b, field_b, rtol=1e-12)
    ranges, other = found.aids[RangeLog], mission.aids[RangeLog]
    np.testing.assert_array_equal(ranges.beacon, other.beacon)
    np.testing.assert_allclose(ranges.range_m, other.range_m, rtol=1e-7)
    np.testing.assert_allclose(found.aids[UsblLog].lat, mission.aids[UsblLog].lat, rtol=1e-15)


class Boat:
    """The part of an ``rclpy`` node that the bridge uses; its clock is that of the recording."""

    def __init__(self) -> None:
        self.callbacks: dict[str, Any] = {}
        self.now_s = 0.0
        self.warnings: list[str] = []

    def create_subscription(self, _: Any, topic: str, callback: Any, __: Any) -> None:
        """Keep the callback."""
        self.callbacks[topic] = callback

    def create_publisher(self, *_: Any) -> None:
        """Nobody listens."""

    def create_timer(self, *_: Any) -> None:
        """Nothing is published."""

    def get_clock(self) -> Any:
        """Return the clock."""
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(1e9 * self.now_s)))

    def get_logger(self) -> Any:
        """Return what keeps warnings."""
        return SimpleNamespace(warning=self.warnings.append)


class Told:
    """An estimator that keeps what it is told, and passes it on."""

    def __init__(self, estimator: FixedLagSmoother) -> None:
        self.messages: list[Message] = []
        self.estimator = estimator

    def push(self, message: Message) -> None:
        """Take a message; its times become those of the mission again."""
        message = replace(message, time_s=message.time_s - EPOCH_S)
        self.messages.append(message)
        self.estimator.push(message)


def test_topics_aid_the_vehicle_as_the_batch(mission: Mission) -> None:
    """IMU, DVL and depth as they are, the aids by the node's topics: the window's answer."""
    ros, vehicle, node = Ros(), vehicle_of(mission), Boat()
    told = Told(FixedLagSmoother(vehicle))
    topics = {f"{section}_topic": topic for section, topic in TOPICS.items()}
    none = dict.fromkeys(("imu_topic", "dvl_topic", "pressure_topic", "fix_topic"), "")
    Bridge(
        node,
        told,  # type: ignore[arg-type]
        parameters={**PARAMETERS, **none, **topics},
        message_class=lambda name: name,
        frame=None,
    )
    assert set(node.callbacks) == set(TOPICS.values())
    kinds = (UsblFix, AcousticRange, HeadingReading, MagneticReading, RestReading)
    others = [m for m in messages_of(mission) if not isinstance(m, kinds)]
    begin = EPOCH_S * 10**9
    arrivals: list[tuple[int, Any]] = [(begin + round(1e9 * m.time_s), m) for m in others]
    arrivals += [(one.nanoseconds, one) for one in aid_bag(mission, ros)]
    for nanoseconds, one in sorted(arrivals, key=lambda item: item[0]):
        node.now_s = nanoseconds / 1e9
        if isinstance(one, Sent):
            node.callbacks[one.topic](one.message)
        else:
            told.estimator.push(one)
    assert node.warnings == []
    assert told.estimator.counts == {}
    assert {type(message) for message in told.messages} == set(kinds)
    course = told.estimator._course
    assert course is not None
    problem = build_problem(mission)
    newest, answer = course.newest.window.newest, solve_fixed_lag(problem, ONLINE).newest.trajectory
    k = int(np.argmin(np.abs(answer.time_s - newest.time_s[0])))
    p_n = problem.frame.p_n_from_geodetic(answer.lat[k], answer.lon[k], answer.height[k])
    sigma = np.sqrt(np.diagonal(answer.position_cov_enu[k]))
    assert np.all(np.abs(newest.states.p_n[0] - p_n) < 1e-2 * sigma)


def header(frame_id: str = "") -> Any:
    """Return a header."""
    return SimpleNamespace(stamp=SimpleNamespace(sec=5, nanosec=0), frame_id=frame_id)


def test_what_cannot_be_used_is_refused() -> None:
    """With what was expected; who says that the vehicle moves says nothing."""
    for frame_id, reach, why in (("acoustics", 5.0, "beacon's number"), ("b7", 0.0, "above zero")):
        with pytest.raises(DataError, match=why):
            aid_message("ranges", SimpleNamespace(header=header(frame_id), range=reach), 9.0)
    far = SimpleNamespace(header=header("b7"), range=40.0, variance=0.04)
    assert aid_message("ranges", far, 9.0) == AcousticRange(5.0, 7.0, 40.0, 0.2)
    nowhere = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
    with pytest.raises(DataError, match="got one that is zero"):
        aid_message("heading", SimpleNamespace(header=header(), quaternion=nowhere), 9.0)
    without = {"orientation_covariance": [-1.0], "orientation": nowhere}
    with pytest.raises(DataError, match="no orientation"):
        aid_message("heading", SimpleNamespace(header=header(), **without), 9.0)
    field = SimpleNamespace(x=math.nan, y=0.0, z=0.0)
    with pytest.raises(DataError, match="field_b is not a finite number"):
        aid_message("magnetometer", SimpleNamespace(header=header(), magnetic_field=field), 9.0)
    assert aid_message("at_rest", SimpleNamespace(data=False), 9.0) is None
    assert aid_message("at_rest", SimpleNamespace(data=True), 9.0) == RestReading(9.0)


@pytest.mark.parametrize(("axes", "ahead"), [(BodyAxes.FLU, 0.0), (BodyAxes.RFU, -0.5 * math.pi)])
def test_heading_of_either_axes(axes: BodyAxes, ahead: float) -> None:
    """Yaw 0 looks east with x, or north with y where y is ahead."""
    level = SimpleNamespace(**quaternion(0.3 + 0.5 * math.pi + ahead - 0.5 * math.pi))
    message = SimpleNamespace(header=header(), orientation=level, orientation_covariance=[0.0])
    found = aid_message("heading", message, 9.0, RosOptions(body=axes))
    assert isinstance(found, HeadingReading)
    wanted = 0.3 if axes is BodyAxes.FLU else 0.3 + ahead - 0.5 * math.pi
    assert math.cos(found.heading - wanted) == pytest.approx(1.0, abs=1e-12)
