"""What may be off for long: each hypothesis a sensor, the numbers of it, and words for them.

A hypothesis is some sums of a channel's columns, over a stretch: by a constant, by a constant and
a rate, or by anything. Another one is another line of :func:`hypotheses_of`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, partial

import numpy as np

from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.graph.aids.aid import OF_SIZE
from ssm_graph.smoothers.faults.columns import (
    BEAM,
    BOTTOM,
    CLOCK,
    IMU,
    MOUNTING,
    SCALE,
    Channels,
)

PER_NUMBER = 6.0
"""Chi-square that each further number of a hypothesis has to earn besides, against others."""
LEAST_PER_NUMBER = 2.0
"""And by itself, where it may be anything: that fits more than its tail allows for."""


USUAL = -6.0
"""Handicap of a depth that drifts: tides, air pressure and warm-up make all of them do."""
ALLOWED = 4.0
"""Chi-square of such a drift from which on it is allowed for, though it is too little to be said.
Of less no harm comes: the DVL's own vertical says by how much at most."""
ALLOWED_M = 0.1
"""Prior sigma of that in 100 s: 1 mm/s. A tide of 4 m runs at 0.3 mm/s, warm-up is faster."""
SEEN_M = 2.0 * ALLOWED_M
"""And that by which it is looked for: larger ones are no longer usual."""
NOISY = 24.0
"""Chi-square that a beam noisier than the others needs less over the whole mission: whatever makes
it so, weak echoes or a foul transducer, seldom has a mean of zero. It is freed in any case."""
LATEST_S = 10.0
"""Prior sigma of a delay."""
RISING_M_PER_S = 0.05
"""Sigma of the vertical velocity of what is taken for the bottom: layers rise and sink slowly."""


AT_AN_END = 4.5
"""Chi-square by which a stretch to the begin or the end of the mission needs less, and twice as
much one over all of it: there are N and 1 of these, of others N^2 / 2."""


class Course(Enum):
    """How an error goes on over its stretch."""

    CONSTANT = "by a constant"
    TREND = "by a constant and a rate"
    RAMP = "by a rate, from nothing on"
    ANYTHING = "by anything"


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A way in which a sensor may be off over a stretch."""

    sensor: str
    """As people call it."""
    channel: str
    combined: Array
    """(c, d) the numbers' columns as sums of those of the channel"""
    sigma: Array
    """(d,) of their priors: so large are they at most"""
    say: Callable[[Array], str]
    """Words for sizes (d,)"""
    course: Course = Course.CONSTANT
    handicap: float = 0.0
    """Chi-square by which it has to be better than others."""
    odds: float = 0.0
    """By which it needs less, for the sensor shows besides that it is not sound, at all times:
    such a one lasts over the whole mission"""
    tail: float = 2e-7
    """Probability of one stretch's chi-square where nothing is off"""

    @property
    def has_rate(self) -> bool:
        """Whether one of its numbers grows with time."""
        return self.course in (Course.TREND, Course.RAMP)

    @property
    def is_usual(self) -> bool:
        """Whether healthy instruments of its kind are a little off in this way."""
        return self.handicap < 0.0

    @property
    def n_numbers(self) -> int:
        """Of one stretch that is not by anything."""
        return int(self.combined.shape[1]) * (2 if self.course is Course.TREND else 1)

    def charge(self, n_numbers: int) -> float:
        """Return the chi-square that hypotheses are compared beyond: each number has its price."""
        return (
            chi_sq_at(self.tail, n_numbers)
            + PER_NUMBER * (n_numbers - 1)
            + self.handicap
            - self.odds
        )

    def least(self, n_numbers: int) -> float:
        """Return the chi-square from which on so many numbers are no chance."""
        more = LEAST_PER_NUMBER * (n_numbers - 1) if self.course is Course.ANYTHING else 0.0
        return chi_sq_at(self.tail, n_numbers) + more + self.handicap - self.odds


@cache
def chi_sq_at(tail: float, n_numbers: int) -> float:
    """Return what a chi-square of so many numbers exceeds with this probability."""
    return float(chi2.isf(tail, n_numbers))


def hypotheses_of(channels: Channels, *, significance: float) -> tuple[Hypothesis, ...]:
    """Return all hypotheses of a mission; ``significance`` in sigmas of one number."""
    tail = float(chi2.sf(significance**2, 1))
    found = [*_of_beams(channels), *_of_the_array(channels), *_of_inertial()]
    for name in channels.aids:
        found.extend(of_aid(name, channels.dim_of(name)))
    for channel, mode in channels.modes.items():
        sigma, say = _of_mode(mode.aid, channel.removeprefix(mode.aid))
        found.append(Hypothesis(mode.aid, channel, np.eye(1), np.full(1, sigma), say))
    return tuple(replace(one, tail=tail) for one in found)


def _of_beams(channels: Channels) -> Iterator[Hypothesis]:
    unit = np.eye(channels.of(BEAM).columns.stop)
    n_beams = len(unit)
    for beam in range(n_beams):
        one = Hypothesis(f"DVL beam {beam + 1}", BEAM, unit[:, [beam]], np.full(1, 3.0), _speeds)
        noise = float(channels.beam_noise[beam])
        yield one
        if noise > 1.0:
            yield replace(one, say=partial(_noisy, noise), odds=NOISY)
        yield replace(one, course=Course.TREND)
        yield replace(one, course=Course.ANYTHING)
    for a, b in itertools.combinations(range(n_beams), 2):
        sensor = f"DVL beams {a + 1} and {b + 1}"
        for sign in (1.0, -1.0):
            yield Hypothesis(
                sensor,
                BEAM,
                unit[:, [a]] + sign * unit[:, [b]],
                np.full(1, 3.0),
                partial(_pair, sign),
            )
        yield Hypothesis(sensor, BEAM, unit[:, [a, b]], np.full(2, 3.0), _speeds)


def _of_the_array(channels: Channels) -> Iterator[Hypothesis]:
    yield Hypothesis("DVL", BOTTOM, np.eye(3)[:, :2], np.full(2, 3.0), _bottom)
    yield Hypothesis("DVL", BOTTOM, np.eye(3), np.array([3.0, 3.0, RISING_M_PER_S]), _bottom)
    if len(channels.beams_d) >= 3:
        yield Hypothesis("DVL", BEAM, channels.beams_d, np.full(3, 3.0), _axes)
    yield Hypothesis("DVL", SCALE, np.eye(1), np.full(1, 1.0), partial(_share, "speed"))
    yield Hypothesis("DVL", MOUNTING, np.eye(3), np.full(3, 1.0), _turn)


def _of_inertial() -> Iterator[Hypothesis]:
    unit = np.eye(6)
    yield Hypothesis("accelerometers", IMU, unit[:, :3], np.full(3, 0.3), _forces, handicap=12.0)
    yield Hypothesis("gyros", IMU, unit[:, 3:], np.full(3, 0.1), _rates, handicap=12.0)
    for axis in range(3):
        say = partial(_rate, axis)
        one = unit[:, [3 + axis]]
        yield Hypothesis("gyros", IMU, one, np.full(1, 0.1), say, handicap=12.0)


def of_aid(name: str, dim: int) -> Iterator[Hypothesis]:
    """Return the hypotheses of an aid of so many components, by its name."""
    unit, size = AIDS.get(name, ("", 1e3))
    is_place = dim == 3 and unit == "m"

    def numbers(s: Array) -> str:
        return f"{', '.join(f'{one:+.3g}' for one in s)} {unit}".rstrip()

    say = _place if is_place else numbers
    one = Hypothesis(name, name, np.eye(dim), np.full(dim, size), say)
    for course in Course:
        is_usual = name == "depth" and course is Course.RAMP
        yield replace(one, course=course, handicap=USUAL if is_usual else 0.0)
    if dim < 3:
        return
    # Level and up by themselves: against the velocity of a bottom, or a depth, which have no more
    # numbers, a place of three pays for what it does not need.
    for part, words in ((slice(0, 2), _level), (slice(2, 3), _up)):
        own = np.eye(dim)[:, part]
        sigma = np.full(own.shape[1], size)
        small = replace(one, combined=own, sigma=sigma, say=words if is_place else numbers)
        for course in (Course.CONSTANT, Course.RAMP):
            yield replace(small, course=course)


def _of_mode(aid: str, name: str) -> tuple[float, Callable[[Array], str]]:
    """Return the prior sigma of a way in which an aid may be off, and words for its size."""
    if name == CLOCK:
        return LATEST_S, _late
    if name == OF_SIZE:
        return 1.0, partial(_share, "distance")
    unit, size = AIDS[aid]
    return size, lambda s: f"{name.strip()} {s[0]:+.3g} {unit}"


AIDS = {
    "GNSS": ("m", 1e3),
    "USBL": ("m", 1e3),
    "depth": ("m", 1e2),
    "range": ("m", 1e3),
    "seabed": ("m", 1e2),
    "heading": ("rad", 1.0),
}
"""Unit and prior sigma of what an aid is off by."""


def _noisy(factor: float, s: Array) -> str:
    return f"errs {factor:.1f} times as much as the others, and by {_speeds(s)} on average"


def _late(s: Array) -> str:
    return f"its stamps are {abs(s[0]):.2f} s {'late' if s[0] > 0.0 else 'early'}"


def _pair(sign: float, s: Array) -> str:
    return _speeds(np.array([s[0], sign * s[0]]))


def _speeds(s: Array) -> str:
    return " and ".join(f"{x:+.3f}" for x in s) + " m/s"


def _bottom(s: Array) -> str:
    speed, to = math.hypot(s[0], s[1]), math.degrees(math.atan2(s[0], s[1])) % 360.0
    up = f" and {s[2]:+.3f} m/s up" if len(s) == 3 else ""
    return (
        f"what its beams see moves at {speed:.3f} m/s towards {to:.0f} deg{up}: "
        "a layer above the bottom, a bottom that drifts, or the water taken for it"
    )


def _axes(s: Array) -> str:
    return f"its velocity is off by {s[0]:+.3f}, {s[1]:+.3f}, {s[2]:+.3f} m/s along its axes"


def _share(of: str, s: Array) -> str:
    return f"reads {1.0 + s[0]:.4f} of the {of}"


def _turn(s: Array) -> str:
    x, y, z = np.degrees(s)
    return f"its mounting is turned by {x:+.2f}, {y:+.2f}, {z:+.2f} deg about x, y, z of the body"


def _forces(s: Array) -> str:
    return f"off by {s[0]:+.2g}, {s[1]:+.2g}, {s[2]:+.2g} m/s^2 along x, y, z"


def _rates(s: Array) -> str:
    x, y, z = np.degrees(s)
    return f"off by {x:+.2g}, {y:+.2g}, {z:+.2g} deg/s about x, y, z"


def _rate(axis: int, s: Array) -> str:
    return f"off by {math.degrees(s[0]):+.2g} deg/s about {'xyz'[axis]}"


def _level(s: Array) -> str:
    level, to = math.hypot(s[0], s[1]), math.degrees(math.atan2(s[0], s[1])) % 360.0
    return f"{level:.2g} m towards {to:.0f} deg"


def _up(s: Array) -> str:
    return f"{s[0]:+.2g} m up"


def _place(s: Array) -> str:
    return f"{_level(s)} and {_up(s[2:])}"
