"""Ranges and headings as factors in anyone's graph of GTSAM's."""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from factors.beacon_range import beacon_range_factor
from factors.compass_heading import heading_factor
from ssm_graph.base.frozen import Array
from tests.helpers import assert_jacobians_match, rotation

ATTITUDES = {
    "random": rotation([0.3, -1.1, 0.8]),
    "near identity": rotation([1e-6, -2e-6, 1e-6]),
    "near pi": rotation([0.02, -0.03, math.pi - 1e-3]),
}
P_N = np.array([10.0, -20.0, -3.0])
RANGE: dict[str, Any] = {
    "sigma": 0.3,
    "range_m": 100.0,
    "lever_arm_b": np.array([0.4, -0.7, 1.1]),
    "beacon_n": np.array([110.0, 30.0, -60.0]),
}
HEADING: dict[str, Any] = {
    "sigma": 0.02,
    "heading": 1.0,
    "east_n": np.eye(3)[0],
    "north_n": np.eye(3)[1],
    "R_back": rotation([0.01, -0.02, 0.03]),
}


def factors(weight: float = 1.0) -> list[gtsam.CustomFactor]:
    """Return one of each."""
    return [
        beacon_range_factor(X(0), weight=weight, **RANGE),
        heading_factor(X(0), weight=weight, **HEADING),
    ]


def at(R_nb: Array) -> gtsam.Values:
    """Return a pose."""
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3(R_nb), P_N))
    return values


@pytest.mark.parametrize("R_nb", ATTITUDES.values(), ids=ATTITUDES)
def test_jacobians(R_nb: Array) -> None:
    """Against central differences."""
    for factor in factors():
        assert_jacobians_match(factor, at(R_nb))


def test_they_are_zero_at_the_truth() -> None:
    """A range to a beacon straight ahead, and the heading of a level vehicle."""
    level = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # heads north
    ahead = P_N + level @ (RANGE["lever_arm_b"] + np.array([50.0, 0.0, 0.0]))
    found = beacon_range_factor(X(0), **(RANGE | {"range_m": 50.0, "beacon_n": ahead}))
    assert found.error(at(level)) == pytest.approx(0.0, abs=1e-18)
    plain = HEADING | {"heading": 2.0 * math.pi, "R_back": None}
    assert heading_factor(X(0), **plain).error(at(level)) == pytest.approx(0.0, abs=1e-18)


def test_a_weight_divides_the_variance() -> None:
    """A quarter of it costs a quarter; asked alone, the error is that of the linearised factor."""
    values = at(ATTITUDES["random"])
    for whole, quarter in zip(factors(), factors(weight=0.25), strict=True):
        cost = whole.error(values)
        assert cost > 0.0
        assert quarter.error(values) == pytest.approx(0.25 * cost)
        _, b = whole.linearize(values).jacobian()
        assert 0.5 * float(b @ b) == pytest.approx(cost)


def test_no_jacobian_work_when_none_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error alone does not go through the residual with its blocks."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("Jacobians were computed")

    made = factors()
    monkeypatch.setattr("factors.beacon_range.range_residual", refuse)
    monkeypatch.setattr("factors.compass_heading.heading_residual", refuse)
    assert all(np.isfinite(factor.error(at(ATTITUDES["random"]))) for factor in made)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sigma": 0.0}, "sigma and weight above zero"),
        ({"weight": math.nan}, "sigma and weight above zero"),
        ({"range_m": math.inf, "heading": math.inf}, "expected a finite number"),
        ({"lever_arm_b": np.zeros(2), "R_back": np.zeros((3, 2))}, "finite numbers"),
        ({"beacon_n": np.full(3, np.nan), "north_n": np.full(3, np.nan)}, "3 finite numbers"),
    ],
)
def test_bad_input_is_refused(changes: dict[str, Any], said: str) -> None:
    """Before GTSAM sees it: a wrong shape would crash the process."""
    for make, given in ((beacon_range_factor, RANGE), (heading_factor, HEADING)):
        known = given.keys() | {"weight"}
        with pytest.raises(ValueError, match=f"{make.__name__}: .*{said}"):
            make(X(0), **(given | {key: changes[key] for key in changes.keys() & known}))
