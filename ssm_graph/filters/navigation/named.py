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
from ssm_graph.filters.rules.kalman import GatedUpdate, KalmanUpdate
from ssm_graph.filters.rules.ssm import SsmUpdate
from ssm_graph.filters.rules.student import StudentUpdate
from ssm_graph.filters.rules.update import UpdateRule
from ssm_graph.mission.answer import RecursiveBeams, recursive_estimate
from ssm_graph.mission.estimate import Estimate, OnKeyframe
from ssm_graph.mission.problem import Problem, without_water_track
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


def _similar(
    about: str, kernel: str, grouping: Grouping, *, state: bool = False, plain: bool = False
) -> FilterChoice:
    """Return a filter by similarity weights, with the parameter of its kernel.

    With ``state`` the prediction gets a weight too; ``plain`` judges by the residual alone.
    """

    def make(value: float | None) -> UpdateRule:
        own = KERNELS[kernel].kernel(value)
        return SsmUpdate(
            own,
            state_kernel=own if state else None,
            similarity=Similarity.PLAIN if plain else Similarity.EXPECTED,
            linearised=Linearised.ONCE,
        )

    return FilterChoice(f"{about}, {kernel} kernel", make, grouping, KERNELS[kernel].default)


def _gated(about: str, grouping: Grouping) -> FilterChoice:
    usual = GatedUpdate().confidence

    def make(value: float | None) -> UpdateRule:
        return GatedUpdate(usual if value is None else value)

    return FilterChoice(f"Kalman filter, chi-square gate on {about}", make, grouping, usual)


_BEAM, _PING = Grouping.PER_BEAM, Grouping.PER_PING
_SSMKF = "SSMKF: one similarity weight for the ping, one for the prediction"
_TRUSTED = "similarity weights, {}, the prediction trusted"
FILTERS: Final[Mapping[str, FilterChoice]] = {
    "ekf": FilterChoice("Kalman filter", lambda _: KalmanUpdate(), _PING),
    "ekf-gate-ping": _gated("the whole ping", _PING),
    "ekf-gate-beam": _gated("every beam", _BEAM),
    "rstkf": FilterChoice(
        "Student's t filter, inverse-Wishart prediction covariance",
        lambda _: StudentUpdate(),
        _PING,
    ),
    "mckf": FilterChoice(
        "maximum correntropy filter",
        lambda value: CorrentropyUpdate() if value is None else CorrentropyUpdate(value),
        _BEAM,
        CorrentropyUpdate().width,
    ),
    **{f"ssmkf-{k}": _similar(_SSMKF, k, _PING, state=True) for k in ("log", "sqrt", "exp")},
    **{
        f"ssm-{k}": _similar(_TRUSTED.format(_BEAM.value), k, _BEAM) for k in ("log", "sqrt", "exp")
    },
    "ssm-ping-log": _similar(_TRUSTED.format(_PING.value), "log", _PING),
    "ssm-plain-log": _similar(
        "as ssm-log, a beam judged by its residual alone", "log", _BEAM, plain=True
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

    Raises :class:`ConfigError` where the filter has no parameter, or not this one, or the problems
    differ in shape.

    Parameters
    ----------
    problems : with equal numbers of keyframes, one navigation frame, and the same kinds of aids.
    name : of :data:`FILTERS`.
    value : its parameter.
    smoothed : whether a Rauch-Tung-Striebel pass goes back over the result.
    on_keyframe : called after each keyframe.
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

    All is as :func:`ssm_graph.filters.geodetic.filter.run_geodetic` takes it.
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
