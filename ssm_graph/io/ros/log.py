"""Reading of rosbag2 recordings without ROS: which topics there are, and their messages one by one.

A recording is the folder with ``metadata.yaml``, or one of its ``.mcap`` or ``.db3`` files alone.
Bags of ROS 2 Humble and before carry no message definitions in ``.db3`` files; those of the DVL
packages are therefore kept here, in every layout they have had.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

from ssm_graph.base.errors import (
    ConfigError,
    DataError,
    MissingExtraError,
    SsmGraphError,
    nearest_hint,
)
from ssm_graph.io.ros import messages as ros_messages
from ssm_graph.sensors.dvl import MOST_BEAMS

ROLES: Final[Mapping[str, tuple[str, ...]]] = {
    "imu": (ros_messages.IMU_TYPE,),
    "dvl": (ros_messages.MARINE_DVL_TYPE, ros_messages.WATER_LINKED_TYPE),
    "depth": (ros_messages.PRESSURE_TYPE,),
    "gnss": (ros_messages.FIX_TYPE,),
}
"""What a topic is for, and the message types that serve it."""
REQUIRED_ROLES: Final = ("imu", "dvl")

_MARINE_DVL: Final = """
std_msgs/Header header
uint8 velocity_mode
uint8 dvl_type
geometry_msgs/Vector3 velocity
float64[9] velocity_covar
float64 altitude
float64 course_gnd
float64 speed_gnd
uint8 num_good_beams
float32 sound_speed
bool beam_ranges_valid
bool beam_velocities_valid
geometry_msgs/Vector3[4] beam_unit_vec
float64[4] range
float32[4] range_covar
float32[4] beam_quality
float32[4] beam_velocity
float32[4] beam_velocity_covar
"""
_WATER_LINKED: Final = """
std_msgs/Header header
float64 time
geometry_msgs/Vector3 velocity
float64 fom
{covariance}
float64 altitude
{beams} beams
bool velocity_valid
int64 status
{times}
string form
================================================================================
MSG: dvl_msgs/DVLBeam
int64 id
float64 velocity
float64 distance
float64 rssi
float64 nsd
bool valid
"""
_TIMES: Final = "int64 time_of_validity\nint64 time_of_transmission"
LAYOUTS: Final[Mapping[str, tuple[str, ...]]] = {
    ros_messages.MARINE_DVL_TYPE: (_MARINE_DVL,),
    ros_messages.WATER_LINKED_TYPE: tuple(
        _WATER_LINKED.format(covariance=covariance, beams=beams, times=times)
        for covariance, beams, times in (
            ("float64[] covariance", "DVLBeam[]", _TIMES),
            ("", "DVLBeam[]", ""),
            ("geometry_msgs/Vector3[] cov", "DVLBeam[]", ""),
            ("float64[9] covariance", "DVLBeam[4]", _TIMES),
        )
    ),
}
"""Definitions of the types that ROS itself does not have, newest first."""

_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
_MCAP_PROFILE_AT: Final = len(_MCAP_MAGIC) + 1 + 8

Decoder = Callable[[bytes], Any]


class BagMessage(NamedTuple):
    """One message of a chosen topic."""

    role: str
    topic: str
    type_name: str
    received_s: float
    """When it was recorded, Unix s."""
    message: Any


def is_rosbag(path: Path) -> bool:
    """Return whether this is a rosbag2 folder, a ``.db3`` file, or MCAP written by ROS 2."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if path.suffix != ".mcap" or not path.is_file():
        return path.suffix == ".db3"
    with path.open("rb") as stream:
        head = stream.read(_MCAP_PROFILE_AT + 8)
    return head.startswith(_MCAP_MAGIC) and head[_MCAP_PROFILE_AT:] == b"\x04\0\0\0ros2"


def read_rosbag(bag: Path, topics: Mapping[str, str]) -> Iterator[BagMessage]:
    """Yield the messages of the chosen topics in the order of their recording.

    Raises :class:`MissingExtraError`: ``rosbags`` is not installed. Raises :class:`ConfigError`: A
    role or topic is unknown, or more than one topic could serve a role. Raises :class:`DataError`:
    the recording is damaged, has no topic for IMU or DVL, or messages of another layout.

    ``topics`` names by role those that more than one topic could serve.
    """
    try:
        reader_class = import_module("rosbags.rosbag2").Reader
    except ImportError as error:
        raise MissingExtraError("rosbags", extra="ros", purpose="reading ROS 2 bags") from error
    for role in topics:
        if role not in ROLES:
            raise ConfigError(f"--topic {role}: unknown sensor; {nearest_hint(role, ROLES)}")
    try:
        with reader_class(bag) as reader:
            yield from _messages(bag, reader, _choose(bag, reader.connections, topics))
    except (SsmGraphError, GeneratorExit):
        raise
    except OSError as error:
        raise DataError(f"{bag}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # of rosbags, apsw, yaml, lz4 or zstd: damage raises many kinds
        raise DataError(
            f"{bag}: not a complete ROS 2 recording ({type(error).__name__}: {error}); if it was "
            "cut off, try  ros2 bag reindex  for a folder,  mcap recover  for a single file"
        ) from error


def _choose(
    bag: Path, connections: Sequence[Any], topics: Mapping[str, str]
) -> dict[str, list[Any]]:
    """Return by role the connections to read, all of one topic."""
    chosen = {}
    for role, types in ROLES.items():
        fitting = [connection for connection in connections if connection.msgtype in types]
        if role in topics:
            fitting = _named(bag, role, topics[role], fitting, connections)
        elif any(connection.msgcount for connection in fitting):
            fitting = [connection for connection in fitting if connection.msgcount]
        names = sorted({connection.topic for connection in fitting})
        if len(names) > 1:
            raise ConfigError(
                f"{bag}: {len(names)} topics could be the {role}: {', '.join(names)}; choose one "
                f"with  --topic {role}={names[0]}"
            )
        if fitting:
            chosen[role] = fitting
        elif role in REQUIRED_ROLES:
            raise DataError(
                f"{bag}: no topic for the {role}; expected one of type {' or '.join(types)}; found "
                + (", ".join(sorted(f"{x.topic} ({x.msgtype})" for x in connections)) or "none")
            )
    return chosen


def _named(
    bag: Path, role: str, name: str, fitting: Sequence[Any], connections: Sequence[Any]
) -> list[Any]:
    """Return the connections of a topic that was asked for by name."""
    found = [connection for connection in fitting if connection.topic == name]
    if found:
        return found
    other = [connection.msgtype for connection in connections if connection.topic == name]
    if other:
        raise ConfigError(
            f"{bag}: topic {name} holds {other[0]}; for the {role} expected "
            + " or ".join(ROLES[role])
        )
    known = [connection.topic for connection in fitting or connections]
    raise ConfigError(f"{bag}: there is no topic {name}; {nearest_hint(name, known)}")


def _messages(bag: Path, reader: Any, chosen: Mapping[str, Sequence[Any]]) -> Iterator[BagMessage]:
    roles = {connection.topic: role for role, some in chosen.items() for connection in some}
    decoders: dict[str, Decoder] = {}
    wanted = [connection for some in chosen.values() for connection in some]
    for connection, nanoseconds, raw in reader.messages(connections=wanted):
        topic, type_name = connection.topic, connection.msgtype
        if topic not in decoders:
            decoders[topic] = _decoder(bag, connection, raw)
        try:
            message = decoders[topic](raw)
        except Exception as error:  # of rosbags: damage and other layouts raise many kinds
            raise DataError(
                f"{bag}: topic {topic} holds a message at {nanoseconds / 1e9:.3f} s that is no "
                f"{type_name} ({type(error).__name__}: {error})"
            ) from error
        yield BagMessage(roles[topic], topic, type_name, nanoseconds / 1e9, message)


def _decoder(bag: Path, connection: Any, raw: bytes) -> Decoder:
    """Return the first decoder that makes sense of a topic's first message."""
    reasons = []
    for decode in _decoders(connection):
        try:
            message = decode(raw)
        except Exception as error:
            reasons.append(f"{type(error).__name__}: {error}")
            continue
        if _makes_sense(message):
            return decode
        reasons.append("beams are not numbered from 0")
    raise DataError(
        f"{bag}: the messages of topic {connection.topic} fit no known definition of "
        f"{connection.msgtype} ({'; '.join(dict.fromkeys(reasons))}); record it as MCAP, which "
        "carries the definitions"
    )


def _decoders(connection: Any) -> Iterator[Decoder]:
    """Yield decoders by the recording's own definition, else by those known here."""
    types = import_module("rosbags.typesys")
    type_name, definition = connection.msgtype, connection.msgdef
    if definition.format.name != "NONE":
        parsed = (
            types.get_types_from_msg(definition.data, type_name)
            if definition.format.name == "MSG"
            else _types_from_idl(definition.data, types)
        )
        sources = [(types.Stores.EMPTY, parsed)]
    else:
        parsed_layouts = (
            types.get_types_from_msg(text, type_name) for text in LAYOUTS.get(type_name, ())
        )
        sources = [(types.Stores.ROS2_HUMBLE, parsed) for parsed in parsed_layouts]
        sources = sources or [(types.Stores.ROS2_HUMBLE, {})]
    for base, parsed in sources:
        store = types.get_typestore(base)
        store.register(parsed)
        yield partial(store.deserialize_cdr, typename=type_name)


def _types_from_idl(text: str, types: Any) -> dict[str, Any]:
    """Return the types of one or more IDL texts, each behind a line of 80 equal signs."""
    rule = "=" * 80 + "\n"
    found: dict[str, Any] = {}
    for part in text.split(rule):
        idl = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
        if idl.strip():
            found.update(types.get_types_from_idl(idl))
    return found


def _makes_sense(message: Any) -> bool:
    """Return False for a Water Linked message read by a layout that is not its own."""
    ids = [beam.id for beam in getattr(message, "beams", ())]
    return len(set(ids)) == len(ids) and set(ids) <= set(range(MOST_BEAMS))
