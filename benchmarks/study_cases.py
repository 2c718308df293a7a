"""What a Monte-Carlo study compares: cases, that is missions with something wrong, and methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

from factors.similarity import ExpKernel, GaussianKernel, Kernel, LogKernel, SqrtKernel
from ssm_graph.errors import ConfigError, nearest_hint
from ssm_graph.simulation import (
    Fault,
    Grade,
    Loss,
    OutlierKind,
    Outliers,
    SimulationConfig,
    scenario_config,
)
from factors.similarity import Similarity

DEFAULT_DURATION_S: Final = 1200.0


@dataclass(frozen=True, slots=True)
class Case:
    """What is wrong with the DVL of a mission."""

    description: str
    change: Callable[[SimulationConfig], SimulationConfig]
    """Puts it into the settings of a clean mission."""
    longer: float = 1.0
    """How many times longer than the others the missions of this case are."""


def _outliers(kind: OutlierKind, *, rate: float) -> Callable[[SimulationConfig], SimulationConfig]:
    return lambda config: replace(config, outliers=Outliers(kind, rate=rate))


def _fault(
    *offsets: float, length_s: float, start: float = 0.5
) -> Callable[[SimulationConfig], SimulationConfig]:
    """Offset neighbouring beams, the first of them drawn by the seed, from a share of the run."""

    def change(config: SimulationConfig) -> SimulationConfig:
        beams = tuple((config.seed + i) % 4 for i in range(len(offsets)))
        start_s = start * config.duration_s
        return replace(config, faults=(Fault(beams, start_s, start_s + length_s, offsets),))

    return change


def _few_beams(config: SimulationConfig) -> SimulationConfig:
    """Lose one, two and three beams for a thirteenth of the run each, then all for a quarter."""
    unit = config.duration_s / 40.0  # a minute of the usual 40
    windows = (
        (5.0, 8.0, (3,)),
        (10.0, 13.0, (2, 3)),
        (15.0, 18.0, (1, 2, 3)),
        (21.0, 31.0, (0, 1, 2, 3)),
    )
    losses = tuple(Loss(begin * unit, end * unit, beams) for begin, end, beams in windows)
    return replace(config, losses=losses)


CASES: Final[Mapping[str, Case]] = MappingProxyType(
    {
        "clean": Case("nothing is wrong", lambda config: config),
        "sparse10": Case(
            "one random beam of 10 % of the pings off by 0.5 to 3 m/s",
            _outliers(OutlierKind.SPARSE, rate=0.1),
        ),
        "one_beam50": Case(
            "the same beam off by 0.5 to 3 m/s in half of the pings",
            _outliers(OutlierKind.ONE_BEAM, rate=0.5),
        ),
        "two_beams": Case(
            "two random beams of 10 % of the pings off by 0.5 to 3 m/s each",
            _outliers(OutlierKind.TWO_BEAMS, rate=0.1),
        ),
        "burst": Case(
            "one beam off by 0.5 to 3 m/s for 5 to 20 s at a time, 10 % of the run",
            _outliers(OutlierKind.BURST, rate=0.1),
        ),
        "silt": Case(
            "one beam drifts off by 0.15 to 0.3 m/s within a minute, 20 % of the run",
            _outliers(OutlierKind.SILT, rate=0.2),
        ),
        "blocked": Case(
            "one beam reads zero for 5 to 20 s at a time, 10 % of the run",
            _outliers(OutlierKind.BLOCKED, rate=0.1),
        ),
        "fault40": Case("one beam off by 1 m/s for 40 s", _fault(1.0, length_s=40.0)),
        "fault2x15": Case(
            "two adjacent beams off by the same 1 m/s for 15 s: unseen by the array's parity",
            _fault(1.0, 1.0, length_s=15.0),
        ),
        "fault2x15_unequal": Case(
            "two adjacent beams off by 1 and 0.6 m/s for 15 s", _fault(1.0, 0.6, length_s=15.0)
        ),
        "fault2x15_early": Case(
            "as fault2x15, a twentieth into the run: little is known of the biases yet",
            _fault(1.0, 1.0, length_s=15.0, start=0.05),
        ),
        "few_beams": Case(
            "three, two and one valid beams for 3 min each, none for 10 min, in a run of 40 min",
            _few_beams,
            longer=2.0,
        ),
    }
)
"""What can be studied by name."""


def case_config(name: str, grade: Grade, *, seed: int, duration_s: float) -> SimulationConfig:
    """Return the settings of one simulated mission; the seed is the number of the trial."""
    case = CASES.get(name)
    if case is None:
        raise ConfigError(f"there is no case {name!r}; {nearest_hint(name, CASES)}")
    clean = scenario_config("survey", grade=grade, seed=seed, duration_s=case.longer * duration_s)
    return case.change(clean)


@dataclass(frozen=True, slots=True)
class Method:
    """One way to smooth a mission."""

    name: str
    kernel: Kernel
    similarity: Similarity = Similarity.EXPECTED
    is_oracle: bool = False
    """Whether it is told which beams are bad, and leaves them out."""


_KERNELS: Final[Mapping[str, Callable[[float], Kernel]]] = MappingProxyType(
    {"log": LogKernel, "log-plain": LogKernel, "sqrt": SqrtKernel, "exp": ExpKernel}
)
_PARAMETERS: Final[Mapping[str, float]] = MappingProxyType(
    {
        "log": LogKernel().dof,
        "log-plain": LogKernel().dof,
        "sqrt": SqrtKernel().dof,
        "exp": ExpKernel().width,
    }
)
"""Degrees of freedom or width where a method is named without a number: the package's own."""

DEFAULT_METHODS: Final = ("oracle", "gaussian", "log", "sqrt", "exp", "log-plain")


def parse_method(text: str) -> Method:
    """Return the method named, for example, ``oracle``, ``log``, ``exp:3``.

    The number is part of the name of what is returned, also where a default stands in for it.

    Raises
    ------
    ConfigError
        The name or its number cannot be used.
    """
    name, colon, number = text.partition(":")
    if text in ("oracle", "gaussian"):
        return Method(text, GaussianKernel(), is_oracle=text == "oracle")
    if name not in _KERNELS:
        known = ("oracle", "gaussian", *_KERNELS)
        raise ConfigError(f"there is no method {text!r}; {nearest_hint(name, known)}")
    try:
        parameter = float(number) if colon else _PARAMETERS[name]
        kernel = _KERNELS[name](parameter)
    except ValueError as error:
        raise ConfigError(
            f"method {text!r}: expected a number above zero after the colon, got {number!r}; "
            "try log:5"
        ) from error
    similarity = Similarity.PLAIN if name == "log-plain" else Similarity.EXPECTED
    return Method(f"{name}:{parameter:g}", kernel, similarity)
