"""How well the start is found in the field: unknown heading, on the move, a minute of GNSS.

``python -m benchmarks.science.alignment --keep`` (about ten minutes on one core; a quick look is
``--missions 3``). Every mission is estimated from its first minute alone, as it would be known to
a vehicle that has to leave the surface then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from benchmarks.missions import survey
from benchmarks.report import Option, Report, note, rms, table
from ssm_graph import Estimate, Status, smooth
from ssm_graph.base.frames import wrap_to_pi
from ssm_graph.io.blueye.vehicle import NOISE
from ssm_graph.simulation import (
    DepthProfile,
    GnssSettings,
    Grade,
    Route,
    SimulatedMission,
    SpiralRoute,
    TransitRoute,
)

GRADES = {
    "small ROV": (Grade.MEMS, NOISE),
    "mems": (Grade.MEMS, None),
    "industrial": (Grade.INDUSTRIAL, None),
}
"""Name, and what the simulator makes of it; the first has the noise of a Blueye X3."""
STARTS = ("straight", "turning", "slow")
SURFACE = DepthProfile(0.3, 0.3)
MINUTE_S = 60.0
"""How long GNSS is there, and all that the estimate knows."""
SLOW = 0.04
"""m/s; of a vehicle that hardly moves: 2.4 m in the minute."""


class Row(NamedTuple):
    """What one mission knew of its heading after the first minute."""

    grade: str
    start: str
    seed: int
    error: float
    """estimated minus true heading at the end of the minute, rad"""
    sigma: float
    """its posterior sigma, rad"""
    is_said: bool
    """the program says that the heading is ambiguous or hardly observable"""
    status: str
    method: str
    """how the heading was found, in one word"""


def route(start: str, rng: np.random.Generator) -> Route:
    """Return a route that is on its way at time zero, at a speed and in a direction of chance."""
    speed = SLOW if start == "slow" else rng.uniform(0.4, 1.5)
    course = rng.uniform(-math.pi, math.pi)
    if start == "turning":
        return SpiralRoute(speed=speed, radius_m=rng.uniform(5.0, 20.0), depth=SURFACE)
    return TransitRoute(speed=speed, course=course, depth=SURFACE)


def mission(grade: str, start: str, seed: int) -> SimulatedMission:
    """Return a minute of a vehicle at the surface, with 10 % sparse outliers and no ``[initial]``.

    The sea turns the vehicle by some degrees about all axes, with the simulator's own waves.
    """
    simulated, noise = GRADES[grade]
    return survey(
        MINUTE_S,
        simulated,
        seed=seed,
        route=route(start, np.random.default_rng([seed, STARTS.index(start)])),
        imu_noise=noise,
        gnss=GnssSettings(rate_hz=2.0),
    )


def run(grade: str, start: str, seed: int) -> Row:
    """Simulate and estimate one mission."""
    sim = mission(grade, start, seed)
    estimate = smooth(replace(sim.mission, initial=None))
    trajectory = estimate.trajectory
    truth = sim.truth_at(trajectory.time_s[-1:]).roll_pitch_heading[0, 2]
    error = float(wrap_to_pi(trajectory.roll_pitch_heading[-1, 2] - truth))
    sigma = float(trajectory.attitude_sigma[-1, 2])
    said = " ".join((estimate.reason, *estimate.notes))
    is_said = "ambiguous" in said or "hardly observable" in said
    found = error, sigma, is_said, estimate.status.name, _method(estimate)
    return Row(grade, start, seed, *found)


def _method(estimate: Estimate) -> str:
    """Return how alignment found the heading, by what it says of itself."""
    said = next(note for note in estimate.notes if note.startswith("aligned"))
    if "hypotheses" in said:
        return "tried"
    return "compass" if "gyrocompassing" in said else "track"


def report(rows: Sequence[Row]) -> list[str]:
    """Return one line of shares and errors for every grade and start."""
    cells = []
    for grade, start in product(GRADES, STARTS):
        some = [row for row in rows if (row.grade, row.start) == (grade, start)]
        if some:
            cells.append([grade, start, *_cells(some)])
    return table(HEADER, cells)


HEADER = ["grade", "start", "missions", "within 3 sigma", "heading error, deg rms", "median"]
HEADER += ["largest", "sigma, median deg", "err/sigma, rms", "said not observable"]
HEADER += ["wrong and not said", "status"]


def _cells(rows: Sequence[Row]) -> list[str]:
    error = np.degrees(np.abs([row.error for row in rows]))
    sigma = np.degrees([row.sigma for row in rows])
    inside = error < 3.0 * sigma
    is_said = np.array([row.is_said for row in rows])
    good = sum(row.status == Status.CONVERGED.name for row in rows)
    return [
        str(len(rows)),
        f"{100 * np.mean(inside):.0f} %",
        f"{rms(error):.2f}",
        f"{np.median(error):.2f}",
        f"{np.max(error):.1f}",
        f"{np.median(sigma):.2f}",
        f"{rms(error / sigma):.2f}",
        f"{100 * np.mean(is_said):.0f} %",
        str(int(np.sum(~inside & ~is_said))),
        f"{good} CONVERGED",
    ]


def doubtful(rows: Sequence[Row]) -> list[str]:
    """Return the missions whose heading is off by more than three sigmas, or that have failed."""
    bad = [row for row in rows if not abs(row.error) < 3.0 * row.sigma]
    cells = []
    for row in bad:
        degrees = [f"{math.degrees(x):.1f}" for x in (row.error, row.sigma)]
        said = "yes" if row.is_said else "no"
        cells.append([*map(str, row[:3]), *degrees, row.method, said, row.status])
    header = ["grade", "start", "seed", "error, deg", "sigma, deg", "found by", "said", "status"]
    return ["Outside of 3 sigma:", "", *table(header, cells)] if bad else ["None outside 3 sigma."]


LEGEND = """\
A vehicle at the surface in waves, on its way from the first sample: `straight` at 0.4 to 1.5 m/s,
`turning` on a circle of 5 to 20 m at the same speeds, `slow` straight at 0.04 m/s. IMU 100 Hz, DVL
1 Hz with a bad beam in 10 % of the pings, GNSS 2 Hz with 0.5 m, nothing known of the start. The
noise of `small ROV` is what the importer states for a Blueye X3. The heading is that at the end of
the first minute, and nothing later was used. Said not observable: the reason or the notes say that
the heading is hardly observable or ambiguous. Wrong and not said: off by more than three of its
sigmas without a word.
"""


def main() -> None:
    """Run all missions and write the tables."""
    missions = Option("--missions", 30, "of each grade and start")
    page = Report(__file__, "Alignment in the field", __doc__, missions)
    rows = []
    for grade, start, seed in product(GRADES, STARTS, range(page.args.missions)):
        rows.append(run(grade, start, seed))
        note(f"{len(rows)}: {rows[-1]}")
    page.write([LEGEND, *report(rows), "", *doubtful(rows), ""])


if __name__ == "__main__":
    main()
