"""The catalogue of malformed missions: each damages a valid folder in one way.

``docs/malformed-input.md`` is made from it, and ``tests/unit/test_malformed.py`` runs it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError, SsmGraphError
from tests.mission_damage import (
    ACCEL,
    BEAMS,
    GYRO,
    POSITION,
    Damage,
    aided,
    beams_against_depth,
    both,
    cell,
    columns,
    drop_section,
    every_second_code,
    lines,
    new_column,
    parquet,
    raw,
    remove,
    rename,
    republish,
    rolling,
    toml,
)


@dataclass(frozen=True, slots=True)
class Malformed:
    """One way in which a mission folder can be wrong."""

    title: str
    """What is wrong with it, for people."""
    damage: Damage
    """Turn a valid folder into a wrong one."""
    error: type[SsmGraphError]
    words: tuple[str, ...]
    """What the message must contain: where, and the point of the hint."""


def cases(
    error: type[SsmGraphError], rows: Mapping[str, tuple[Damage, str]]
) -> tuple[Malformed, ...]:
    """Return the cases of an error: by their titles the damage, and the words with bars between."""
    return tuple(
        Malformed(title, damage, error, tuple(words.split(" | ")))
        for title, (damage, words) in rows.items()
    )


def without_first_beam(row: str) -> str:
    """Return a line of a DVL's table with the cell of its first beam left empty."""
    time, _, *others = row.split(",")
    return ",".join([time, "", *others])


TOML_CASES = cases(
    ConfigError,
    {
        "A pipe in the place of mission.toml": (
            both(remove("mission.toml"), lambda folder: os.mkfifo(folder / "mission.toml")),
            "mission.toml | expected a file",
        ),
        "Sections 50 000 deep": (
            raw("mission.toml", lambda content: b"a." * 50_000 + b"a = 1\n" + content),
            "mission.toml:1: expected at most 500 dots",
        ),
        "A settings file of 2 MB": (
            raw("mission.toml", lambda content: content + b"#" * 2**21),
            "mission.toml: expected at most 1048576 bytes | another file",
        ),
        "A sigma whose square is zero": (
            toml("beam_noise_m_per_s = 0.005", "beam_noise_m_per_s = 1e-300"),
            "mission.toml [dvl] beam_noise_m_per_s | 1e-300",
        ),
        "No mission.toml": (remove("mission.toml"), "there is none in"),
        "Not valid TOML": (
            toml('name = "straight-run"', "name = straight-run"),
            "mission.toml: expected valid TOML | line 2",
        ),
        "A newer format": (toml("format = 1", "format = 2"), "format:  | got 2"),
        "No format": (toml("format = 1\n", ""), "format | missing"),
        "No name": (toml('name = "straight-run"\n', ""), "name:  | nothing"),
        "An order of the rows that is not known": (
            toml("format = 1", 'format = 1\norder = "random"'),
            "order: expected one of time, arrival | 'random'",
        ),
        "A section misspelt": (
            toml("[gnss]", "[gps]"),
            "mission.toml gps:  | unknown key or section | gnss",
        ),
        "A section missing": (drop_section("dvl"), "[dvl]:  | missing"),
        "A key misspelt": (
            toml("beam_noise_m_per_s", "beam_noise_mps"),
            "[dvl] beam_noise_mps | did you mean 'beam_noise_m_per_s'",
        ),
        "A key missing": (
            toml("gyro_bias_deg_per_h = 0.5\n", ""),
            "[imu] gyro_bias_deg_per_h | missing | a number above 0",
        ),
        "A number in quotes": (
            toml("beam_noise_m_per_s = 0.005", 'beam_noise_m_per_s = "0.005"'),
            "[dvl] beam_noise_m_per_s | expected a number | '0.005'",
        ),
        "A truth value for a number": (
            toml("noise_m = 0.05", "noise_m = true"),
            "[depth] noise_m | expected a number | True",
        ),
        "A list of the wrong length": (
            toml("lever_arm_m = [0.2, 0.0, 0.1]", "lever_arm_m = [0.2, 0.0]"),
            "[dvl] lever_arm_m | a list of 3 numbers | [0.2, 0.0]",
        ),
        "Noise of zero": (
            toml("beam_noise_m_per_s = 0.005", "beam_noise_m_per_s = 0.0"),
            "[dvl] beam_noise_m_per_s | above 0 | got 0.0",
        ),
        "Noise that is NaN": (
            toml("accel_bias_ug = 100.0", "accel_bias_ug = nan"),
            "[imu] accel_bias_ug | expected a number | got nan",
        ),
        "A lever arm in millimetres": (
            toml("lever_arm_m = [0.2, 0.0, 0.1]", "lever_arm_m = [200, 0, 100]"),
            "[dvl] lever_arm_m | from -100 to 100 | metres",
        ),
        "Body axes that are not known": (
            toml('body = "FRD"', 'body = "NED"'),
            "[frames] body | FRD, FLU, RFU | 'NED'",
        ),
        "A stamp that is not known": (
            toml('stamp = "end"', 'stamp = "begin"'),
            "[imu] stamp | start, middle, end | 'begin'",
        ),
        "The horizontal angle of the beams instead of the Janus angle": (
            toml("beam_janus_deg = 30.0", "beam_janus_deg = 60.0"),
            "[dvl] beam_janus_deg | got 60.0 | the horizontal angle is 90 minus this",
        ),
        "Four beams in one plane": (
            toml("[45, 135, 225, 315]", "[45, 225, 45, 225]"),
            "[dvl] beam_azimuth_deg | lie in one plane",
        ),
        "Beam vectors that are not of unit length": (
            toml(
                "beam_azimuth_deg = [45, 135, 225, 315]\nbeam_janus_deg = 30.0",
                "beam_vectors = [[1, 0, 2], [0, 1, 2], [-1, 0, 2], [0, -1, 2]]",
            ),
            "[dvl] beam_vectors | unit vectors | 2.23607 | beam 1",
        ),
        "Beam vectors and angles together": (
            toml("beam_janus_deg = 30.0", "beam_vectors = [[1,0,0],[0,1,0],[0,0,1],[0,0,1]]"),
            "[dvl] beam_vectors | together with beam_azimuth_deg",
        ),
        "A Janus angle without azimuths": (
            toml("beam_azimuth_deg = [45, 135, 225, 315]\n", ""),
            "[dvl] beam_azimuth_deg | missing",
        ),
        "A time offset in milliseconds": (
            toml("[depth]", "time_offset_s = 120\n\n[depth]"),
            "[dvl] time_offset_s | got 120 | not milliseconds",
        ),
        "A current of zero": (
            toml("[depth]", "[current]\nsigma_m_per_s = 0.0\n\n[depth]"),
            "[current] sigma_m_per_s | above 0 | got 0.0 | m/s",
        ),
        "Noise of water track in millimetres per second": (
            toml(
                "beam_noise_m_per_s = 0.005", "beam_noise_m_per_s = 0.005\nwater_noise_m_per_s = 10"
            ),
            "[dvl] water_noise_m_per_s | got 10 | not mm/s",
        ),
        "Nothing says where the mission was": (
            both(drop_section("origin"), drop_section("gnss"), drop_section("initial")),
            "[origin] | add [origin] with lat_deg, lon_deg and height_m",
        ),
        "Latitude and longitude of the origin swapped": (
            toml("lat_deg = 45.7\nlon_deg = 126.6", "lat_deg = 126.6\nlon_deg = 45.7"),
            "[origin] lat_deg | got 126.6 | swapped",
        ),
        "The initial state far from the origin": (
            toml("lon_deg = 126.6\nheight_m = -20.0", "lon_deg = -126.6\nheight_m = -20.0"),
            "[initial] lat_deg, lon_deg | km from [origin] | wrong sign",
        ),
        "The initial state at a time without data": (
            toml("time_s = 0.0", "time_s = 1746622453.0"),
            "[initial] time_s | between 0.000 and 60.000 s | imu.csv | 1746622453.000",
        ),
        "A table that does not exist": (
            toml('file = "imu.csv"', 'file = "xsens.csv"'),
            "[imu] file | there is no file 'xsens.csv'",
        ),
        "The name of an optional table misspelt": (
            toml('file = "gnss.csv"', 'file = "gnns.csv"'),
            "[gnss] file | there is no file 'gnns.csv' | did you mean 'gnss.csv'",
        ),
        "A table of another format": (
            both(
                toml('file = "depth.csv"', 'file = "depth.txt"'),
                rename("depth.csv", "depth.txt"),
            ),
            "depth.txt | .csv or .parquet | '.txt'",
        ),
    },
)

TABLE_CASES = cases(
    DataError,
    {
        "An empty file": (raw("imu.csv", lambda _: b""), "imu.csv | is empty"),
        "A header and no rows": (
            lines("imu.csv", lambda rows: rows[:1]),
            "imu.csv | a header and no rows | at least 2",
        ),
        "No header": (
            lines("depth.csv", lambda rows: rows[1:]),
            "depth.csv:1 | add the header row",
        ),
        "UTF-16 instead of UTF-8": (
            raw("dvl.csv", lambda content: content.decode().encode("utf-16")),
            "dvl.csv:1 | UTF-16 | plain CSV",
        ),
        "A spreadsheet under the name of a CSV table": (
            raw("dvl.csv", lambda content: b"PK\x03\x04" + content),
            "dvl.csv:1 | spreadsheet",
        ),
        "Bytes that are no text": (
            raw("depth.csv", lambda content: content[:300] + b"\xff\xfe\xfd" + content[300:]),
            "depth.csv:21 | expected UTF-8 text",
        ),
        "Zero bytes, as after a power failure": (
            raw("depth.csv", lambda content: content[:300] + bytes(40) + content[300:]),
            "depth.csv:21 | zero bytes",
        ),
        "Semicolons and decimal commas": (
            raw("gnss.csv", lambda content: content.replace(b",", b";").replace(b".", b",")),
            "gnss.csv:1 | semicolons | commas between the cells",
        ),
        "A column misspelt": (
            raw("imu.csv", lambda content: content.replace(b"gyro_x_rad_per_s", b"gyro_x_rads", 1)),
            "imu.csv:1 | 'gyro_x_rads' | did you mean 'gyro_x_rad_per_s'",
        ),
        "A column in degrees per second, and named so": (
            raw(
                "imu.csv", lambda content: content.replace(b"gyro_x_rad_per_s", b"gyro_x_deg_per_s")
            ),
            "imu.csv:1 | 'gyro_x_deg_per_s' | did you mean 'gyro_x_rad_per_s'",
        ),
        "A column missing": (
            lines("depth.csv", lambda rows: [row.split(",")[0] for row in rows]),
            "depth.csv:1 | column 'depth_m' is missing",
        ),
        "A column twice": (
            raw("imu.csv", lambda content: content.replace(b"gyro_y", b"gyro_x", 1)),
            "imu.csv:1 | 'gyro_x_rad_per_s' appears 2 times",
        ),
        "A word where a number belongs": (
            cell("imu.csv", 17, "gyro_x_rad_per_s", "abc"),
            "imu.csv:17 | 'gyro_x_rad_per_s' holds 'abc' | expected a number",
        ),
        "A word for a missing beam": (
            cell("dvl.csv", 9, "beam2_m_per_s", "N/A"),
            "dvl.csv:9 | 'beam2_m_per_s' holds 'N/A' | leave the cell of a missing reading empty",
        ),
        "An empty cell where a number is needed": (
            cell("depth.csv", 9, "depth_m", ""),
            "depth.csv:9 | 'depth_m' is empty | expected a number",
        ),
        "NaN in the IMU": (
            cell("imu.csv", 300, "accel_y_m_per_s2", "nan"),
            "imu.csv:300 | 'accel_y_m_per_s2' holds nan | expected a finite number",
        ),
        "Infinity in a beam speed": (
            cell("dvl.csv", 12, "beam2_m_per_s", "inf"),
            "dvl.csv:12 | 'beam2_m_per_s' holds inf | leave the cell empty",
        ),
        "A row with too many cells": (
            lines("imu.csv", lambda rows: [*rows[:40], rows[40] + ",1.0", *rows[41:]]),
            "imu.csv:41 | 8 cells | the header names 7",
        ),
        "A row that was only partly written": (
            lines("imu.csv", lambda rows: [*rows[:40], "2.0,0.0", *rows[41:]]),
            "imu.csv:41 | 2 cells | partly written",
        ),
        "The last line cut off, cells missing": (
            raw("imu.csv", lambda content: content[:-40]),
            "imu.csv:1201 | the file ends within this line",
        ),
        "The last line cut off within its last number": (
            raw("imu.csv", lambda content: content[:-7]),
            "imu.csv:1201 | the file was cut off",
        ),
        "Two rows in the wrong order": (
            lines("imu.csv", lambda rows: [*rows[:50], rows[51], rows[50], *rows[52:]]),
            "imu.csv:52 | goes back from 2.550000 to 2.500000 | sort the rows",
        ),
        "The clock set back": (
            columns("depth.csv", ["time_s"], lambda t: np.where(t > 30.0, t - 20.0, t)),
            "depth.csv:33 | goes back from 30.000000 to 11.000000 | split the mission",
        ),
        "A row repeated": (
            lines("gnss.csv", lambda rows: [*rows[:4], rows[3], *rows[4:]]),
            "gnss.csv:5 | the row before is repeated | delete the copies",
        ),
        "Two rows of one time, one of them with a beam missing": (
            lines("dvl.csv", lambda rows: [*rows[:4], without_first_beam(rows[3]), *rows[4:]]),
            "dvl.csv:5 | time_s repeats | delete one",
        ),
        "Times written with too few digits": (
            columns("imu.csv", ["time_s"], lambda t: np.round(t, 1)),
            "imu.csv:5 | time_s repeats | more digits",
        ),
        "A clock that was begun anew amid a table (order of arrival)": (
            both(
                toml("format = 1", 'format = 1\norder = "arrival"'),
                lines("imu.csv", lambda rows: [*rows, *rows[1:301]]),
            ),
            "imu.csv:1202 | falls from | two missions",
        ),
        "Most rows partly written, where single ones may be (order of arrival)": (
            both(
                toml("format = 1", 'format = 1\norder = "arrival"'),
                lines("depth.csv", lambda rows: [rows[0], *(row[:3] for row in rows[1:])]),
            ),
            "depth.csv:2 | 1 cells | partly written",
        ),
        "A gap in the IMU": (
            lines("imu.csv", lambda rows: rows[:400] + rows[700:]),
            "imu.csv:401 | no samples for 15.050 s after 19.950 s | split the mission",
        ),
        "A Parquet table cut off": (
            parquet(raw("imu.parquet", lambda content: content[:5000])),
            "imu.parquet | expected a Parquet table | magic bytes",
        ),
        "CSV under the name of Parquet": (
            parquet(raw("dvl.parquet", lambda _: b"time_s,beam1_m_per_s\n0.0,1.0\n")),
            "dvl.parquet | expected a Parquet table",
        ),
    },
)

PHYSICS_CASES = cases(
    DataError,
    {
        "Accelerometer in g": (
            columns("imu.csv", ACCEL, lambda f: f / 9.80665),
            "imu.csv | median length of 1.0 | in g | 9.80665",
        ),
        "Accelerometer in mg": (
            columns("imu.csv", ACCEL, lambda f: f / 9.80665e-3),
            "imu.csv | in mg | 0.00980665",
        ),
        "Accelerometer without gravity": (
            columns("imu.csv", ACCEL, lambda f: f - f.mean(axis=0)),
            "imu.csv | was gravity taken out",
        ),
        "Accelerometer with the wrong scale": (
            columns("imu.csv", ACCEL, lambda f: 1.2 * f),
            "imu.csv | median length of 11.7 | check unit and scale",
        ),
        "Accelerometer with reversed signs": (
            columns("imu.csv", ACCEL, lambda f: -f),
            "imu.csv | 'accel_z_m_per_s2' | +9.8 | signs are reversed | FLU",
        ),
        "Body axes declared FLU that are FRD": (
            toml('body = "FRD"', 'body = "FLU"'),
            "imu.csv | 'accel_z_m_per_s2' | -9.8 | really FRD",
        ),
        "Gyros in deg/s, vehicle turning": (
            columns("imu.csv", GYRO, lambda w: np.degrees(w + 0.3)),
            "imu.csv | expected rad/s | deg/s: multiply them by pi/180",
        ),
        "Gyros in deg/s, vehicle rolling gently": (
            rolling(57.2958),
            "imu.csv | times as far by the gyros | deg/s",
        ),
        "Gyros with reversed signs": (
            rolling(-1.0),
            "imu.csv | rolls by the gyros and the other way | signs of the gyros",
        ),
        "One impossible turn rate": (
            cell("imu.csv", 77, "gyro_z_rad_per_s", "4294967.295"),
            "imu.csv:77 | 'gyro_z_rad_per_s' holds 4294967.295 | rad/s",
        ),
        "IMU times in milliseconds": (
            columns("imu.csv", ["time_s"], lambda t: 1e3 * t),
            "imu.csv | 50 s apart | in milliseconds",
        ),
        "IMU thinned out to 2 Hz": (
            lines("imu.csv", lambda rows: [rows[0], *rows[1::10]]),
            "imu.csv | 0.5 s apart, 2 Hz | 5 to 20000 Hz | thinned out",
        ),
        "Beam speeds in mm/s": (
            columns("dvl.csv", BEAMS, lambda v: 1e3 * v),
            "dvl.csv | expected m/s | mm/s: divide them by 1000",
        ),
        "Beams without bottom lock coded as -32768": (
            columns("dvl.csv", BEAMS, lambda v: every_second_code(v, -32768.0)),
            "dvl.csv:2 | 'beam1_m_per_s' holds -32768.0 | this code | empty",
        ),
        "Beams without bottom lock coded as -1": (
            columns("dvl.csv", BEAMS, lambda v: every_second_code(v, -1.0)),
            "dvl.csv:2 | 'beam1_m_per_s' holds -1.0 | a driver's code | empty",
        ),
        "One impossible beam speed": (
            cell("dvl.csv", 33, "beam3_m_per_s", "88.888"),
            "dvl.csv:33 | 'beam3_m_per_s' holds 88.888 | up to 30 | empty",
        ),
        "One velocity in all four beams": (
            columns("dvl.csv", BEAMS, lambda v: np.tile(v[:, :1], (1, 4))),
            "dvl.csv | all four beams hold the same number | beam velocities",
        ),
        "The driver republishes its last report": (
            columns("dvl.csv", BEAMS, republish),
            "dvl.csv:3 | 30 of 60 pings (50 %) | republishes | delete the copies",
        ),
        "A beam sigma of zero": (
            cell("dvl.csv", 20, "beam1_sigma_m_per_s", "0.0"),
            "dvl.csv:20 | 'beam1_sigma_m_per_s' holds 0.0 | beam_noise_m_per_s",
        ),
        "A mark for water track that is neither 0 nor 1": (
            new_column("dvl.csv", "water_track", lambda k: "2" if k == 20 else "0"),
            "dvl.csv:22 | 'water_track' holds 2 | 1 for a ping off the water",
        ),
        "Beam speeds with the opposite sign": (
            beams_against_depth,
            "dvl.csv | opposite to the change of depth.csv | positive when",
        ),
        "DVL times in milliseconds": (
            columns("dvl.csv", ["time_s"], lambda t: 1e3 * t),
            "dvl.csv | 1000.000 to 60000.000 | imu.csv from 0.000 to 60.000 | milliseconds",
        ),
        "DVL on another clock": (
            columns("dvl.csv", ["time_s"], lambda t: 1746622453.0 + t),
            "dvl.csv | 1746622454.000 | imu.csv from 0.000 to 60.000 | counts from 1970",
        ),
        "Heights in the column of depth": (
            columns("depth.csv", ["depth_m"], lambda d: -d),
            "depth.csv | median of -20 | change its sign",
        ),
        "A pressure in the column of depth": (
            columns("depth.csv", ["depth_m"], lambda d: 101325.0 + 1e4 * d),
            "depth.csv | expected metres | a pressure",
        ),
        "Latitude and longitude swapped in a table": (
            columns("gnss.csv", POSITION, lambda p: p[:, ::-1]),
            "gnss.csv:2 | 'lat_deg' holds 126.6 | seem swapped",
        ),
        "Positions in radians": (
            columns("gnss.csv", POSITION, np.radians),
            "gnss.csv:2 | km from the mission's origin | in radians",
        ),
        "A fix far from all others": (
            cell("gnss.csv", 5, "lat_deg", "55.7"),
            "gnss.csv:5 | 1111 km | correct or delete it",
        ),
        "No fix, coded as 0 N, 0 E": (
            both(cell("gnss.csv", 4, "lat_deg", "0.0"), cell("gnss.csv", 4, "lon_deg", "0.0")),
            "gnss.csv:4 | exactly 0 | no fix",
        ),
        "A GNSS sigma below zero": (
            cell("gnss.csv", 3, "sigma_up_m", "-1.0"),
            "gnss.csv:3 | 'sigma_up_m' holds -1.0 | above 0",
        ),
        "A reference in mm/s": (
            columns("reference.csv", ["vel_east_m_per_s"], lambda v: 1e3 * v),
            "reference.csv:2 | 'vel_east_m_per_s' | m/s",
        ),
    },
)

AID_CASES = (
    *cases(
        ConfigError,
        {
            "A beacon in single brackets": (
                toml("[initial]", "[beacon]\nnumber = 4\n\n[initial]"),
                "[beacon] | [[beacon]] | double brackets",
            ),
            "A beacon whose number is another's": (
                aided(toml("number = 5", "number = 4")),
                "[[beacon]] 2 number | 4 is another beacon's already",
            ),
            "A beacon whose number is none": (
                aided(toml("number = 5", "number = 4.5")),
                "[[beacon]] 2 number | whole number",
            ),
            "A beacon whose place is known to nothing": (
                aided(toml("[50.0, 50.0, 5.0]", "[50.0, 50.0, 0.0]")),
                "[[beacon]] 2 position_sigma_m | leave the key out",
            ),
            "A correlation time without a walk": (
                aided(toml("noise_deg = 1.0", "noise_deg = 1.0\ncorrelation_s = 300.0")),
                "[heading] correlation_s | walk_sigma_deg",
            ),
            "A standstill that ends before it begins": (
                aided(toml("end_s = 5.0", "end_s = -5.0")),
                "[[standstill]] 1 end_s | after",
            ),
            "A standstill on another clock": (
                aided(toml("begin_s = 0.0\nend_s = 5.0", "begin_s = 1.7e9\nend_s = 1.8e9")),
                "[[standstill]] 1 begin_s | clock of the tables",
            ),
        },
    ),
    *cases(
        DataError,
        {
            "A range to a beacon that is not stated": (
                aided(cell("ranges.csv", 3, "beacon", "6")),
                "ranges.csv:3 | 'beacon' holds 6 | expected one of 4, 5 | [[beacon]]",
            ),
            "Ranges in millimetres": (
                aided(cell("ranges.csv", 2, "range_m", "130000")),
                "ranges.csv:2 | 'range_m' | mm",
            ),
            "Two ranges to one beacon at one time": (
                aided(cell("ranges.csv", 3, "beacon", "4")),
                "ranges.csv:3 | time_s repeats",
            ),
            "An acoustic delay in milliseconds": (
                aided(cell("usbl.csv", 2, "delay_s", "1500000")),
                "usbl.csv:2 | 'delay_s' | milliseconds",
            ),
            "An acoustic fix of no stated quality": (
                aided(cell("usbl.csv", 3, "sigma_east_m", "0")),
                "usbl.csv:3 | 'sigma_east_m' | standard deviation",
            ),
            "An acoustic fix at another place on Earth": (
                aided(cell("usbl.csv", 2, "lat_deg", "-45.7")),
                "usbl.csv:2 | wrong sign",
            ),
            "A heading beyond a full turn": (
                aided(cell("heading.csv", 2, "heading_deg", "634")),
                "heading.csv:2 | 'heading_deg' | clockwise from north",
            ),
            "The column of a compass misspelt": (
                aided(lines("heading.csv", lambda rows: ["time_s,heading_degree", *rows[1:]])),
                "heading.csv:1 | did you mean 'heading_deg'?",
            ),
        },
    ),
)

CASES = (*TOML_CASES, *TABLE_CASES, *PHYSICS_CASES, *AID_CASES)
