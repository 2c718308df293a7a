"""Noise found from what an answer misses: consistent, robust, said where it is not as stated."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.graph.first_values import first_values
from ssm_graph.graph.gtsam_graph import gtsam_graph, gtsam_values, inertial_graph
from ssm_graph.graph.inertial_rows import inertial_fit
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.estimate import Estimate, NoiseFound, Status
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import Beams, Problem, build_problem
from ssm_graph.simulation import Grade, OutlierKind, Outliers
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.faults.columns import KERNEL
from ssm_graph.smoothers.verdict import adaptation, beam_noise, noise_notes, with_sigmas
from tests.helpers import simulated

N = 20_000


def beams_of(sigma: Array) -> Beams:
    """Return rows of the four beams in turn with these stated sigmas."""
    rows = np.arange(len(sigma))
    zeros = np.zeros((len(sigma), 3))
    return Beams(
        keyframe=rows // 4,
        beam=rows % 4,
        speed=zeros[:, 0],
        sigma=sigma,
        gyro_b=zeros,
        beam_b=zeros,
        lever_arm_b=np.zeros(3),
        R_bd=np.eye(3),
        ping=rows // 4,
        is_water=np.zeros(len(rows), bool),
        n_beams=4,
    )


def stated(problem: Problem, factor: float) -> Problem:
    """Return the problem with all beam sigmas stated so many times as large."""
    return with_sigmas(problem, np.full(4, factor))


def smoothed(problem: Problem, *, adapt: bool = False) -> Estimate:
    """Return the estimate by the default kernel."""
    return SsmSmoother(SmootherConfig(adapt_noise=adapt)).solve(problem)


def test_sigmas_of_gaussian_errors_are_found() -> None:
    """Each beam its own, leverage made up for; to four of the deviations of the estimate."""
    rng = np.random.default_rng(5)
    beams, leverage = beams_of(np.full(N, 0.01)), rng.uniform(0.0, 0.5, N)
    true = np.array([0.5, 1.0, 2.0, 3.0])[beams.beam]
    error = 0.01 * true * np.sqrt(1.0 - leverage) * rng.standard_normal(N)
    ones = np.ones(N)
    factor, dof = beam_noise(beams, error=error, variance=1e-4 * leverage, weights=ones)
    np.testing.assert_allclose(factor, [0.5, 1.0, 2.0, 3.0], rtol=4.0 / np.sqrt(2.0 * N / 4))
    np.testing.assert_allclose(dof, 0.75 * N / 4, rtol=0.02)


def test_outliers_do_not_count() -> None:
    """A fifth of the speeds off by ten sigmas or more, with any weight; half of them rejected."""
    rng = np.random.default_rng(6)
    beams, error = beams_of(np.full(N, 0.01)), 0.01 * rng.standard_normal(N)
    is_bad = rng.random(N) < 0.2
    error[is_bad] += rng.uniform(0.1, 3.0, is_bad.sum())
    weights = np.ones(N)
    weights[is_bad & (rng.random(N) < 0.5)] = 1e-3
    factor, _ = beam_noise(beams, error=error, variance=np.zeros(N), weights=weights)
    np.testing.assert_allclose(factor, 1.0, atol=0.05)


def test_few_speeds_say_nothing() -> None:
    """No factor, no note, no adaptation."""
    ones = np.ones(40)
    factor, dof = beam_noise(beams_of(ones), error=9.0 * ones, variance=0.0 * ones, weights=ones)
    assert np.all(np.isnan(factor))
    found = NoiseFound(factor, dof, np.ones(4), 1e3, 5.0)
    assert noise_notes(found) == ()
    assert adaptation(found) is None


def found_with(**changes: object) -> NoiseFound:
    """Return noise as stated, but for what is changed."""
    as_stated = NoiseFound(np.ones(4), np.full(4, 500.0), np.ones(4), 100.0, 110.0)
    return replace(as_stated, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"beam_factor": np.array([1.0, 1.2, 1.0, 1.0])}, ""),
        ({"beam_factor": np.array([1.0, 1.4, 1.0, 0.5])}, "1.40 of beam 2, 0.50 of beam 4 times"),
        ({"beam_factor": np.full(4, 1.3), "beam_dof": np.full(4, 40.0)}, ""),
        ({"beam_used": np.full(4, 2.0)}, "adapted to their errors: 2.00, 2.00"),
        ({"inertial_chi_sq": 500.0}, "more than their noise says (chi-square 500 with 110"),
        ({"inertial_chi_sq": 30.0}, "are too large, by a factor of 1.9"),
        ({"inertial_chi_sq": 180.0}, ""),
    ],
)
def test_notes_say_what_is_significant_and_notable(changes: dict[str, object], said: str) -> None:
    """Five deviations and a quarter for beams, five deviations and twice for inertial data."""
    notes = noise_notes(found_with(**changes))
    assert len(notes) == (1 if said else 0)
    assert said in "".join(notes)


def test_inertial_degrees_of_freedom_are_those_of_the_dense_system() -> None:
    """Against the trace of the projector of one dense matrix of the whole graph."""
    problem = build_problem(simulated(duration_s=6.0, grade=Grade.MEMS).mission)
    linearizer = GraphLinearizer(problem)
    states = first_values(problem, kernel=KERNEL).states
    linearizer.follow(states)
    rows = linearizer.beam_rows(states)
    weights = np.ones(len(rows.error))
    step = linearizer.solve(states, rows, weights)
    fit = inertial_fit(linearizer.inertial_rows(states), step)
    A, _ = gtsam_graph(problem, states).linearize(gtsam_values(states)).jacobian()
    own, b = inertial_graph(problem, states).linearize(gtsam_values(states)).jacobian()
    # Both have their columns in the order of the keys.
    explained = np.trace(own @ np.linalg.solve(A.T @ A, own.T))
    assert fit.dof.sum() == pytest.approx(len(b) - explained, abs=1e-3)
    assert fit.chi_sq.sum() == pytest.approx(float(b @ b))


@pytest.mark.parametrize("asks", [False, True])
def test_neighbour_covariance_goes_with_calibration(asks: bool) -> None:
    """A known scale is hardly an extra variable: chain and border find the same fit."""
    mission = simulated(duration_s=30.0, grade=Grade.MEMS).mission
    sigma = 1e-9 if asks else 0.0
    dvl = replace(mission.dvl, mount=replace(mission.dvl.mount, scale_sigma=sigma))
    noise = smoothed(build_problem(replace(mission, dvl=dvl))).noise
    expected = smoothed(build_problem(mission)).noise
    assert noise is not None
    assert expected is not None
    assert noise.inertial_dof == pytest.approx(expected.inertial_dof, rel=1e-3)
    assert noise.inertial_chi_sq == pytest.approx(expected.inertial_chi_sq, rel=1e-2)


@cache
def sparse() -> Problem:
    """Return two minutes with a tenth of outliers, sigmas as they are."""
    outliers = Outliers(OutlierKind.SPARSE, 0.1)
    sim = simulated(duration_s=120.0, grade=Grade.TACTICAL, outliers=outliers, seed=3)
    return build_problem(sim.mission)


@cache
def rightly_stated(adapt: bool) -> Estimate:
    """Return the estimate of that."""
    return smoothed(sparse(), adapt=adapt)


@pytest.mark.parametrize("factor", [1.0 / 3.0, 3.0])
def test_adaptation_finds_the_answer_of_the_right_sigma(factor: float) -> None:
    """Whatever was stated; without it a note gives the factor."""
    wrong, right = stated(sparse(), factor), rightly_stated(True)
    adapted, alone = smoothed(wrong, adapt=True), smoothed(wrong)
    for estimate in (right, adapted, alone):
        assert estimate.status is Status.CONVERGED, estimate.reason
    assert right.noise is not None
    assert adapted.noise is not None
    np.testing.assert_allclose(right.noise.beam_used, 1.0, atol=0.25)
    np.testing.assert_allclose(adapted.noise.beam_used * factor, right.noise.beam_used, rtol=0.05)
    np.testing.assert_allclose(
        adapted.trajectory.velocity_enu, right.trajectory.velocity_enu, atol=1e-3
    )
    assert "they ask for sigmas of" in "".join(alone.notes)
    assert "adapted to their errors" in "".join(adapted.notes)
    assert not any("sigmas" in note for note in rightly_stated(False).notes)


@cache
def four_minutes() -> Mission:
    """Return four minutes at MEMS grade."""
    return simulated(duration_s=240.0, grade=Grade.MEMS, seed=2).mission


@pytest.mark.parametrize(
    ("factor", "said"), [(1.0 / 3.0, "too small"), (3.0, "too large"), (1.0, "")]
)
def test_wrong_inertial_noise_is_said_and_right_is_not(factor: float, said: str) -> None:
    """Four minutes at MEMS grade."""
    mission = four_minutes()
    noise = mission.imu.noise
    wrong = replace(
        noise,
        gyro_density=factor * noise.gyro_density,
        accel_density=factor * noise.accel_density,
        gyro_bias_density=factor * noise.gyro_bias_density,
        accel_bias_density=factor * noise.accel_bias_density,
    )
    imu = replace(mission.imu, noise=wrong)
    notes = smoothed(build_problem(replace(mission, imu=imu))).notes
    assert (f"the densities of [imu] are {said}" in "".join(notes)) == bool(said)
    assert any("densities" in note for note in notes) == bool(said)
