"""Whether the stamps of a recording's headers are of one clock that was never set.

Header less time of recording is minus the delay of a message, where both are of one clock. A clock
that is set shifts it for good; a sensor on another clock, as GPS time, 18 s ahead of UTC, has
another one than the rest; and no message is recorded before its stamp.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array

SMALLEST_STEP_S: Final = 0.3
"""A clock that was set by less is not told from scatter of the delays."""
LARGEST_AHEAD_S: Final = 0.5
"""So far may a sensor's stamps be ahead of those of the IMU, by their times of recording."""
_LARGEST_DELAY_S: Final = 2.0
"""A longer one than that of the IMU's messages is told."""
GPS_AHEAD_S: Final = 18.0
"""GPS time less UTC since 2017."""
_WINDOW_S: Final = 10.0
_FEWEST: Final = 5
_LITTLE_DELAY: Final = 0.9
"""Quantile: delays only make stamps lag, so that the upper ones tell of the clock."""


def check_never_set(place: str, stamp_s: Array, received_s: Array) -> None:
    """Raise :class:`DataError` where the clock of the headers (N,) was set amid the recording.

    ``place`` names the topic; the times are in the order of recording, s.
    """
    ahead = stamp_s - received_s
    steps, intervals = np.diff(ahead), np.diff(stamp_s)
    if len(steps) == 0:
        return
    # where the stamps go on as ever it is the delay that has changed, not the clock
    steps = np.where(np.abs(intervals - np.median(intervals)) > SMALLEST_STEP_S, steps, 0.0)
    order = np.argsort(-np.abs(steps))[: 4 * _FEWEST]
    for k in order[np.abs(steps[order]) > SMALLEST_STEP_S]:
        before, after = ahead[: k + 1], ahead[k + 1 :]
        near = (received_s[: k + 1] >= received_s[k] - _WINDOW_S, received_s[k + 1 :])
        before = before[near[0]]
        after = after[near[1] <= received_s[k + 1] + _WINDOW_S]
        if min(len(before), len(after)) < _FEWEST:
            continue
        step = float(np.median(after) - np.median(before))
        scatter = float(np.median(np.abs(after - np.median(after))))
        if abs(step) > max(SMALLEST_STEP_S, 5.0 * scatter):
            way = "back" if step < 0.0 else "forward"
            raise DataError(
                f"{place}: the clock of the headers was set {way} by {abs(step):.4g} s at "
                f"{received_s[k + 1]:.3f} s of recording; expected one clock: split the recording "
                "there, and convert the parts as two missions"
            )


def ahead_of_recording(stamp_s: Array, received_s: Array) -> float:
    """Return header less time of recording, s, of messages that come with little delay."""
    return float(np.quantile(stamp_s - received_s, _LITTLE_DELAY))


def check_one_clock(
    bag: Path, ahead_s: Mapping[str, tuple[str, float]], late_s: Mapping[str, float]
) -> tuple[dict[str, float], list[str]]:
    """Return by role what is to be taken off the stamps, s, and the notes.

    Raises :class:`DataError` for a sensor whose stamps are ahead of those of the IMU, but for fixes
    on GPS time, which is known to be 18 s ahead.

    Parameters
    ----------
    ahead_s : by role, the topic and its :func:`ahead_of_recording`, s.
    late_s : by role, how far ahead its stamps are by the vehicle's file (``time_offset_s``), s.
    """
    take_off, notes = dict[str, float](), list[str]()
    imu_topic, imu_s = ahead_s["imu"]
    for role, (topic, stamps_s) in ahead_s.items():
        off = stamps_s - imu_s - late_s.get(role, 0.0)
        if role == "gnss" and GPS_AHEAD_S - 1.0 < off < GPS_AHEAD_S + LARGEST_AHEAD_S:
            take_off[role] = GPS_AHEAD_S
            notes.append(
                f"{topic}: the stamps are {off:.4g} s ahead of those of {imu_topic}, by the times "
                f"of recording: taken for GPS time, {GPS_AHEAD_S:g} s are taken off."
            )
        elif off > LARGEST_AHEAD_S:
            raise DataError(
                f"{bag}: {topic}: the stamps are {off:.4g} s ahead of those of {imu_topic}, by the "
                "times at which both were recorded; expected one clock, and no stamp after its own "
                f"recording; {_remedy(role, stamps_s - imu_s)}"
            )
        elif off < -_LARGEST_DELAY_S:
            notes.append(
                f"{topic}: recorded {-off:.4g} s later behind its stamps than {imu_topic}: late "
                "messages, or another clock that is behind."
            )
    return take_off, notes


def _remedy(role: str, off_s: float) -> str:
    if role in ("dvl", "gnss") and abs(off_s) <= 10.0:
        return f"if it stamps late, state  time_offset_s = {off_s:.3g}  in [{role}] of --vehicle"
    return "set the clocks, and record again"
