"""What is unknown of the further aids: places of beacons and errors of a compass, as extras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from ssm_graph.engine.extras import Extra
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.acoustic import RangeLog
from ssm_graph.sensors.compass import HeadingErrors, HeadingLog

BEACON: Final = "beacon_"
"""Followed by the beacon's number."""
HEADING_OFFSET: Final = "heading_offset"
HEADING_RATE: Final = "heading_rate"
HEADING_WALK: Final = "heading_walk"
HEADING_ONE_CYCLE: Final = "heading_one_cycle"
HEADING_TWO_CYCLE: Final = "heading_two_cycle"
_CONSTANTS_OF_HEADING: Final = (
    HEADING_OFFSET,
    HEADING_RATE,
    HEADING_ONE_CYCLE,
    HEADING_TWO_CYCLE,
)


def is_constant_of_aid(name: str) -> bool:
    """Return whether an extra variable is the place of a beacon or a lasting error of a compass."""
    return name.startswith(BEACON) or name in _CONSTANTS_OF_HEADING


def is_of_aid(name: str) -> bool:
    """Return whether an extra variable is of a further aid, lasting or not."""
    return is_constant_of_aid(name) or name == HEADING_WALK


def not_used(sections: Sequence[str]) -> tuple[str, ...]:
    """Return the note of an estimator without further aids, if the mission has some."""
    if not sections:
        return ()
    return (
        f"{', '.join(sections)} of mission.toml left out: this estimator is not aided by them; "
        "ssm-graph smooth is",
    )


def beacon_name(number: int) -> str:
    """Return what the place of a beacon is called, as an extra variable."""
    return f"{BEACON}{number}"


def aid_extras(aids: Aids) -> tuple[Extra, ...]:
    """Return what the further aids ask to estimate."""
    extras: list[Extra] = []
    ranges, heading = aids.get(RangeLog), aids.get(HeadingLog)
    if ranges is not None:
        heard = np.unique(ranges.beacon)
        extras += [
            Extra(
                beacon_name(beacon.number),
                tuple(f"{beacon_name(beacon.number)}_{axis}_m" for axis in ("east", "north", "up")),
                beacon.position_sigma_enu,
            )
            for beacon in ranges.beacons
            if not beacon.is_known and beacon.number in heard
        ]
    if heading is not None:
        extras += _of_heading(heading.errors)
    return tuple(extras)


def _of_heading(errors: HeadingErrors) -> list[Extra]:
    degree = math.radians(1.0)
    found = []
    for name, sigma, waves in (
        (HEADING_OFFSET, errors.offset_sigma, ("",)),
        (HEADING_ONE_CYCLE, errors.one_cycle_sigma, ("_sine", "_cosine")),
        (HEADING_TWO_CYCLE, errors.two_cycle_sigma, ("_sine", "_cosine")),
    ):
        if sigma > 0.0:
            labels = tuple(f"{name}{wave}_deg" for wave in waves)
            found.append(Extra(name, labels, np.full(len(waves), sigma), unit=degree))
    if errors.rate_sigma > 0.0:
        labels, rate = (f"{HEADING_RATE}_deg_per_h",), np.full(1, errors.rate_sigma)
        found.append(Extra(HEADING_RATE, labels, rate, unit=degree / 3600.0))
    if errors.walk_sigma > 0.0:
        found.append(
            Extra.gauss_markov(
                HEADING_WALK,
                (f"{HEADING_WALK}_deg",),
                errors.walk_sigma,
                correlation_s=errors.correlation_s,
                unit=degree,
            )
        )
    return found
