"""Times of sentences for people: minutes since start, and UTC where the clock is Unix time."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Final

from ssm_graph.base.times import UNIX_FROM_S, UNIX_UNTIL_S

_TIME: Final = r"(\d+(?:\.\d+)?)"
_WHEN: Final = re.compile(
    rf"\b(?:at|from|since) {_TIME} s\b(?: to {_TIME} s\b)?|\bfrom {_TIME} to {_TIME} s\b"
    rf"|(?<=, ){_TIME}-{_TIME} s(?=,)"
)
"""One time, or two of a stretch, as notes and reasons write them."""


def clocked(sentence: str, begin_s: float = 0.0, epoch_s: float | None = None) -> str:
    """Return a sentence with minutes, and UTC where it is known, behind its times.

    Parameters
    ----------
    sentence : such as a note of an estimate, its times on the mission's clock.
    begin_s : of the trajectory, s.
    epoch_s : Unix time of that clock's zero, s; None for a clock that is Unix time or unknown.
    """

    def told(found: re.Match[str]) -> str:
        times = [float(text) for text in found.groups() if text is not None]
        minutes = " to ".join(f"{(time_s - begin_s) / 60.0:.1f}" for time_s in times)
        words = f"{found[0]} ({minutes} min"
        is_unix = epoch_s is None and UNIX_FROM_S <= begin_s <= UNIX_UNTIL_S
        known_s = 0.0 if is_unix else epoch_s
        if known_s is not None:
            stamps = (datetime.fromtimestamp(known_s + t, UTC) for t in times)
            words += f", {' to '.join(f'{stamp:%H:%M:%S}' for stamp in stamps)} UTC"
        return f"{words})"

    return _WHEN.sub(told, sentence)
