"""Readers of public logs: UTIAS MRCLAM, and graphs in the text of GTSAM, such as Victoria Park.

References
----------
.. [1] K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, "The UTIAS Multi-Robot Cooperative
   Localization and Mapping Dataset", International Journal of Robotics Research 30, 2011.
.. [2] J. Guivant, E. Nebot, "Optimization of the Simultaneous Localization and Map-Building
   Algorithm for Real-Time Implementation", IEEE Transactions on Robotics and Automation 17, 2001.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.logs import LandmarkLog
from ssm_graph.systems.landmark_slam.models import Odometry
from ssm_graph.systems.landmark_slam.problem import SlamNoise, SlamProblem

MRCLAM_ROBOTS: Final = range(1, 6)
"""Subjects that are robots: they move, and are no landmarks."""
MRCLAM_NOISE: Final = SlamNoise(np.array([0.02, 0.01, 0.04]), np.array([0.05, 0.02]))
"""A guess of such robots and cameras: from it the noise of a log is estimated."""


def read_mrclam(folder: Path, robot: int) -> LandmarkLog:
    """Return the log of one robot; observed robots and unknown bar codes are left out."""
    codes = _numbers(folder / "Barcodes.dat", 2)
    odometry = _numbers(folder / f"Robot{robot}_Odometry.dat", 3)
    seen = _numbers(folder / f"Robot{robot}_Measurement.dat", 4)
    truth_path = folder / f"Robot{robot}_Groundtruth.dat"
    truth = _numbers(truth_path, 4) if truth_path.exists() else np.empty((0, 4))
    subject_of = {int(code): int(subject) for subject, code in codes}
    subject = np.array([subject_of.get(int(code), -1) for code in seen[:, 1]])
    is_robot = np.isin(subject, list(MRCLAM_ROBOTS))
    kept = (subject >= 0) & ~is_robot & (seen[:, 2] > 0.0)
    odometry = odometry[np.append(True, np.diff(odometry[:, 0]) > 0.0)]
    begin = odometry[0, 0]
    kept &= ~_repeated(seen[:, 0], subject)
    notes = (
        f"left out: {int(is_robot.sum())} observations of robots, "
        f"{int((subject < 0).sum())} of unknown bar codes, "
        f"{int((~kept & ~is_robot & (subject >= 0)).sum())} repeated",
    )
    return LandmarkLog(
        odometry[:, 0] - begin,
        np.column_stack([odometry[:, 1], np.zeros(len(odometry))]),
        odometry[:, 2],
        seen[kept, 0] - begin,
        seen[kept, 2:],
        subject[kept],
        MRCLAM_NOISE,
        truth[:, 0] - begin,
        truth[:, 1:],
        range_sigma_grows=True,
        notes=notes,
    )


def _repeated(time_s: Array, name: NDArray[np.intp]) -> NDArray[np.bool_]:
    repeated = np.ones(len(time_s), dtype=bool)
    pairs = np.column_stack([time_s, name])
    repeated[np.unique(pairs, axis=0, return_index=True)[1]] = False
    return repeated


def _numbers(path: Path, columns: int) -> Array:
    try:
        values = np.loadtxt(path, comments="#", ndmin=2)
    except OSError as error:
        raise DataError(f"{path}: expected a file of the data set, got none ({error})") from error
    except ValueError as error:
        raise DataError(f"{path}: expected rows of {columns} numbers; {error}") from error
    if values.shape[1] != columns:
        raise DataError(f"{path}: expected {columns} columns, got {values.shape[1]}")
    return values


def read_graph(path: Path) -> tuple[SlamProblem, SlamNoise]:
    """Return a landmark graph in GTSAM's text: rows ``ODOMETRY`` and ``LANDMARK``.

    Sigmas are those of its first odometry row and, of landmarks, of the nearest there is in range
    and bearing: the text states x and y. Odometry that is not from one pose to the next is refused.
    """
    steps: list[list[float]] = []
    seen: list[list[float]] = []
    pose_of: dict[int, int] = {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected a text graph, got bytes that are none") from error
    for number, text in enumerate(lines, 1):
        words = text.split()
        if not words:
            continue
        try:
            cells = [float(word) for word in words[1:]]
            if words[0] == "ODOMETRY":
                if pose_of and pose_of.get(int(cells[0])) != len(steps):
                    raise DataError(
                        f"{path}:{number}: expected odometry from the last pose, got one from "
                        f"{cells[0]:g}; graphs of poses that meet again are not read"
                    )
                pose_of = pose_of or {int(cells[0]): 0}
                pose_of[int(cells[1])] = len(steps) + 1
                steps.append([*cells[2:5], cells[5], cells[8], cells[10]])
            elif words[0] == "LANDMARK":
                seen.append(cells[:5])
        except (ValueError, IndexError) as error:
            raise DataError(
                f"{path}:{number}: expected ODOMETRY or LANDMARK, got {text!r}"
            ) from error
    if not steps or not seen:
        raise DataError(f"{path}: expected rows ODOMETRY and LANDMARK, got none of one of them")
    moves, marks = np.array(steps), np.array(seen)
    strange = [int(key) for key in marks[:, 0] if int(key) not in pose_of]
    if strange:
        raise DataError(f"{path}: landmark seen from pose {strange[0]}, which no odometry reaches")
    keyframe = np.array([pose_of[int(key)] for key in marks[:, 0]])
    name = marks[:, 1].astype(np.intp)
    fresh = ~_repeated(marks[:, 0], name)
    order = np.flatnonzero(fresh)[np.argsort(keyframe[fresh], kind="stable")]
    names, landmark = np.unique(name[order], return_inverse=True)
    xy = marks[order, 2:4]
    ranges = np.hypot(xy[:, 0], xy[:, 1])
    measured = np.column_stack([ranges, np.arctan2(xy[:, 1], xy[:, 0])])
    sigma = float(np.sqrt(marks[0, 4]))
    noise = SlamNoise(np.sqrt(moves[0, 3:]), np.array([sigma, sigma / float(np.median(ranges))]))
    control = np.hstack([moves[:, :3], np.ones((len(moves), 3))])
    problem = SlamProblem(
        np.arange(len(moves) + 1, dtype=np.float64),
        Odometry(),
        control,
        keyframe[order],
        landmark,
        measured,
        tuple(str(n) for n in names),
        np.zeros(3),
        np.full(3, 1e-3),
    )
    return problem, noise
