"""The catalogue of malformed missions, continued: acoustics, compass and times at rest."""

from __future__ import annotations

from ssm_graph.base.errors import ConfigError, DataError
from tests.malformed_case import Malformed
from tests.mission_damage import aided, cell, lines, toml

AID_CASES = (
    Malformed(
        "A beacon in single brackets",
        toml("[initial]", "[beacon]\nnumber = 4\n\n[initial]"),
        ConfigError,
        ("[beacon]", "[[beacon]]", "double brackets"),
    ),
    Malformed(
        "A beacon whose number is another's",
        aided(toml("number = 5", "number = 4")),
        ConfigError,
        ("[[beacon]] 2 number", "4 is another beacon's already"),
    ),
    Malformed(
        "A beacon whose number is none",
        aided(toml("number = 5", "number = 4.5")),
        ConfigError,
        ("[[beacon]] 2 number", "whole number"),
    ),
    Malformed(
        "A beacon whose place is known to nothing",
        aided(toml("[50.0, 50.0, 5.0]", "[50.0, 50.0, 0.0]")),
        ConfigError,
        ("[[beacon]] 2 position_sigma_m", "leave the key out"),
    ),
    Malformed(
        "A range to a beacon that is not stated",
        aided(cell("ranges.csv", 3, "beacon", "6")),
        DataError,
        ("ranges.csv:3", "'beacon' holds 6", "expected one of 4, 5", "[[beacon]]"),
    ),
    Malformed(
        "Ranges in millimetres",
        aided(cell("ranges.csv", 2, "range_m", "130000")),
        DataError,
        ("ranges.csv:2", "'range_m'", "mm"),
    ),
    Malformed(
        "Two ranges to one beacon at one time",
        aided(cell("ranges.csv", 3, "beacon", "4")),
        DataError,
        ("ranges.csv:3", "time_s repeats"),
    ),
    Malformed(
        "An acoustic delay in milliseconds",
        aided(cell("usbl.csv", 2, "delay_s", "1500000")),
        DataError,
        ("usbl.csv:2", "'delay_s'", "milliseconds"),
    ),
    Malformed(
        "An acoustic fix of no stated quality",
        aided(cell("usbl.csv", 3, "sigma_east_m", "0")),
        DataError,
        ("usbl.csv:3", "'sigma_east_m'", "standard deviation"),
    ),
    Malformed(
        "An acoustic fix at another place on Earth",
        aided(cell("usbl.csv", 2, "lat_deg", "-45.7")),
        DataError,
        ("usbl.csv:2", "wrong sign"),
    ),
    Malformed(
        "A heading beyond a full turn",
        aided(cell("heading.csv", 2, "heading_deg", "634")),
        DataError,
        ("heading.csv:2", "'heading_deg'", "clockwise from north"),
    ),
    Malformed(
        "The column of a compass misspelt",
        aided(lines("heading.csv", lambda rows: ["time_s,heading_degree", *rows[1:]])),
        DataError,
        ("heading.csv:1", "did you mean 'heading_deg'?"),
    ),
    Malformed(
        "A correlation time without a walk",
        aided(toml("noise_deg = 1.0", "noise_deg = 1.0\ncorrelation_s = 300.0")),
        ConfigError,
        ("[heading] correlation_s", "walk_sigma_deg"),
    ),
    Malformed(
        "A standstill that ends before it begins",
        aided(toml("end_s = 5.0", "end_s = -5.0")),
        ConfigError,
        ("[[standstill]] 1 end_s", "after"),
    ),
    Malformed(
        "A standstill on another clock",
        aided(toml("begin_s = 0.0\nend_s = 5.0", "begin_s = 1.7e9\nend_s = 1.8e9")),
        ConfigError,
        ("[[standstill]] 1 begin_s", "clock of the tables"),
    ),
)
