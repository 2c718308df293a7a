"""Methods by name, and what becomes of those that fail."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import pytest

from ssm_graph.base.errors import ConfigError, SolverError
from ssm_graph.mission.estimate import Estimate
from ssm_graph.study.methods import FAMILIES, Failure, Method, parse_method, parse_methods
from ssm_graph.study.trials import Trial


def test_every_family_has_a_default() -> None:
    """And its own parameter is not part of the name."""
    for name, family in FAMILIES.items():
        method = parse_method(name)
        assert method.name == name
        assert method.is_oracle == family.is_oracle
        if family.default is not None:
            assert parse_method(f"{name}:{family.default!r}").name == name


def test_a_number_belongs_to_the_name() -> None:
    """Runs of different numbers never mix."""
    assert parse_method("smoother-log:8").name == "smoother-log:8"
    assert parse_method("smoother-log:8.0").name == "smoother-log:8"
    assert parse_methods(["oracle", "smoother-log", "smoother-log:5"], where="x") == (
        "oracle",
        "smoother-log",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("smoother-lag", "did you mean 'smoother-log'"),
        ("oracle:3", "expected no parameter, got '3'; try oracle"),
        ("smoother-gaussian:3", "expected no parameter"),
        ("smoother-log:x", "expected a number above zero after the colon, got 'x'"),
        ("smoother-log:-1", "expected a number above zero .* try smoother-log:5"),
    ],
)
def test_bad_names_are_refused(text: str, message: str) -> None:
    """The message says what would do."""
    with pytest.raises(ConfigError, match=message):
        parse_method(text)
    with pytest.raises(ConfigError, match=r"^--methods: "):
        parse_methods([text], where="--methods")


def fake_solver(bad: int, error: Exception, calls: list[int]) -> Any:
    """Return a solver that cannot do trial ``bad``; it returns trials for estimates."""

    def solve(trials: Sequence[Trial], _: object) -> list[Estimate]:
        calls.append(len(trials))
        if bad in cast(Sequence[int], trials):
            raise error
        return cast(list[Estimate], list(trials))

    return solve


def run_fake(method: Method, n: int) -> list[Any]:
    """Return what comes of numbers in place of trials."""
    return cast(list[Any], method.run(cast(list[Trial], list(range(n)))))


def test_one_bad_trial_of_a_batch_is_found() -> None:
    """By halves; all others have their estimate."""
    calls: list[int] = []
    method = Method("x", fake_solver(5, SolverError("cannot"), calls), is_batched=True)
    outcomes = run_fake(method, 8)
    assert outcomes[5] == Failure("cannot")
    assert [o for o in outcomes if not isinstance(o, Failure)] == [0, 1, 2, 3, 4, 6, 7]
    assert calls == [8, 4, 4, 2, 2, 2, 2]  # one alone is doubled


def test_single_trials_fail_alone() -> None:
    """A defect is named by its kind."""
    calls: list[int] = []
    method = Method("x", fake_solver(1, ZeroDivisionError("oh"), calls))
    assert run_fake(method, 3) == [0, Failure("ZeroDivisionError: oh"), 2]
    assert calls == [1, 1, 1]
