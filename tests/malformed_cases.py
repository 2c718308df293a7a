"""The catalogue of malformed missions: each damages a valid folder in one way.

``docs/malformed-input.md`` is made from it, and ``tests/unit/test_malformed.py`` runs it.
"""

from __future__ import annotations

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError
from tests.malformed_aids import AID_CASES
from tests.malformed_case import Malformed
from tests.mission_damage import (
    ACCEL,
    BEAMS,
    GYRO,
    POSITION,
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


def without_first_beam(row: str) -> str:
    """Return a line of a DVL's table with the cell of its first beam left empty."""
    time, _, *others = row.split(",")
    return ",".join([time, "", *others])


TOML_CASES = (
    Malformed("No mission.toml", remove("mission.toml"), ConfigError, ("there is none in",)),
    Malformed(
        "Not valid TOML",
        toml('name = "straight-run"', "name = straight-run"),
        ConfigError,
        ("mission.toml: expected valid TOML", "line 2"),
    ),
    Malformed(
        "A newer format", toml("format = 1", "format = 2"), ConfigError, ("format: ", "got 2")
    ),
    Malformed("No format", toml("format = 1\n", ""), ConfigError, ("format", "missing")),
    Malformed("No name", toml('name = "straight-run"\n', ""), ConfigError, ("name: ", "nothing")),
    Malformed(
        "An order of the rows that is not known",
        toml("format = 1", 'format = 1\norder = "random"'),
        ConfigError,
        ("order: expected one of time, arrival", "'random'"),
    ),
    Malformed(
        "A section misspelt",
        toml("[gnss]", "[gps]"),
        ConfigError,
        ("mission.toml gps: ", "unknown key or section", "gnss"),
    ),
    Malformed("A section missing", drop_section("dvl"), ConfigError, ("[dvl]: ", "missing")),
    Malformed(
        "A key misspelt",
        toml("beam_noise_m_per_s", "beam_noise_mps"),
        ConfigError,
        ("[dvl] beam_noise_mps", "did you mean 'beam_noise_m_per_s'"),
    ),
    Malformed(
        "A key missing",
        toml("gyro_bias_deg_per_h = 0.5\n", ""),
        ConfigError,
        ("[imu] gyro_bias_deg_per_h", "missing", "a number above 0"),
    ),
    Malformed(
        "A number in quotes",
        toml("beam_noise_m_per_s = 0.005", 'beam_noise_m_per_s = "0.005"'),
        ConfigError,
        ("[dvl] beam_noise_m_per_s", "expected a number", "'0.005'"),
    ),
    Malformed(
        "A truth value for a number",
        toml("noise_m = 0.05", "noise_m = true"),
        ConfigError,
        ("[depth] noise_m", "expected a number", "True"),
    ),
    Malformed(
        "A list of the wrong length",
        toml("lever_arm_m = [0.2, 0.0, 0.1]", "lever_arm_m = [0.2, 0.0]"),
        ConfigError,
        ("[dvl] lever_arm_m", "a list of 3 numbers", "[0.2, 0.0]"),
    ),
    Malformed(
        "Noise of zero",
        toml("beam_noise_m_per_s = 0.005", "beam_noise_m_per_s = 0.0"),
        ConfigError,
        ("[dvl] beam_noise_m_per_s", "above 0", "got 0.0"),
    ),
    Malformed(
        "Noise that is NaN",
        toml("accel_bias_ug = 100.0", "accel_bias_ug = nan"),
        ConfigError,
        ("[imu] accel_bias_ug", "expected a number", "got nan"),
    ),
    Malformed(
        "A lever arm in millimetres",
        toml("lever_arm_m = [0.2, 0.0, 0.1]", "lever_arm_m = [200, 0, 100]"),
        ConfigError,
        ("[dvl] lever_arm_m", "from -100 to 100", "metres"),
    ),
    Malformed(
        "Body axes that are not known",
        toml('body = "FRD"', 'body = "NED"'),
        ConfigError,
        ("[frames] body", "FRD, FLU, RFU", "'NED'"),
    ),
    Malformed(
        "A stamp that is not known",
        toml('stamp = "end"', 'stamp = "begin"'),
        ConfigError,
        ("[imu] stamp", "start, middle, end", "'begin'"),
    ),
    Malformed(
        "The horizontal angle of the beams instead of the Janus angle",
        toml("beam_janus_deg = 30.0", "beam_janus_deg = 60.0"),
        ConfigError,
        ("[dvl] beam_janus_deg", "got 60.0", "the horizontal angle is 90 minus this"),
    ),
    Malformed(
        "Four beams in one plane",
        toml("[45, 135, 225, 315]", "[45, 225, 45, 225]"),
        ConfigError,
        ("[dvl] beam_azimuth_deg", "lie in one plane"),
    ),
    Malformed(
        "Beam vectors that are not of unit length",
        toml(
            "beam_azimuth_deg = [45, 135, 225, 315]\nbeam_janus_deg = 30.0",
            "beam_vectors = [[1, 0, 2], [0, 1, 2], [-1, 0, 2], [0, -1, 2]]",
        ),
        ConfigError,
        ("[dvl] beam_vectors", "unit vectors", "2.23607", "beam 1"),
    ),
    Malformed(
        "Beam vectors and angles together",
        toml("beam_janus_deg = 30.0", "beam_vectors = [[1,0,0],[0,1,0],[0,0,1],[0,0,1]]"),
        ConfigError,
        ("[dvl] beam_vectors", "together with beam_azimuth_deg"),
    ),
    Malformed(
        "A Janus angle without azimuths",
        toml("beam_azimuth_deg = [45, 135, 225, 315]\n", ""),
        ConfigError,
        ("[dvl] beam_azimuth_deg", "missing"),
    ),
    Malformed(
        "A time offset in milliseconds",
        toml("[depth]", "time_offset_s = 120\n\n[depth]"),
        ConfigError,
        ("[dvl] time_offset_s", "got 120", "not milliseconds"),
    ),
    Malformed(
        "A current of zero",
        toml("[depth]", "[current]\nsigma_m_per_s = 0.0\n\n[depth]"),
        ConfigError,
        ("[current] sigma_m_per_s", "above 0", "got 0.0", "m/s"),
    ),
    Malformed(
        "Noise of water track in millimetres per second",
        toml("beam_noise_m_per_s = 0.005", "beam_noise_m_per_s = 0.005\nwater_noise_m_per_s = 10"),
        ConfigError,
        ("[dvl] water_noise_m_per_s", "got 10", "not mm/s"),
    ),
    Malformed(
        "Nothing says where the mission was",
        both(drop_section("origin"), drop_section("gnss"), drop_section("initial")),
        ConfigError,
        ("[origin]", "add [origin] with lat_deg, lon_deg and height_m"),
    ),
    Malformed(
        "Latitude and longitude of the origin swapped",
        toml("lat_deg = 45.7\nlon_deg = 126.6", "lat_deg = 126.6\nlon_deg = 45.7"),
        ConfigError,
        ("[origin] lat_deg", "got 126.6", "swapped"),
    ),
    Malformed(
        "The initial state far from the origin",
        toml("lon_deg = 126.6\nheight_m = -20.0", "lon_deg = -126.6\nheight_m = -20.0"),
        ConfigError,
        ("[initial] lat_deg, lon_deg", "km from [origin]", "wrong sign"),
    ),
    Malformed(
        "The initial state at a time without data",
        toml("time_s = 0.0", "time_s = 1746622453.0"),
        ConfigError,
        ("[initial] time_s", "between 0.000 and 60.000 s", "imu.csv", "1746622453.000"),
    ),
    Malformed(
        "A table that does not exist",
        toml('file = "imu.csv"', 'file = "xsens.csv"'),
        ConfigError,
        ("[imu] file", "there is no file 'xsens.csv'"),
    ),
    Malformed(
        "The name of an optional table misspelt",
        toml('file = "gnss.csv"', 'file = "gnns.csv"'),
        ConfigError,
        ("[gnss] file", "there is no file 'gnns.csv'", "did you mean 'gnss.csv'"),
    ),
    Malformed(
        "A table of another format",
        both(
            toml('file = "depth.csv"', 'file = "depth.txt"'),
            rename("depth.csv", "depth.txt"),
        ),
        ConfigError,
        ("depth.txt", ".csv or .parquet", "'.txt'"),
    ),
)

TABLE_CASES = (
    Malformed("An empty file", raw("imu.csv", lambda _: b""), DataError, ("imu.csv", "is empty")),
    Malformed(
        "A header and no rows",
        lines("imu.csv", lambda rows: rows[:1]),
        DataError,
        ("imu.csv", "a header and no rows", "at least 2"),
    ),
    Malformed(
        "No header",
        lines("depth.csv", lambda rows: rows[1:]),
        DataError,
        ("depth.csv:1", "add the header row"),
    ),
    Malformed(
        "UTF-16 instead of UTF-8",
        raw("dvl.csv", lambda content: content.decode().encode("utf-16")),
        DataError,
        ("dvl.csv:1", "UTF-16", "plain CSV"),
    ),
    Malformed(
        "A spreadsheet under the name of a CSV table",
        raw("dvl.csv", lambda content: b"PK\x03\x04" + content),
        DataError,
        ("dvl.csv:1", "spreadsheet"),
    ),
    Malformed(
        "Bytes that are no text",
        raw("depth.csv", lambda content: content[:300] + b"\xff\xfe\xfd" + content[300:]),
        DataError,
        ("depth.csv:21", "expected UTF-8 text"),
    ),
    Malformed(
        "Zero bytes, as after a power failure",
        raw("depth.csv", lambda content: content[:300] + bytes(40) + content[300:]),
        DataError,
        ("depth.csv:21", "zero bytes"),
    ),
    Malformed(
        "Semicolons and decimal commas",
        raw("gnss.csv", lambda content: content.replace(b",", b";").replace(b".", b",")),
        DataError,
        ("gnss.csv:1", "semicolons", "commas between the cells"),
    ),
    Malformed(
        "A column misspelt",
        raw("imu.csv", lambda content: content.replace(b"gyro_x_rad_per_s", b"gyro_x_rads", 1)),
        DataError,
        ("imu.csv:1", "'gyro_x_rads'", "did you mean 'gyro_x_rad_per_s'"),
    ),
    Malformed(
        "A column in degrees per second, and named so",
        raw("imu.csv", lambda content: content.replace(b"gyro_x_rad_per_s", b"gyro_x_deg_per_s")),
        DataError,
        ("imu.csv:1", "'gyro_x_deg_per_s'", "did you mean 'gyro_x_rad_per_s'"),
    ),
    Malformed(
        "A column missing",
        lines("depth.csv", lambda rows: [row.split(",")[0] for row in rows]),
        DataError,
        ("depth.csv:1", "column 'depth_m' is missing"),
    ),
    Malformed(
        "A column twice",
        raw("imu.csv", lambda content: content.replace(b"gyro_y", b"gyro_x", 1)),
        DataError,
        ("imu.csv:1", "'gyro_x_rad_per_s' appears 2 times"),
    ),
    Malformed(
        "A word where a number belongs",
        cell("imu.csv", 17, "gyro_x_rad_per_s", "abc"),
        DataError,
        ("imu.csv:17", "'gyro_x_rad_per_s' holds 'abc'", "expected a number"),
    ),
    Malformed(
        "An empty cell where a number is needed",
        cell("depth.csv", 9, "depth_m", ""),
        DataError,
        ("depth.csv:9", "'depth_m' is empty", "expected a number"),
    ),
    Malformed(
        "NaN in the IMU",
        cell("imu.csv", 300, "accel_y_m_per_s2", "nan"),
        DataError,
        ("imu.csv:300", "'accel_y_m_per_s2' holds nan", "expected a finite number"),
    ),
    Malformed(
        "Infinity in a beam speed",
        cell("dvl.csv", 12, "beam2_m_per_s", "inf"),
        DataError,
        ("dvl.csv:12", "'beam2_m_per_s' holds inf", "leave the cell empty"),
    ),
    Malformed(
        "A row with too many cells",
        lines("imu.csv", lambda rows: [*rows[:40], rows[40] + ",1.0", *rows[41:]]),
        DataError,
        ("imu.csv:41", "8 cells", "the header names 7"),
    ),
    Malformed(
        "A row that was only partly written",
        lines("imu.csv", lambda rows: [*rows[:40], "2.0,0.0", *rows[41:]]),
        DataError,
        ("imu.csv:41", "2 cells", "partly written"),
    ),
    Malformed(
        "The last line cut off, cells missing",
        raw("imu.csv", lambda content: content[:-40]),
        DataError,
        ("imu.csv:1201", "the file ends within this line"),
    ),
    Malformed(
        "The last line cut off within its last number",
        raw("imu.csv", lambda content: content[:-7]),
        DataError,
        ("imu.csv:1201", "the file was cut off"),
    ),
    Malformed(
        "Two rows in the wrong order",
        lines("imu.csv", lambda rows: [*rows[:50], rows[51], rows[50], *rows[52:]]),
        DataError,
        ("imu.csv:52", "goes back from 2.550000 to 2.500000", "sort the rows"),
    ),
    Malformed(
        "The clock set back",
        columns("depth.csv", ["time_s"], lambda t: np.where(t > 30.0, t - 20.0, t)),
        DataError,
        ("depth.csv:33", "goes back from 30.000000 to 11.000000", "split the mission"),
    ),
    Malformed(
        "A row repeated",
        lines("gnss.csv", lambda rows: [*rows[:4], rows[3], *rows[4:]]),
        DataError,
        ("gnss.csv:5", "the row before is repeated", "delete the copies"),
    ),
    Malformed(
        "Two rows of one time, one of them with a beam missing",
        lines("dvl.csv", lambda rows: [*rows[:4], without_first_beam(rows[3]), *rows[4:]]),
        DataError,
        ("dvl.csv:5", "time_s repeats", "delete one"),
    ),
    Malformed(
        "Times written with too few digits",
        columns("imu.csv", ["time_s"], lambda t: np.round(t, 1)),
        DataError,
        ("imu.csv:5", "time_s repeats", "more digits"),
    ),
    Malformed(
        "Most rows partly written, where single ones may be (order of arrival)",
        both(
            toml("format = 1", 'format = 1\norder = "arrival"'),
            lines("depth.csv", lambda rows: [rows[0], *(row[:3] for row in rows[1:])]),
        ),
        DataError,
        ("depth.csv:2", "1 cells", "partly written"),
    ),
    Malformed(
        "A gap in the IMU",
        lines("imu.csv", lambda rows: rows[:400] + rows[700:]),
        DataError,
        ("imu.csv:401", "no samples for 15.050 s after 19.950 s", "split the mission"),
    ),
    Malformed(
        "A Parquet table cut off",
        parquet(raw("imu.parquet", lambda content: content[:5000])),
        DataError,
        ("imu.parquet", "expected a Parquet table", "cut off"),
    ),
    Malformed(
        "CSV under the name of Parquet",
        parquet(raw("dvl.parquet", lambda _: b"time_s,beam1_m_per_s\n0.0,1.0\n")),
        DataError,
        ("dvl.parquet", "expected a Parquet table"),
    ),
)

PHYSICS_CASES = (
    Malformed(
        "Accelerometer in g",
        columns("imu.csv", ACCEL, lambda f: f / 9.80665),
        DataError,
        ("imu.csv", "median length of 1.0", "in g", "9.80665"),
    ),
    Malformed(
        "Accelerometer in mg",
        columns("imu.csv", ACCEL, lambda f: f / 9.80665e-3),
        DataError,
        ("imu.csv", "in mg", "0.00980665"),
    ),
    Malformed(
        "Accelerometer without gravity",
        columns("imu.csv", ACCEL, lambda f: f - f.mean(axis=0)),
        DataError,
        ("imu.csv", "was gravity taken out"),
    ),
    Malformed(
        "Accelerometer with the wrong scale",
        columns("imu.csv", ACCEL, lambda f: 1.2 * f),
        DataError,
        ("imu.csv", "median length of 11.7", "check unit and scale"),
    ),
    Malformed(
        "Accelerometer with reversed signs",
        columns("imu.csv", ACCEL, lambda f: -f),
        DataError,
        ("imu.csv", "'accel_z_m_per_s2'", "+9.8", "signs are reversed", "FLU"),
    ),
    Malformed(
        "Body axes declared FLU that are FRD",
        toml('body = "FRD"', 'body = "FLU"'),
        DataError,
        ("imu.csv", "'accel_z_m_per_s2'", "-9.8", "really FRD"),
    ),
    Malformed(
        "Gyros in deg/s, vehicle turning",
        columns("imu.csv", GYRO, lambda w: np.degrees(w + 0.3)),
        DataError,
        ("imu.csv", "expected rad/s", "deg/s: multiply them by pi/180"),
    ),
    Malformed(
        "Gyros in deg/s, vehicle rolling gently",
        rolling(57.2958),
        DataError,
        ("imu.csv", "times as far by the gyros", "deg/s"),
    ),
    Malformed(
        "Gyros with reversed signs",
        rolling(-1.0),
        DataError,
        ("imu.csv", "rolls by the gyros and the other way", "signs of the gyros"),
    ),
    Malformed(
        "One impossible turn rate",
        cell("imu.csv", 77, "gyro_z_rad_per_s", "4294967.295"),
        DataError,
        ("imu.csv:77", "'gyro_z_rad_per_s' holds 4294967.295", "rad/s"),
    ),
    Malformed(
        "IMU times in milliseconds",
        columns("imu.csv", ["time_s"], lambda t: 1e3 * t),
        DataError,
        ("imu.csv", "50 s apart", "in milliseconds"),
    ),
    Malformed(
        "IMU thinned out to 2 Hz",
        lines("imu.csv", lambda rows: [rows[0], *rows[1::10]]),
        DataError,
        ("imu.csv", "0.5 s apart, 2 Hz", "5 to 20000 Hz", "thinned out"),
    ),
    Malformed(
        "Beam speeds in mm/s",
        columns("dvl.csv", BEAMS, lambda v: 1e3 * v),
        DataError,
        ("dvl.csv", "expected m/s", "mm/s: divide them by 1000"),
    ),
    Malformed(
        "Beams without bottom lock coded as -32768",
        columns("dvl.csv", BEAMS, lambda v: every_second_code(v, -32768.0)),
        DataError,
        ("dvl.csv:2", "'beam1_m_per_s' holds -32768.0", "this code", "empty"),
    ),
    Malformed(
        "Beams without bottom lock coded as -1",
        columns("dvl.csv", BEAMS, lambda v: every_second_code(v, -1.0)),
        DataError,
        ("dvl.csv:2", "'beam1_m_per_s' holds -1.0", "a driver's code", "empty"),
    ),
    Malformed(
        "One impossible beam speed",
        cell("dvl.csv", 33, "beam3_m_per_s", "88.888"),
        DataError,
        ("dvl.csv:33", "'beam3_m_per_s' holds 88.888", "up to 30", "empty"),
    ),
    Malformed(
        "One velocity in all four beams",
        columns("dvl.csv", BEAMS, lambda v: np.tile(v[:, :1], (1, 4))),
        DataError,
        ("dvl.csv", "all four beams hold the same number", "beam velocities"),
    ),
    Malformed(
        "The driver republishes its last report",
        columns("dvl.csv", BEAMS, republish),
        DataError,
        ("dvl.csv:3", "30 of 60 pings (50 %)", "republishes", "delete the copies"),
    ),
    Malformed(
        "A beam sigma of zero",
        cell("dvl.csv", 20, "beam1_sigma_m_per_s", "0.0"),
        DataError,
        ("dvl.csv:20", "'beam1_sigma_m_per_s' holds 0.0", "beam_noise_m_per_s"),
    ),
    Malformed(
        "A mark for water track that is neither 0 nor 1",
        new_column("dvl.csv", "water_track", lambda k: "2" if k == 20 else "0"),
        DataError,
        ("dvl.csv:22", "'water_track' holds 2", "1 for a ping off the water"),
    ),
    Malformed(
        "Beam speeds with the opposite sign (PD0)",
        beams_against_depth,
        DataError,
        ("dvl.csv", "opposite to the change of depth.csv", "positive when"),
    ),
    Malformed(
        "DVL times in milliseconds",
        columns("dvl.csv", ["time_s"], lambda t: 1e3 * t),
        DataError,
        ("dvl.csv", "1000.000 to 60000.000", "imu.csv from 0.000 to 60.000", "milliseconds"),
    ),
    Malformed(
        "DVL on another clock",
        columns("dvl.csv", ["time_s"], lambda t: 1746622453.0 + t),
        DataError,
        ("dvl.csv", "1746622454.000", "imu.csv from 0.000 to 60.000", "counts from 1970"),
    ),
    Malformed(
        "Heights in the column of depth",
        columns("depth.csv", ["depth_m"], lambda d: -d),
        DataError,
        ("depth.csv", "median of -20", "change its sign"),
    ),
    Malformed(
        "A pressure in the column of depth",
        columns("depth.csv", ["depth_m"], lambda d: 101325.0 + 1e4 * d),
        DataError,
        ("depth.csv", "expected metres", "a pressure"),
    ),
    Malformed(
        "Latitude and longitude swapped in a table",
        columns("gnss.csv", POSITION, lambda p: p[:, ::-1]),
        DataError,
        ("gnss.csv:2", "'lat_deg' holds 126.6", "seem swapped"),
    ),
    Malformed(
        "Positions in radians",
        columns("gnss.csv", POSITION, np.radians),
        DataError,
        ("gnss.csv:2", "km from the mission's origin", "in radians"),
    ),
    Malformed(
        "A fix far from all others",
        cell("gnss.csv", 5, "lat_deg", "55.7"),
        DataError,
        ("gnss.csv:5", "1111 km", "correct or delete it"),
    ),
    Malformed(
        "No fix, coded as 0 N, 0 E",
        both(cell("gnss.csv", 4, "lat_deg", "0.0"), cell("gnss.csv", 4, "lon_deg", "0.0")),
        DataError,
        ("gnss.csv:4", "exactly 0", "no fix"),
    ),
    Malformed(
        "A GNSS sigma below zero",
        cell("gnss.csv", 3, "sigma_up_m", "-1.0"),
        DataError,
        ("gnss.csv:3", "'sigma_up_m' holds -1.0", "above 0"),
    ),
    Malformed(
        "A reference in mm/s",
        columns("reference.csv", ["vel_east_m_per_s"], lambda v: 1e3 * v),
        DataError,
        ("reference.csv:2", "'vel_east_m_per_s'", "m/s"),
    ),
)

CASES = (*TOML_CASES, *TABLE_CASES, *PHYSICS_CASES, *AID_CASES)
