"""Damaged recordings into what reads files: a refusal that says why, or finite numbers in order."""

from __future__ import annotations

import random
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from rosbags.rosbag2 import StoragePlugin

from ssm_graph.base.errors import SsmGraphError
from ssm_graph.io.ardupilot.convert import convert_ardupilot
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.ros.convert import convert_rosbag
from ssm_graph.io.ros.messages import RosOptions
from ssm_graph.live.recorded.log import read_recorded
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.messages import Message, bad_number
from ssm_graph.simulation import GnssSettings
from tests.damaged_traffic import (
    MAX_FAILURES,
    START_S,
    damaged,
    nmea_traffic,
    serial_traffic,
    waterlinked_traffic,
)
from tests.helpers import simulated
from tests.rosbag_fixture import Ros, marine_bag, ros1_bag, write_bag
from tests.unit.test_ardupilot import dataflash, tlog
from tests.unit.test_nortek import adcp, dvl, nucleus_log, velocities
from tests.unit.test_pd0 import ensemble as pd0
from tests.unit.test_recorded import as_table, reports
from tests.unit.test_short_formats import ensemble as pd45
from tests.unit.test_short_formats import sentences as pd6

SIZE: Final = 64 * 1024
"""Of a recorded stream, bytes."""


@dataclass
class FileTarget:
    """One kind of file, and what became of it."""

    name: str
    sound: bytes
    read: Callable[[Path], int]
    """Return how many rows there are; raise for what is wrong with them."""
    suffix: str
    fed: int = 0
    files: int = 0
    refused: int = 0
    rows: int = 0
    wall_s: float = 0.0
    slowest_s: float = 0.0
    failures: list[str] = field(default_factory=list)

    def feed(self, folder: Path, rng: random.Random) -> None:
        """Read the file, damaged."""
        data = damaged(self.sound, rng) if rng.random() < 0.5 else _scratched(self.sound, rng)
        path = folder / f"damaged{self.suffix}"
        path.write_bytes(data)
        begin = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                self.rows += self.read(path)
        except SsmGraphError as error:
            self.refused += 1
            if not 10 < len(str(error)) < 2000:
                self.failures.append(f"{self.name}: a refusal of {len(str(error))} letters")
        except Exception as error:  # nothing else may come out
            self.failures.append(f"{self.name}, file {self.files}: {type(error).__name__}: {error}")
        spent_s = time.perf_counter() - begin
        self.wall_s += spent_s
        self.slowest_s = max(self.slowest_s, spent_s)
        self.fed += len(data)
        self.files += 1


def _scratched(data: bytes, rng: random.Random) -> bytes:
    """Return a file with one to four bytes altered: what checksums and lengths stand against."""
    result = bytearray(data)
    for _ in range(rng.randrange(1, 5)):
        result[rng.randrange(len(result))] = rng.randrange(256)
    return bytes(result)


def run(target: FileTarget, folder: Path, n_bytes: int, rng: random.Random) -> None:
    """Read damaged files of so many bytes together."""
    while target.fed < n_bytes and len(target.failures) < MAX_FAILURES:
        target.feed(folder, rng)


def _recorded(path: Path) -> int:
    found = read_recorded(path)
    if found is None:
        return 0
    last: dict[type[Message], float] = {}
    for message in found.messages:
        name = bad_number(message)
        if name is not None:
            raise ValueError(f"{name} of {message} is not finite")
        if not message.time_s > last.get(type(message), -np.inf):
            raise ValueError(f"{message} is not after the one before")
        last[type(message)] = message.time_s
    return len(found.messages)


def _rows(found: Mission) -> int:
    logs = [log for log in (found.imu, found.dvl, found.depth, found.gnss) if log is not None]
    for log in logs:
        if not (np.isfinite(log.time_s).all() and np.all(np.diff(log.time_s) > 0.0)):
            raise ValueError(f"{type(log).__name__}: times do not increase")
    if not np.isfinite([found.imu.gyro_b, found.imu.accel_b]).all():
        raise ValueError("inertial data that are not finite")
    return sum(len(log.time_s) for log in logs)


def _bag_of(mission: Mission) -> Callable[[Path], int]:
    vehicle = vehicle_of(mission)
    options = RosOptions(surface_height=0.0)
    return lambda path: _rows(convert_rosbag(path, vehicle=vehicle, options=options))


def _stream(traffic: Callable[[random.Random, float], bytes]) -> bytes:
    rng, parts = random.Random(5), list[bytes]()
    while sum(map(len, parts)) < SIZE:
        parts.append(traffic(rng, START_S + 0.5 * len(parts)))
    return b"".join(parts)


def file_targets(folder: Path) -> list[FileTarget]:
    """Return every kind of file; those that need a library to be written are written there."""
    gnss = GnssSettings(windows=((0.0, 9.0),))
    mission, ros = simulated(duration_s=10.0, gnss=gnss).mission, Ros()
    sent, bag = marine_bag(mission, ros), _bag_of(mission)
    mcap = write_bag(folder / "mcap", ros, sent) / "mcap.mcap"
    db3 = write_bag(folder / "db3", ros, sent, StoragePlugin.SQLITE3) / "db3.db3"
    old = ros1_bag(folder / "old.bag", mission, ros)
    return [
        FileTarget("Water Linked JSON", _stream(waterlinked_traffic), _recorded, ".json"),
        FileTarget("Water Linked, serial protocol", _stream(serial_traffic), _recorded, ".txt"),
        FileTarget("Water Linked table", as_table(reports(200, "json_v2")), _recorded, ".csv"),
        FileTarget("NMEA 0183", _stream(nmea_traffic), _recorded, ".nmea"),
        FileTarget("ROS 2, MCAP", mcap.read_bytes(), bag, ".mcap"),
        FileTarget("ROS 2, db3", db3.read_bytes(), bag, ".db3"),
        FileTarget("ROS 1", old.read_bytes(), bag, ".bag"),
        *_makers(),
    ]


def _makers() -> list[FileTarget]:
    """Return the makers' own formats; of ArduPilot 20 s, as its readers take a whole mission."""
    v = velocities(240)
    beams = np.array([0.5, 0.1, -0.2, 0.3])
    ad2cp = [dvl(k, v[k], is_long=k % 2 == 0) for k in range(60)]
    ad2cp += [adcp(60 + k, [100, -200, 300, -400]) for k in range(60)]
    pd4, pd5 = (
        [pd45(k, [k, -k, 5, 6], is_pd5=is_pd5) for k in range(60)] for is_pd5 in (False, True)
    )
    flight = simulated(
        duration_s=20.0, imu_rate_hz=100.0, gnss=GnssSettings(windows=((0.0, 20.0),))
    ).mission
    ardupilot: Callable[[Path], int] = lambda path: _rows(convert_ardupilot(path))  # noqa: E731
    return [
        FileTarget("Teledyne PD0", b"".join(pd0(k, beams) for k in range(120)), _recorded, ".pd0"),
        FileTarget("Teledyne PD4", b"".join(pd4), _recorded, ".pd4"),
        FileTarget("Teledyne PD5", b"".join(pd5), _recorded, ".pd5"),
        FileTarget("Teledyne PD6", b"".join(pd6(k % 60, k) for k in range(60)), _recorded, ".pd6"),
        FileTarget("Nortek AD2CP", b"".join(ad2cp), _recorded, ".ad2cp"),
        FileTarget("Nortek Nucleus", nucleus_log(), _recorded, ".nucleus"),
        FileTarget("ArduPilot dataflash", dataflash(flight), ardupilot, ".BIN"),
        FileTarget("ArduPilot telemetry", tlog(flight), ardupilot, ".tlog"),
    ]
