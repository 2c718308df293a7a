"""The faults of data: rows of the table that need no process of their own."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from benchmarks.faults.case import BEGIN_S, Case, Rule, Stage, Transform, simulated_stage
from benchmarks.faults.transforms import (
    Edit,
    beams,
    chained,
    clock_moved,
    edited,
    frozen,
    late,
    moved,
    offset,
    one_more,
    outliers,
    permuted,
    repeated,
    same,
    scaled,
    silent,
    spoiled,
    turned_start,
    untouched,
    with_speeds,
)
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.mission.navigation import Health
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message

NAN, INF = math.nan, math.inf
BAD_NUMBERS: Final = [NAN, INF, -INF]
USUAL: Final = Stage()
SURFACING: Final = Stage(duration_s=200.0, gnss=((0.0, 60.0), (110.0, 200.0)))
"""GNSS comes back."""
GNSS_ALL: Final = Stage(gnss=((0.0, 1e9),))
HARMLESS: Final = Rule(is_harmless=True, good_after_s=2.0)
PROVEN_S: Final = 13.0
"""Good again where a contradiction has to end first: the answer is begun anew within 3 s, and a lane
without the sensor has to agree with it for 8 s."""
TOLD: Final = Health.DEGRADED
FOLLOWED: Final = Rule(Health.BAD, 15.0, None, told="recovered")


def water_track(current_enu: tuple[float, float, float]) -> Edit:
    """Let the DVL measure against water that moves."""

    def edit(ping: Any) -> Message:
        sim, vehicle, _ = simulated_stage(USUAL)
        truth = sim.truth_at(np.array([ping.time_s]))
        R_lb = R_lb_from_roll_pitch_heading(*truth.roll_pitch_heading.T)[0]
        off = vehicle.mount.beams_b @ (R_lb.T @ np.array(current_enu))
        return with_speeds(ping, np.array(ping.speed) - off)

    return edit


def lasting(
    name: str,
    injected: str,
    spoil: Transform,
    rule: Rule,
    end_s: float = INF,
    stage: Stage = USUAL,
) -> Case:
    """Return a fault from the usual begin to an end, or for ever, and say so."""
    until = f" to {end_s:.0f} s" if end_s < INF else " s on"
    injected = f"{injected}from {BEGIN_S:.0f}{until}"
    return Case(name, injected, spoil, rule, end_s=end_s, stage=stage)


def _numbers() -> list[Case]:
    """NaN and infinities, two of three messages of a sensor for 10 s."""
    fields = (
        ("gyro", ImuSample, "gyro_b", Stage(), 10.0),
        ("accelerometer", ImuSample, "accel_b", Stage(), 10.0),
        ("DVL speed", Ping, "speed", Stage(), 10.0),
        ("DVL sigma", Ping, "sigma", Stage(), 10.0),
        ("depth", DepthReading, "depth", Stage(), 5.0),
        ("GNSS", Fix, "lat", GNSS_ALL, 5.0),
        ("stamps of all", object, "time_s", Stage(), 10.0),
    )
    return [
        Case(
            f"NaN, ±inf: {name}",
            f"in two of three messages, {BEGIN_S:.0f} to {BEGIN_S + 10:.0f} s",
            edited(kind, spoiled(field, BAD_NUMBERS), BEGIN_S, BEGIN_S + 10.0),
            Rule(good_after_s=good_s, told="" if field == "speed" else _told(kind)),
            end_s=BEGIN_S + 10.0,
            stage=stage,
        )
        for name, kind, field, stage, good_s in fields
    ]


def _told(kind: type) -> str:
    names = {ImuSample: "imu", Ping: "dvl", DepthReading: "depth", Fix: "gnss"}
    return f"{names.get(kind, '')}_not_finite" if kind in names else ""


def _units() -> list[Case]:
    """Units and signs, from a moment on; nobody gets good again before somebody repairs it."""
    rows = (
        ("gyro in deg/s", ImuSample, scaled("gyro_b", factor=math.degrees(1.0))),
        ("accelerometer in g", ImuSample, scaled("accel_b", factor=1 / 9.80665)),
        ("accelerometer sign", ImuSample, scaled("accel_b", factor=-1.0)),
        ("beam speeds in mm/s", Ping, scaled("speed", factor=1e3)),
        ("beam speeds in cm/s", Ping, scaled("speed", factor=1e2)),
        ("all beams' sign", Ping, scaled("speed", factor=-1.0)),
        ("depth in cm", DepthReading, scaled("depth", factor=100.0)),
        ("depth sign", DepthReading, scaled("depth", factor=-1.0)),
    )
    in_degrees = scaled("lat", "lon", factor=math.degrees(1.0))
    flip = beams(lambda speed: speed * np.array([-1.0, 1.0, 1.0, 1.0]))
    for_good = Rule(TOLD, 5.0, None)
    return [
        *(lasting(name, "", edited(kind, edit, BEGIN_S), for_good) for name, kind, edit in rows),
        lasting(
            "latitude, longitude in degrees", "GNSS all the time, ",
            edited(Fix, in_degrees, BEGIN_S), Rule(told="gnss_implausible"), stage=GNSS_ALL,
        ),
        lasting(
            "one beam's sign", "beam 1, ", edited(Ping, flip, BEGIN_S), Rule(good_after_s=15.0)
        ),
    ]  # fmt: skip


def _dvl() -> list[Case]:
    begin_s = BEGIN_S

    def row(
        name: str, injected: str, edit: Edit, rule: Rule, end_s: float = INF, stage: Stage = USUAL
    ) -> Case:
        spoil = edited(Ping, edit, begin_s, end_s)
        return lasting(name, f"{injected}, ", spoil, rule, end_s, stage)

    alike = beams(lambda speed: np.full(4, speed[0]))
    stuck = beams(lambda speed: np.array([0.0, *speed[1:]]))
    long = Stage(duration_s=150.0)
    return [
        row("identical beams", "all four those of beam 1", alike, Rule(TOLD, 5.0), begin_s + 20.0),
        lasting(
            "frozen DVL", "one report with new stamps, ", frozen(Ping, begin_s, begin_s + 20.0),
            Rule(TOLD, 5.0, told="dvl_repeated_speeds"), begin_s + 20.0,
        ),
        lasting(
            "DVL silent 60 s", "", silent(Ping, begin_s, begin_s + 60.0), Rule(TOLD, 5.0),
            begin_s + 60.0, long,
        ),
        row("one beam stuck", "beam 1 reads 0", stuck, Rule(good_after_s=15.0)),
        row(
            "two beams off", "+1 m/s on beams 1, 2", offset(1, 1, 0, 0),
            Rule(), begin_s + 30.0, long,
        ),
        row(
            "two opposite beams off", "+1 m/s on 1, −1 on 3; fixes from 110 s on",
            offset(1, 0, -1, 0), Rule(good_after_s=90.0), begin_s + 30.0, SURFACING,
        ),
        row(
            "water track", "current 0.5 m/s to the east", water_track((0.5, 0.0, 0.0)),
            Rule(good_after_s=PROVEN_S), begin_s + 20.0,
        ),
        row(
            "water track, slow", "current 0.15 m/s to the north", water_track((0.0, 0.15, 0.0)),
            Rule(good_after_s=PROVEN_S), begin_s + 20.0,
        ),
        row(
            "40 % outliers", "each beam, ±0.5 to 3 m/s", outliers(0.4, (0.5, 3.0)),
            Rule(good_after_s=None),
        ),
        row(
            "40 % small outliers", "each beam, ±0.1 to 0.3 m/s", outliers(0.4, (0.1, 0.3)),
            Rule(good_after_s=None),
        ),
        row("opposite beams swapped", "1 with 3", permuted((2, 1, 0, 3)), Rule(good_after_s=None)),
        row("neighbours swapped", "1 with 2", permuted((1, 0, 2, 3)), Rule(good_after_s=None)),
        row("beams turned", "2, 3, 4, 1", permuted((1, 2, 3, 0)), Rule(TOLD, 5.0, None)),
    ]  # fmt: skip


def _order() -> list[Case]:
    every = f"from the beginning, lag {10} s"
    return [
        Case("all repeated", "every message twice", repeated(1.0), HARMLESS, 0.0),
        Case("10 % repeated", "up to 50 messages later", repeated(0.1, later=50), HARMLESS, 0.0),
        Case("flood", "every ping 100 times", repeated(1.0, times=99, kind=Ping), HARMLESS, 0.0),
        Case(
            "late within the lag", f"20 % of pings by up to 3 s, {every}",
            late(Ping, 0.2, 0.0, 3.0), HARMLESS, 0.0, 0.0,
        ),
        Case(
            "inertial samples out of order", f"2 % by up to 0.3 s, {every}",
            late(ImuSample, 0.02, 0.0, 0.3), Rule(is_harmless=True, good_after_s=None), 0.0, 0.0,
        ),
        Case(
            "late beyond the lag", f"20 % of pings and depths by 12 to 15 s, {every}",
            chained(late(Ping, 0.2, 12.0, 15.0), late(DepthReading, 0.2, 12.0, 15.0)),
            Rule(told="dvl_too_late"), 0.0, 0.0,
        ),
    ]  # fmt: skip


def _clock() -> list[Case]:
    def jump(by_s: float, rule: Rule, stage: Stage = USUAL) -> Case:
        name = f"clock {'forward' if by_s > 0 else 'back'} {abs(by_s):g} s"
        move = clock_moved(by_s, BEGIN_S)
        return Case(
            name, f"all stamps, at {BEGIN_S:.0f} s", move, rule, clock_s=by_s, stage=stage,
            end_s=BEGIN_S,
        )  # fmt: skip

    def single(name: str, kind: type, stamp: float) -> Case:
        more = one_more(lambda message: same(message, time_s=stamp), kind, BEGIN_S)
        return Case(name, f"one {kind.__name__} at {BEGIN_S:.0f} s", more, HARMLESS)

    year = 365 * 86400.0
    return [
        jump(30.0, Rule(worst=Health.ALIGNING, within_s=2.0, good_after_s=130.0), SURFACING),
        jump(3.0, Rule(told="clock_gap", good_after_s=15.0)),
        jump(-0.5, Rule(told="clock_set_back")),
        jump(-3.0, Rule(told="clock_set_back")),
        jump(-30.0, Rule(told="clock_set_back")),
        Case(
            "DVL clock forward 3 s", f"pings only, at {BEGIN_S:.0f} s",
            clock_moved(3.0, BEGIN_S, Ping), Rule(TOLD, 10.0, None),
        ),
        single("a sample a year ahead", ImuSample, BEGIN_S + year),
        single("a ping a year ahead", Ping, BEGIN_S + year),
        single("a sample of 1970", ImuSample, BEGIN_S - 50 * year),
        single("a ping of 1970", Ping, BEGIN_S - 50 * year),
        single("a depth a year ahead", DepthReading, BEGIN_S + year),
    ]  # fmt: skip


def _imu() -> list[Case]:
    def gap(length_s: float, rule: Rule, stage: Stage = USUAL) -> Case:
        end_s = BEGIN_S + length_s
        name = f"IMU gap {length_s:g} s" if end_s < INF else "IMU silent for ever"
        return lasting(name, "", silent(ImuSample, BEGIN_S, end_s), rule, end_s, stage)

    return [
        gap(1.0, Rule()),
        gap(5.0, Rule(worst=Health.BAD, within_s=2.0, good_after_s=20.0)),
        gap(15.0, Rule(worst=Health.BAD, within_s=2.0, good_after_s=130.0), SURFACING),
        gap(INF, Rule(worst=Health.BAD, within_s=2.0, good_after_s=None)),
    ]


def _aids() -> list[Case]:
    begin_s = BEGIN_S
    jump, north = moved("depth", 20.0), moved("lat", 100.0 / 6.371e6)
    return [
        lasting("depth stuck", "", frozen(DepthReading, begin_s), Rule(good_after_s=None)),
        lasting(
            "depth jumps 20 m", "", edited(DepthReading, jump, begin_s, begin_s + 10.0),
            Rule(TOLD, 5.0), begin_s + 10.0,
        ),
        lasting("depth 20 m off", "", edited(DepthReading, jump, begin_s), FOLLOWED),
        Case(
            "one GNSS outlier", "100 m to the north, at 40 s",
            edited(Fix, north, 40.0, 40.9), Rule(told="doubt"), 40.0, 40.9,
        ),
        Case(
            "GNSS outliers", "5 fixes in a row 100 m to the north, from 40 s on",
            edited(Fix, north, 40.0, 44.9), Rule(TOLD, 5.0, 15.0), 40.0, 44.9,
        ),
        Case(
            "GNSS offset that stays", "100 m to the north, from 65 s on, GNSS all the time",
            edited(Fix, north, 65.0), FOLLOWED, stage=GNSS_ALL,
        ),
        Case(
            "heading wrong at the start", "180 degrees, stated sigma 0.5 degrees", untouched,
            Rule(TOLD, 10.0, None), 0.0, vehicle=turned_start,
        ),
    ]  # fmt: skip


def data_cases() -> list[Case]:
    """Return all of them, in the order of the table."""
    return [*_numbers(), *_units(), *_dvl(), *_order(), *_clock(), *_imu(), *_aids()]
