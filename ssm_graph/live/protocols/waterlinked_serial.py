"""The serial protocol of the Water Linked DVL-A50 and A125, as the reports of its JSON.

A ping is a line of the velocity (``wrz``, off the water ``wrs``) and a line of each transducer
(``wru``), each with a CRC-8; ``wrp`` is the dead reckoning. Lines of the first version (``wrx``,
``wrt``) say no speed along a beam and are not read. Protocol: serial version 2.1 to 2.8, by the
maker.

Which velocity the transducers belong to, that before them as the maker lists the lines or that
after them, no line says. It is told by how well they agree: speeds along four beams of a Janus of
22.5 deg have a vertical and a horizontal part, however the instrument is turned about its axis.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

from ssm_graph.live.protocols.decoder import RefusedError, shown
from ssm_graph.live.protocols.framing import ObjectFramer
from ssm_graph.live.protocols.nmea_fields import required_number

MAX_LINE: Final = 512
"""Bytes; velocities with their covariance have some 150."""
N_BEAMS: Final = 4
_UNDECIDED: Final = 4096
"""Bytes without a begin of either protocol, after which JSON is expected."""
_LINE = re.compile(r"\bwr([a-zA-Z])((?:,[^,*]*)*)\*([0-9A-Fa-f]{2})\Z", re.ASCII)
_BEGIN: Final = re.compile(rb"(?:\A|[\r\n])[^{\r\n]{0,120}\bwr[a-zA-Z],")
SERIAL: Final = re.compile(
    rb"(?:\A|[\r\n])[^{\r\n]{0,120}\bwr[zsuxt],[^*\r\n]{1,400}\*[0-9A-Fa-f]{2}"
)
"""A recording of the serial protocol has it."""
_NOT_READ: Final = frozenset("vwcanNT")
"""Answers to commands."""
_OLD: Final = frozenset("xt")
"""Kinds of the first version."""
_NEW: Final = frozenset("zu")
"""Kinds of the second alone, of which one comes with every ping."""
_MANY_OLD: Final = 10
"""Without one of the second between: nothing else comes."""
_SIN, _COS = math.sin(math.pi / 8.0) / math.sqrt(2.0), math.cos(math.pi / 8.0)
"""Of a beam along each horizontal axis, and along the vertical one."""
_FORGET: Final = 0.9
"""Of a ping's misfit, what counts at the next one."""
_CLEAR: Final = 2e-4
"""(m/s)²: rounding to a millimetre per second leaves a hundredth of it."""
_TIMES: Final = 4.0
"""As much better does the other order agree; noise of the velocity alone favours neither."""


def crc8(data: bytes) -> int:
    """Return the CRC-8 (polynomial 0x07, begin 0) of the bytes before the star."""
    crc = 0
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


def is_sound(line: str) -> bool:
    """Return whether a text ends in a line of the serial protocol whose checksum is right."""
    found = _LINE.search(line)
    return found is not None and _checksum(found) == int(found[3], 16)


def _checksum(found: re.Match[str]) -> int:
    return crc8(found[0][:-3].encode("latin-1"))


def _crc_of(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1) ^ (0x107 if byte & 0x80 else 0)
    return byte


_CRC: Final = tuple(_crc_of(byte) for byte in range(256))


class ReportFramer:
    """Reports as JSON texts, of either protocol: which it is is told by what comes.

    ``refuse`` is told what is no report; of either no more than ``max_length`` bytes are held.
    """

    def __init__(self, refuse: Callable[[str], None], *, max_length: int) -> None:
        self._refuse, self._max_length = refuse, max_length - MAX_LINE
        self._objects = ObjectFramer(refuse, max_length=self._max_length)
        self._serial = SerialReports(refuse)
        self._undecided: bytes | None = b""
        self._is_serial = False
        self._line = b""
        """The end of the unfinished line"""

    @property
    def n_held(self) -> int:
        """Bytes held of what is not complete."""
        return len(self._undecided or b"") + self._objects.n_held + len(self._line)

    def feed(self, data: bytes) -> list[str]:
        """Return the reports that end in ``data``."""
        if self._undecided is not None:
            data = self._undecided = self._undecided + data
            begin = _BEGIN.search(data)
            if not begin and b"{" not in data and len(data) <= _UNDECIDED:
                return []
            self._is_serial = begin is not None and b"{" not in data[: begin.end()]
            self._undecided = None
        return [text for part in data.splitlines(keepends=True) for text in self._take(part)]

    def _take(self, part: bytes) -> list[str]:
        """Return the reports that end in what has come of a line."""
        texts = [] if self._is_serial else self._objects.feed(part)
        self._line += part
        is_ended = part.endswith((b"\r", b"\n"))
        line = self._line.strip().decode("latin-1")
        is_object = is_ended and "{" in line and not _LINE.search(line)
        if self._is_serial and (is_object or len(line) > MAX_LINE):
            self._is_serial = False
            texts = self._objects.feed(self._line)
        if not is_ended:
            self._line = self._line[-MAX_LINE:]
            return texts
        self._line = b""
        if not self._is_serial and is_sound(line):
            if self._objects.n_held > len(b"\n"):
                self._refuse("expected the end of a JSON object, got the serial protocol")
            self._objects = ObjectFramer(self._refuse, max_length=self._max_length)
            self._is_serial = True
        return texts + (self._serial.feed(line) if self._is_serial and line else [])


class SerialReports:
    """Lines to reports; one that is damaged costs its ping.

    It may be the end of one ping and the begin of the next, with all between lost.
    """

    def __init__(self, refuse: Callable[[str], None]) -> None:
        self._refuse = refuse
        self._head: dict[str, Any] | None = None
        """The last velocity."""
        self._beams: dict[int, dict[str, Any]] = {}
        """What transducers have said since."""
        self._is_used = False
        """Whether they went with a report."""
        self._n_old = 0
        """Lines of the first version since one of the second."""
        self._misfits = [0.0, 0.0]
        """Of transducers after their velocity, and before it, (m/s)²."""
        self._is_before = False
        """Whether transducers come before the velocity that they belong to."""

    def feed(self, line: str) -> list[str]:
        """Return the reports that a line completes."""
        found = _LINE.search(line)
        try:
            if not found:
                raise RefusedError(f"expected 'wr..,*hh', got {shown(line)}")
            kind, fields, given = found[1], found[2].split(",")[1:], int(found[3], 16)
            if given != (expected := _checksum(found)):
                raise RefusedError(
                    f"expected checksum {expected:02x}, got {given:02x} in {shown(line)}"
                )
            return self._read(kind, fields)
        except RefusedError as error:
            self._refuse(str(error))
            self._head, self._beams, self._is_used = None, {}, False
            return []

    def _read(self, kind: str, fields: list[str]) -> list[str]:
        self._n_old = 0 if kind in _NEW else self._n_old + (kind in _OLD)
        if kind in _OLD and self._n_old == _MANY_OLD:
            raise RefusedError(
                "wrx and wrt come alone, which say no speed along a beam; set the output of the "
                "instrument to WL - Serial V2 (wcp,3)"
            )
        if kind == "u":
            return self._on_beam(fields)
        if kind == "z" or (kind == "s" and len(fields) == len(_WATER)):  # else a time status
            return self._on_velocity(fields, is_water=kind == "s")
        if kind == "p":
            return [_dead_reckoning(fields)]
        if kind not in _NOT_READ | _OLD and kind != "s":
            raise RefusedError(f"expected wrz, wrs, wru or wrp, got {shown('wr' + kind)}")
        return []

    def _on_velocity(self, fields: list[str], *, is_water: bool) -> list[str]:
        head = _velocity(fields, _WATER if is_water else _GROUND)
        done = []
        if self._head is not None:
            self._compare(head)
            if self._is_before and self._beams and not self._is_used:
                done = [_report(head, self._beams)]
            elif not self._is_before and not self._is_used:
                done = [_report(self._head, self._beams)]
        self._head, self._beams, self._is_used = head, {}, False
        return done

    def _on_beam(self, fields: list[str]) -> list[str]:
        number, beam = _transducer(fields)
        if number in self._beams:  # a velocity between was lost
            self._head, self._beams, self._is_used = None, {}, False
        self._beams[number] = beam
        if self._head is None or self._is_before or len(self._beams) < N_BEAMS:
            return []
        self._is_used = True
        return [_report(self._head, self._beams)]

    def _compare(self, head: Mapping[str, Any]) -> None:
        """Take note of which of two velocities agrees with what transducers said between them."""
        assert self._head is not None
        misfits = [_misfit(one, self._beams) for one in (self._head, head)]
        if all(map(math.isfinite, misfits)):
            was = self._misfits
            self._misfits = [_FORGET * old + new for old, new in zip(was, misfits, strict=True)]
            own, other = self._misfits[self._is_before], self._misfits[not self._is_before]
            self._is_before ^= own > _CLEAR + _TIMES * other


_GROUND: Final = (
    *("vx", "vy", "vz", "valid", "altitude", "fom", "covariance"),
    *("time_of_validity", "time_of_transmission", "time", "status"),
)
_WATER: Final = tuple(name for name in _GROUND if name != "altitude")
_RECKONED: Final = ("ts", "x", "y", "z", "std", "roll", "pitch", "yaw", "status")
_AS_TEXT: Final = frozenset({"valid", "covariance", "time_of_validity", "time_of_transmission"})


def _named(fields: list[str], names: tuple[str, ...], kind: str) -> dict[str, Any]:
    if len(fields) != len(names):
        raise RefusedError(f"{kind}: expected {len(names)} fields, got {len(fields)}")
    return {
        name: field if name in _AS_TEXT else required_number(field, name)
        for name, field in zip(names, fields, strict=True)
    }


def _velocity(fields: list[str], names: tuple[str, ...]) -> dict[str, Any]:
    """Return what a velocity says, by the keys of the JSON."""
    kind = "velocity" if names is _GROUND else "velocity_water"
    found = _named(fields, names, kind)
    if found["valid"] not in ("y", "n"):
        raise RefusedError(f"{kind}: expected y or n for valid, got {shown(found['valid'])}")
    stamp = found["time_of_validity"]
    if not (stamp.isascii() and stamp.isdigit() and len(stamp) < 20):
        raise RefusedError(f"{kind}: expected whole microseconds, got {shown(stamp)}")
    numbers = {name: value for name, value in found.items() if name not in _AS_TEXT}
    is_valid = found["valid"] == "y"
    return {**numbers, "velocity_valid": is_valid, "time_of_validity": int(stamp), "type": kind}


def _transducer(fields: list[str]) -> tuple[int, dict[str, Any]]:
    """Return number and speed of a transducer; one that heard nothing has a distance of -1."""
    names = ("id", "velocity", "distance")
    if len(fields) < len(names):
        raise RefusedError(f"transducer: expected 3 fields or more, got {len(fields)}")
    said = zip(fields[: len(names)], names, strict=True)
    number, speed, distance = (required_number(field, name) for field, name in said)
    if number not in range(N_BEAMS):
        raise RefusedError(f"transducer: expected the numbers 0 to {N_BEAMS - 1}, got {number:g}")
    return int(number), {"id": int(number), "velocity": speed, "beam_valid": distance > 0.0}


def _dead_reckoning(fields: list[str]) -> str:
    return json.dumps({**_named(fields, _RECKONED, "dead reckoning"), "type": "position_local"})


def _report(head: Mapping[str, Any], beams: Mapping[int, dict[str, Any]]) -> str:
    """Return a report as the JSON has it; a transducer whose line is lost is not valid."""
    lost = {"velocity": 0.0, "beam_valid": False}
    transducers = [beams.get(k, {"id": k, **lost}) for k in range(N_BEAMS)]
    return json.dumps({**head, "transducers": transducers})


def _misfit(head: Mapping[str, Any], beams: Mapping[int, dict[str, Any]]) -> float:
    """Return how far a velocity is from what beams say, (m/s)²; NaN where that is not known."""
    if len(beams) < N_BEAMS or not head["velocity_valid"]:
        return math.nan
    if not all(beam["beam_valid"] for beam in beams.values()):
        return math.nan
    a, b, c, d = (beams[k]["velocity"] for k in range(N_BEAMS))
    horizontal = math.hypot(c + d - a - b, a + d - b - c) / (4.0 * _SIN)
    vertical = (a + b + c + d) / (4.0 * _COS)
    off = horizontal - math.hypot(head["vx"], head["vy"]), vertical - head["vz"]
    return float(off[0] ** 2 + off[1] ** 2)
