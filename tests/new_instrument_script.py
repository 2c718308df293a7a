"""Run by `test_new_instrument` where the package has a fluxgate: every way in and out of it."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from ssm_graph.sensors.fluxgate import (  # type: ignore[import-not-found]
    FLUXGATE,
    FluxgateLog,
    FluxgateReading,
)

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.io.mission_folder.assembly import mission_from
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of, write_vehicle
from ssm_graph.io.raw_log.log import RawLog, replay
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator.intake import Intake
from ssm_graph.live.protocols.json_messages import decode_message, encode_message
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.mission import Aids
from tests.mission_fixture import make_mission
from tests.unit.test_mission_roundtrip import assert_same

folder = Path(sys.argv[1])
time_s = np.arange(1.0, 60.0)
field_b = 1e-6 * np.column_stack([20.0 + 0.0 * time_s, np.sin(time_s), 45.0 + 0.1 * time_s])
log = FluxgateLog(
    sigma=0.2e-6, time_s=time_s, field_b=field_b, hard_iron_b=1e-6 * np.array([3.0, -1.0, 0.5])
)
plain = make_mission()
mission = replace(plain, aids=Aids(log))


def said(change: str, into: str, *, file: str) -> str:
    """Return what the reader says where a file of the folder is changed."""
    path = folder / "mission" / file
    text = path.read_text()
    assert change in text
    path.write_text(text.replace(change, into, 1))
    try:
        read_mission(folder / "mission")
    except (ConfigError, DataError) as error:
        return str(error)
    finally:
        path.write_text(text)
    raise AssertionError("read without an error")


write_mission(folder / "mission", mission)
assert_same(read_mission(folder / "mission").aids, mission.aids)
toml = (folder / "mission" / "mission.toml").read_text()
assert "noise_ut = 0.2" in toml
assert "noise_ut: the key is missing" in said("noise_ut = 0.2\n", "", file="mission.toml")
first = (folder / "mission" / "fluxgate.csv").read_text().splitlines()[1]
far = first.replace("20.0", "2000.0").replace("19.99", "1999.0")
assert "expected microtesla" in said(first, far, file="fluxgate.csv")

labels = {name: f"bag: /{name}" for name in ("imu", "dvl", "depth", "gnss", "fluxgate")}
logs = (plain.imu, plain.dvl, plain.depth, plain.gnss, log)
made = mission_from(logs, None, source=Path("bag"), labels=labels)
assert_same(made.aids, mission.aids)

vehicle = vehicle_of(mission)
(folder / "vehicle").mkdir()
write_vehicle(folder / "vehicle", vehicle)
assert_same(read_vehicle(folder / "vehicle").aids, vehicle.aids)

messages = list(messages_of(mission))
readings = [message for message in messages if isinstance(message, FluxgateReading)]
assert len(readings) == len(time_s)
assert all(decode_message(encode_message(one).decode()) == one for one in readings)

with RawLog(folder / "log", vehicle) as raw:
    for message in messages:
        raw.append(message)
logged = [m for m in replay(folder / "log", vehicle) if isinstance(m, FluxgateReading)]
assert logged == readings
assert_same(read_mission(folder / "log").aids, mission.aids)

intake = Intake(vehicle, EventLog())
for message in messages:
    intake.accept(message)
kept = FLUXGATE.log_of(intake.buffers.rows["fluxgate"].all, vehicle.aids[FluxgateLog])
assert_same(kept, log)
intake.accept(FluxgateReading(60.0, (1.0, 0.0, 0.0)))
assert intake.counts["fluxgate implausible"] == 1, intake.counts
bare = Intake(vehicle_of(plain), EventLog())
bare.accept(readings[0])
assert bare.counts == {"fluxgate undeclared": 1}, bare.counts
sys.stdout.write("all ways\n")
