"""JSON lines: every message comes back bit for bit, all else is refused with a hint; answers."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_graph.base.frames import BodyAxes, to_frd
from ssm_graph.base.units import MICRO_G
from ssm_graph.io.results.tables import trajectory_columns
from ssm_graph.live.protocols.json_messages import (
    KEYS,
    JsonDecoder,
    encode_message,
    encode_navigation,
    navigation_fields,
)
from ssm_graph.mission.estimate import Trajectory
from ssm_graph.mission.navigation import Health, Navigation
from ssm_graph.sensors.acoustic import AcousticRange, UsblFix
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.features import FeatureSighting
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.magnetometer import MagneticReading
from ssm_graph.sensors.messages import Message, bad_number
from ssm_graph.sensors.registry import BY_MESSAGE
from ssm_graph.sensors.standstill import RestReading
from tests.helpers import STEADY

NUMBER = st.floats(-1e9, 1e9)
VECTOR = st.tuples(NUMBER, NUMBER, NUMBER)
SIGMA = st.floats(1e-6, 1e6)
BEAM = NUMBER | st.just(math.nan)
BEAM_SIGMA = SIGMA | st.just(math.nan)
MESSAGES = st.one_of(
    st.builds(ImuSample, NUMBER, VECTOR, VECTOR),
    st.builds(
        Ping,
        NUMBER,
        st.tuples(BEAM, BEAM, BEAM, BEAM),
        st.none() | st.tuples(BEAM_SIGMA, BEAM_SIGMA, BEAM_SIGMA, BEAM_SIGMA),
        st.booleans(),
    ),
    st.builds(DepthReading, NUMBER, NUMBER),
    st.builds(
        Fix,
        NUMBER,
        st.floats(-math.pi / 2, math.pi / 2),
        st.floats(-math.pi, math.pi),
        NUMBER,
        st.tuples(SIGMA, SIGMA, SIGMA),
    ),
    st.builds(
        UsblFix,
        NUMBER,
        st.floats(-math.pi / 2, math.pi / 2),
        st.floats(-math.pi, math.pi),
        NUMBER,
        st.tuples(SIGMA, SIGMA, SIGMA),
        NUMBER,
    ),
    st.builds(AcousticRange, NUMBER, NUMBER, NUMBER, st.one_of(BEAM_SIGMA, st.just(math.nan))),
    st.builds(RestReading, NUMBER, st.one_of(BEAM_SIGMA, st.just(math.nan))),
    st.builds(HeadingReading, NUMBER, st.floats(-2.0 * math.pi, 2.0 * math.pi)),
)
LINES = {
    "imu": '{"type": "imu", "time_s": 1, "gyro_rad_per_s": [1, 2, 3], "accel_m_per_s2": [4, 5, 6]}',
    "dvl": '{"type": "dvl", "time_s": 1.5, "beam_m_per_s": [0.1, null, -0.3, 0.4]}',
    "depth": '{"type": "depth", "time_s": 2, "depth_m": 30.5}',
    "gnss": '{"type": "gnss", "time_s": 3, "lat_deg": 63.5, "lon_deg": -10, "height_m": 40,'
    ' "sigma_m": [1, 2, 3]}',
    "usbl": '{"type": "usbl", "time_s": 4, "lat_deg": 63.5, "lon_deg": 350, "height_m": -40,'
    ' "sigma_m": [1, 2, 3], "delay_s": 1.5}',
    "ranges": '{"type": "ranges", "time_s": 5, "beacon": 4, "range_m": 130.5, "sigma_m": 0.3}',
    "heading": '{"type": "heading", "time_s": 6, "heading_deg": 90}',
    "magnetometer": '{"type": "magnetometer", "time_s": 7, "mag_ut": [20, -5, 44]}',
    "at_rest": '{"type": "at_rest", "time_s": 8, "sigma_m_per_s": 0.1}',
    "features": '{"type": "features", "time_s": 9, "feature": 2, "range_m": 12.5, '
    '"bearing_deg": -30, "elevation_deg": -20}',
}


def decode(data: bytes, axes: BodyAxes = BodyAxes.FRD) -> tuple[list[Message], list[str]]:
    """Return the messages and what was refused."""
    decoder = JsonDecoder(axes=axes)
    return decoder.feed(data, arrival_s=math.nan), decoder.take_refusals()


def as_numbers(message: Message) -> str:
    """Return a text that is the same for the same bits; NaN equals NaN, and no zero has a sign."""
    return repr(message).replace("-0.0,", "0.0,").replace("-0.0)", "0.0)")


@STEADY
@given(message=MESSAGES, axes=st.sampled_from(BodyAxes))
def test_every_message_comes_back(message: Message, axes: BodyAxes) -> None:
    """Bit for bit, in whatever axes."""
    (found,), refused = decode(encode_message(message, axes=axes), axes)
    assert as_numbers(found) == as_numbers(message)
    assert type(found) is type(message)
    assert bad_number(found) is None
    assert not refused


def test_all_kinds_of_message_have_a_schema() -> None:
    """A new message needs a line here."""
    assert len(KEYS) == len(BY_MESSAGE) == len(LINES)


def test_lines_of_the_documentation() -> None:
    """Written by hand: integers are numbers, null is a missing beam, degrees become radians."""
    messages, refused = decode("\n".join([*LINES.values(), ""]).encode())
    imu, ping, depth, fix, acoustic, reach, heading, magnetic, rest, sight = messages
    assert isinstance(sight, FeatureSighting)
    assert (sight.bearing, sight.elevation) == pytest.approx(np.radians([-30.0, -20.0]))
    assert imu == ImuSample(1.0, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    assert isinstance(ping, Ping)
    assert ping == Ping(1.5, (0.1, math.nan, -0.3, 0.4))
    assert depth == DepthReading(2.0, 30.5)
    assert fix == Fix(3.0, math.radians(63.5), math.radians(-10.0), 40.0, (1.0, 2.0, 3.0))
    place = (math.radians(63.5), math.radians(-10.0), -40.0)
    assert acoustic == UsblFix(4.0, *place, (1.0, 2.0, 3.0), 1.5)
    assert reach == AcousticRange(5.0, 4.0, 130.5, 0.3)
    assert rest == RestReading(8.0, 0.1)
    assert heading == HeadingReading(6.0, math.radians(90.0))
    assert isinstance(magnetic, MagneticReading)
    assert magnetic.field_b == pytest.approx((20e-6, -5e-6, 44e-6))
    assert not refused


@pytest.mark.parametrize("lon_deg", [-180, -10, 180, 190.125, 360])
def test_longitudes_may_go_once_around(lon_deg: float) -> None:
    """As in all other inputs; what is beyond half a turn is west of Greenwich."""
    (fix,), refused = decode(f"{changed('gnss', lon_deg=lon_deg)}\n".encode())
    assert isinstance(fix, Fix)
    assert not refused
    west = lon_deg - 360 if lon_deg > 180 else lon_deg
    assert fix.lon == pytest.approx(math.radians(west), rel=1e-15)


@pytest.mark.parametrize("axes", BodyAxes)
def test_axes_are_those_of_the_mission_folder(axes: BodyAxes) -> None:
    """The same names, the same turns."""
    ((imu,), _) = decode(LINES["imu"].encode() + b"\n", axes)
    assert isinstance(imu, ImuSample)
    np.testing.assert_array_equal(imu.gyro_b, to_frd(np.array([1.0, 2, 3]), axes))
    np.testing.assert_array_equal(imu.accel_b, to_frd(np.array([4.0, 5, 6]), axes))


def changed(kind: str, **changes: Any) -> str:
    """Return a line with other values; None takes a key out."""
    fields = {**json.loads(LINES[kind]), **changes}
    return json.dumps({key: value for key, value in fields.items() if value is not None})


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (changed("imu", gyro_rad_per_sec=[1, 2, 3]), "did you mean 'gyro_rad_per_s'"),
        (changed("imu", type="imuu"), "did you mean 'imu'"),
        (changed("dvl", water_track=1), "water_track: expected true or false, got 1"),
        (changed("dvl", water_trak=True), "did you mean 'water_track'"),
        (changed("imu", type=None), "'type' is missing"),
        (changed("imu", type=["imu"]), "unknown type"),
        (changed("imu", time_s=None), "'time_s' is missing"),
        (changed("imu", time_s=True), "expected a number, got True"),
        (changed("imu", time_s="1"), "expected a number, got '1'"),
        (changed("imu", time_s=10**15), "below 1e+12"),
        (changed("imu", time_s=10**40), "at most 20 digits"),
        (changed("imu", gyro_rad_per_s=[1, 2]), "list of 3 numbers"),
        (changed("imu", gyro_rad_per_s=[1, 2, {}]), "expected a number"),
        (changed("imu", gyro_rad_per_s={"x": 1}), "list of 3 numbers"),
        (changed("dvl", beam_m_per_s=list(range(9))), "list of 1 to 8 numbers"),
        (changed("dvl", beam_m_per_s=[1, 2, 3, False]), "expected a number"),
        (changed("dvl", sigma_m_per_s=[1, 2, 3, 0]), "sigma_m_per_s"),
        (changed("depth", depth_m=[1]), "expected a number"),
        (changed("depth", lat_deg=1), "unknown key 'lat_deg'"),
        (changed("gnss", lat_deg=90.001), "check the unit"),
        (changed("gnss", lon_deg=-181), "expected -180 to 360, got -181; check the unit"),
        (changed("gnss", lon_deg=360.5), "expected -180 to 360"),
        (changed("gnss", lat_deg="63"), "expected a number"),
        (changed("gnss", sigma_m=[1, -1, 1]), "sigma_m"),
        (LINES["gnss"].replace("63.5", "NaN"), "finite"),
        (LINES["gnss"].replace("63.5", "1e-99999999999999999999"), "expected a JSON object"),
        (LINES["depth"].replace("30.5", "1e999"), "finite"),
        (LINES["depth"].replace("30.5", '1, "depth_m": 2'), "comes twice"),
        ('{"type": "depth"} {"type": "depth"}', "expected a JSON object"),
        ("[" * 100_000, "at most 65536 bytes"),
        ("[" * 60_000, "brackets"),
        ("null", "expected a JSON object"),
        ("\x00", "expected a JSON object"),
    ],
)
def test_damage_is_refused(line: str, told: str) -> None:
    """One sentence each; the next line is decoded."""
    messages, refused = decode(f"{line}\n{LINES['depth']}\n".encode())
    assert messages == [DepthReading(2.0, 30.5)]
    (text,) = refused
    assert text.startswith("json: ")
    assert told in text


@STEADY
@given(data=st.binary(max_size=200))
def test_bytes_never_raise(data: bytes) -> None:
    """Whatever they are; and the line after them is there."""
    messages, _ = decode(data + b"\n" + LINES["depth"].encode() + b"\n")
    assert messages[-1] == DepthReading(2.0, 30.5)


NAVIGATION = Navigation(
    time_s=12.5,
    lat=math.radians(63.5),
    lon=math.radians(10.4),
    height=-30.25,
    health=Health.DEGRADED,
    reason='no "bottom" since 3 s',
    confidence=0.6,
    bottom_lock=False,
    since_aid_s=math.inf,
    latency_s=0.01,
    velocity_enu=np.array([1.0, -1.0, 0.1]),
    roll_pitch_heading=np.array([0.01, -0.02, -0.5]),
    position_sigma_enu=np.array([0.5, 0.4, 0.1]),
    velocity_sigma_enu=np.array([0.05, 0.04, 0.01]),
    attitude_sigma=np.array([0.001, 0.002, 0.02]),
    gyro_bias=np.array([1e-6, 2e-6, -3e-6]),
    accel_bias=np.array([1e-3, 2e-3, -3e-3]),
    beam_weights=np.array([1.0, 0.5, math.nan, 1.0]),
)


def test_an_answer_speaks_as_the_trajectory_table() -> None:
    """The columns of ``trajectory.csv`` by name, order and value; then what only an answer has."""
    row = {
        spec.name: getattr(NAVIGATION, spec.name, None) for spec in dataclasses.fields(Trajectory)
    }
    row["position_cov_enu"] = np.diag(NAVIGATION.position_sigma_enu**2)
    row["n_beams"] = 3.0
    table = trajectory_columns(Trajectory(**{key: np.array([x]) for key, x in row.items()}))
    fields = navigation_fields(NAVIGATION)
    assert [key for key in fields if key in table] == [key for key in table if key != "n_beams"]
    for key, (values, _) in table.items():
        if key != "n_beams":
            assert fields[key] == pytest.approx(values[0], rel=1e-12), key
    assert set(fields) - set(table) == {
        "type",
        "beam_weights",
        "health",
        "reason",
        "confidence",
        "bottom_lock",
        "since_aid_s",
        "latency_s",
        "protection_m",
        "protection_up_m",
        "witness_m",
        "witness_up_m",
        "witness_s",
        "innovation_ratios",
    }
    assert fields["accel_bias_x_ug"] == pytest.approx(1e-3 / MICRO_G)


def test_an_answer_is_one_line_of_plain_json() -> None:
    """What is not finite is null, and the line is no message."""
    line = encode_navigation(NAVIGATION)
    assert line.count(b"\n") == 1
    found = json.loads(line, parse_constant=lambda text: pytest.fail(text))
    assert found == {**navigation_fields(NAVIGATION), "clock_set_by_s": 0.0}
    assert found["since_aid_s"] is None
    assert found["beam_weights"] == [1.0, 0.5, None, 1.0]
    assert (found["health"], found["reason"]) == ("DEGRADED", NAVIGATION.reason)
    nowhere = dataclasses.replace(NAVIGATION, lat=math.nan, velocity_enu=np.full(3, math.nan))
    assert navigation_fields(nowhere)["lat_deg"] is navigation_fields(nowhere)["vel_up_m_per_s"]
    messages, refused = decode(line)
    assert not messages
    assert "unknown type 'navigation'" in refused[0]
