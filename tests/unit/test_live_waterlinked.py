"""Water Linked reports: sign and sigma on the real logs, locks, repeats, clocks and damage."""

from __future__ import annotations

import copy
import csv
import json
import math
import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.live.protocols.decoder import Clock
from ssm_graph.live.protocols.waterlinked import BeamRule, WaterLinkedDecoder
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping

DATA = Path(os.environ.get("SSM_GRAPH_DATA", Path(__file__).parents[2] / "../shared/data"))
LOGS = DATA / "waterlinked_a50"
needs_logs = pytest.mark.skipif(not LOGS.is_dir(), reason=f"no Water Linked logs in {LOGS}")
ARRIVAL_S = 1_700_000_000.0


def report(**changes: Any) -> dict[str, Any]:
    """Return a report of format ``json_v3``, taken 0.15 s before its arrival."""
    beams = [
        {"id": k, "velocity": 0.1 * k - 0.2, "distance": 5.0, "beam_valid": True} for k in range(4)
    ]
    fields = {
        "time": 106.4,
        "vx": 0.1,
        "fom": 1e-3,
        "altitude": 4.6,
        "transducers": beams,
        "velocity_valid": True,
        "status": 0,
        "format": "json_v3.1",
        "type": "velocity",
        "time_of_validity": int((ARRIVAL_S - 0.15) * 1e6),
    }
    return {**fields, **changes}


def with_beams(**changes: Any) -> dict[str, Any]:
    """Return a report whose second transducer is changed."""
    fields = report()
    fields["transducers"][1].update(changes)
    return fields


def line(fields: dict[str, Any]) -> bytes:
    """Return a report as the instrument sends it."""
    return json.dumps(fields).encode() + b"\r\n"


def read(*reports: dict[str, Any], **options: Any) -> tuple[list[Ping], list[str]]:
    """Return the pings of reports and what was refused."""
    decoder = WaterLinkedDecoder(**options)
    pings = decoder.feed(b"".join(map(line, reports)), arrival_s=ARRIVAL_S)
    assert all(isinstance(ping, Ping) for ping in pings)
    return [ping for ping in pings if isinstance(ping, Ping)], decoder.take_refusals()


def csv_report(row: dict[str, str]) -> dict[str, Any]:
    """Return a row of the recorded table as the report that it was."""
    beams = [
        {
            "id": k,
            "velocity": float(row[f"transducers_{k}_velocity"]),
            "beam_valid": row[f"transducers_{k}_beam_valid"] == "True",
        }
        for k in range(4)
    ]
    numbers = {key: float(row[key]) for key in ("time", "vx", "vy", "vz", "fom", "altitude")}
    is_valid = row["velocity_valid"] == "True"
    return {**numbers, "transducers": beams, "velocity_valid": is_valid, "type": "velocity"}


@pytest.fixture(scope="module")
def recorded() -> list[dict[str, Any]]:
    """Return the 303 recorded reports."""
    with (LOGS / "20211217-152655dvl_data_time.csv").open(encoding="utf-8") as file:
        return [csv_report(row) for row in csv.DictReader(file)]


def test_what_other_writers_make_of_a_report() -> None:
    """Nothing where a beam or the altitude is not valid, numbers for truth, whole floats."""
    lacking = with_beams(velocity=None, beam_valid=False)
    short = report()
    del short["transducers"][2]
    table = report(altitude=None)
    table["time_of_validity"] = float(table["time_of_validity"])
    for beam in table["transducers"]:
        beam["beam_valid"] = int(beam["beam_valid"])
    for k, fields in enumerate((lacking, short, table)):
        fields["time_of_validity"] += 1000 * (k + 1)
    pings, refused = read(report(), lacking, short, table)
    assert not refused
    missing = [[k for k, v in enumerate(ping.speed) if math.isnan(v)] for ping in pings]
    assert missing == [[], [1], [2], []]
    assert read(short)[0] == []  # nothing says yet that it has four
    assert "expected a number" in read(with_beams(velocity=None))[1][0]
    assert "true or false" in read(with_beams(beam_valid=2))[1][0]


def test_tracking_mode_of_newer_software() -> None:
    """A velocity in the mode of water track is off the water, whatever its type."""
    for changes, is_water in (
        ({"tracking_mode": "bottom"}, False),
        ({"tracking_mode": "water"}, True),
        ({"tracking_mode": "water", "type": "velocity_water"}, True),
        ({"type": "velocity_water"}, True),
    ):
        (ping,), refused = read(report(**changes, format="json_v4.1"))
        assert ping.is_water is is_water
        assert not refused
    assert "tracking_mode" in read(report(tracking_mode="dry"))[1][0]
    assert read({"command": "get_config"}) == ([], [])


@needs_logs
def test_sign_of_the_instrument(recorded: list[dict[str, Any]]) -> None:
    """Transducer velocities are along beams that point down, out of the transducer."""
    pings, refused = read(*recorded)
    assert not refused
    assert len(pings) == 303
    full = [k for k, x in enumerate(recorded) if x["velocity_valid"]]
    speed = np.array([pings[k].speed for k in full])
    velocity = np.array([[recorded[k][axis] for axis in ("vx", "vy", "vz")] for k in full])
    assert speed.shape == (269, 4)
    fitted = np.linalg.lstsq(velocity, speed, rcond=None)[0].T
    residual = np.sqrt(np.mean((speed - velocity @ fitted.T) ** 2, axis=0))
    np.testing.assert_allclose(residual, [2.3e-3, 2.0e-3, 0.6e-3, 0.7e-3], atol=0.1e-3)
    side, down = math.sin(math.radians(22.5)) / math.sqrt(2.0), math.cos(math.radians(22.5))
    beams = np.array(
        [[-side, side, down], [-side, -side, down], [side, -side, down], [side, side, down]]
    )
    np.testing.assert_allclose(fitted, beams, atol=0.03)
    assert np.sqrt(np.mean((speed - velocity @ beams.T) ** 2)) < 1.7e-3
    assert np.sqrt(np.mean((speed + velocity @ beams.T) ** 2)) > 0.1


@needs_logs
def test_figure_of_merit_is_no_sigma(recorded: list[dict[str, Any]]) -> None:
    """Why a ping has no sigma: the beams disagree by more than three times what the report says."""
    valid = [x for x in recorded if x["velocity_valid"]]
    speed = np.array([[beam["velocity"] for beam in x["transducers"]] for x in valid])
    parity = speed @ [0.5, -0.5, 0.5, -0.5]
    ratio = np.sqrt(np.mean((parity / [x["fom"] for x in valid]) ** 2))
    assert ratio == pytest.approx(3.43, abs=0.01)
    assert all(ping.sigma is None for ping in read(*valid)[0])


@needs_logs
def test_false_locks_of_the_log_are_missing(recorded: list[dict[str, Any]]) -> None:
    """Without velocity and altitude no beam counts, unless it is asked for."""
    counts = {}
    for rule in BeamRule:
        pings, _ = read(*recorded, beam_rule=rule)
        counts[rule] = sum(not all(map(math.isnan, ping.speed)) for ping in pings)
    assert counts == {BeamRule.BOTTOM: 269 + 10, BeamRule.EACH: 303 - 7, BeamRule.VELOCITY: 269}


@needs_logs
@pytest.mark.parametrize("size", [64, 4096, 1_000_000])
def test_log_over_lines_object_by_object(size: int) -> None:
    """A list of indented objects with one broken in the middle; no velocity in it is valid."""
    data = (LOGS / "log_28_08_2021.json").read_bytes()
    decoder = WaterLinkedDecoder()
    pings = []
    for k in range(0, len(data), size):
        pings += decoder.feed(data[k : k + size], arrival_s=ARRIVAL_S)
    assert len(pings) + decoder.n_repeats == 232
    assert decoder.n_repeats == 17
    assert all(isinstance(x, Ping) and all(map(math.isnan, x.speed)) for x in pings)
    refused = decoder.take_refusals()
    assert len(refused) == 2
    assert "line break within quotes" in refused[1]


def test_each_transducer_is_a_beam() -> None:
    """An invalid one is missing, the others stay; their order is that of their numbers."""
    fields = with_beams(beam_valid=False, velocity=0)
    fields["transducers"].reverse()
    (ping,), refused = read(fields)
    assert ping.speed[0] == -0.2
    assert math.isnan(ping.speed[1])
    assert list(ping.speed[2:]) == pytest.approx([0.0, 0.1])
    assert not refused


def test_equal_beams_without_velocity_are_missing() -> None:
    """Four equal or zero speeds are what an instrument writes that has none."""
    for speed in (0, 0.25):
        fields = report(velocity_valid=False)
        for beam in fields["transducers"]:
            beam["velocity"] = speed
        for rule in BeamRule:
            (ping,), _ = read(fields, beam_rule=rule)
            assert all(map(math.isnan, ping.speed))
        (still,), _ = read({**fields, "velocity_valid": True})
        assert still.speed == (speed,) * 4


def test_repeats_are_dropped_and_counted() -> None:
    """By time of validity where there is one that runs, else by content."""
    decoder = WaterLinkedDecoder()
    later = report(time_of_validity=report()["time_of_validity"] + 100_000)
    sent = [report(), report(time_of_transmission=1), later, report()]
    assert len(decoder.feed(b"".join(map(line, sent)), arrival_s=ARRIVAL_S)) == 3
    assert decoder.n_repeats == 1
    old = report()
    del old["time_of_validity"]
    for clock in (old, report(time_of_validity=0)):
        pings, _ = read(clock, copy.deepcopy(clock), {**clock, "time": 99.0})
        assert len(pings) == 2


def test_clocks() -> None:
    """The centre of the ping where it agrees with the arrival, else the arrival, said once."""
    assert read(report())[0][0].time_s == pytest.approx(ARRIVAL_S - 0.15, abs=1e-6)
    assert read(report(), clock=Clock.ARRIVAL)[0][0].time_s == ARRIVAL_S
    pings, refused = read(report(time_of_validity=5), report(time_of_validity=6))
    assert [ping.time_s for ping in pings] == [ARRIVAL_S] * 2
    assert len(refused) == 1
    assert "set both clocks" in refused[0]


def test_other_reports_are_ignored() -> None:
    """Dead reckoning and answers to commands pass without a word."""
    position = {"ts": 49056.8, "x": 1.0, "type": "position_local", "status": 0}
    answer = {"response_to": "get_config", "success": True, "result": {}, "type": "response"}
    assert read(position, answer) == ([], [])


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"vx": 1.0}, "'type' is missing"),
        (report(type="velocit"), "'velocit'"),
        (report(type=3), "got 3"),
        (report(transducers=[]), "numbers 0 to 3"),
        (report(transducers=None), "list of 3 or 4 objects"),
        (with_beams(id=True), "numbers 0 to 3"),
        (with_beams(id=2), "numbers 0 to 3"),
        (with_beams(velocity="0.1"), "velocity: expected a number"),
        (with_beams(velocity=1e5), "check the unit"),
        (with_beams(beam_valid=2), "true or false"),
        (report(velocity_valid="yes"), "true or false"),
        (report(altitude=[]), "altitude"),
        (report(time_of_validity=1.5), "whole microseconds"),
        (report(time_of_validity=True), "whole microseconds"),
    ],
)
def test_damage_is_refused(fields: dict[str, Any], told: str) -> None:
    """One sentence each; the next report is decoded."""
    pings, refused = read(fields, report())
    assert len(pings) == 1
    (text,) = refused
    assert text.startswith("water linked: ")
    assert told in text


def test_no_time_no_ping() -> None:
    """An arrival that is no number is refused, not raised."""
    decoder = WaterLinkedDecoder()
    assert decoder.feed(line(report()), arrival_s=math.nan) == []
    assert decoder.n_refused == 1


def test_a_clock_that_agreed_is_believed_after_a_standstill() -> None:
    """What waited while the process stood still is of the instrument's time, within an hour."""
    decoder = WaterLinkedDecoder()
    assert len(decoder.feed(line(report()), arrival_s=ARRIVAL_S)) == 1
    for later_s, n_pings in ((0.5, 1), (-0.5, 0), (4e3, 0), (1.0, 1)):
        stamp = int((ARRIVAL_S - 0.15 + later_s) * 1e6)
        found = decoder.feed(line(report(time_of_validity=stamp)), arrival_s=math.nan)
        assert len(found) == n_pings, later_s
    decoder.feed(line(report(time_of_validity=5)), arrival_s=ARRIVAL_S)
    stamp = int((ARRIVAL_S + 2.0) * 1e6)
    assert decoder.feed(line(report(time_of_validity=stamp)), arrival_s=math.nan) == []


def first_format(k: int, **changes: Any) -> dict[str, Any]:
    """Return a report of format ``json_v1``, which has no type and no clock."""
    fields = report(time=100.0 + k, format="json_v1", **changes)
    del fields["type"], fields["time_of_validity"]
    return fields


def test_the_first_format_has_no_type() -> None:
    """It is a velocity all the same; one that might be a water track is damaged without a type."""
    pings, refused = read(*(first_format(k) for k in range(5)))
    assert len(pings) == 5
    assert not refused
    assert pings[0].speed == pytest.approx((-0.2, -0.1, 0.0, 0.1))
    assert len(read(first_format(0) | {"format": "json_v3.1"})[0]) == 1
    for later in ({"format": "json_v3.2"}, {"format": 7}):
        assert "key 'type' is missing" in read(first_format(0) | later)[1][0]


def test_water_track_of_software_2_7() -> None:
    """A type of its own; both tracks may have one time, and neither is the other's repeat."""
    ground, water = report(), report(type="velocity_water", altitude=-1.0)
    pings, refused = read(ground, water, water)
    assert [ping.is_water for ping in pings] == [False, True]
    assert not refused


def test_yaw_of_its_dead_reckoning_is_a_directional_gyro() -> None:
    """Where it is asked for, and its status is good."""
    place = {"type": "position_local", "ts": ARRIVAL_S - 0.2, "x": 1.0, "yaw": -90.0, "status": 0}
    decoder = WaterLinkedDecoder(heading=True)
    bad = line({**place, "ts": ARRIVAL_S - 0.1, "status": 1})
    (reading,) = decoder.feed(line(place) * 2 + bad, arrival_s=ARRIVAL_S)
    assert isinstance(reading, HeadingReading)
    assert (reading.time_s, reading.heading) == (ARRIVAL_S - 0.2, math.radians(-90.0))
    assert decoder.n_repeats == 1
    assert read(place) == ([], [])
    decoder.feed(line({"type": "position_local", "yaw": 1e3}), arrival_s=ARRIVAL_S)
    assert "yaw, deg" in decoder.take_refusals()[0]


@needs_logs
@pytest.mark.parametrize(
    ("name", "n_pings", "n_repeats"),
    [
        ("out20210528.txt", 234, 16),
        ("out20210528_straight+turn360.txt", 320, 22),
        ("out_circle.txt", 31, 602),
    ],
)
def test_recordings_of_the_first_format(name: str, n_pings: int, n_repeats: int) -> None:
    """Read to the last report: as many as differ from the one before, and none refused."""
    data = (LOGS / "mr_dvl" / name).read_bytes()
    reports = data.splitlines()
    assert sum(a != b for a, b in pairwise([b"", *reports])) == n_pings
    decoder = WaterLinkedDecoder()
    assert len(decoder.feed(data, arrival_s=ARRIVAL_S)) == n_pings
    assert (decoder.n_repeats, decoder.n_refused) == (n_repeats, 0)
