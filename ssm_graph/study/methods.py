"""The methods that can be compared, by name; a new one is a line in :data:`FAMILIES`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from factors.kernels import KERNELS, KernelChoice
from factors.m_estimators import TruncatedKernel
from factors.similarity import GaussianKernel, Similarity
from ssm_graph.base.errors import ConfigError, SsmGraphError, nearest_hint
from ssm_graph.engine.reweighting import Graduation
from ssm_graph.filters.geodetic.filter import GeodeticConfig
from ssm_graph.filters.navigation.named import (
    FILTERS,
    FilterChoice,
    filter_geodetic,
    filter_problems,
)
from ssm_graph.mission.estimate import Estimate, OnKeyframe
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.beam_faults import FaultSearch
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from ssm_graph.study.trials import Trial

ORACLE: Final = "oracle"


class Solver(Protocol):
    """Estimates every trial; a batched one all of them at once, any other one at a time.

    One that goes keyframe by keyframe calls ``on_keyframe`` after each.
    """

    def __call__(  # noqa: D102
        self, trials: Sequence[Trial], *, on_keyframe: OnKeyframe | None = None
    ) -> Sequence[Estimate]: ...


@dataclass(frozen=True, slots=True)
class Failure:
    """What came instead of an estimate."""

    message: str


Outcome = Estimate | Failure


@dataclass(frozen=True, slots=True)
class Family:
    """A method, but for its parameter."""

    description: str
    make: Callable[[float | None], Solver]
    """Takes the parameter, None where none is given; a ValueError says what is wrong with it."""
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
            estimates = list(self.solver([*trials, *trials] if is_alone else trials))
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


def _smoother(config: SmootherConfig, *, is_oracle: bool = False) -> Solver:
    def solve(trials: Sequence[Trial], *, on_keyframe: OnKeyframe | None = None) -> list[Estimate]:
        del on_keyframe  # there is none to tell of: all keyframes are solved for at once
        smoother = SsmSmoother(config)
        return [
            smoother.solve(trial.oracle_problem)
            if is_oracle
            else smoother.solve(trial.problem, first=trial.warm_start)
            for trial in trials
        ]

    return solve


def _kernel_family(name: str, choice: KernelChoice, similarity: Similarity | None) -> Family:
    judged = "" if similarity is None else ", a beam judged by its residual alone"
    return Family(
        f"batch smoother, {name} kernel{judged}",
        lambda value: _smoother(SmootherConfig(choice.kernel(value), similarity)),
        choice.default,
    )


def _filter_family(name: str, choice: FilterChoice, **how: bool) -> Family:
    is_oracle, smoothed = how.get("is_oracle", False), how.get("smoothed", False)

    def make(value: float | None) -> Solver:
        choice.make(choice.default if value is None else value)  # refuses a wrong parameter now

        def solve(
            trials: Sequence[Trial], *, on_keyframe: OnKeyframe | None = None
        ) -> list[Estimate]:
            problems = [t.oracle_problem if is_oracle else t.problem for t in trials]
            return filter_problems(
                problems, name, value=value, smoothed=smoothed, on_keyframe=on_keyframe
            )

        return solve

    told = ", without the bad beams" if is_oracle else ""
    back = ", and a Rauch-Tung-Striebel pass backwards" if smoothed else ""
    description = choice.description + told + back
    return Family(description, make, choice.default, True, is_oracle, is_recursive=True)


def _make_geodetic(value: float | None) -> Solver:
    config = GeodeticConfig(KERNELS["log"].kernel(value))

    def solve(trials: Sequence[Trial], *, on_keyframe: OnKeyframe | None = None) -> list[Estimate]:
        problems, imu = [t.problem for t in trials], [t.mission.imu for t in trials]
        return filter_geodetic(problems, imu, config, on_keyframe=on_keyframe)

    return solve


def _fixed_lag_family(states: str, description: str, lag_s: float | None = None) -> Family:
    def make(value: float | None) -> Solver:
        chosen_s = value if lag_s is None else lag_s
        config = FixedLagConfig() if chosen_s is None else FixedLagConfig(chosen_s)

        def solve(
            trials: Sequence[Trial], *, on_keyframe: OnKeyframe | None = None
        ) -> list[Estimate]:
            results = (
                solve_fixed_lag(trial.problem, config, on_keyframe=on_keyframe) for trial in trials
            )
            return [getattr(result, states) for result in results]

        return solve

    default = FixedLagConfig().lag_s if lag_s is None else None
    return Family(description, make, default, is_recursive=True)


def _make_gnc(value: float | None) -> Solver:
    kernel = TruncatedKernel() if value is None else TruncatedKernel(value)
    return _smoother(SmootherConfig(kernel, graduation=Graduation()))


def _make_fault_search(value: float | None) -> Solver:
    search = FaultSearch() if value is None else FaultSearch(significance=value)
    return _smoother(SmootherConfig(fault_search=search))


def _make_oracle(_: float | None) -> Solver:
    return _smoother(SmootherConfig(GaussianKernel()), is_oracle=True)


FAMILIES: Final[Mapping[str, Family]] = {
    ORACLE: Family("least squares without the bad beams", _make_oracle, is_oracle=True),
    **{f"smoother-{name}": _kernel_family(name, choice, None) for name, choice in KERNELS.items()},
    **{
        f"smoother-plain-{name}": _kernel_family(name, KERNELS[name], Similarity.PLAIN)
        for name in ("log", "sqrt", "exp")
    },
    "smoother-log-faults": Family(
        "batch smoother, log kernel, without stretches of a beam off by so many sigmas of its mean",
        _make_fault_search,
        FaultSearch().significance,
    ),
    **{name: _filter_family(name, choice) for name, choice in FILTERS.items()},
    **{
        f"{name}+rts": _filter_family(name, choice, smoothed=True)
        for name, choice in FILTERS.items()
    },
    "ekf-oracle": _filter_family("ekf", FILTERS["ekf"], is_oracle=True),
    "geodetic-log": Family(
        "the filter of the paper in geodetic coordinates, similarity weights for every beam",
        _make_geodetic,
        KERNELS["log"].default,
        is_batched=True,
        is_recursive=True,
    ),
    "single-step": _fixed_lag_family(
        "newest", "fixed-lag smoother without lag: the filter ssm-log by way of the graph", 0.0
    ),
    "fixed-lag": _fixed_lag_family(
        "newest", "fixed-lag smoother with this lag in seconds, its newest states"
    ),
    "fixed-lag-delayed": _fixed_lag_family(
        "delayed", "the same, its states when they leave the window"
    ),
    "smoother-gnc-tls": Family(
        "batch smoother, truncated least squares by graduated non-convexity",
        _make_gnc,
        TruncatedKernel().width,
    ),
}
"""All methods by the name in front of the colon."""


def parse_method(text: str) -> Method:
    """Return the method named, for example, ``oracle``, ``smoother-log`` or ``smoother-log:7``.

    Raises
    ------
    ConfigError
        The name or its number cannot be used.
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
