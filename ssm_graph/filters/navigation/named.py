"""Every filter that can be asked for by name, with its parameter and the default of that.

All take the same process and the same measurements, and linearise once at the prediction.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from factors.kernels import KERNELS
from factors.similarity import Similarity
from ssm_graph.base.errors import ConfigError
from ssm_graph.engine.error_state import Linearised
from ssm_graph.filters.geodetic.filter import GeodeticConfig, run_geodetic, to_navigation
from ssm_graph.filters.navigation.filter import (
    Grouping,
    estimates_from_history,
    run_filter,
    smooth_history,
)
from ssm_graph.filters.rules.correntropy import CorrentropyUpdate
from ssm_graph.filters.rules.kalman import Gate, GatedUpdate, KalmanUpdate
from ssm_graph.filters.rules.ssm import SsmUpdate
from ssm_graph.filters.rules.student import StudentUpdate
from ssm_graph.filters.rules.update import UpdateRule
from ssm_graph.mission.bottom_track import without_water_track
from ssm_graph.mission.estimate import Estimate, OnKeyframe
from ssm_graph.mission.problem import Problem
from ssm_graph.mission.recursive import RecursiveBeams, recursive_estimate
from ssm_graph.sensors.imu import ImuLog


@dataclass(frozen=True, slots=True)
class FilterChoice:
    """A filter with at most one parameter."""

    description: str
    make: Callable[[float | None], UpdateRule]
    """Takes the parameter, None where none is given."""
    grouping: Grouping
    default: float | None = None
    """The parameter where none is given; None for a filter without one."""


def _ssm(name: str, grouping: Grouping = Grouping.PER_BEAM) -> FilterChoice:
    choice = KERNELS[name]
    return FilterChoice(
        f"similarity weights, {grouping.value}, the prediction trusted, {name} kernel",
        lambda value: SsmUpdate(choice.kernel(value), linearised=Linearised.ONCE),
        grouping,
        choice.default,
    )


def _ssmkf(name: str) -> FilterChoice:
    choice = KERNELS[name]

    def make(value: float | None) -> UpdateRule:
        kernel = choice.kernel(value)
        return SsmUpdate(kernel, state_kernel=kernel, linearised=Linearised.ONCE)

    return FilterChoice(
        f"SSMKF: one similarity weight for the ping, one for the prediction, {name} kernel",
        make,
        Grouping.PER_PING,
        choice.default,
    )


def _gated(gate: Gate, value: float | None) -> UpdateRule:
    return GatedUpdate(gate) if value is None else GatedUpdate(gate, value)


def _plain_log(value: float | None) -> UpdateRule:
    kernel = KERNELS["log"].kernel(value)
    return SsmUpdate(kernel, similarity=Similarity.PLAIN, linearised=Linearised.ONCE)


FILTERS: Final[Mapping[str, FilterChoice]] = {
    "ekf": FilterChoice("Kalman filter", lambda _: KalmanUpdate(), Grouping.PER_PING),
    "ekf-gate-ping": FilterChoice(
        "Kalman filter, chi-square gate on the whole ping",
        lambda value: _gated(Gate.PING, value),
        Grouping.PER_PING,
        GatedUpdate(Gate.PING).confidence,
    ),
    "ekf-gate-beam": FilterChoice(
        "Kalman filter, chi-square gate on every beam",
        lambda value: _gated(Gate.BEAM, value),
        Grouping.PER_BEAM,
        GatedUpdate(Gate.BEAM).confidence,
    ),
    "rstkf": FilterChoice(
        "Student's t filter, inverse-Wishart prediction covariance",
        lambda _: StudentUpdate(),
        Grouping.PER_PING,
    ),
    "mckf": FilterChoice(
        "maximum correntropy filter",
        lambda value: CorrentropyUpdate() if value is None else CorrentropyUpdate(value),
        Grouping.PER_BEAM,
        CorrentropyUpdate().width,
    ),
    **{f"ssmkf-{name}": _ssmkf(name) for name in ("log", "sqrt", "exp")},
    **{f"ssm-{name}": _ssm(name) for name in ("log", "sqrt", "exp")},
    "ssm-ping-log": _ssm("log", Grouping.PER_PING),
    "ssm-plain-log": FilterChoice(
        "as ssm-log, a beam judged by its residual alone",
        _plain_log,
        Grouping.PER_BEAM,
        KERNELS["log"].default,
    ),
}
"""Names as on the command line."""


def filter_problems(
    problems: Sequence[Problem],
    name: str,
    *,
    value: float | None = None,
    smoothed: bool = False,
    on_keyframe: OnKeyframe | None = None,
) -> list[Estimate]:
    """Filter problems side by side by the filter of a name.

    Parameters
    ----------
    problems : with equal numbers of keyframes, one navigation frame, and the same kinds of aids.
    name : of :data:`FILTERS`.
    value : its parameter.
    smoothed : whether a Rauch-Tung-Striebel pass goes back over the result.
    on_keyframe : called after each keyframe.

    Raises
    ------
    ConfigError
        If the filter has no parameter, or not this one, or the problems differ in shape.
    """
    begin = time.perf_counter()
    choice = FILTERS[name]
    if value is not None and choice.default is None:
        raise ConfigError(f"filter {name}: expected no parameter, got {value:g}; leave it out")
    problems = [without_water_track(problem) for problem in problems]
    rule = choice.make(choice.default if value is None else value)
    history = run_filter(problems, rule, grouping=choice.grouping, on_keyframe=on_keyframe)
    states = smooth_history(history) if smoothed else history.posterior
    wall_s = (time.perf_counter() - begin) / len(problems)
    return estimates_from_history(
        problems,
        history,
        states,
        method=f"filter {name}{' + rts' if smoothed else ''}",
        kernel=str(rule),
        wall_s=wall_s,
    )


def filter_geodetic(
    problems: Sequence[Problem],
    imu: Sequence[ImuLog],
    config: GeodeticConfig | None = None,
    *,
    on_keyframe: OnKeyframe | None = None,
) -> list[Estimate]:
    """Filter problems side by side by the paper's own filter, in geodetic coordinates.

    Parameters
    ----------
    problems, imu : as :func:`ssm_graph.filters.geodetic.filter.run_geodetic` takes them.
    config : kernel, feedback and stopping rule.
    on_keyframe : called after each keyframe.
    """
    begin = time.perf_counter()
    config = config or GeodeticConfig()
    problems = [without_water_track(problem) for problem in problems]
    history = run_geodetic(problems, imu, config, on_keyframe=on_keyframe)
    wall_s = (time.perf_counter() - begin) / len(problems)
    estimates = []
    for run, problem in enumerate(problems):
        states = to_navigation(problem, history, run)
        at = run, problem.beams.keyframe, problem.beams.beam
        estimates.append(
            recursive_estimate(
                problem,
                states,
                states.covariance,
                RecursiveBeams(
                    history.innovation[at], history.mahalanobis_sq[at], history.weight[at]
                ),
                history.iterations[run],
                max_iterations=config.max_iterations,
                method=f"filter geodetic, {config.feedback.name.lower()} feedback",
                kernel=str(config.kernel),
                wall_s=wall_s,
            )
        )
    return estimates
