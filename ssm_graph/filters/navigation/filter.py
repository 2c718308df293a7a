"""The navigation filter: predict with the inertial sensors, correct by one update rule, smooth.

Any rule of the literature goes in; the process and the measurements are the same for all, and the
same as the graph's. With :class:`SsmUpdate` and a group for every beam it is the filter of [1]_.
A pass backwards [2]_ may follow the history of any of them.

Shapes: K keyframes, R runs, B beams.

References
----------
.. [1] Xu et al., "Combined navigation robust filtering method based on statistical similarity
   measurement", 2021, steps 5.1 to 5.5.
.. [2] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic
   systems", AIAA Journal 3, 1965.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.inertial import Intervals, predict
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import VELOCITY
from ssm_graph.engine.states import NavigationStates
from ssm_graph.filters.navigation.measurements import KeyframeModel
from ssm_graph.filters.rules.update import UpdateRule
from ssm_graph.filters.side_by_side import require_alike, side_by_side
from ssm_graph.graph.aids.aid import Aid
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.graph.aids.gnss import EAST_NORTH_UP, Fixes
from ssm_graph.imu.preintegration import gravity_gradient, gtsam_gravity
from ssm_graph.mission.answer import RecursiveBeams, doubt_of_run, recursive_estimate
from ssm_graph.mission.estimate import AidTable, Estimate, OnKeyframe
from ssm_graph.mission.problem import Problem, start_of

RUNAWAY_SIGMA = 1e4
"""m/s; a filter this uncertain of its velocity has run away."""


class Grouping(Enum):
    """How the beams of a ping share auxiliary parameters."""

    PER_BEAM = "one for every beam"
    PER_PING = "one for the whole ping"

    def groups(self, n_beams: int) -> NDArray[np.intp]:
        """Return the group of each beam, (B,)."""
        per_beam = self is Grouping.PER_BEAM
        return np.arange(n_beams) if per_beam else np.zeros(n_beams, dtype=np.intp)


class StateHistory(NamedTuple):
    """States of R runs at K keyframes with covariances in their own error states."""

    R_nb: Array
    """(K, R, 3, 3)"""
    p_n: Array
    """(K, R, 3) m"""
    v_n: Array
    """(K, R, 3) m/s"""
    bias: Array
    """(K, R, 6) accelerometer m/s^2, gyro rad/s"""
    covariance: Array
    """(K, R, 15, 15)"""

    @classmethod
    def of(cls, steps: Sequence[tuple[NavigationStates, Array]]) -> StateHistory:
        """Return the history of states and covariances keyframe by keyframe."""
        return cls(*_stacked([(*states, covariance) for states, covariance in steps]))

    def at(self, k: int) -> NavigationStates:
        """Return the states of keyframe ``k``."""
        return NavigationStates(*(column[k] for column in self[:4]))


class FilterHistory(NamedTuple):
    """All that a filter found out on its way."""

    posterior: StateHistory
    """NaN from where a run has run away"""
    predicted: StateHistory
    transition: Array
    """(K - 1, R, 15, 15) of the error state from keyframe to keyframe."""
    innovation: Array
    """(K, R, B) m/s, measured minus predicted before the update; NaN without a beam."""
    mahalanobis_sq: Array
    """(K, R, B)"""
    weight: Array
    """(K, R, B) 1 = nominal"""
    n_iterations: Array
    """(K, R)"""
    aid_innovation: Array
    """(K, R, 4) m, measured minus predicted before the update: height by the depth, then the fix in
    navigation axes; NaN without one, as in the two that follow"""
    aid_mahalanobis_sq: Array
    """(K, R, 2) of depth and fix"""
    aid_weight: Array
    """(K, R, 2) 1 = nominal"""


def run_filter(
    problems: Sequence[Problem],
    rule: UpdateRule,
    *,
    grouping: Grouping,
    on_keyframe: OnKeyframe | None = None,
) -> FilterHistory:
    """Filter R runs side by side.

    Raises :class:`ConfigError` where the problems differ in shape: filter them one by one.

    Parameters
    ----------
    problems : with equal numbers of keyframes and beams, one navigation frame, and the same kinds
        of aids.
    rule : how a ping corrects the prediction.
    grouping : which beams the rule takes as one measurement.
    on_keyframe : called after each keyframe.
    """
    require_alike(
        problems,
        {
            "depth sensor, or none": lambda p: "none" if p.depths is None else "one",
            "GNSS, or none": lambda p: "none" if p.fixes is None else "one",
        },
    )
    if any(problem.frame != problems[0].frame for problem in problems):
        raise ConfigError(
            f"runs side by side: expected one navigation frame of all {len(problems)}; filter them "
            "one by one"
        )
    # A run that overflows is found by what comes of it, and is no reason to warn.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return _Filter(problems, rule, grouping).run(on_keyframe)


class _Filter:
    def __init__(self, problems: Sequence[Problem], rule: UpdateRule, grouping: Grouping) -> None:
        self._rule, self._frame = rule, problems[0].frame
        self._measured = side_by_side(problems)
        self._groups = grouping.groups(self._measured.beams.speed.shape[2])
        self._process = Process([p.chain.intervals for p in problems], self._frame)
        starts = [start_of(p) for p in problems]
        self._start = NavigationStates(*(np.array([s[i] for s in starts]) for i in range(4)))
        self._start_cov = np.array([s.covariance for s in starts])
        self._lost = np.zeros(len(problems), dtype=bool)

    def run(self, on_keyframe: OnKeyframe | None) -> FilterHistory:
        n_keyframes = len(self._measured.keyframe_s)
        predictions, posteriors, transitions, beams = [], [], [], []
        predicted, covariance = self._start, self._start_cov
        states = None
        for k in range(n_keyframes):
            if states is not None:
                predicted, F, process_cov = self._process.predict(k - 1, states)
                covariance = F @ covariance @ np.swapaxes(F, 1, 2) + process_cov
                transitions.append(F)
            predictions.append((predicted, covariance))
            states, covariance, of_beams = self._correct(k, predicted, covariance, states)
            states, covariance = self._without_lost(states, covariance)
            kept = [_where(self._lost, np.nan, own) for own in (*states, covariance)]
            posteriors.append((NavigationStates(*kept[:4]), kept[4]))
            beams.append(of_beams)
            if on_keyframe is not None:
                on_keyframe(k + 1, n_keyframes)
        return FilterHistory(
            StateHistory.of(posteriors),
            StateHistory.of(predictions),
            np.array(transitions),
            *_stacked(beams),
        )

    def _without_lost(
        self, states: NavigationStates, covariance: Array
    ) -> tuple[NavigationStates, Array]:
        """Put runs that have run away back to their start, where they meet no measurement.

        The others go on beside them.
        """
        variance = np.einsum("bii->bi", covariance)
        self._lost |= ~np.all(variance > 0.0, axis=1)
        self._lost |= ~np.all(variance[:, VELOCITY] < RUNAWAY_SIGMA**2, axis=1)
        self._lost |= ~np.all(np.isfinite(states.p_n + states.v_n), axis=1)
        if not np.any(self._lost):
            return states, covariance
        self._measured.silence(self._lost)
        pairs = zip(self._start, states, strict=True)
        kept = NavigationStates(*(_where(self._lost, start, own) for start, own in pairs))
        return kept, _where(self._lost, self._start_cov, covariance)

    def _correct(
        self, k: int, predicted: NavigationStates, P: Array, before: NavigationStates | None
    ) -> tuple[NavigationStates, Array, tuple[Array, ...]]:
        """Return states, covariances, and what :class:`FilterHistory` keeps of measurements."""
        model = KeyframeModel(
            self._measured, k, predicted, frame=self._frame, beam_groups=self._groups, before=before
        )
        present = model.present[:, : model.n_beams]
        nothing = np.full(present.shape, np.nan)
        if not np.any(model.present):
            none = (np.full((len(P), n), np.nan) for n in (4, 2, 2))
            return predicted, P, (nothing, nothing, nothing, np.zeros(len(P)), *none)
        update = self._rule(P, model)
        own = (update.mahalanobis_sq, update.weights)
        found = (np.where(present, rows[:, : model.n_beams], np.nan) for rows in own)
        of_aids = (model.aid_innovations(), *map(model.of_aids, own))
        kept = (model.beam_innovations(), *found, update.n_iterations, *of_aids)
        return predicted.displaced(update.xi), update.covariance, kept


def _stacked(steps: Sequence[tuple[Array, ...]]) -> list[Array]:
    """Return the columns of K steps, (K, ...) each."""
    return [np.stack(column) for column in zip(*steps, strict=True)]


def _where(runs: NDArray[np.bool_], one: Array | float, other: Array) -> Array:
    """Return ``one`` for some runs (R,) and ``other`` (R, ...) for the rest."""
    return np.where(runs.reshape(-1, *(1,) * (other.ndim - 1)), one, other)


def smooth_history(history: FilterHistory) -> StateHistory:
    """Return the states given all measurements, by one pass backwards in time [2]_.

    Error states of successive keyframes are related by the filter's own transitions; what the
    smoothed states differ from the predicted ones goes back through the gain ``P F' P_pred^-1``.
    """
    posterior, predicted = history.posterior, history.predicted
    last = len(posterior.p_n) - 1
    states, covariance = posterior.at(last), posterior.covariance[last]
    smoothed = [(states, covariance)]
    for k in range(last - 1, -1, -1):
        gain = _gain(posterior.covariance[k], history.transition[k], predicted.covariance[k + 1])
        missed = predicted.at(k + 1).deviation_of(states)
        states = posterior.at(k).displaced((gain @ missed[..., None])[..., 0])
        change = covariance - predicted.covariance[k + 1]
        covariance = posterior.covariance[k] + gain @ change @ np.swapaxes(gain, 1, 2)
        covariance = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
        smoothed.append((states, covariance))
    return StateHistory.of(smoothed[::-1])


def _gain(posterior: Array, transition: Array, predicted: Array) -> Array:
    """Return ``P F' P_pred^-1`` (R, 15, 15), solved in correlation form."""
    scale = np.sqrt(np.diagonal(predicted, axis1=1, axis2=2))
    correlation = predicted / (scale[:, :, None] * scale[:, None, :])
    cross = transition @ posterior / scale[:, :, None]
    return np.swapaxes(np.linalg.solve(correlation, cross) / scale[:, :, None], 1, 2)


def estimates_from_history(
    problems: Sequence[Problem],
    history: FilterHistory,
    states: StateHistory,
    *,
    method: str,
    kernel: str,
    wall_s: float,
) -> list[Estimate]:
    """Return the estimate of every run; ``states`` are the posterior or smoothed ones.

    Smoothed states have innovations of beams of their own; all else of measurements stays the
    filter's.
    """
    estimates, is_smoothed = [], states is not history.posterior
    for run, problem in enumerate(problems):
        at = problem.beams.keyframe, run, problem.beams.beam
        estimate = recursive_estimate(
            problem,
            NavigationStates(*(column[:, run] for column in states[:4])),
            states.covariance[:, run],
            RecursiveBeams(
                None if is_smoothed else history.innovation[at],
                history.mahalanobis_sq[at],
                history.weight[at],
            ),
            history.n_iterations[:, run],
            method=method,
            kernel=kernel,
            wall_s=wall_s,
            doubts=_doubts_of_places(problem, history, run),
        )
        estimates.append(replace(estimate, aids=_aid_table(problem, history, run)))
    return estimates


PLACES: dict[type[Aid], tuple[str, ...]] = {DepthMeans: (DepthMeans.name,), Fixes: EAST_NORTH_UP}
"""What a filter takes beside beams, in the order of its history, and the components of each."""


def _doubts_of_places(problem: Problem, history: FilterHistory, run: int) -> list[str]:
    """Look for depths and fixes that are far from their predictions one after the other.

    The beams tell little of a start whose heading is wrong: the vehicle goes where they say.
    """
    whitened_sq = history.aid_mahalanobis_sq[:, run].T
    at = [np.flatnonzero(np.isfinite(own)) for own in whitened_sq]
    doubts = [
        doubt_of_run(aid, problem.keyframe_s[k], own[k], dim=len(labels))
        for (aid, labels), own, k in zip(PLACES.items(), whitened_sq, at, strict=True)
    ]
    return [f"{doubt}; or the start is wrong, above all its heading" for doubt in doubts if doubt]


def _aid_table(problem: Problem, history: FilterHistory, run: int) -> AidTable | None:
    """Return what became of depths and fixes in one run; None if it has none."""
    innovation = history.aid_innovation[:, run]
    parts = []
    for i, (aid, labels) in enumerate(PLACES.items()):
        weight = history.aid_weight[:, run, i]
        k = np.flatnonzero(np.isfinite(weight))
        size = len(labels)
        parts.append(
            AidTable(
                aid=(aid.name,) * (size * len(k)),
                component=labels * len(k),
                unit=(aid.unit,) * (size * len(k)),
                time_s=np.repeat(problem.keyframe_s[k], size),
                innovation=innovation[k, i : i + size].ravel(),
                mahalanobis_sq=np.repeat(history.aid_mahalanobis_sq[k, run, i], size),
                weight=np.repeat(weight[k], size),
            )
        )
    return AidTable.joined(parts)


class Prediction(NamedTuple):
    """States of B runs at the end of an interval."""

    states: NavigationStates
    transition: Array
    """(B, 15, 15) of the error state."""
    process_cov: Array
    """(B, 15, 15)"""


class Process:
    """Predicts B runs from keyframe to keyframe."""

    def __init__(self, intervals: Sequence[Intervals], frame: LocalFrame) -> None:
        columns = zip(*(own.without_errors(own.errors) for own in intervals), strict=True)
        self._intervals = Intervals(*(np.stack(column, axis=1) for column in columns))
        self._frame = frame
        self._gravity_gradient = gravity_gradient(frame)

    def predict(self, k: int, states: NavigationStates) -> Prediction:
        """Predict from keyframe ``k`` to the next."""
        interval = Intervals(*(column[k] for column in self._intervals))
        middle = states.p_n + 0.5 * interval.span_s[:, None] * states.v_n
        g_n = gtsam_gravity(self._frame, middle)
        moved = predict(interval, states, g_n=g_n, gradient=self._gravity_gradient)
        return Prediction(NavigationStates(*moved.state), moved.transition, moved.noise(interval))
