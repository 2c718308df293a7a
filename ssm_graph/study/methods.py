"""The methods that can be compared, by name; a new one is a line in :data:`FAMILIES`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

from factors.kernels import KERNELS, GeneralKernel, KernelChoice, TruncatedKernel
from factors.similarity import GaussianKernel, Similarity
from ssm_graph.base.errors import ConfigError, SsmGraphError, nearest_hint
from ssm_graph.base.usual import FILTER
from ssm_graph.engine.reweighting import Graduation
from ssm_graph.filters.geodetic.filter import GeodeticConfig
from ssm_graph.filters.navigation.named import FILTERS, filter_geodetic, filter_problems
from ssm_graph.mission.estimate import Estimate, OnKeyframe
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import ProblemConfig, build_problem
from ssm_graph.smoothers.batch import SsmSmoother
from ssm_graph.smoothers.faults.search import FaultSearch
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from ssm_graph.smoothers.mission import OnStage
from ssm_graph.smoothers.settings import SmootherConfig
from ssm_graph.study.trials import Trial, with_initial

ORACLE: Final = "oracle"


Solver = Callable[[Sequence[Trial], OnKeyframe | None], Sequence[Estimate]]
"""Estimates every trial; a batched one all of them at once, any other one at a time.

One that goes keyframe by keyframe calls what it is handed after each.
"""


@dataclass(frozen=True, slots=True)
class Failure:
    """What came instead of an estimate."""

    message: str


Outcome = Estimate | Failure


@dataclass(frozen=True, slots=True)
class Family:
    """A method, but for its parameter."""

    description: str
    make: Callable[[Any], Solver]
    """Takes the parameter, None for a method without one; a ValueError says what is wrong."""
    default: float | None = None
    """The parameter where none is given; None for a method without one."""
    is_batched: bool = False
    """Whether many missions at once are faster than one by one."""
    is_oracle: bool = False
    """Whether it is told which beams are bad."""
    is_recursive: bool = False
    """Whether it goes keyframe by keyframe."""


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """One way to estimate missions."""

    name: str
    """For example ``smoother-log`` or ``smoother-log:7``; a default parameter is left out."""
    solver: Solver
    is_batched: bool = False
    is_oracle: bool = False

    def run(self, trials: Sequence[Trial]) -> list[Outcome]:
        """Return an estimate for every trial; one that fails leaves the others as they are.

        A defect of a method must neither end a study of hours nor be lost, so that any error
        counts as a failure. A batch that fails is halved until it is known who is to blame.
        """
        if not self.is_batched:
            return [outcome for trial in trials for outcome in self._attempt([trial])]
        return self._attempt(trials)

    def _attempt(self, trials: Sequence[Trial]) -> list[Outcome]:
        try:
            # NumPy rounds a stack of one otherwise: a trial must not depend on its company.
            is_alone = self.is_batched and len(trials) == 1
            estimates = list(self.solver([*trials, *trials] if is_alone else trials, None))
            estimates = estimates[: len(trials)] if is_alone else estimates
        except Exception as error:
            if len(trials) > 1:
                half = len(trials) // 2
                return self._attempt(trials[:half]) + self._attempt(trials[half:])
            return [Failure(shown(error))]
        assert len(estimates) == len(trials), f"{self.name}: {len(estimates)} of {len(trials)}"
        return list(estimates)


def shown(error: Exception) -> str:
    """Return the text of an error; one that is none of ours with its kind."""
    return str(error) if isinstance(error, SsmGraphError) else f"{type(error).__name__}: {error}"


def _smooth(
    config: SmootherConfig, is_oracle: bool, trials: Sequence[Trial], _: OnKeyframe | None
) -> list[Estimate]:
    smoother = SsmSmoother(config)
    if is_oracle:
        return [smoother.solve(trial.oracle_problem) for trial in trials]
    return [smoother.solve(trial.problem, first=trial.warm_start) for trial in trials]


def _smoother(config: SmootherConfig, *, is_oracle: bool = False) -> Solver:
    return partial(_smooth, config, is_oracle)


def _kernel_family(name: str, choice: KernelChoice, similarity: Similarity | None) -> Family:
    judged = "" if similarity is None else ", a beam judged by its residual alone"
    return Family(
        f"batch smoother, {name} kernel{judged}",
        lambda value: _smoother(SmootherConfig(choice.kernel(value), similarity)),
        choice.default,
    )


SEARCHED: Final[Mapping[str, SmootherConfig]] = {
    **{name: SmootherConfig(KERNELS[name].kernel()) for name in ("log", "exp", "truncated")},
    "gnc-tls": SmootherConfig(TruncatedKernel(), graduation=Graduation()),
    "adaptive": SmootherConfig(GeneralKernel(), adapt_shape=True),
}
"""Weightings that are compared with the search for lasting faults as well."""


def _family_with_search(name: str, config: SmootherConfig) -> Family:
    def make(value: float | None) -> Solver:
        significance = FaultSearch().significance if value is None else value
        return _smoother(replace(config, fault_search=FaultSearch(significance=significance)))

    return Family(
        f"batch smoother, {name}, freed of what lasts and is off by so many sigmas",
        make,
        FaultSearch().significance,
    )


def _filter_family(name: str, *, is_oracle: bool = False, is_smoothed: bool = False) -> Family:
    choice = FILTERS[name]

    def solve(
        value: float | None, trials: Sequence[Trial], on_keyframe: OnKeyframe | None
    ) -> list[Estimate]:
        problems = [t.oracle_problem if is_oracle else t.problem for t in trials]
        return filter_problems(
            problems, name, value=value, smoothed=is_smoothed, on_keyframe=on_keyframe
        )

    def make(value: float | None) -> Solver:
        choice.make(choice.default if value is None else value)  # refuses a wrong parameter now
        return partial(solve, value)

    told = ", without the bad beams" if is_oracle else ""
    back = ", and a Rauch-Tung-Striebel pass backwards" if is_smoothed else ""
    description = choice.description + told + back
    return Family(description, make, choice.default, True, is_oracle, is_recursive=True)


def _geodetic(
    config: GeodeticConfig, trials: Sequence[Trial], on_keyframe: OnKeyframe | None
) -> list[Estimate]:
    problems, imu = [t.problem for t in trials], [t.mission.imu for t in trials]
    return filter_geodetic(problems, imu, config, on_keyframe=on_keyframe)


def _fixed_lag(
    states: str, lag_s: float | None, trials: Sequence[Trial], on_keyframe: OnKeyframe | None
) -> list[Estimate]:
    config = FixedLagConfig() if lag_s is None else FixedLagConfig(lag_s)
    solved = (solve_fixed_lag(t.problem, config, on_keyframe=on_keyframe) for t in trials)
    return [getattr(result, states) for result in solved]


def _fixed_lag_family(states: str, description: str, lag_s: float | None = None) -> Family:
    def make(value: float | None) -> Solver:
        chosen_s = value if lag_s is None else lag_s
        if chosen_s is not None:
            FixedLagConfig(chosen_s)  # refuses a wrong lag now
        return partial(_fixed_lag, states, chosen_s)

    default = FixedLagConfig().lag_s if lag_s is None else None
    return Family(description, make, default, is_recursive=True)


FAMILIES: Final[Mapping[str, Family]] = {
    ORACLE: Family(
        "least squares without the bad beams",
        lambda _: _smoother(SmootherConfig(GaussianKernel()), is_oracle=True),
        is_oracle=True,
    ),
    **{f"smoother-{name}": _kernel_family(name, choice, None) for name, choice in KERNELS.items()},
    **{
        f"smoother-plain-{name}": _kernel_family(name, KERNELS[name], Similarity.PLAIN)
        for name in ("log", "sqrt", "exp")
    },
    **{
        f"smoother-{name}-faults": _family_with_search(name, config)
        for name, config in SEARCHED.items()
    },
    **{name: _filter_family(name) for name in FILTERS},
    **{f"{name}+rts": _filter_family(name, is_smoothed=True) for name in FILTERS},
    "ekf-oracle": _filter_family("ekf", is_oracle=True),
    "geodetic-log": Family(
        "the filter of the paper in geodetic coordinates, similarity weights for every beam",
        lambda value: partial(_geodetic, GeodeticConfig(KERNELS["log"].kernel(value))),
        KERNELS["log"].default,
        is_batched=True,
        is_recursive=True,
    ),
    "single-step": _fixed_lag_family(
        "newest",
        "fixed-lag smoother without lag: as ssm-log, but linearised at each pass, and calibrating",
        0.0,
    ),
    "fixed-lag": _fixed_lag_family(
        "newest", "fixed-lag smoother with this lag in seconds, its newest states"
    ),
    "fixed-lag-delayed": _fixed_lag_family(
        "delayed", "the same, its states when they leave the window"
    ),
    "smoother-gnc-tls": Family(
        "batch smoother, truncated least squares by graduated non-convexity",
        lambda value: _smoother(SmootherConfig(TruncatedKernel(value), graduation=Graduation())),
        TruncatedKernel().width,
    ),
    "smoother-adaptive": Family(
        "batch smoother, general loss of this width and of the likeliest shape",
        lambda value: _smoother(SmootherConfig(GeneralKernel(width=value), adapt_shape=True)),
        GeneralKernel().width,
    ),
}
"""All methods by the name in front of the colon."""
RECURSIVE: Final = {n: f for n, f in FAMILIES.items() if f.is_recursive and not f.is_oracle}
"""Those that need nothing but the mission and go keyframe by keyframe."""


def parse_method(text: str) -> Method:
    """Return the method named, for example, ``oracle``, ``smoother-log`` or ``smoother-log:7``.

    Raises :class:`ConfigError`: the name or its number cannot be used.
    """
    name, colon, number = text.strip().partition(":")
    family = FAMILIES.get(name)
    if family is None:
        raise ConfigError(f"there is no method {text!r}; {nearest_hint(name, FAMILIES)}")
    if colon and family.default is None:
        raise ConfigError(f"method {text!r}: expected no parameter, got {number!r}; try {name}")
    try:
        value = float(number) if colon else family.default
        solver = family.make(value)
    except ValueError as error:
        raise ConfigError(
            f"method {text!r}: expected a number above zero after the colon, got {number!r} "
            f"({error}); try {name}:{family.default:g}"
        ) from error
    is_default = value is None or value == family.default
    return Method(
        name if is_default else f"{name}:{value:g}", solver, family.is_batched, family.is_oracle
    )


def parse_methods(texts: Sequence[str], *, where: str) -> tuple[str, ...]:
    """Return the names of methods, checked and each once; an error says where they stand."""
    try:
        names = dict.fromkeys(parse_method(text).name for text in texts)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    if not names:
        raise ConfigError(f"{where}: expected at least one method; known: {', '.join(FAMILIES)}")
    return tuple(names)


def parse_filter(text: str) -> Method:
    """Return the method of :data:`RECURSIVE` that is named, as :func:`parse_method` does."""
    name = text.strip().partition(":")[0]
    if name not in RECURSIVE:
        raise ConfigError(f"{text!r} is no filter; {nearest_hint(name, RECURSIVE)}")
    return parse_method(text)


def filter_mission(
    mission: Mission,
    method: str = FILTER,
    *,
    problem_config: ProblemConfig | None = None,
    on_keyframe: OnKeyframe | None = None,
    on_stage: OnStage | None = None,
) -> Estimate:
    """Filter a mission, or smooth it with a fixed lag; without an initial state, align first.

    Raises :class:`SsmGraphError` with a sentence that says what is wrong, if there is no such
    filter, or it cannot be used.

    Parameters
    ----------
    mission : from :func:`ssm_graph.read_mission` or a simulation.
    method : one of ``ssm-graph help methods``, for example ``ssm-log``, ``ekf-gate-beam:0.99`` or
        ``fixed-lag:10``.
    problem_config : rates and intervals of the keyframes.
    on_keyframe : called with number and total after each keyframe.
    on_stage : called with a line of text when a new stage begins.
    """
    say = on_stage or (lambda _: None)
    chosen = parse_filter(method)
    if mission.initial is None:
        say("aligning")
        mission = with_initial(mission)
    say("preintegrating")
    problem = build_problem(mission, problem_config)
    say(f"{chosen.name}: {problem.n_keyframes} keyframes")
    (estimate,) = chosen.solver([Trial(0, mission, problem)], on_keyframe)
    return replace(estimate, notes=mission.notes + estimate.notes)
