"""One run of a study as a row of numbers: errors against the truth, weights against the faults."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.errors import Metrics, evaluate
from ssm_graph.mission.estimate import (
    OUTLIER_WEIGHT,
    Estimate,
    Status,
    path_length_m,
    since_first_ping,
)
from ssm_graph.simulation import SimulatedMission
from ssm_graph.study.methods import Failure, Outcome, shown
from ssm_graph.study.trials import Trial

LARGE_OFFSET: Final = 0.5
"""m/s, 100 sigma: outliers from here on must be rejected."""
SERIES_STEP_S: Final = 10.0
"""Time between the samples that are kept for figures, s."""

LABEL_COLUMNS: Final = (
    *("study", "case", "grade", "kind", "rate", "size_low_m_per_s", "size_high_m_per_s"),
    *("duration_s", "seed", "method"),
)
NUMBER_COLUMNS: Final = (
    *("horizontal_rms_m", "vertical_rms_m", "velocity_rms_m_per_s", "heading_rms_deg"),
    *("end_error_m", "path_length_m", "end_error_percent", "n_epochs", "nees_position"),
    *("nees_position_final", "inside_3sigma_east", "inside_3sigma_north", "inside_3sigma_up"),
    *("n_outliers", "outliers_rejected", "good_weight", "good_rejected", "iterations", "wall_s"),
)
COLUMNS: Final = (*LABEL_COLUMNS, "status", "failed", "error", *NUMBER_COLUMNS)
"""Columns of the table, in their order."""
TEXT_COLUMNS: Final = frozenset({"study", "case", "grade", "kind", "method", "status", "error"})
COUNT_COLUMNS: Final = frozenset({"seed", "failed"})
TIMING_COLUMNS: Final = frozenset({"wall_s"})
"""Columns that differ from one repetition to the next; all others are the same to the bit."""

FAILED: Final = "FAILED"
"""Status of a run without an estimate."""
LOST: Final = "LOST"
"""Status of a run whose process died; it is tried again when the study is resumed."""

Row = Mapping[str, str | float | int]


def failed_row(labels: Row, message: str, *, status: str = FAILED) -> dict[str, str | float | int]:
    """Return the row of a run without an estimate: no numbers but the reason."""
    numbers = dict.fromkeys(NUMBER_COLUMNS, math.nan)
    return {**labels, "status": status, "failed": 1, "error": message, **numbers}


def score(labels: Row, trial: Trial, outcome: Outcome) -> tuple[Row, Array]:
    """Return the row of one run and its series (T, 3): see :func:`series_of`.

    An estimate that cannot be judged, for whatever reason, is a failure of its method.
    """
    if isinstance(outcome, Estimate):
        if outcome.status is Status.INTERRUPTED:  # never a result: the study was interrupted
            raise KeyboardInterrupt
        try:
            return _score(labels, trial, outcome)
        except Exception as error:
            outcome = Failure(shown(error))
    return failed_row(labels, outcome.message), _no_series(trial)


def _score(labels: Row, trial: Trial, outcome: Estimate) -> tuple[Row, Array]:
    metrics = _metrics(trial, outcome)
    numbers = dict.fromkeys(NUMBER_COLUMNS, math.nan)
    numbers["path_length_m"] = path_length_m(outcome.trajectory)
    numbers |= {} if metrics is None else _errors(metrics)
    numbers |= _weights(trial, outcome)
    numbers |= {"iterations": outcome.n_iterations, "wall_s": outcome.wall_s}
    is_known = math.isfinite(numbers["horizontal_rms_m"]) or trial.simulated is None
    row = {
        **labels,
        "status": outcome.status.name,
        "failed": int(outcome.status is Status.DIVERGED or not is_known),
        "error": "" if outcome.status.is_good else outcome.reason,
        **numbers,
    }
    return row, _no_series(trial) if metrics is None else series_of(trial, metrics)


def _metrics(trial: Trial, estimate: Estimate) -> Metrics | None:
    """Return the errors from the first ping on.

    None without a common time with a reference: nothing may be finite.
    """
    trajectory = since_first_ping(estimate.trajectory)
    told, truth = trial.simulated, trial.mission.reference
    reference = truth if told is None else told.truth_at(trajectory.time_s)
    if reference is None:
        return None
    try:
        return evaluate(trajectory, reference)
    except DataError:
        return None


def _errors(metrics: Metrics) -> dict[str, float]:
    east, north, up = metrics.inside_3_sigma
    return {
        "horizontal_rms_m": metrics.rmse_horizontal_m,
        "vertical_rms_m": metrics.rmse_vertical_m,
        "velocity_rms_m_per_s": metrics.rmse_velocity_m_per_s,
        "heading_rms_deg": math.degrees(metrics.rmse_attitude[2]),
        "end_error_m": metrics.end_error_m,
        "path_length_m": metrics.path_length_m,
        "end_error_percent": metrics.drift_percent,
        "n_epochs": metrics.n_epochs,
        "nees_position": metrics.nees_position,
        "nees_position_final": float(metrics.errors.nees_position[-1]) / 3.0,
        "inside_3sigma_east": east,
        "inside_3sigma_north": north,
        "inside_3sigma_up": up,
    }


def _weights(trial: Trial, estimate: Estimate) -> dict[str, float]:
    if trial.simulated is None or len(estimate.beams.weight) == 0:
        return {}
    offset, is_outlier = beam_truth(trial.simulated, estimate)
    weight = estimate.beams.weight
    is_large, good = is_outlier & (np.abs(offset) >= LARGE_OFFSET), ~is_outlier
    rejected = weight < OUTLIER_WEIGHT
    return {
        "n_outliers": int(is_large.sum()),
        "outliers_rejected": _mean(rejected[is_large]),
        "good_weight": _mean(weight[good]),
        "good_rejected": _mean(rejected[good]),
    }


def _mean(values: NDArray[np.float64] | NDArray[np.bool_]) -> float:
    return float(values.mean()) if len(values) else math.nan


def beam_truth(sim: SimulatedMission, estimate: Estimate) -> tuple[Array, NDArray[np.bool_]]:
    """Return offset (m/s) and outlier flag (M,) of every row of the estimate's beam table."""
    middle = 0.5 * (sim.ping_time_s[:-1] + sim.ping_time_s[1:])
    ping = np.searchsorted(middle, estimate.beams.time_s)
    beam = estimate.beams.beam.astype(np.intp) - 1
    return sim.beam_offset[ping, beam], sim.is_outlier[ping, beam]


def series_times(duration_s: float) -> Array:
    """Return the times (T,) of a series, seconds since the begin of the mission."""
    return np.arange(0.0, duration_s + 1e-6, SERIES_STEP_S)


def series_of(trial: Trial, metrics: Metrics) -> Array:
    """Return horizontal error (m), velocity error (m/s) and position NEES/3 (T, 3).

    Each is that of the epoch nearest in time; NaN where there is none within half a step.
    """
    errors = metrics.errors
    time_s = series_times(trial.duration_s)
    wanted = time_s + trial.mission.imu.start_s
    middle = 0.5 * (errors.time_s[:-1] + errors.time_s[1:])
    nearest = np.searchsorted(middle, wanted)
    is_near = np.abs(errors.time_s[nearest] - wanted) <= 0.5 * SERIES_STEP_S
    velocity = np.linalg.norm(errors.velocity_enu, axis=1)
    columns = np.column_stack([errors.horizontal, velocity, errors.nees_position / 3.0])
    return np.asarray(np.where(is_near[:, None], columns[nearest], np.nan))


def _no_series(trial: Trial) -> Array:
    return np.full((len(series_times(trial.duration_s)), 3), np.nan)
