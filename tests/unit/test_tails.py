"""The tail of a sensor's noise is found from what it measured, in batch and window alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from factors.similarity import ExpKernel, GaussianKernel, Kernel, LogKernel
from factors.tails import LIGHTER, likeliest_tail, tail_evidence, tails_of
from ssm_graph.engine.reweighting import MOST_TAILS, Lengths, TailSchedule
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.simulation import GnssSettings, SimulatedMission
from ssm_graph.smoothers.batch import SsmSmoother
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, run_fixed_lag
from tests.helpers import simulated

TAILS = tails_of(LogKernel())
WINDOW = FixedLagConfig(10.0, max_iterations=2, relinearise_sigmas=0.1, reweigh=1e-3)


def sound_lengths(many: int, *, dim: int) -> np.ndarray:
    """Return squared lengths of Gaussian noise, evenly by their probability."""
    return np.asarray(stats.chi2(dim).ppf((np.arange(many) + 0.5) / many))


def found(t: np.ndarray, *, dim: int, telling: float = 1.0) -> Kernel:
    """Return the likeliest tail of measurements that all tell as much."""
    evidence = tail_evidence(TAILS, t, np.full(len(t), telling), dim=dim)
    return likeliest_tail(TAILS, evidence, dim=dim)


@pytest.mark.parametrize("dim", [1, 3])
def test_evidence_is_the_density_of_student(dim: int) -> None:
    """Up to what all tails share, by SciPy's multivariate density."""
    rng = np.random.default_rng(dim)
    r = rng.standard_normal((50, dim))
    ours = tail_evidence(TAILS, np.sum(r**2, axis=1), np.ones(50), dim=dim)
    dofs = (LogKernel().dof, *LIGHTER)
    theirs = [stats.multivariate_t(np.zeros(dim), np.eye(dim), df=d).logpdf(r).sum() for d in dofs]
    np.testing.assert_allclose(np.diff(ours), np.diff(theirs), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("dim", "many"), [(1, 400), (3, 120)])
def test_sound_noise_has_the_lightest_tail_and_gross_errors_the_heaviest(
    dim: int, many: int
) -> None:
    """Of 60 sigmas one is enough; few measurements, or ones the answer follows, say nothing."""
    sound = sound_lengths(many, dim=dim)
    assert found(sound, dim=dim) in TAILS[2:]
    assert found(np.tile(sound, 5), dim=dim) == TAILS[-1]
    assert found(np.append(sound, 60.0**2), dim=dim) == LogKernel()
    assert found(sound[::20], dim=dim) == LogKernel()
    assert found(sound, dim=dim, telling=0.05) == LogKernel()
    assert found(2.5 * sound, dim=dim) == LogKernel()


def test_only_the_log_kernel_has_other_tails() -> None:
    """And lighter ones than its own alone."""
    assert tails_of(ExpKernel()) == (ExpKernel(),)
    assert tails_of(GaussianKernel()) == (GaussianKernel(),)
    assert tails_of(LogKernel(15.0)) == (LogKernel(15.0), LogKernel(20.0), LogKernel(40.0))
    assert tails_of(LogKernel(1e3)) == (LogKernel(1e3),)


def test_tails_are_looked_for_near_the_end_and_not_for_ever() -> None:
    """By the warm kernel until the updates are near; near a tie they stop going to and fro."""
    sensors = np.array([0, 600]), np.array([3])
    schedule = TailSchedule(LogKernel(), (LogKernel(),), *sensors)
    spread, used = np.zeros(600), np.ones(600)
    sound = sound_lengths(600, dim=3)
    wild = np.where(np.arange(600) < 20, 1e4, sound)
    lengths = [Lengths(t, spread) for t in (sound, wild)]
    far, weights = schedule.after(used, schedule.weight(sound), lengths[0], update_sigmas=5.0)
    assert far is schedule
    assert not far.may_end(lengths[0], used)
    near, weights = far.after(used, weights, lengths[0], update_sigmas=0.5)
    assert near.kernels == (LogKernel(LIGHTER[-1]),)
    np.testing.assert_array_equal(weights, near.kernels[0].weight(sound, dim=3))
    assert near.may_end(lengths[0], used)
    assert not near.may_end(lengths[1], used)
    for i in range(2 * MOST_TAILS):
        turn = lengths[1 - i % 2]
        near, _ = near.after(used, near.weight(turn.square), turn, update_sigmas=0.5)
    assert near.may_end(lengths[0], used)
    assert near.may_end(lengths[1], used)
    ends = [near.anew().may_end(one, used) for one in lengths]
    assert sorted(ends) == [False, True]


def surfaced() -> SimulatedMission:
    """Return two minutes with sound fixes."""
    return simulated(duration_s=120.0, gnss=GnssSettings(windows=((0.0, 120.0),)), seed=11)


def tail_of(t: np.ndarray, weight: np.ndarray) -> Kernel:
    """Return the tail by which fixes have these weights."""
    off = [np.abs(tail.weight(t, dim=3) - weight).max() for tail in TAILS]
    assert min(off) < 2e-3
    return TAILS[int(np.argmin(off))]


def test_batch_and_window_give_fixes_the_weights_of_their_tail() -> None:
    """Sound ones those of a lighter one; with one in ten wild all have those of the heaviest."""
    sim = surfaced()
    gnss = sim.mission.gnss
    assert isinstance(gnss, GnssLog)
    lat = gnss.lat.copy()
    lat[::10] += 50.0 / 6.37e6
    wild = replace(sim.mission, gnss=replace(gnss, lat=lat))
    for mission, expected in ((sim.mission, TAILS[1:]), (wild, TAILS[:1])):
        problem = build_problem(mission)
        estimate = SsmSmoother().solve(problem)
        assert estimate.aids is not None
        own = np.array(estimate.aids.aid) == Fixes.name
        assert tail_of(estimate.aids.mahalanobis_sq[own], estimate.aids.weight[own]) in expected
        last = run_fixed_lag(problem, WINDOW).delayed.aids[Fixes.name]
        assert tail_of(last.mahalanobis_sq[-10:], last.weight[-10:]) in expected
