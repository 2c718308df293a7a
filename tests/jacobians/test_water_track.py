"""The beam off the water: Jacobians, water at rest, and the ground beside it."""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, V, X

from factors.dvl_beam import dvl_beam_factor
from factors.water_track import through_water, water_beam_factor
from ssm_graph.base.frozen import Array
from tests.helpers import assert_jacobians_match, rotation

OMEGA_IE_N = 7.292115e-5 * np.array([0.0, math.cos(0.8), math.sin(0.8)])
ATTITUDES = {
    "near identity": np.array([1e-7, 2e-7, -1e-7]),
    "random": np.array([0.3, -1.1, 0.8]),
    "near 180 degrees": (math.pi - 1e-6) * np.array([2.0, -1.0, 2.0]) / 3.0,
}
R_NL = rotation(np.array([1e-3, -2e-3, 5e-4]))
KEYS = (X(0), V(0), B(0))


def beam(rng: np.random.Generator) -> dict[str, Any]:
    """Return one beam of any direction."""
    beam_b = rng.normal(size=3)
    return {
        "sigma": 0.01,
        "speed": rng.normal(),
        "gyro_b": 0.1 * rng.normal(size=3),
        "beam_b": beam_b / np.linalg.norm(beam_b),
        "lever_arm_b": rng.normal(size=3),
        "omega_ie_n": OMEGA_IE_N,
    }


def values_at(attitude: Array, rng: np.random.Generator, current: Array) -> gtsam.Values:
    """Return a state and a current."""
    values = gtsam.Values()
    values.insert(X(0), pose3=gtsam.Pose3(gtsam.Rot3(rotation(attitude)), rng.normal(size=3)))
    values.insert(V(0), rng.normal(size=3))
    bias = gtsam.imuBias.ConstantBias(0.01 * rng.normal(size=3), 0.01 * rng.normal(size=3))
    values.insert(B(0), constant_bias=bias)
    values.insert(C(0), current)
    return values


@pytest.mark.parametrize("attitude", ATTITUDES.values(), ids=ATTITUDES)
def test_jacobians_through_gtsam(attitude: Array) -> None:
    """Every block, that of the current along east, north, up at the vehicle among them."""
    rng = np.random.default_rng(3)
    factor = water_beam_factor(*KEYS, C(0), R_nl=R_NL, **beam(rng))
    assert_jacobians_match(factor, values_at(attitude, rng, rng.normal(size=3)))


def test_water_at_rest_is_as_good_as_ground() -> None:
    """Without a current the error is that of bottom track; with the vehicle's drift it is too."""
    rng = np.random.default_rng(4)
    one = beam(rng)
    water = water_beam_factor(*KEYS, C(0), R_nl=R_NL, weight=0.25, **one)
    ground = dvl_beam_factor(*KEYS, weight=0.25, **one)
    values = values_at(ATTITUDES["random"], rng, np.zeros(3))
    np.testing.assert_allclose(water.whitenedError(values), ground.whitenedError(values))
    drift = np.array([0.4, -0.2, 0.02])
    carried = gtsam.Values(values)
    carried.update(C(0), drift)
    carried.update(V(0), values.atVector(V(0)) + R_NL @ drift)
    np.testing.assert_allclose(
        water.whitenedError(carried), ground.whitenedError(values), rtol=0.0, atol=1e-12
    )


def test_only_rows_off_the_water_know_the_current() -> None:
    """Of mixed rows the others keep their velocity, whatever the current."""
    is_water = np.array([True, False])
    v_n = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    through = through_water(v_n, np.array([0.5, 0.0, 0.0]), R_nl=np.eye(3), is_water=is_water)
    np.testing.assert_array_equal(through.v_n, [[0.5, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(through.v_D_current, [-np.eye(3), np.zeros((3, 3))])


def test_no_jacobian_work_when_none_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error alone does not go through the residual with its blocks."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("Jacobians were computed")

    monkeypatch.setattr("factors.water_track.beam_residual", refuse)
    rng = np.random.default_rng(5)
    factor = water_beam_factor(*KEYS, C(0), R_nl=R_NL, **beam(rng))
    assert np.isfinite(factor.error(values_at(ATTITUDES["random"], rng, np.ones(3))))


@pytest.mark.parametrize(
    "changes",
    [
        {"speed": math.nan},
        {"sigma": 0.0},
        {"beam_b": np.ones(2)},
        {"R_nl": np.eye(2)},
        {"R_nl": np.full((3, 3), np.nan)},
    ],
)
def test_bad_input_is_refused(changes: dict[str, Any]) -> None:
    """Before GTSAM sees it: a wrong shape would crash the process."""
    given = {"R_nl": R_NL} | beam(np.random.default_rng(6)) | changes
    with pytest.raises(ValueError, match="water_beam_factor"):
        water_beam_factor(*KEYS, C(0), **given)
