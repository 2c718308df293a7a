"""Readers of public logs: UTIAS MRCLAM, Victoria Park, and graphs in the text of GTSAM.

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
from scipy.io import loadmat

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.logs import LandmarkLog
from ssm_graph.systems.landmark_slam.models import Odometry
from ssm_graph.systems.landmark_slam.problem import SlamNoise, SlamProblem

MRCLAM_ROBOTS: Final = range(1, 6)
"""Subjects that are robots: they move, and are no landmarks."""
MRCLAM_NOISE: Final = SlamNoise(np.array([0.02, 0.01, 0.04]), np.array([0.1, 0.02]))
"""A guess of such robots and cameras, 10 cm and a degree: with it the noise of a log is found."""


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
        noise_is_a_guess=True,
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


VICTORIA_GRAPH: Final = "gtsam_victoria_park.txt"
VICTORIA_ODOMETRY: Final = "aa3_dr.mat"
VICTORIA_GPS: Final = "aa3_gpsx.mat"
WHEEL_TO_CENTRE_M: Final = 0.76
"""From the middle of the rear axle to the wheel whose speed is measured (`info.txt` of the set)."""
WHEEL_BASE_M: Final = 2.83
POSE_APART_S: Final = 0.025
"""A step of its odometry: poses of the graph where the vehicle stood follow one another by it."""
DISTANCE_SHARE: Final = 0.01
"""By which the graph's way and that of the odometry may differ."""


def read_victoria_park(folder: Path) -> LandmarkLog:
    """Return the raw log: all speeds and steering angles, the graph's observations, GPS as truth.

    The graph tells no times. Its odometry is that of the log, put together between scans of the
    laser: times follow from the way travelled. GPS knows no heading, so that the frame of the start
    is not that of the truth: only what is aligned can be compared.
    """
    told = _arrays(folder / VICTORIA_ODOMETRY, "time", "speed", "steering")
    time_s, speed, steering = told["time"] / 1e3, told["speed"], told["steering"]
    gps = _arrays(folder / VICTORIA_GPS, "timeGps", "Lo_m", "La_m")
    problem, noise = read_graph(folder / VICTORIA_GRAPH)
    forward = speed / (1.0 - np.tan(steering) * WHEEL_TO_CENTRE_M / WHEEL_BASE_M)
    way = np.append(0.0, np.cumsum(np.abs(forward[:-1]) * np.diff(time_s)))
    own = np.append(0.0, np.cumsum(np.hypot(problem.control[:, 0], problem.control[:, 1])))
    if abs(own[-1] / way[-1] - 1.0) > DISTANCE_SHARE:
        raise DataError(
            f"{folder}: expected a graph of the same drive, got {own[-1]:.0f} m in "
            f"{VICTORIA_GRAPH} and {way[-1]:.0f} m in {VICTORIA_ODOMETRY}; is one of them cut?"
        )
    moved = np.append(True, np.diff(way) > 0.0)
    pose_s = np.interp(own * (way[-1] / own[-1]), way[moved], time_s[moved])
    # No two poses at one time: where it stood, each a step after the one before.
    steps = POSE_APART_S * np.arange(len(pose_s))
    pose_s = np.maximum.accumulate(pose_s - steps) + steps
    typical = float(np.sqrt(np.mean(np.diff(pose_s))))
    gps_s = gps["timeGps"] / 1e3
    fresh = np.append(True, np.diff(gps_s) > 0.0)
    truth = np.column_stack([gps["Lo_m"], gps["La_m"], np.full(len(gps_s), np.nan)])
    return LandmarkLog(
        time_s - time_s[0],
        np.column_stack([forward, np.zeros(len(forward))]),
        forward * np.tan(steering) / WHEEL_BASE_M,
        pose_s[problem.keyframe] - time_s[0],
        problem.measured,
        np.array(problem.names).astype(np.intp)[problem.landmark],
        SlamNoise(noise.control / typical, noise.observation),
        gps_s[fresh] - time_s[0],
        truth[fresh],
        notes=("the truth is GPS, without a heading: of the errors only the aligned one counts",),
    )


def _arrays(path: Path, *names: str) -> dict[str, Array]:
    try:
        told = loadmat(path)
        return {name: np.asarray(told[name], dtype=np.float64).ravel() for name in names}
    except (OSError, ValueError, KeyError) as error:
        raise DataError(
            f"{path}: expected MATLAB's arrays {', '.join(names)}, got {error}; fetch the set anew"
        ) from error
