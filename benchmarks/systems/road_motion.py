"""What a drive of comma2k19 says of its own chassis and receiver, and what that is worth.

``python -m benchmarks.systems.road_motion --keep`` (seconds). Scale, bias and delay come of the
chassis and one receiver alone; the reference judges.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from benchmarks.report import Option, Report, table
from benchmarks.systems.road_map import DATA
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.road_map.comma2k19 import Comma2k19, read_comma2k19
from ssm_graph.systems.road_map.drive import GnssFixes, dead_reckoned
from ssm_graph.systems.road_map.motion import MotionErrors, motion_errors

REFERENCE_SIGMA_M = 0.3
"""Of the reference poses, as they are used in place of fixes."""
HEADER = (
    *(
        "receiver",
        "fixes of, s",
        "speed, %",
        "bias, deg/s",
        "delay, s",
        "delay by the reference, s",
    ),
    *("fixes off east, north, m", "dead reckoning off after 10 s, m", "at the end, m"),
    *("at the end, were the fixes right, m", "at the end without, m"),
)


def main() -> None:
    """Read a segment and write the page."""
    report = Report(
        __file__,
        "Chassis and receiver of a real drive",
        __doc__,
        Option("--segment", f"{DATA}/systems/comma2k19", "folder of a segment"),
    )
    segment = read_comma2k19(Path(report.args.segment))
    t, end = segment.truth, float(segment.chassis.time_s[-1])
    sigma = np.full(len(t.time_s), REFERENCE_SIGMA_M)
    reference = motion_errors(segment.chassis, GnssFixes(t.time_s, t.x_y, sigma))
    cells = []
    for name, fixes in segment.gnss.items():
        for last in (end, 0.5 * end):
            try:
                found = motion_errors(segment.chassis, fixes, last_s=last)
            except DataError as error:
                cells.append((name, f"0 to {last:.0f}", str(error), *["–"] * (len(HEADER) - 3)))
                continue
            told = _delay(segment, fixes) - reference.delay_s
            off, right = _right(segment, fixes, found.delay_s, last)
            cells.append((name, f"0 to {last:.0f}", *_cells(segment, found, told, off, right)))
    lines = [
        "Dead reckoning begins at the reference's pose after 1 s and goes on to "
        f"{end - 1.0:.0f} s, by speed and yaw rate alone; *without* is without scale and bias. "
        "Sigmas in brackets. The delay by the reference is that by which the fixes lie best on it, "
        "less by how much the chassis' clock is behind the reference's "
        f"({1e3 * reference.delay_s:.0f} ms). *Fixes off* is by how much they scatter about the "
        "reference (standard deviation, a constant and the delay left out); *were the fixes right* "
        "takes the reference's places at the same times: what is left is not the receiver's.",
        "",
        *table(HEADER, cells),
    ]
    report.write(lines)


def _delay(segment: Comma2k19, fixes: GnssFixes) -> float:
    """Return by which delay fixes lie best on the reference, s; a constant offset is left out."""
    t = segment.truth
    inside = (fixes.time_s > t.time_s[0] + 1.0) & (fixes.time_s < t.time_s[-1] - 1.0)
    time_s, x_y = fixes.time_s[inside], fixes.x_y[inside]

    def off(delay_s: float) -> float:
        error = x_y - t.at(time_s - delay_s)[:, :2]
        return float(np.median(np.hypot(*(error - np.median(error, axis=0)).T)))

    return float(min(np.arange(-0.5, 1.0, 0.002), key=off))


def _right(
    segment: Comma2k19, fixes: GnssFixes, delay_s: float, last_s: float
) -> tuple[Array, MotionErrors]:
    """Return how far fixes scatter, (2,) m, and what the reference in their place would tell."""
    t = segment.truth
    use = (fixes.time_s > t.time_s[0] + 1.0) & (fixes.time_s < min(last_s, t.time_s[-1] - 1.0))
    time_s, sigma = fixes.time_s[use], fixes.sigma_m[use]
    off = np.std(fixes.x_y[use] - t.at(time_s - delay_s)[:, :2], axis=0)
    right = GnssFixes(time_s, t.at(time_s)[:, :2], sigma)
    return off, motion_errors(segment.chassis, right, last_s=last_s)


def _cells(
    segment: Comma2k19, found: MotionErrors, told_s: float, off: Array, right: MotionErrors
) -> tuple[str, ...]:
    sigma = found.sigma[3:]
    ours, best, without = (
        _error(segment, scale=1.0 + scale, bias=bias)
        for scale, bias in ((found.scale, found.bias), (right.scale, right.bias), (0.0, 0.0))
    )
    return (
        f"{100.0 * found.scale:+.2f} ({100.0 * sigma[0]:.2f})",
        f"{math.degrees(found.bias):.3f} ({math.degrees(sigma[1]):.3f})",
        f"{found.delay_s:.3f} ({sigma[2]:.3f})",
        f"{told_s:.3f}",
        f"{off[0]:.1f}, {off[1]:.1f}",
        f"{ours[0]:.1f}",
        f"{ours[1]:.1f}",
        f"{best[1]:.1f}",
        f"{without[1]:.1f}",
    )


def _error(segment: Comma2k19, *, scale: float, bias: float) -> Array:
    """Return how far dead reckoning is off after 10 s and at the end, (2,) m."""
    t, end = segment.truth, float(segment.chassis.time_s[-1]) - 1.0
    time_s = np.array([1.0, 11.0, end])
    # The course of the first seconds, turned by what was driven: one pose's own is noisy.
    way = dead_reckoned(np.zeros(3), np.linspace(1.0, 6.0, 26), segment.chassis, scale=scale)
    seen = t.at(np.linspace(1.0, 6.0, 26))[:, :2]
    a, b = way[:, :2] - way[0, :2], seen - seen[0]
    turn = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    start = np.array([*seen[0], turn])
    track = dead_reckoned(start, time_s, segment.chassis, scale=scale, bias=bias)
    return np.asarray(np.hypot(*(track[1:, :2] - t.at(time_s[1:])[:, :2]).T))


if __name__ == "__main__":
    main()
