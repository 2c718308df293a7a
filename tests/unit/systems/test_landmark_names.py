"""Landmarks without names after a blind stretch, in pairs; poses in gaps; drift as a state."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from factors.bearing_range import half_turn
from factors.similarity import GaussianKernel
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.landmark_slam.association import (
    Association,
    AssociationSettings,
    associate,
    association_errors,
)
from ssm_graph.systems.landmark_slam.filtered import filtered, first_values
from ssm_graph.systems.landmark_slam.logs import LONGEST_STEP_S, LandmarkLog, problem_of_log
from ssm_graph.systems.landmark_slam.merging import Map, all_merged
from ssm_graph.systems.landmark_slam.models import between, composed
from ssm_graph.systems.landmark_slam.particles import pair_by_particles
from ssm_graph.systems.landmark_slam.problem import UNKNOWN, SlamNoise, SlamStatus
from ssm_graph.systems.landmark_slam.reassociation import reassociate
from ssm_graph.systems.landmark_slam.sight import View, unseen
from ssm_graph.systems.landmark_slam.smoother import SmootherSettings, smooth_landmarks
from ssm_graph.systems.landmark_slam.solve import Asked, solve
from ssm_graph.systems.landmark_slam.sparse import smooth_quickly

STEP_S = 0.1
SIGMA = np.array([0.05, 0.01])


def drive(
    places: Array, *, seen_s: tuple[tuple[float, float], ...], wrong: float = 0.0, seed: int = 0
) -> LandmarkLog:
    """Return circles of 2.5 m for 120 s that see what lies ahead within 5 m, at some times alone.

    The odometry's turn rate is ``wrong`` rad/s too large all along.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 120.0, STEP_S)
    heading = 0.2 * t
    truth = np.column_stack([2.5 * np.sin(heading), 2.5 * (1.0 - np.cos(heading)), heading])
    times, seen, names = [], [], []
    for at in range(0, len(t), 5):
        if not any(begin <= t[at] < end for begin, end in seen_s):
            continue
        d = places - truth[at, :2]
        z = np.column_stack([np.hypot(*d.T), np.arctan2(d[:, 1], d[:, 0]) - heading[at]])
        z[:, 1] = (z[:, 1] + np.pi) % (2.0 * np.pi) - np.pi
        view = np.flatnonzero((z[:, 0] < 5.0) & (np.abs(z[:, 1]) < 1.2))
        seen.append(z[view] + SIGMA * rng.standard_normal((len(view), 2)))
        times += [t[at]] * len(view)
        names += view.tolist()
    speed = np.column_stack([0.5 + 0.02 * rng.standard_normal(len(t)), np.zeros(len(t))])
    return LandmarkLog(
        t,
        speed,
        0.2 + wrong + 0.06 * rng.standard_normal(len(t)),
        np.array(times),
        np.concatenate(seen),
        np.array(names),
        SlamNoise(np.array([0.02, 0.01, 0.02]), SIGMA),
        t,
        truth,
    )


RING = np.array([[4.0, 2.5], [1.0, 6.0], [-4.0, 4.0], [-3.0, -0.5], [1.5, -2.0]])


def test_poses_stand_in_gaps() -> None:
    """A second apart at most; what was seen keeps its times."""
    log = drive(RING, seen_s=((0.0, 10.0), (60.3, 70.0)))
    problem = problem_of_log(log)
    assert np.diff(problem.time_s).max() <= LONGEST_STEP_S
    assert problem.time_s[problem.keyframe] == pytest.approx(log.seen_s)
    assert np.sum(problem.control[:, 3] ** 2) == pytest.approx(np.ptp(problem.time_s))
    # Where it stands still the same time is worth less noise.
    still = replace(log, speed=np.zeros_like(log.speed), turn_rate=np.zeros_like(log.turn_rate))
    assert problem_of_log(still).control[:, 3].max() < 0.06


def test_a_clock_that_was_set_is_told() -> None:
    """Each second of the jump would be a pose."""
    log = drive(RING, seen_s=((0.0, 10.0), (60.3, 70.0)))
    odometry_s, seen_s = (t + 2e5 * (t > 30.0) for t in (log.odometry_s, log.seen_s))
    jumped = replace(log, odometry_s=odometry_s, seen_s=seen_s)
    with pytest.raises(DataError, match=r"none from 9\.500 to 200060\.500 s; .*clock"):
        problem_of_log(jumped)


def test_what_odometry_is_wrong_by_becomes_known() -> None:
    """A turn rate that is 0.03 rad/s too large, and the path with it as good as without."""
    errors_m = []
    for wrong in (0.0, 0.03):
        log = drive(RING, seen_s=((0.0, 40.0), (70.0, 120.0)), wrong=wrong)
        answer = filtered(problem_of_log(log), log.noise, "ekf-weighted")
        turn = answer.drift[2] + answer.drift[1] * (0.2 + wrong)
        assert turn == pytest.approx(-wrong, abs=0.004)
        problem = problem_of_log(log)
        true = np.column_stack([np.interp(problem.time_s, log.truth_s, x) for x in log.truth.T])
        errors_m.append(np.sqrt(np.mean(np.sum((answer.pose - true)[:, :2] ** 2, axis=1))))
    assert errors_m[1] < 3.0 * errors_m[0] + 0.1


def test_steps_put_together_follow_the_drift_as_they_do_one_by_one() -> None:
    """Over 50 s in which nothing is seen: a rate of turn bends the way, not its end alone."""
    log = drive(RING, seen_s=((0.0, 10.0), (60.0, 120.0)))
    problem = problem_of_log(log)
    short, _, kept = problem.condensed(log.noise)
    drift = np.array([0.02, 0.003, 0.001])
    bent = [problem.start]
    for step in problem.steps(drift):
        bent.append(composed(bent[-1], step))
    wanted = between(np.array(bent)[kept[:-1]], np.array(bent)[kept[1:]])
    missed = wanted - short.steps(drift)
    missed[:, 2] = half_turn(missed[:, 2])
    by_drift = short.steps(drift) - short.steps()
    assert np.abs(by_drift[:, :2]).max() > 0.1
    assert np.abs(missed).max() < 0.02


def test_the_quick_solution_is_the_smoothers() -> None:
    """Path, map and joint covariance, least squares."""
    log = drive(RING, seen_s=((0.0, 40.0),))
    problem = problem_of_log(log)
    settings = SmootherSettings(GaussianKernel())
    first = first_values(problem, log.noise)
    exact = smooth_landmarks(problem, log.noise, first, settings)
    quick = smooth_quickly(problem, log.noise, first, settings)
    assert quick.values.pose == pytest.approx(exact.pose, abs=2e-3)
    assert quick.values.landmarks == pytest.approx(exact.landmarks, abs=2e-3)
    blocks = quick.cov.reshape(5, 2, 5, 2)[np.arange(5), :, np.arange(5)]
    assert blocks == pytest.approx(exact.landmark_cov, rel=0.02, abs=1e-6)


def test_a_constellation_met_again_is_one() -> None:
    """Off by a turn and a shift that the joint covariance allows; a lone landmark is not taken."""
    rng = np.random.default_rng(0)
    lone = np.array([[12.0, 9.0]])
    places = np.vstack([RING, RING, lone])
    moves = np.zeros((22, 3))  # shift and turn of all that was met later
    moves[10::2, 0] = moves[11::2, 1] = 1.0
    moves[10::2, 2], moves[11::2, 2] = -places[5:, 1], places[5:, 0]
    off = moves @ [0.8, -0.5, 0.15] + 0.02 * rng.standard_normal(22)
    cov = moves @ np.diag([1.0, 1.0, 0.04]) @ moves.T + 0.03**2 * np.eye(22)
    together = np.zeros((11, 11), dtype=np.intp)
    together[:5, :5] = together[5:, 5:] = 20
    now = Map(places + off.reshape(-1, 2), cov, together, np.arange(11))
    one = all_merged(now, 0.1, 5.0).one
    assert one.tolist() == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 10]
    assert all_merged(now._replace(cov=1e-6 * cov), 0.1, 5.0).one.tolist() == list(range(11))


def test_after_a_blind_stretch_no_landmark_is_believed_at_once() -> None:
    """What is seen then stands where nothing was mapped, and is not taken for what was."""
    places = np.array([[4.0, 2.5], [1.0, 6.0], [-4.0, 4.0], [-3.0, -0.5]])
    log = drive(places, seen_s=((0.0, 4.0), (40.0, 44.0)), wrong=0.02)
    before = log.landmark[log.seen_s < 20.0]
    after = np.setdiff1d(log.landmark[log.seen_s > 20.0], before)
    assert len(after) > 0
    problem = problem_of_log(log)
    # Odometry that leaves heading and place open by 0.6 rad and a metre.
    found = associate(problem, SlamNoise(np.array([0.1, 0.1, 0.1]), SIGMA))
    is_new = np.isin(log.landmark, after)
    old = np.unique(found.landmark[(log.seen_s < 20.0) & (found.landmark != UNKNOWN)])
    taken = np.isin(found.landmark[is_new], old)
    assert not taken.any()


def test_a_short_memory_closes_nothing() -> None:
    """What is met again after a blind stretch is another landmark, and the same one otherwise."""
    log = drive(RING, seen_s=((0.0, 25.0), (45.0, 70.0)))
    problem = problem_of_log(log)
    for memory_s, is_met in ((10.0, False), (np.inf, True)):
        found = associate(problem, log.noise, AssociationSettings(memory_s=memory_s)).landmark
        is_early, known = log.seen_s < 35.0, found != UNKNOWN
        before, after = np.unique(found[known & is_early]), np.unique(found[known & ~is_early])
        assert len(before) > 2
        assert len(after) > 2
        assert bool(np.isin(after, before).any()) is is_met


def test_particles_pair_what_is_met_again_after_a_blind_stretch() -> None:
    """With errors among what was seen; each landmark once in a scan, and the same for a seed."""
    log = drive(RING, seen_s=((0.0, 25.0), (45.0, 70.0)), wrong=0.02)
    rng = np.random.default_rng(1)
    wrong = rng.random(len(log.seen)) < 0.1
    log = replace(log, seen=np.where(wrong[:, None], rng.uniform([1, -1], [5, 1]), log.seen))
    problem, noise, _ = problem_of_log(log).condensed(log.noise)
    drawn = pair_by_particles(problem, noise, np.zeros(3), seed=0)
    again = pair_by_particles(problem, noise, np.zeros(3), seed=0)
    np.testing.assert_array_equal(drawn.landmark, again.landmark)
    errors = association_errors(drawn.landmark[~wrong], problem.landmark[~wrong])
    assert errors.n_wrong + errors.n_left_out < 0.1 * errors.n
    assert errors.n_split <= 1
    named = drawn.landmark >= 0
    scans = np.column_stack([problem.keyframe, drawn.landmark])[named]
    assert len(np.unique(scans, axis=0)) == len(scans)
    assert drawn.landmark.max() == len(drawn.values.landmarks) - 1


def test_a_place_that_is_there_twice_stays_unseen() -> None:
    """It costs more than the one place; a log without a whole sighting has no view."""
    log = drive(RING, seen_s=((0.0, 120.0),))
    problem = problem_of_log(log)
    pose = np.column_stack([np.interp(problem.time_s, log.truth_s, x) for x in log.truth.T])
    block = ((problem.time_s - problem.time_s[0]) // 10.0).astype(np.intp)
    view = View.of(problem)
    assert 3.0 < view.farthest_m < 5.1
    assert 0.8 < view.widest_rad < 1.25
    once = unseen(view, problem, block, pose, RING, problem.landmark)
    late = np.where((problem.landmark == 0) & (log.seen_s > 60.0), len(RING), problem.landmark)
    twice = unseen(view, problem, block, pose, np.vstack([RING, RING[0]]), late)
    assert once.shape == twice.shape == (block[-1] + 1,)
    assert twice.sum() > once.sum() + 20.0
    blind = replace(problem, measured=np.full_like(problem.measured, np.nan))
    assert not View.of(blind).has(pose, RING).any()


def test_leftovers_become_landmarks() -> None:
    """A first opinion that has one in the place of two, none in that of a third, one twice."""
    pair = np.vstack([RING, RING[0] + [0.3, 0.3]])
    log = drive(pair, seen_s=((0.0, 120.0),))
    problem = problem_of_log(log)
    true = np.column_stack([np.interp(problem.time_s, log.truth_s, x) for x in log.truth.T])
    sigma = log.noise.observation * problem.scales
    first = np.vstack([np.delete(pair, [3, 5], axis=0), RING[1] + 0.003])
    again = reassociate(problem, sigma, true, first)
    errors = association_errors(again.landmark, problem.landmark)
    assert len(again.places) == len(pair)
    assert errors.n_split == 0
    assert errors.n_wrong < 0.02 * errors.n
    assert errors.n_left_out < 0.02 * errors.n


def test_a_filter_goes_through_unnamed_landmarks_that_stand_together() -> None:
    """Two that are seen in one scan where one is begun: each landmark once in a scan."""
    rng = np.random.default_rng(0)
    log = drive(RING, seen_s=((0.0, 10.0),))
    seen_s = np.repeat(np.unique(log.seen_s), 25)
    n = len(seen_s)
    seen = np.column_stack([rng.uniform(1.0, 20.0, n), rng.uniform(-1.5, 1.5, n)])
    log = replace(log, seen_s=seen_s, seen=seen, landmark=np.full(n, UNKNOWN))
    problem = problem_of_log(log)
    found = associate(problem, log.noise).landmark
    scans = np.column_stack([problem.keyframe, found])[found != UNKNOWN]
    assert len(scans) > 20
    assert len(np.unique(scans, axis=0)) == len(scans)
    solved = solve(problem, log.noise, Asked(method="ekf", association=Association.JOINT))
    assert np.isfinite(solved.answer.landmarks).all()


@pytest.mark.slow
def test_pairs_that_hang_on_trust_are_told() -> None:
    """Landmarks too close for ranges that are worse than stated, after blind stretches."""
    rng = np.random.default_rng(0)
    places = np.vstack([RING + rng.normal(0.0, 0.25, (5, 2)) for _ in range(3)])
    log = drive(places, seen_s=((0.0, 25.0), (60.0, 70.0), (105.0, 120.0)), wrong=0.02)
    seen = log.seen + rng.normal(0.0, 0.15, (len(log.seen), 1)) * [1.0, 0.2]
    log = replace(log, seen=seen)
    solved = solve(problem_of_log(log), log.noise, Asked(association=Association.JOINT))
    assert solved.answer.status is SlamStatus.AMBIGUOUS
    assert not solved.is_good
    assert "pair otherwise" in " ".join(solved.notes)


def test_a_filter_without_any_landmark_answers() -> None:
    """One sighting makes none: the path is the odometry's."""
    log = drive(RING, seen_s=((0.0, 20.0),))
    log = replace(log, seen_s=log.seen_s[:1], seen=log.seen[:1], landmark=np.full(1, UNKNOWN))
    asked = Asked(method="ekf-weighted", association=Association.JOINT)
    estimate = solve(problem_of_log(log), log.noise, asked).answer
    assert len(estimate.landmarks) == 0
    assert np.isfinite(estimate.pose).all()


def test_many_leftovers_take_little_memory() -> None:
    """They are compared with what is near, not each with all others."""
    rng = np.random.default_rng(0)
    log = drive(RING, seen_s=((0.0, 120.0),))
    n = 3000
    seen = np.column_stack([rng.uniform(20.0, 500.0, n), rng.uniform(-3.0, 3.0, n)])
    seen_s = np.sort(rng.choice(log.odometry_s[:-1], n))
    log = replace(log, seen_s=seen_s, seen=seen, landmark=np.full(n, UNKNOWN))
    problem = problem_of_log(log)
    pose = np.zeros((len(problem.time_s), 3))
    tracemalloc.start()
    found = reassociate(problem, SIGMA * problem.scales, pose, np.array([[1.0, 1.0]]))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.all(found.landmark == UNKNOWN)
    assert peak < 20 * 2**20


def test_unnamed_is_nearly_as_good_as_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A log with a blind stretch and a turn rate that is wrong, through all stages."""
    monkeypatch.setattr("ssm_graph.systems.landmark_slam.opinions.SWARMS", 1)
    log = drive(RING, seen_s=((0.0, 40.0), (70.0, 120.0)), wrong=0.01, seed=1)
    problem = problem_of_log(log)
    true = np.column_stack([np.interp(problem.time_s, log.truth_s, x) for x in log.truth.T])
    named, unnamed = (
        solve(problem, log.noise, Asked(association=kind), truth=true)
        for kind in (Association.KNOWN, Association.JOINT)
    )
    assert named.score is not None
    assert unnamed.score is not None
    assert unnamed.score.aligned_m < 1.2 * named.score.aligned_m + 0.01
    assert unnamed.answer.status is SlamStatus.CONVERGED
    assert unnamed.is_good
