"""Reports of the Water Linked DVL-A50 and A125 (JSON over TCP, port 16171; serial) as pings.

Sign. Over the 269 reports with four beams and a valid velocity of a recorded A50 (December 2021),
least squares gives the transducers' velocities from (vx, vy, vz), z down, as::

    id 0   -0.273  0.263  0.894
    id 1   -0.271 -0.272  0.904
    id 2    0.270 -0.271  0.917
    id 3    0.272  0.270  0.929

with residuals of 2.3, 2.0, 0.6 and 0.7 mm/s rms at speeds up to 0.5 m/s: the beams of a 22.5 deg
Janus, (.2706, .2706, .9239) but for signs. All third components are positive, so a velocity is
positive when the instrument moves along the beam, away from the transducer, as ours is. Nothing is
turned. Opposite signs would leave 112 mm/s rms, these signs 1.6 mm/s.

Sigma. A ping carries none. The report's ``fom`` (and its covariance, which is of the same solution)
is no sigma of a beam: against the parity of the four beams, half of their alternating sum, which
has the sigma of one beam, it was 3.4 times too small in that log (rms), and 7 to 30 times too large
in logs of another A50 of 2025. A number that is off by a hundred between firmwares is not believed;
the vehicle's nominal one and the weights of the estimator are.

Lock. Where neither a velocity nor an altitude is valid, transducers still flag beams as valid:
false locks at ranges of 0.1 to 1 m, off by up to 0.15 m/s from what the reports around them say (17
such reports in that log). All beams of such reports are missing
unless :class:`BeamRule` says otherwise. Where there is an altitude and the velocity is not valid,
the beams are within 0.033 m/s of the reports around them (all 10), so they count.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Any, Final

from ssm_graph.live.protocols.decoder import (
    Clock,
    Decoder,
    RefusedError,
    Stamper,
    flag,
    number,
    parse_object,
    require,
    shown,
)
from ssm_graph.live.protocols.framing import MAX_LENGTH
from ssm_graph.live.protocols.waterlinked_serial import ReportFramer
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.dvl_readings import LARGEST_SPEED
from ssm_graph.sensors.messages import Message

PLACE: Final = "water linked"
_TRACKS: Final = {"velocity": False, "velocity_water": True}
"""Types of reports with beams, and whether they are off the water, as software 2.7 has them."""
_MODES: Final = {"bottom": False, "water": True}
"""The tracking mode that software 2.7 states besides."""
_DEAD_RECKONING: Final = "position_local"
_IGNORED: Final = frozenset({"response"})
"""Types of the protocol that say nothing of the motion."""
_MOST, _FEWEST = 4, 3
"""Transducers of an instrument."""
_GROUND_ALONE: Final = ("json_v1", "json_v2", "json_v2.1", "json_v3", "json_v3.1")
"""Formats of software before 2.7, which knew no water track: the first has no type, and what passes
reports on may leave it out."""


class BeamRule(Enum):
    """Which beams of a report count; the text is shown to the user."""

    BOTTOM = "beams flagged valid, where the report has a valid velocity or an altitude"
    EACH = "every beam flagged valid"
    VELOCITY = "beams flagged valid, where the report has a valid velocity"


class WaterLinkedDecoder(Decoder):
    """Velocity reports to pings, as JSON in any layout, or as lines of the serial protocol.

    A report without a beam that counts is a ping of missing beams. The same report again (by
    ``time_of_validity``, or by content where there is none) is dropped and counted.

    Parameters
    ----------
    clock : INSTRUMENT takes ``time_of_validity``, the centre of the ping; arrival is some 0.1 to
        0.2 s later.
    max_clock_error_s : a stamp further from the arrival is not believed.
    beam_rule : which beams count.
    heading : whether the yaw of its dead reckoning is read, as the heading of a directional gyro:
        its own inertial unit seeks no north.
    max_length : of a report, bytes.
    """

    def __init__(
        self,
        *,
        clock: Clock = Clock.INSTRUMENT,
        max_clock_error_s: float = 5.0,
        beam_rule: BeamRule = BeamRule.BOTTOM,
        heading: bool = False,
        max_length: int = MAX_LENGTH,
    ) -> None:
        super().__init__(PLACE)
        self.n_repeats = 0
        """How many reports came again and were dropped."""
        self._framer = ReportFramer(self._refuse, max_length=max_length)
        self._stamper, self._yaw_stamper = (
            Stamper(clock, max_clock_error_s=max_clock_error_s, refusals=self._refusals, place=one)
            for one in (PLACE, f"{PLACE} {_DEAD_RECKONING}")
        )
        self._beam_rule, self._reads_heading = beam_rule, heading
        self._last: dict[str, dict[str, Any]] = {}
        self._n_beams = _FEWEST

    def _decode(self, text: str, arrival_s: float) -> list[Message]:
        report = parse_object(text)
        if "command" in report:  # what somebody asked of it, in a recording of both sides
            return []
        kind = "velocity" if _is_without_type(report) else require(report, "type")
        if not isinstance(kind, str) or kind not in {*_TRACKS, _DEAD_RECKONING, *_IGNORED}:
            raise RefusedError(f"expected a report of type 'velocity', got {shown(kind)}")
        if kind in _IGNORED or (kind == _DEAD_RECKONING and not self._reads_heading):
            return []
        message = (
            self._ping(report, arrival_s, is_water=_is_water(report, kind))
            if kind in _TRACKS
            else self._heading(report, arrival_s)
        )
        if self._is_repeat(report, kind):
            self.n_repeats += 1
            return []
        self._last[kind] = report
        return [message] if message is not None else []

    def _ping(self, report: dict[str, Any], arrival_s: float, *, is_water: bool) -> Ping:
        beams = _transducers(report, self._n_beams)
        self._n_beams = max(self._n_beams, len(beams))
        counts = self._counts(report, beams)
        if not is_water:
            altitude_m = _altitude(report)
            self.altitude_m = altitude_m if altitude_m > 0.0 else math.nan
        speed = tuple(
            float(x["velocity"]) if counts and x["beam_valid"] else math.nan for x in beams
        )
        time_s = self._stamper.stamp(_time_of_validity(report), arrival_s)
        return Ping(time_s, speed, is_water=is_water)

    def _heading(self, report: dict[str, Any], arrival_s: float) -> HeadingReading | None:
        """Return the yaw of a dead reckoning, degrees clockwise; None where its status is bad."""
        yaw = number(require(report, "yaw"), key="yaw, deg", low=-360.0, high=360.0)
        stamp_s = number(report["ts"], key="ts") if "ts" in report else None
        if number(report.get("status", 0), key="status") != 0.0:
            return None
        time_s = self._yaw_stamper.stamp(stamp_s, arrival_s)
        return HeadingReading(time_s, math.radians(yaw))

    def _is_repeat(self, report: dict[str, Any], kind: str) -> bool:
        last, stamp = self._last.get(kind, {}), report.get("time_of_validity", 0)
        is_set = stamp > 0  # a clock that was never set may stand still
        return report == last or (is_set and stamp == last.get("time_of_validity"))

    def _counts(self, report: dict[str, Any], beams: list[dict[str, Any]]) -> bool:
        """Return whether the valid beams of a report are to be believed."""
        is_valid = flag(report, "velocity_valid")
        has_altitude = _altitude(report) > 0.0
        if is_valid:
            return True
        if len({beam["velocity"] for beam in beams}) == 1:
            return False
        if self._beam_rule is BeamRule.BOTTOM:
            return has_altitude
        return self._beam_rule is BeamRule.EACH


def _is_water(report: dict[str, Any], kind: str) -> bool:
    """Return whether a report is off the water, by its type or the mode of the instrument."""
    mode = report.get("tracking_mode", "bottom")
    if not isinstance(mode, str) or mode not in _MODES:
        raise RefusedError(f"tracking_mode: expected bottom or water, got {shown(mode)}")
    return _TRACKS[kind] or _MODES[mode]


def _is_without_type(report: dict[str, Any]) -> bool:
    """Return whether a report says by what it holds that it is of a velocity off the ground."""
    if "type" in report or not {"transducers", "velocity_valid"} <= report.keys():
        return False
    return report.get("format", "json_v1") in _GROUND_ALONE


def _transducers(report: dict[str, Any], n_known: int) -> list[dict[str, Any]]:
    """Return the transducers in the order of their numbers, checked.

    One of which nothing is said is not valid, where the instrument is known to have it.
    """
    found = require(report, "transducers")
    if not isinstance(found, list) or not all(isinstance(beam, dict) for beam in found):
        raise RefusedError(
            f"transducers: expected a list of 3 or 4 objects, got {shown(str(found))}"
        )
    numbers = [require(beam, "id") for beam in found]
    are_sound = all(type(n) is int and 0 <= n < _MOST for n in numbers)
    is_of_three = are_sound and sorted(numbers) == [*range(_FEWEST)]
    n_beams = _FEWEST if is_of_three else _MOST
    is_known = len(numbers) == _MOST or n_known == _MOST or is_of_three
    if not are_sound or len({*numbers}) < len(numbers) or not is_known:
        raise RefusedError(
            f"transducers: expected the numbers 0 to 3, or 0 to 2, got {shown(str(numbers))}"
        )
    said = {int(beam["id"]): beam for beam in found}
    beams = [said.get(k, {"velocity": 0.0, "beam_valid": False}) for k in range(n_beams)]
    return [_checked(beam) for beam in beams]


def _checked(beam: dict[str, Any]) -> dict[str, Any]:
    """Return a transducer with a number for its velocity; nothing may stand for one not valid."""
    is_valid = require(beam, "beam_valid")
    if not isinstance(is_valid, bool) and is_valid not in (0, 1):  # as tables and databases write
        raise RefusedError(f"beam_valid: expected true or false, got {shown(is_valid)}")
    velocity = require(beam, "velocity")
    if velocity is None and not is_valid:
        velocity = 0.0
    largest = LARGEST_SPEED if is_valid else math.inf
    speed = number(velocity, key="velocity", low=-largest, high=largest)
    return {"velocity": speed, "beam_valid": bool(is_valid)}


def _altitude(report: dict[str, Any]) -> float:
    """Return the altitude, m; -1 where there is none."""
    altitude = report.get("altitude")
    return -1.0 if altitude is None else number(altitude, key="altitude")


def _time_of_validity(report: dict[str, Any]) -> float | None:
    """Return the centre of the ping, Unix s; None in reports before format ``json_v3``."""
    if "time_of_validity" not in report:
        return None
    stamp = report["time_of_validity"]
    is_whole = type(stamp) is int or (isinstance(stamp, float) and stamp.is_integer())
    if not is_whole:  # tables make floats of whole numbers
        raise RefusedError(f"time_of_validity: expected whole microseconds, got {shown(stamp)}")
    return float(stamp) / 1e6
