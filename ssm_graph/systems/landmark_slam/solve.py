"""From an input to an answer: reading, association, filter or smoother, noise, figures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from factors.similarity import Kernel, LogKernel
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.report.style import new_figure, save
from ssm_graph.systems.landmark_slam.association import (
    Association,
    AssociationErrors,
    AssociationSettings,
    associate,
    association_errors,
)
from ssm_graph.systems.landmark_slam.figures import draw_map
from ssm_graph.systems.landmark_slam.filtered import filtered, first_values
from ssm_graph.systems.landmark_slam.folder import (
    TOML_NAME,
    read_landmark_folder,
    write_answer,
)
from ssm_graph.systems.landmark_slam.graph_files import SUFFIXES, read_pose_graph
from ssm_graph.systems.landmark_slam.graphs import (
    SlamGraph,
    graph_of_problem,
    problem_of_graph,
)
from ssm_graph.systems.landmark_slam.incremental import (
    LAG_S,
    IncrementalSettings,
    smooth_incrementally,
)
from ssm_graph.systems.landmark_slam.logs import (
    LogScore,
    problem_of_log,
    score_of,
    truth_at,
)
from ssm_graph.systems.landmark_slam.methods import INCREMENTAL
from ssm_graph.systems.landmark_slam.noise import SigmaFound, estimate_noise
from ssm_graph.systems.landmark_slam.observation_noise import learn_observations
from ssm_graph.systems.landmark_slam.opinions import best_opinion
from ssm_graph.systems.landmark_slam.problem import (
    UNKNOWN,
    SlamEstimate,
    SlamNoise,
    SlamProblem,
    SlamStatus,
)
from ssm_graph.systems.landmark_slam.recorded import (
    VICTORIA_ODOMETRY,
    read_graph,
    read_mrclam,
    read_victoria_park,
)
from ssm_graph.systems.landmark_slam.smoother import SmootherSettings, Values, smooth_landmarks

NO_TRUTH: Final = np.zeros((0, 3))
PAIRED_ONCE: Final = (
    "landmarks without names: paired as they came, and not looked at again; the smoother does"
)
FAR_SIGMAS: Final = 3.0
"""By which a path is another one: what a normal error exceeds once in 400 times."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What is done with a log."""

    method: str = "smoother"
    """Or `methods.INCREMENTAL`, or a filter of `methods.FILTERS`."""
    learns_observations: bool | None = None
    """The noise of the observations is estimated, from the stated one on; None: where the log
    states none (MRCLAM), by the smoother."""
    learns_control: bool = False
    """The sigmas of the odometry too, all errors taken for white."""
    association: Association = Association.KNOWN
    kernel: Kernel = LogKernel(5.0)
    robot: int | None = None
    """Of a MRCLAM folder or a PyFG file."""
    lag_s: float = LAG_S
    """Of the method fixed-lag."""


class Solved(NamedTuple):
    """An answer with all that is told of it."""

    asked: Asked
    problem: SlamProblem
    answer: SlamEstimate
    truth: Array
    """(K, 3), NaN where there is none; no rows without any"""
    score: LogScore | None
    sigmas: tuple[SigmaFound, ...]
    errors: AssociationErrors | None
    notes: tuple[str, ...]

    @property
    def is_good(self) -> bool:
        """Whether it may be trusted as far as its own account goes."""
        return self.answer.status in (SlamStatus.CONVERGED, SlamStatus.DONE)

    def lines(self) -> Iterator[str]:
        """Yield what is said of it."""
        answer, problem = self.answer, self.problem
        yield (
            f"{len(problem.time_s)} poses, {len(problem.names)} landmarks, "
            f"{len(problem.keyframe)} observations, {int(np.sum(answer.weights < 0.5))} of them "
            f"with less than half their weight; {answer.status.value}"
        )
        for found in self.sigmas:
            low, high = found.found.low, found.found.high
            yield (
                f"noise of {found.label}: {found.found.value:.3g} ({low:.3g} to {high:.3g}), "
                f"stated {found.stated:.3g}"
            )
        if self.errors is not None:
            e = self.errors
            yield (
                f"association: {e.n_wrong} of {e.n} wrong, {e.n_left_out} left out, "
                f"{e.n_split} landmarks there twice"
            )
        if self.score is not None:
            s = self.score
            heading = "" if s.heading_deg is None else f" and heading {s.heading_deg:.2f} deg"
            yield (
                f"against the truth: position rms {s.position_m:.3f} m{heading} in the frame of "
                f"the start, {s.aligned_m:.3f} m aligned"
            )

    def summary(self) -> dict[str, Any]:
        """Return it as it stands in ``summary.json``."""
        answer, score = self.answer, self.score
        return {
            "method": self.asked.method,
            "association": self.asked.association.name.lower(),
            "kernel": str(self.asked.kernel),
            "status": answer.status.name,
            "reason": answer.status.value,
            "iterations": answer.n_iterations,
            "poses": len(self.problem.time_s),
            "landmarks": len(self.problem.names),
            "observations": len(self.problem.keyframe),
            "noise_of": list((*self.problem.motion.labels, "range", "bearing, rad")),
            "noise_used": [*answer.noise.control.tolist(), *answer.noise.observation.tolist()],
            "odometry_wrong_by": answer.drift.tolist(),
            "score": None if score is None else score._asdict(),
            "association_errors": None if self.errors is None else self.errors._asdict(),
            "notes": list(self.notes),
        }


def solve_input(path: Path, asked: Asked) -> Solved:
    """Read an input and solve it."""
    if asked.robot is not None and path.is_file() and path.suffix != ".pyfg":
        raise ConfigError(f"--robot: expected with a MRCLAM folder or a PyFG file, got {path.name}")
    if path.suffix in SUFFIXES and path.is_file():
        return solve_graph(*read_pose_graph(path, robot=asked.robot), asked)
    if path.is_file():
        problem, noise = read_graph(path)
        return solve(problem, noise, asked)
    if (path / TOML_NAME).exists():
        log = read_landmark_folder(path)
    elif (path / "Barcodes.dat").exists():
        if asked.robot is None:
            raise ConfigError(f"--robot: {path} has several robots; expected a number, try 1")
        log = read_mrclam(path, asked.robot)
    elif (path / VICTORIA_ODOMETRY).exists():
        log = read_victoria_park(path)
    else:
        raise ConfigError(
            f"{path}: expected a folder with {TOML_NAME}, MRCLAM's Barcodes.dat or Victoria Park's "
            f"{VICTORIA_ODOMETRY}, or a graph file"
        )
    if asked.learns_observations is None:
        learns = log.noise_is_a_guess and asked.method == "smoother"
        asked = replace(asked, learns_observations=learns)
    problem = problem_of_log(log)
    truth, known = truth_at(log, problem.time_s)
    truth = np.where(known[:, None], truth, np.nan) if len(log.truth_s) > 1 else np.zeros((0, 3))
    return solve(problem, log.noise, asked, truth=truth, notes=log.notes)


def solve_graph(graph: SlamGraph, notes: tuple[str, ...], asked: Asked) -> Solved:
    """Return the answer to a graph of a file; with closures by GTSAM, else as a log."""
    problem, noise = problem_of_graph(graph)
    if not (graph.is_closure.any() or len(graph.seen)):
        raise DataError(
            "; ".join(
                (
                    *notes,
                    "expected landmarks that are seen, or places that are met again, got odometry "
                    "alone; has a landmark the number of a pose",
                )
            )
        )
    if not graph.is_closure.any():
        return solve(problem, noise, asked, truth=graph.truth, notes=notes)
    if asked.method not in ("smoother", *INCREMENTAL):
        raise ConfigError(
            f"--method {asked.method}: expected isam2 or fixed-lag for a graph whose places are "
            "met again; filters take a log"
        )
    if asked.learns_observations or asked.association is not Association.KNOWN:
        raise ConfigError(
            "--noise, --association: expected stated and known for a graph whose places are met "
            "again; leave them out"
        )
    lag_s = asked.lag_s if asked.method == "fixed-lag" else None
    found = smooth_incrementally(graph, IncrementalSettings(asked.kernel, lag_s=lag_s))
    w = found.closure_weights
    told = f"{len(w)} closures, {int(np.sum(w < 0.5))} of them with less than half their weight"
    notes = (*notes, told, *found.estimate.notes)
    return _solved(asked, problem, found.estimate, graph.truth, notes=notes)


def solve(
    problem: SlamProblem,
    noise: SlamNoise,
    asked: Asked,
    *,
    truth: Array = NO_TRUTH,
    notes: tuple[str, ...] = (),
) -> Solved:
    """Return the answer to a log with a truth (K, 3), NaN where there is none, or none at all."""
    named, errors, elsewhere_m = problem, None, None
    if asked.association is Association.KNOWN:
        unnamed = int(np.sum(problem.landmark == UNKNOWN))
        if unnamed == len(problem.landmark):
            raise DataError(
                "observations: none has a landmark; add the column, or ask for --association joint"
            )
        named = problem.associated(problem.landmark, problem.names)
        first = None
    else:
        pairing = AssociationSettings(asked.association)
        if asked.method == "smoother":
            best = best_opinion(problem, noise, pairing, SmootherSettings(asked.kernel))
            named, first, landmark = best[:3]
            elsewhere_m = best.elsewhere_m
        else:
            found = associate(problem, noise, pairing)
            named, first = found.problem, Values(found.pose, found.places)
            landmark = found.landmark
            notes = (*notes, PAIRED_ONCE)
        if np.all(problem.landmark != UNKNOWN):
            errors = association_errors(landmark, problem.landmark)
    sigmas: tuple[SigmaFound, ...] = ()
    if asked.method in INCREMENTAL:
        lag_s = asked.lag_s if asked.method == "fixed-lag" else None
        how = IncrementalSettings(asked.kernel, lag_s=lag_s)
        answer = smooth_incrementally(graph_of_problem(named, noise), how).estimate
    elif asked.method != "smoother":
        answer = filtered(named, noise, asked.method)
    else:
        values = first or first_values(named, noise)
        settings = SmootherSettings(asked.kernel)
        if asked.learns_control:
            learnt = estimate_noise(named, noise, values, settings)
            answer, sigmas = learnt.estimate, learnt.sigmas
        elif asked.learns_observations:
            own = learn_observations(named, noise, values, settings)
            named, answer, sigmas, notes = own.problem, own.estimate, own.sigmas, notes + own.notes
        else:
            answer = smooth_landmarks(named, noise, values, settings)
    if elsewhere_m is not None:
        answer = _with_doubt(answer, elsewhere_m)
    notes = (*notes, *answer.notes)
    return _solved(asked, named, answer, truth, sigmas=sigmas, errors=errors, notes=notes)


def _with_doubt(answer: SlamEstimate, elsewhere_m: Array) -> SlamEstimate:
    """Return an answer that says where other pairings (K,) put its path, if not where it does."""
    sigma = np.sqrt(np.linalg.eigvalsh(answer.pose_cov[:, :2, :2])[:, -1])
    is_off = elsewhere_m > FAR_SIGMAS * sigma
    if not is_off.any():
        return answer
    note = (
        "landmarks without names: with more or less trust in what was seen, or a shorter memory, "
        f"they pair otherwise, and {int(is_off.sum())} of {len(is_off)} poses are up to "
        f"{elsewhere_m.max():.2f} m elsewhere; sigmas hold for this pairing alone"
    )
    settled = answer.status is SlamStatus.CONVERGED
    status = SlamStatus.AMBIGUOUS if settled else answer.status
    return replace(answer, status=status, notes=(*answer.notes, note))


def _solved(
    asked: Asked,
    problem: SlamProblem,
    answer: SlamEstimate,
    truth: Array,
    *,
    sigmas: tuple[SigmaFound, ...] = (),
    errors: AssociationErrors | None = None,
    notes: tuple[str, ...] = (),
) -> Solved:
    known = np.asarray(np.isfinite(truth[:, :2]).all(axis=1))
    score = score_of(truth, known, answer) if known.any() else None
    return Solved(asked, problem, answer, truth, score, sigmas, errors, notes)


def write_solved(folder: Path, solved: Solved) -> None:
    """Write tables, summary and figure."""
    problem, answer = solved.problem, solved.answer
    write_answer(folder, problem, answer, solved.summary())
    figure = new_figure(7.2, 5.4, f"{solved.asked.method}: path and map")
    draw_map(
        figure.subplots(),
        path=answer.pose,
        landmarks=answer.landmarks,
        landmark_cov=answer.landmark_cov,
        true_path=solved.truth if len(solved.truth) else None,
        labels=problem.names if len(problem.names) <= 40 else (),
    )
    save(figure, folder / "figure.png")
