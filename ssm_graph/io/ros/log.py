"""Reading of recordings of ROS without ROS: which topics there are, and their messages one by one.

A recording is the folder of ``.mcap`` or ``.db3`` files, with its ``metadata.yaml`` or, where the
recorder was killed, without; one of these files alone; or a ``.bag`` of ROS 1.
Bags of ROS 2 Humble and before carry no message definitions in ``.db3`` files; those of the DVL
packages are therefore kept here, in every layout they have had.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import sqlite3
import tempfile
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
from ssm_graph.base.progress import told
from ssm_graph.io.ros import messages as ros_messages
from ssm_graph.io.ros.aids import AID_TYPES
from ssm_graph.io.ros.frames import TF_TOPIC, TF_TYPE
from ssm_graph.io.ros.mcap import McapFile, is_ros2_mcap, zstd_decompress
from ssm_graph.sensors.dvl import MOST_BEAMS

ROLES: Final[Mapping[str, tuple[str, ...]]] = {
    "imu": (ros_messages.IMU_TYPE,),
    "dvl": (
        ros_messages.MARINE_DVL_TYPE,
        *ros_messages.WATER_LINKED_TYPES,
        ros_messages.TWIST_TYPE,
    ),
    "depth": (ros_messages.PRESSURE_TYPE,),
    "gnss": (ros_messages.FIX_TYPE,),
    **AID_TYPES,
}
"""What a topic is for, and the message types that serve it; further aids have to be named."""
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

_ROS1_MAGIC: Final = b"#ROSBAG V2.0"
_REINDEX: Final = "ros2 bag reindex"
_ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
_JOURNALS: Final = ("-wal", "-journal")
"""What SQLite has beside a database while it is written."""
_NAMED_FILE = re.compile(r"^\s*-\s+[\"']?(?:\S*/)?([^/\s\"']+\.mcap)[\"']?\s*$", re.MULTILINE)
"""A file in the list of ``metadata.yaml``."""
Topics = Mapping[str, str | Sequence[str]]

Decoder = Callable[[bytes], Any]


class BagMessage(NamedTuple):
    """One message of a chosen topic."""

    role: str
    """One of :data:`ROLES`, or ``tf_static``."""
    topic: str
    type_name: str
    received_s: float
    """When it was recorded, Unix s."""
    message: Any


def is_rosbag(path: Path) -> bool:
    """Return whether this is a recording of ROS: a folder of its files, or one of them."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or bool(
            _files(path, "mcap") + _files(path, "db3")
        )
    if path.suffix == ".mcap" and path.is_file():
        return is_ros2_mcap(path)
    return path.suffix == ".db3" or _is_ros1(path)


def _is_ros1(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return stream.read(len(_ROS1_MAGIC)) == _ROS1_MAGIC
    except OSError:
        return False


def _files(folder: Path, suffix: str) -> list[Path]:
    """Return the files of a recording in their order: ``run_2`` before ``run_10``."""

    def number(path: Path) -> tuple[int, str]:
        found = re.search(r"_(\d+)\Z", path.stem)
        return (int(found[1]) if found else -1, path.name)

    return sorted(folder.glob(f"*.{suffix}"), key=number)


def read_rosbag(bag: Path, topics: Topics, notes: list[str] | None = None) -> Iterator[BagMessage]:
    """Yield the messages of the chosen topics in the order of their recording.

    Raises :class:`MissingExtraError`: ``rosbags`` is not installed. Raises :class:`ConfigError`: A
    role or topic is unknown, or more than one topic could serve a role. Raises :class:`DataError`:
    the recording is damaged, has no topic for IMU or DVL, or messages of another layout.

    Parameters
    ----------
    bag : the recording.
    topics : by role, those that more than one topic could serve; of the DVL also two, one off the
        ground and one off the water.
    notes : takes what is to be known of the recording.
    """
    for role in topics:
        if role not in ROLES:
            raise ConfigError(f"--topic {role}: unknown sensor; {nearest_hint(role, ROLES)}")
    notes = [] if notes is None else notes
    try:
        with contextlib.ExitStack() as stack:
            readers = _readers(_with_journals(bag, stack, notes), notes)
            readers = [stack.enter_context(reader) for reader in readers]
            connections = _merged(readers)
            broken = [x.cut_off for x in readers if isinstance(x, McapFile) and x.cut_off]
            if broken and not connections:
                raise DataError(
                    f"{bag}: no whole chunk of messages is left ({broken[0]}); try  mcap recover"
                )
            chosen = _choose(bag, readers, connections, topics)
            for reader in readers:
                yield from _messages(bag, reader, chosen)
            notes += [
                f"{reader.path.name} was cut off: {reader.cut_off}; read up to there."
                for reader in readers
                if isinstance(reader, McapFile) and reader.cut_off
            ]
    except (SsmGraphError, GeneratorExit):
        raise
    except OSError as error:
        raise DataError(f"{bag}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # of rosbags, apsw, yaml, lz4 or zstd: damage raises many kinds
        kind, remedy = "ROS 2", "sqlite3 FILE .recover" if bag.suffix == ".db3" else _REINDEX
        if _is_ros1(bag):
            kind, remedy = "ROS 1", "rosbag reindex  and  rosbag fix"
        raise DataError(
            f"{bag}: not a complete recording of {kind} ({type(error).__name__}: {error}); if it "
            f"was cut off, try  {remedy}"
        ) from error


def _with_journals(bag: Path, stack: contextlib.ExitStack, notes: list[str]) -> Path:
    """Return a recording whose databases hold all that was written; the bag itself where they do.

    A recorder that was killed leaves its last messages in a journal beside the database, which who
    reads that alone does not see. They are joined in a copy: a recording is not written to.
    """
    databases = _files(bag, "db3") if bag.is_dir() else [bag] if bag.suffix == ".db3" else []
    journals = [path.with_name(path.name + end) for path in databases for end in _JOURNALS]
    journals = [path for path in journals if path.is_file() and path.stat().st_size]
    if not journals:
        return bag
    copy = Path(stack.enter_context(tempfile.TemporaryDirectory())) / bag.name
    folder = copy if bag.is_dir() else copy.parent
    folder.mkdir(exist_ok=True)
    others = [bag / "metadata.yaml"] if (bag / "metadata.yaml").is_file() else []
    for path in (*databases, *journals, *others):
        shutil.copyfile(path, folder / path.name)
    for path in databases:
        with contextlib.closing(sqlite3.connect(folder / path.name)) as database:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            database.execute("PRAGMA journal_mode=DELETE")
    names = ", ".join(path.name for path in journals)
    notes.append(f"{names}: what a recorder that was killed left there was read too.")
    return copy


def _readers(bag: Path, notes: list[str]) -> list[Any]:
    """Return what reads each of the files of a recording."""
    try:
        rosbag1, rosbag2 = (import_module(f"rosbags.rosbag{n}") for n in (1, 2))
    except ImportError as error:
        raise MissingExtraError("rosbags", extra="ros", purpose="reading ROS bags") from error
    if not bag.is_dir():
        if bag.suffix == ".mcap":
            return [McapFile(bag)]
        return [(rosbag1 if _is_ros1(bag) else rosbag2).Reader(bag)]
    metadata = bag / "metadata.yaml"
    files = _files(bag, "mcap")
    if files:
        text = metadata.read_text(errors="replace") if metadata.is_file() else ""
        missing = sorted(set(_NAMED_FILE.findall(text)) - {path.name for path in files})
        if missing:
            raise DataError(f"{bag}: {', '.join(missing)} is missing, which metadata.yaml names")
    if not metadata.is_file():
        files = files or _files(bag, "db3")
        notes.append(
            f"{bag.name} has no metadata.yaml (was the recorder killed?): "
            f"{', '.join(path.name for path in files)} read in this order."
        )
        if files[0].suffix == ".db3":
            return [rosbag2.Reader(path) for path in files]
    return [McapFile(path) for path in files] if files else [rosbag2.Reader(bag)]


def _merged(readers: Sequence[Any]) -> list[Any]:
    """Return the topics of all files, each with all of its messages counted."""
    found: dict[tuple[str, str], Any] = {}
    for reader in readers:
        for one in reader.connections:
            key = one.topic, one.msgtype
            before = found.get(key)
            count = one.msgcount + (before.msgcount if before else 0)
            found[key] = (before or one)._replace(msgcount=count)
    return list(found.values())


def _choose(
    bag: Path, readers: Sequence[Any], connections: Sequence[Any], topics: Topics
) -> dict[str, list[Any]]:
    """Return by role the connections to read, all of one topic; two tracks of a DVL of two."""
    chosen = {}
    wanted = {
        role: (names,) if isinstance(names, str) else tuple(names) for role, names in topics.items()
    }
    for role, types in ROLES.items():
        names = wanted.get(role, ())
        if role in AID_TYPES and not names:
            continue
        others = {name for other, some in wanted.items() if other != role for name in some}
        fitting = [x for x in connections if x.msgtype in types and x.topic not in others]
        if names:
            fitting = [x for name in names for x in _named(bag, role, name, fitting, connections)]
        elif any(connection.msgcount for connection in fitting):
            fitting = [connection for connection in fitting if connection.msgcount]
            with_beams = [x for x in fitting if x.msgtype != ros_messages.TWIST_TYPE]
            fitting = with_beams or fitting
        found = sorted({connection.topic for connection in fitting})
        is_open = len(found) > 1 and len(names) != len(found)
        if len(names) > 1 and (role != "dvl" or len(found) > 2):
            raise ConfigError(
                f"--topic {role}: expected each sensor once, the DVL up to twice, off the ground "
                f"and off the water; got {', '.join(names)}"
            )
        if is_open and not (role == "dvl" and _are_tracks(bag, readers, fitting)):
            raise ConfigError(
                f"{bag}: {len(found)} topics could be the {role}: {', '.join(found)}; choose one "
                f"with  --topic {role}={found[0]}"
            )
        if fitting:
            chosen[role] = fitting
        elif role in REQUIRED_ROLES:
            raise DataError(
                f"{bag}: no topic for the {role}; expected one of type {' or '.join(types)}; found "
                + (", ".join(sorted(f"{x.topic} ({x.msgtype})" for x in connections)) or "none")
            )
    transforms = [x for x in connections if x.msgtype == TF_TYPE and x.topic.endswith(TF_TOPIC)]
    return chosen | ({TF_TOPIC: transforms} if transforms else {})


def _are_tracks(bag: Path, readers: Sequence[Any], fitting: Sequence[Any]) -> bool:
    """Return whether two topics are one DVL's, off the ground and off the water."""
    if len(fitting) != 2 or any(x.msgtype != ros_messages.MARINE_DVL_TYPE for x in fitting):
        return False
    modes = set()
    for one in fitting:
        items = (item for reader in readers for item in _messages(bag, reader, {"dvl": [one]}))
        modes.add(next((ros_messages.is_off_water(item.message) for item in items), None))
    return modes == {False, True}


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
    roles = {(x.topic, x.msgtype): role for role, some in chosen.items() for x in some}
    decoders: dict[str, Decoder] = {}
    wanted = [one for one in reader.connections if (one.topic, one.msgtype) in roles]
    if not wanted:
        return
    items = told(reader.messages(connections=wanted), sum(one.msgcount for one in wanted))
    for connection, nanoseconds, raw in items:
        topic, type_name = connection.topic, connection.msgtype
        data = zstd_decompress(raw) if bytes(raw[:4]) == _ZSTD_MAGIC else raw
        if topic not in decoders:
            decoders[topic] = _decoder(bag, connection, data)
        try:
            message = decoders[topic](data)
        except Exception as error:  # of rosbags: damage and other layouts raise many kinds
            raise DataError(
                f"{bag}: topic {topic} holds a message at {nanoseconds / 1e9:.3f} s that is no "
                f"{type_name} ({type(error).__name__}: {error})"
            ) from error
        role = roles[topic, type_name]
        yield BagMessage(role, topic, type_name, nanoseconds / 1e9, message)


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
        is_ros1 = hasattr(connection.ext, "callerid")
        decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        yield partial(decode, typename=type_name)


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
