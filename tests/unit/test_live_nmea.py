"""NMEA 0183: fixes, sigmas, UTC of day, depths, damage; answers as sentences."""

from __future__ import annotations

import dataclasses
import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_graph.base.errors import ConfigError
from ssm_graph.io.nmea_sentences import checksum
from ssm_graph.live.protocols.decoder import Clock
from ssm_graph.live.protocols.nmea import NmeaDecoder, NmeaOptions
from ssm_graph.live.protocols.nmea_fields import DepthSentence
from ssm_graph.live.protocols.nmea_out import encode_gga, encode_hdt, encode_nmea, encode_vtg
from ssm_graph.mission.navigation import Health, Navigation
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.messages import Message
from tests.helpers import STEADY

DAY_S = 86400.0
MIDNIGHT_S = 19_675 * DAY_S
NOON_S = MIDNIGHT_S + 43_200.0
GGA = "GPGGA,120000.00,6326.0000,N,01024.0000,E,4,12,0.8,20.50,M,40.25,M,,"
GST = "GPGST,120000.00,1.1,0.3,0.2,45.0,0.02,0.01,0.05"


def sentence(body: str) -> bytes:
    """Return a sentence with its checksum."""
    return f"${body}*{checksum(body)}\r\n".encode()


def read(
    *bodies: str, arrival_s: float = NOON_S, options: NmeaOptions | None = None
) -> tuple[list[Message], list[str]]:
    """Return the messages of sentences that come at once, and what was refused."""
    decoder = NmeaDecoder(options)
    messages = decoder.feed(b"".join(map(sentence, bodies)), arrival_s=arrival_s)
    return messages, decoder.take_refusals()


def read_fix(*bodies: str, arrival_s: float = NOON_S, options: NmeaOptions | None = None) -> Fix:
    """Return the only message, a fix."""
    (fix,), refused = read(*bodies, arrival_s=arrival_s, options=options)
    assert isinstance(fix, Fix)
    assert not refused
    return fix


def test_checksums_of_makers() -> None:
    """Sentences out of manuals: Valeport VA500, miniIPS, miniIPS2 and a Trimble GST."""
    for text in (
        "PRVAT,00.115,M,0010.073,dBar*39",
        "PIPS,0001.00,M*78",
        "PVIPS2,01,45687,10.996,d,10.988,M*61",
        "GPGST,172814.0,0.006,0.023,0.020,273.6,0.023,0.020,0.031*6A",
    ):
        body, _, given_sum = text.partition("*")
        assert checksum(body) == given_sum


def test_gga_is_a_fix_above_the_ellipsoid() -> None:
    """Radians, geoid separation added, sigmas from HDOP and the stated range error."""
    fix = read_fix(GGA, options=NmeaOptions(user_range_error_m=4.0))
    assert fix.time_s == NOON_S
    assert fix.lat == pytest.approx(math.radians(63.0 + 26.0 / 60.0), abs=1e-15)
    assert fix.lon == pytest.approx(math.radians(10.4), abs=1e-15)
    assert fix.height == 60.75
    assert fix.sigma_enu == pytest.approx((3.2, 3.2, 6.4))
    south = read_fix(GGA.replace(",N,", ",S,").replace(",E,", ",W,"))
    assert (south.lat, south.lon) == (-fix.lat, -fix.lon)


def test_gst_before_the_fix() -> None:
    """Latitude's sigma is north, longitude's east."""
    assert read_fix(GST, GGA).sigma_enu == (0.01, 0.02, 0.05)
    assert read_fix(GST.replace("120000", "115959"), GGA).sigma_enu[0] == pytest.approx(4.0)
    for unusable in (",,,", ",0.00,0.00,0.00"):
        body = GST.rsplit(",", 3)[0] + unusable
        assert read_fix(body, GGA).sigma_enu[0] == pytest.approx(4.0)


def test_gst_after_the_fix_is_waited_for() -> None:
    """Once it is known to follow; no longer than said, and no fix is lost when it stops."""
    decoder = NmeaDecoder()
    found: list[tuple[float, float]] = []

    def feed(time_s: float, *bodies: str) -> None:
        for fix in decoder.feed(b"".join(map(sentence, bodies)), arrival_s=time_s):
            assert isinstance(fix, Fix)
            found.append((fix.time_s - NOON_S, round(fix.sigma_enu[0], 3)))

    def at(body: str, second: int) -> str:
        return body.replace("120000", f"1200{second:02d}")

    feed(NOON_S, GGA, GST)
    feed(NOON_S + 1.0, at(GGA, 1))
    assert found == [(0.0, 4.0)]
    feed(NOON_S + 1.1, at(GST, 1))
    feed(NOON_S + 2.0, at(GGA, 2))
    assert found == [(0.0, 4.0), (1.0, 0.01)]
    feed(NOON_S + 2.6)
    assert found[-1] == (2.0, 4.0)
    feed(NOON_S + 3.0, at(GGA, 3))
    assert found[-1] == (3.0, 4.0)
    assert len(found) == 4
    assert decoder.n_refused == 0


def sigmas_of_two(epoch: str, *, tags: bool = False) -> tuple[list[list[float]], list[str]]:
    """Return the sigmas east of the fixes of each receiver, A north of B, and what was refused.

    In an epoch ``A`` and ``B`` are their positions, ``a`` and ``b`` their GST, of 0.1 and 0.2 m;
    both receivers are of one talker where tag blocks tell them apart, of one altogether as ``C``.
    """
    decoder, found = NmeaDecoder(), list[Message]()
    talkers = {"A": "GP", "B": "GP" if tags else "GN", "C": "GP"}
    for k in range(12):
        utc, data = f"1200{k:02d}.00", b""
        for one in epoch:
            talker, east = talkers[one.upper()], {"A": 0.1, "B": 0.2, "C": 0.3}[one.upper()]
            north = "6327" if one == "A" else "6326"
            gga = f"{talker}GGA,{utc},{north}.0000,N,01024.0000,E,4,12,0.8,20.50,M,40.25,M,,"
            gst = f"{talker}GST,{utc},1.1,0.3,0.2,45.0,{east},{east},{east}"
            tag = f"s:{one.upper()},c:1"
            block = f"\\{tag}*{checksum(tag)}\\".encode() if tags else b""
            data += block + sentence(gga if one.isupper() else gst)
        found += decoder.feed(data, arrival_s=NOON_S + k)
    found += decoder.take_waiting()
    fixes = [one for one in found if isinstance(one, Fix)]
    is_north = [math.degrees(one.lat) > 63.44 for one in fixes]
    assert len(fixes) == 12 * sum(one.isupper() for one in epoch)
    pairs = list(zip(fixes, is_north, strict=True))
    of_each = [[one.sigma_enu[0] for one, at in pairs if at == side] for side in (True, False)]
    return of_each, decoder.take_refusals()


@pytest.mark.parametrize("tags", [False, True], ids=["talkers", "tag blocks"])
@pytest.mark.parametrize("epoch", ["ABab", "ABba", "AaBb", "BbAa", "abAB", "BAab", "bBAa"])
def test_of_two_receivers_each_has_its_own_sigmas(epoch: str, *, tags: bool) -> None:
    """By the second epoch at the latest, in whatever order they speak."""
    (north, south), refused = sigmas_of_two(epoch, tags=tags)
    assert set(north[1:]) == {0.1}
    assert set(south[1:]) == {0.2}
    assert not refused


@pytest.mark.parametrize("epoch", ["ABa", "BAa", "aBA", "BaA"])
def test_a_receiver_without_sigmas_is_not_given_those_of_another(epoch: str) -> None:
    """It has those of its HDOP."""
    (north, south), _ = sigmas_of_two(epoch)
    assert set(north[1:]) == {0.1}
    assert set(south[1:]) == {4.0}


@pytest.mark.parametrize("epoch", ["ACac", "AaCc", "ACca"])
def test_of_two_receivers_that_are_not_told_apart_no_sigmas_are_taken(epoch: str) -> None:
    """Which is said, once."""
    of_each, (text,) = sigmas_of_two(epoch)
    assert all(set(sigmas[1:]) == {4.0} for sigmas in of_each)
    assert "two places of one time" in text
    assert "tag block" in text


def test_the_source_of_a_damaged_tag_block_is_not_believed() -> None:
    """The position of A, damaged to be of B, does not get the sigmas of B."""
    gga = "GPGGA,120000.00,6327.0000,N,01024.0000,E,4,12,0.8,20.50,M,40.25,M,,"
    gst = "GPGST,120000.00,1.1,0.3,0.2,45.0,0.2,0.2,0.2"
    block = f"\\s:B*{checksum('s:B')}\\".encode()
    for damaged, east in ((block, 0.2), (block.replace(b"*", b"*0")[:-2] + b"\\", 4.0)):
        decoder = NmeaDecoder()
        data = block + sentence(gst) + damaged + sentence(gga)
        (fix,) = decoder.feed(data, arrival_s=NOON_S) + decoder.take_waiting()
        assert isinstance(fix, Fix)
        assert fix.sigma_enu[0] == east
        assert decoder.n_refused == (damaged != block)


def test_a_gns_for_each_system_of_satellites() -> None:
    """The first has the place; the others are no receivers without a fix."""
    place = "6326.0000,N,01024.0000,E,AAN,14,0.9,5.5,6.5,,"
    bodies = (
        f"GNGNS,120000.00,{place}",
        "GPGNS,120000.00,,,,,,7,,,,,",
        "GLGNS,120000.00,,,,,,5,,,,,",
    )
    decoder = NmeaDecoder(only=("GNS",))
    fixes = decoder.feed(b"".join(map(sentence, bodies)) * 3, arrival_s=NOON_S)
    assert len(fixes) == 3
    assert decoder.n_without_fix == decoder.n_refused == 0
    decoder.feed(sentence("GPGNS,120001.00,,,,,,0,,,,,"), arrival_s=NOON_S + 1.0)
    assert decoder.n_without_fix == 1


def test_a_receiver_may_say_its_sigmas_as_another_talker() -> None:
    """GPGGA and GNGST, as where satellites of several systems are used."""
    (_, south), refused = sigmas_of_two("Ba")
    assert set(south[1:]) == {0.1}
    assert not refused


@pytest.mark.parametrize("quality", ["0", "6", "7", "8", ""])
def test_what_is_no_measured_fix_is_refused(quality: str) -> None:
    """No fix, estimated, typed in, simulated."""
    messages, refused = read(GGA.replace(",4,12", f",{quality},12"))
    assert messages == []
    assert len(refused) == 1


def test_no_fix_is_told_once() -> None:
    """A receiver under water repeats it every second."""
    decoder = NmeaDecoder()
    lost = sentence(GGA.replace(",4,12", ",0,00"))
    decoder.feed(lost * 5 + sentence(GGA) + lost, arrival_s=NOON_S)
    assert decoder.n_without_fix == 6
    assert len(decoder.take_refusals()) == 2


@pytest.mark.parametrize(
    ("utc", "arrival", "expected"),
    [
        ("235959.90", MIDNIGHT_S + 0.1, MIDNIGHT_S - 0.1),
        ("000000.10", MIDNIGHT_S - 0.2, MIDNIGHT_S + 0.1),
        ("000000", MIDNIGHT_S + 0.3, MIDNIGHT_S),
        ("235960.00", MIDNIGHT_S + 0.5, MIDNIGHT_S),
        ("", NOON_S + 0.25, NOON_S + 0.25),
    ],
)
def test_utc_of_day_meets_the_arrival(utc: str, arrival: float, expected: float) -> None:
    """Midnight between instrument and arrival, either way; a leap second; no time."""
    fix = read_fix(GGA.replace("120000.00", utc), arrival_s=arrival)
    assert fix.time_s == pytest.approx(expected, abs=1e-6)


@STEADY
@given(ms=st.integers(0, 86_399_999), late_ms=st.integers(-4000, 4000))
def test_every_time_of_day_comes_back(ms: int, late_ms: int) -> None:
    """Whatever the day's hour and the arrival's side of midnight."""
    seconds, part = divmod(ms, 1000)
    utc = f"{seconds // 3600:02d}{seconds // 60 % 60:02d}{seconds % 60:02d}.{part:03d}"
    time_s = MIDNIGHT_S + 1e-3 * ms
    fix = read_fix(GGA.replace("120000.00", utc), arrival_s=time_s + 1e-3 * late_ms)
    assert fix.time_s == pytest.approx(time_s, abs=1e-6)


def test_a_clock_that_is_off_gives_way_to_the_arrival() -> None:
    """The vehicle's clock is not UTC, or the receiver's is not set."""
    (fix,), refused = read(GGA, arrival_s=NOON_S + 900.0)
    assert fix.time_s == NOON_S + 900.0
    assert "set both clocks to UTC" in refused[0]
    options = NmeaOptions(clock=Clock.ARRIVAL)
    assert read_fix(GGA, arrival_s=NOON_S + 900.0, options=options).time_s == NOON_S + 900.0


def depth(body: str, options: NmeaOptions | None = None) -> float:
    """Return the only message, a depth."""
    (reading,), refused = read(body, options=options)
    assert isinstance(reading, DepthReading)
    assert reading.time_s == NOON_S
    assert not refused
    return reading.depth


def test_depths_of_pressure_sensors() -> None:
    """Air is subtracted; an altimeter's range beside the pressure is not a depth."""
    metre_dbar = 1025.0 * 9.80665 / 1e4
    reading = f"{10.1325 + 20.0 * metre_dbar:.9f}"
    for body in (
        f"PRVAT,00.115,M,{reading},dBar",
        f"PIPS,{reading},d",
        f"PVIPS2,01,45687,{reading},d,1,M",
    ):
        assert depth(body) == pytest.approx(20.0, abs=1e-7)
    assert depth("PIPS,0020.00,M") == 20.0
    tank = NmeaOptions(air_pressure_dbar=0.0, water_density_kg_per_m3=1000.0)
    assert depth("PIPS,9.80665,d", tank) == pytest.approx(10.0)
    assert depth("PIPS,0020.00,M", NmeaOptions(surface_height_m=40.25)) == -20.25


def test_water_below_a_transducer_is_no_vehicle_depth() -> None:
    """Unless the vehicle's builder says so."""
    bodies = ("SDDPT,12.5,0.0", "SDDBT,41.0,f,12.5,M,6.8,F", "GPRMC,120000,V,,,,,,,,,,N")
    assert read(*bodies) == ([], [])
    asked = NmeaOptions(depth_sentences=frozenset({DepthSentence.DPT, DepthSentence.DBT}))
    assert depth(bodies[0], asked) == depth(bodies[1], asked) == 12.5
    assert read("PIPS,0020.00,M", options=asked) == ([], [])


@pytest.mark.parametrize(
    ("raw", "told"),
    [
        (b"$GPGGA,1*00\r\n", "expected checksum"),
        (b"$GPGGA,1\r\n", "expected a checksum '*hh'"),
        (b"$GPGGA,1*4G\r\n", "expected a checksum '*hh'"),
        (b"GPGGA,1*00\r\n", "begins with '$'"),
        (b"$" + b"A" * 2000 + b"\r\n", "at most 1024 bytes"),
        (sentence("GPGGA,120000"), "expected 14 fields"),
        (sentence(GGA.replace("120000.00", "250000")), "UTC as hhmmss"),
        (sentence(GGA.replace("120000.00", "12:00")), "UTC as hhmmss"),
        (sentence(GGA.replace("6326.0000", "6360.0000")), "angle"),
        (sentence(GGA.replace("6326.0000", "9026.0000")), "check the unit"),
        (sentence(GGA.replace(",N,", ",X,")), "angle"),
        (sentence(GGA.replace(",N,", ",,")), "angle"),
        (sentence(GGA.replace("20.50", "nan")), "altitude"),
        (sentence(GGA.replace("20.50", "1_0")), "altitude"),
        (sentence("GPGST,120000.00"), "expected 8 fields"),
        (sentence("PRVAT,00.115,M"), "depth_sentences"),
        (sentence("PIPS,1.0,"), "dBar"),
        (sentence("PIPS,99999,M"), "depth, m"),
    ],
)
def test_damage_is_refused(raw: bytes, told: str) -> None:
    """One sentence each; the next message is decoded."""
    decoder = NmeaDecoder()
    (fix,) = decoder.feed(raw + sentence(GGA), arrival_s=NOON_S)
    assert isinstance(fix, Fix)
    (text,) = decoder.take_refusals()
    assert text.startswith("nmea: ")
    assert told in text


def test_a_sentence_that_was_run_into_is_saved() -> None:
    """Bytes lost on a serial line join two sentences; the second is whole."""
    decoder = NmeaDecoder()
    assert len(decoder.feed(b"$GPGGA,12" + sentence(GGA), arrival_s=NOON_S)) == 1
    assert decoder.n_refused == 1


def test_geoid_where_the_receiver_has_none() -> None:
    """Its field counts first."""
    options = NmeaOptions(geoid_separation_m=39.0)
    assert read_fix(GGA.replace("40.25", ""), options=options).height == 59.5
    assert read_fix(GGA, options=options).height == 60.75


@pytest.mark.parametrize(
    "settings",
    [
        {"water_density_kg_per_m3": 0.0},
        {"surface_height_m": math.nan},
        {"geoid_separation_m": math.inf},
        {"user_range_error_m": -1.0},
    ],
)
def test_options_are_checked(settings: dict[str, float]) -> None:
    """Once, at the border."""
    with pytest.raises(ConfigError, match="NmeaOptions"):
        NmeaOptions(**settings)  # type: ignore[arg-type]


NAVIGATION = Navigation(
    time_s=NOON_S + 0.9996,
    lat=math.radians(-63.5),
    lon=math.radians(10.4),
    height=-30.25,
    health=Health.GOOD,
    reason="all agree",
    confidence=0.9,
    bottom_lock=True,
    since_aid_s=0.2,
    latency_s=0.01,
    velocity_enu=np.array([1.0, -1.0, 0.1]),
    roll_pitch_heading=np.array([0.01, -0.02, math.radians(359.999)]),
    position_sigma_enu=np.ones(3),
    velocity_sigma_enu=np.ones(3),
    attitude_sigma=np.ones(3),
    gyro_bias=np.zeros(3),
    accel_bias=np.zeros(3),
    beam_weights=np.array([1.0, 0.5, math.nan, 1.0]),
)


def fields_of(text: str) -> list[str]:
    """Return the fields of a sentence whose checksum is right."""
    body, _, given_sum = text.removeprefix("$").removesuffix("\r\n").partition("*")
    assert checksum(body) == given_sum
    return body.split(",")


def test_an_answer_as_sentences() -> None:
    """Estimated (6); rounding carries into the next second and over north."""
    gga = fields_of(encode_gga(NAVIGATION, geoid_separation_m=40.0))
    assert gga[:7] == ["INGGA", "120001.000", "6330.000000", "S", "01024.000000", "E", "6"]
    assert gga[9:13] == ["-70.250", "M", "40.000", "M"]
    assert len(gga) == 15
    vtg = fields_of(encode_vtg(NAVIGATION))
    assert vtg == ["INVTG", "135.00", "T", "", "M", "2.749", "N", "5.091", "K", "E"]
    assert fields_of(encode_hdt(NAVIGATION)) == ["INHDT", "0.00", "T"]
    all_of_it = encode_nmea(NAVIGATION)
    assert all_of_it.count(b"\r\n") == 3
    assert max(map(len, all_of_it.split(b"\r\n"))) <= 80


@pytest.mark.parametrize("health", list(Health))
def test_only_a_usable_answer_is_written(health: Health) -> None:
    """Else quality 0, mode N and empty fields: nobody steers by them."""
    navigation = dataclasses.replace(NAVIGATION, health=health)
    gga, vtg, hdt = (fields_of(f(navigation)) for f in (encode_gga, encode_vtg, encode_hdt))
    is_usable = health in (Health.GOOD, Health.DEGRADED)
    assert (gga[6], vtg[-1], bool(hdt[1])) == (("6", "E", True) if is_usable else ("0", "N", False))
    assert bool(gga[2]) == bool(vtg[1]) == is_usable
    nowhere = dataclasses.replace(NAVIGATION, lat=math.nan)
    assert fields_of(encode_gga(nowhere))[6] == "0"


def test_our_own_answer_is_never_a_measurement() -> None:
    """Fed back it is refused."""
    decoder = NmeaDecoder()
    assert decoder.feed(encode_nmea(NAVIGATION), arrival_s=NOON_S) == []
    assert decoder.n_refused == 1


@STEADY
@given(
    lat=st.floats(-math.pi / 2, math.pi / 2),
    lon=st.floats(-math.pi, math.pi),
    height=st.floats(-11_000, 9_000),
)
def test_position_comes_back(lat: float, lon: float, height: float) -> None:
    """To what the digits of a sentence hold."""
    navigation = dataclasses.replace(NAVIGATION, lat=lat, lon=lon, height=height)
    body = ",".join(fields_of(encode_gga(navigation, geoid_separation_m=12.3)))
    fix = read_fix(body.replace(",6,00,", ",1,10,0.8"), arrival_s=NOON_S)
    assert fix.lat == pytest.approx(lat, abs=2e-10)
    assert math.remainder(fix.lon - lon, 2.0 * math.pi) == pytest.approx(0.0, abs=2e-10)
    assert fix.height == pytest.approx(height, abs=1e-3)


def test_a_fix_without_height_or_quality_is_poor_and_said_once() -> None:
    """The surface's height to 100 m; twice the range error; so is an altitude above the geoid."""
    no_height = GGA.replace("20.50", "").replace("40.25", "").replace(",0.8,", ",,")
    (fix, again), refused = read(
        no_height, no_height.replace("00.00", "01.00"), options=NmeaOptions(surface_height_m=39.0)
    )
    assert isinstance(fix, Fix)
    assert fix.height == 39.0
    assert fix.sigma_enu == (10.0, 10.0, 100.0)
    assert isinstance(again, Fix)
    assert ["no HDOP" in refused[0], "no height" in refused[1], len(refused)] == [True, True, 2]
    (fix,), refused = read(GGA.replace("40.25", ""))
    assert isinstance(fix, Fix)
    assert (fix.height, fix.sigma_enu[2]) == (20.5, 100.0)
    assert "--geoid-separation" in refused[0]


PLACE = "6326.0000,N,01024.0000,E"
POSITIONS_OF_ONE_EPOCH = {
    "GNS": f"GNGNS,1200%02d.00,{PLACE},AN,10,0.9,20.50,40.25,,",
    "RMC": f"GNRMC,1200%02d.00,A,{PLACE},0.5,54.7,250625,,,A",
    "GLL": f"GNGLL,{PLACE},1200%02d.00,A,D",
}


@pytest.mark.parametrize(
    ("sent", "read_as"),
    [
        (("GLL", "RMC", "GNS"), "GNS"),
        (("GLL", "RMC"), "RMC"),
        (("GLL",), "GLL"),
        (("GGA", "GNS", "RMC", "GLL"), "GGA"),
    ],
)
def test_positions_by_one_rule(sent: tuple[str, ...], read_as: str) -> None:
    """The sentence that says most is read; where it is not GGA, after five seconds of waiting."""
    decoder = NmeaDecoder()
    bodies = {**POSITIONS_OF_ONE_EPOCH, "GGA": GGA.replace("120000", "1200%02d")}
    fixes, n_early = [], 0
    for k in range(12):
        data = b"".join(sentence(bodies[kind] % k) for kind in sent)
        fixes += decoder.feed(data, arrival_s=NOON_S + k)
        n_early = len(fixes) if k == 4 else n_early
    assert n_early == (5 if read_as == "GGA" else 0)
    assert [fix.time_s for fix in fixes] == [NOON_S + k for k in range(12)]
    sigmas = {fix.sigma_enu[:2] for fix in fixes if isinstance(fix, Fix)}
    assert sigmas == {{"GGA": (4.0, 4.0), "GNS": (4.5, 4.5)}.get(read_as, (10.0, 10.0))}


@pytest.mark.parametrize(
    ("body", "lat_deg", "lon_deg"),
    [
        (f"GPRMC,120000,A,{PLACE},0.5,54.7,250625,,,", 63.0 + 26.0 / 60.0, 10.4),
        (f"GPRMC,120000,A,{PLACE},0.5,54.7,250625", 63.0 + 26.0 / 60.0, 10.4),
        (f"GPGLL,{PLACE},120000,A,", 63.0 + 26.0 / 60.0, 10.4),
        ("GPGGA,120000,807.5,S,907.25,W,1,8,0.8,20.5,M,40.2,M,,", -8.125, -(9.0 + 7.25 / 60.0)),
        ("GPGGA,120000,07.5,N,00.3,E,1,8,0.8,20.5,M,40.2,M,,", 0.125, 0.005),
    ],
)
def test_positions_of_older_receivers(body: str, lat_deg: float, lon_deg: float) -> None:
    """An empty mode says nothing, the status does; zeros before the degrees may be left out."""
    (fix,) = NmeaDecoder(only=(body[2:5],)).feed(sentence(body), arrival_s=NOON_S)
    assert isinstance(fix, Fix)
    np.testing.assert_allclose(np.degrees([fix.lat, fix.lon]), [lat_deg, lon_deg], atol=1e-9)


def test_positions_where_the_better_sentence_falls_silent() -> None:
    """What it says less comes late, but all of it and nothing twice; the better one ends that."""
    decoder, fixes = NmeaDecoder(), []
    bodies = {**POSITIONS_OF_ONE_EPOCH, "GGA": GGA.replace("120000", "1200%02d")}
    for k in range(30):
        kinds = ("GGA", "RMC") if k < 6 or k >= 20 else ("RMC",)
        data = b"".join(sentence(bodies[kind] % k) for kind in kinds)
        fixes += decoder.feed(data, arrival_s=NOON_S + k)
    assert [fix.time_s for fix in fixes] == [NOON_S + k for k in range(30)]


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("GNGNS,120000.00,,,,,NN,00,,,,,", "no fix"),
        ("GNRMC,120000.00,V,,,,,,,250625,,,N", "no fix"),
        ("GNGLL,,,,,120000.00,V,N", "no fix"),
        (f"GNGNS,120000.00,{PLACE},EE,10,0.9,20.50,40.25,,", "mode 'EE'"),
        (f"GNRMC,120000.00,A,{PLACE},0.5,54.7,250625,,,S", "mode 'S'"),
        (f"GNGLL,{PLACE},120000.00,A,M", "mode 'M'"),
        (f"GNRMC,120000.00,A,{PLACE}", "expected 12 fields"),
    ],
)
def test_other_positions_that_are_no_measured_fix(body: str, said: str) -> None:
    """Not valid, estimated, simulated, typed in, cut off."""
    kind = body[2:5]
    decoder = NmeaDecoder(only=(kind,))
    assert decoder.feed(sentence(body), arrival_s=NOON_S) == []
    (text,) = decoder.take_refusals()
    assert text.startswith(f"nmea: {kind}: ")
    assert said in text


@pytest.mark.parametrize(
    ("body", "degrees"),
    [
        ("HEHDT,123.4,T", 123.4),
        ("HETHS,5.0,A", 5.0),
        ("PASHR,120000.00,359.9,T,0.1,0.2,0.0,0.1,0.1,0.2,1,1", 359.9),
        ("HCHDG,10.0,2.0,W,3.0,E", 8.0),
        ("HCHDG,10.0,,,3.0,E", 10.0),
    ],
)
def test_headings(body: str, degrees: float) -> None:
    """True, or magnetic with the deviation and without the variation, which is the vehicle's."""
    name = "PASHR" if body.startswith("P") else body[2:5]
    decoder = NmeaDecoder(only=(name,))
    (reading,) = decoder.feed(sentence(body), arrival_s=NOON_S)
    assert isinstance(reading, HeadingReading)
    assert reading.heading == pytest.approx(math.radians(degrees))
    assert reading.time_s == NOON_S
    silent = {
        "HDT": "HEHDT,,T",
        "THS": "HETHS,5.0,V",
        "PASHR": "PASHR,POS,1,2",
        "HDG": "HCHDG,,,,,",
    }
    assert decoder.feed(sentence(silent[name]), arrival_s=NOON_S) == []
    assert decoder.take_refusals() == []


def test_one_heading_at_a_time() -> None:
    """A true and a magnetic one of one instrument are not mixed, and our own is none."""
    decoder = NmeaDecoder()
    found = []
    for k in range(10):
        data = sentence("HCHDG,10.0,,,3.0,E") + sentence("HEHDT,13.0,T") + sentence("INHDT,99.0,T")
        found += decoder.feed(data, arrival_s=NOON_S + k)
    headings = [round(math.degrees(one.heading)) for one in found if hasattr(one, "heading")]
    assert headings == [13] * 10
    assert "expected a measured heading" in read("HETHS,5.0,E")[1][0]


def ubx(payload: bytes) -> bytes:
    """Return a binary frame of a u-blox receiver."""
    body = b"\x01\x07" + len(payload).to_bytes(2, "little") + payload
    first = second = 0
    for byte in body:
        first = (first + byte) & 255
        second = (second + first) & 255
    return b"\xb5\x62" + body + bytes((first, second))


def test_binary_frames_between_cost_no_sentence() -> None:
    """UBX and RTCM, with line ends, dollars and stars among their bytes; cut anywhere."""
    rng = random.Random(3)
    data = b""
    for k in range(40):
        noise = bytes(rng.choice((rng.randrange(256), 13, 10, 36, 42)) for _ in range(300))
        rtcm = b"\xd3" + (90).to_bytes(2, "big") + rng.randbytes(93)
        data += ubx(noise) + rtcm + b"\x00" * 5 + sentence(GGA.replace("120000", f"1200{k:02d}"))
    decoder = NmeaDecoder()
    fixes = []
    for at in range(0, len(data), 37):
        fixes += decoder.feed(data[at : at + 37], arrival_s=NOON_S + 20.0)
    assert len(fixes) == 40


def test_bytes_without_any_sentence_are_told_once() -> None:
    """A wrong baud rate, or a port that speaks another protocol."""
    decoder = NmeaDecoder()
    decoder.feed(ubx(bytes(range(128, 256)) * 8) * 30, arrival_s=NOON_S)
    (text,) = decoder.take_refusals()
    assert "check the baud rate" in text
    assert len(decoder.feed(b"\r\n" + sentence(GGA), arrival_s=NOON_S)) == 1


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n", b"\n\r", b" \r\n"])
def test_line_ends(end: bytes) -> None:
    """CR alone as well."""
    data = sentence(GGA).rstrip() + end
    decoder = NmeaDecoder()
    assert len(decoder.feed(data * 3, arrival_s=NOON_S)) == 3
    assert decoder.n_refused == 0


def test_tag_blocks() -> None:
    """Before a sentence, of AIS too; one that is damaged costs no fix."""
    tag = "s:GP0001,c:1750812360"
    block = f"\\{tag}*{checksum(tag)}\\".encode()
    decoder = NmeaDecoder()
    data = block + sentence(GGA) + block + b"!AIVDM,1,1,,A,15,0*00\r\n" + b"$" + sentence(GGA)
    assert len(decoder.feed(data, arrival_s=NOON_S)) == 2
    assert decoder.n_refused == 0
    assert len(decoder.feed(block.replace(b"c:1", b"c:2") + sentence(GGA), arrival_s=NOON_S)) == 1
    assert "tag block checksum" in decoder.take_refusals()[0]


def test_what_is_held_can_be_had_before_its_time() -> None:
    """A fix that waits for its GST, and positions that wait for a sentence that says more."""
    decoder = NmeaDecoder()
    decoder.feed(sentence(GGA) + sentence(GST), arrival_s=NOON_S)
    rmc = "GPRMC,12000{}.00,A,6326.0000,N,01024.0000,E,0.0,0.0,141123,,,A"
    given = decoder.feed(sentence(GGA.replace("120000", "120001")), arrival_s=NOON_S + 1.0)
    given += decoder.feed(sentence(rmc.format(1)), arrival_s=NOON_S + 1.0)  # of the same moment
    assert not given
    assert [message.time_s - NOON_S for message in decoder.waiting()] == [1.0]
    given = decoder.feed(sentence(rmc.format(2)), arrival_s=NOON_S + 2.0)
    assert [message.time_s - NOON_S for message in given] == [1.0]
    for held in (decoder.waiting, decoder.waiting, decoder.take_waiting):
        assert [message.time_s - NOON_S for message in held()] == [2.0]
    assert decoder.waiting() == decoder.take_waiting() == []


def test_a_listener_that_reads_nothing_says_what_comes() -> None:
    """After ten seconds, once, until something is read."""
    decoder = NmeaDecoder()
    for k in range(30):
        data = sentence("GPVTG,,T,,M,0.0,N,0.0,K,A") + sentence("SDDPT,12.5,0.0")
        assert decoder.feed(data, arrival_s=NOON_S + k) == []
    (text,) = decoder.take_refusals()
    assert "(VTG, DPT)" in text
    assert "GGA, GNS, RMC, GLL" in text
    assert len(decoder.feed(sentence("PIPS,0020.00,M"), arrival_s=NOON_S + 30.0)) == 1
    decoder.feed(sentence("SDDPT,12.5,0.0"), arrival_s=NOON_S + 31.0)
    assert decoder.take_refusals() == []
