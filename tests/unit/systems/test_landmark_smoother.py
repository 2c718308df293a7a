"""The smoother of a log of landmarks: against GTSAM, against the truth, and its noise."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors.bearing_range import bearing_range_factor, bearing_range_residual, range_bearing
from factors.kernels import CauchyKernel, TruncatedKernel
from factors.similarity import GaussianKernel, Kernel, LogKernel
from ssm_graph.base.errors import ConfigError
from ssm_graph.engine.reweighting import Lengths
from ssm_graph.systems.landmark_slam.models import Odometry
from ssm_graph.systems.landmark_slam.noise import NoiseSettings, estimate_noise
from ssm_graph.systems.landmark_slam.observation_noise import learn_observations
from ssm_graph.systems.landmark_slam.problem import (
    UNKNOWN,
    SlamEstimate,
    SlamNoise,
    SlamProblem,
    SlamStatus,
)
from ssm_graph.systems.landmark_slam.simulator import CASES, Sigmas, World, simulate
from ssm_graph.systems.landmark_slam.smoother import SmootherSettings, Values, smooth_landmarks
from ssm_graph.systems.landmark_slam.study import path_of, problem_of_run
from ssm_graph.systems.landmark_slam.weights import information_scale, tail_of, weights_of

NOISE = SlamNoise(np.array([0.05, 0.03, 0.02]), np.array([0.1, 0.02]))


FINE = SlamNoise(np.array([0.002, 0.002, 0.001]), NOISE.observation)
"""GTSAM's error of odometry is a logarithm, which differs by the square of it, in the axes of the
end of the step: with one sigma for both axes these are the same."""


def small(
    rng: np.random.Generator, *, n_poses: int = 30, noise: SlamNoise = NOISE
) -> tuple[SlamProblem, Values]:
    """Return a log of a drive in a circle among four landmarks, and the truth."""
    motion = Odometry()
    true_step = np.array([0.5, 0.0, 0.2])
    ones = np.ones(3)
    control = np.concatenate([true_step, ones])
    pose = np.zeros((n_poses, 3))
    for k in range(n_poses - 1):
        pose[k + 1] = motion.move(pose[k], control, np.zeros(3))
    landmarks = np.array([[1.0, 5.0], [-3.0, 1.0], [3.0, 2.0], [0.0, -2.0]])
    told = true_step + noise.control * rng.standard_normal((n_poses - 1, 3))
    keyframe, landmark = np.repeat(np.arange(n_poses), 2), np.tile(np.arange(4), n_poses // 2)
    seen = range_bearing(pose[keyframe], landmarks[landmark])
    problem = SlamProblem(
        np.arange(n_poses, dtype=np.float64),
        motion,
        np.hstack([told, np.ones((n_poses - 1, 3))]),
        keyframe,
        landmark,
        seen + NOISE.observation * rng.standard_normal(seen.shape),
        ("1", "2", "3", "4"),
        np.zeros(3),
        np.full(3, 1e-3),
    )
    return problem, Values(pose, landmarks)


def by_gtsam(problem: SlamProblem, first: Values) -> tuple[gtsam.Values, gtsam.Marginals]:
    """Solve the same with GTSAM's factors."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    tight = gtsam.noiseModel.Diagonal.Sigmas(problem.start_sigma)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*problem.start), tight))
    odometry = gtsam.noiseModel.Diagonal.Sigmas(FINE.control)
    for k, step in enumerate(problem.control[:, :3]):
        graph.add(gtsam.BetweenFactorPose2(k, k + 1, gtsam.Pose2(*step), odometry))
    for k, i, (r, b) in zip(problem.keyframe, problem.landmark, problem.measured, strict=True):
        factor = bearing_range_factor(
            int(k),
            1000 + int(i),
            range_m=r,
            bearing_rad=b,
            range_sigma=NOISE.observation[0],
            bearing_sigma=NOISE.observation[1],
        )
        graph.add(factor)
    for k, pose in enumerate(first.pose):
        values.insert(k, gtsam.Pose2(*pose))
    for i, place in enumerate(first.landmarks):
        values.insert(1000 + i, place)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return found, gtsam.Marginals(graph, found)


def test_least_squares_is_gtsams() -> None:
    """Path, map and marginals of the whole log."""
    problem, truth = small(np.random.default_rng(0), noise=FINE)
    found = smooth_landmarks(problem, FINE, truth, SmootherSettings(GaussianKernel()))
    theirs, marginals = by_gtsam(problem, truth)
    assert found.status is SlamStatus.CONVERGED
    places = np.array([theirs.atPoint2(1000 + i) for i in range(4)])
    sigma = np.sqrt(np.einsum("lii->li", found.landmark_cov))
    assert np.abs((found.landmarks - places) / sigma).max() < 0.02  # where the smoother stops: 0.01
    last = theirs.atPose2(29)
    assert found.pose[-1] == pytest.approx([last.x(), last.y(), last.theta()], abs=3e-4)
    for i in range(4):
        theirs_cov = marginals.marginalCovariance(1000 + i)
        assert found.landmark_cov[i] == pytest.approx(
            theirs_cov, abs=0.01 * float(np.max(theirs_cov))
        )


def test_slopes_of_range_and_bearing() -> None:
    """Against central differences; zero error at the truth, over half a turn too."""
    rng = np.random.default_rng(5)
    pose, place = rng.normal(size=3), 4.0 * rng.normal(size=2)
    measured = range_bearing(pose, place) + np.array([0.0, 2.0 * np.pi])
    found = bearing_range_residual(pose, place, measured=measured)
    assert found.error == pytest.approx(0.0, abs=1e-12)
    for i in range(3):
        step = 1e-6 * np.eye(3)[i]
        ahead, behind = (range_bearing(pose + s, place) for s in (step, -step))
        assert found.error_D_pose[:, i] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)
    for i in range(2):
        step = 1e-6 * np.eye(2)[i]
        ahead, behind = (range_bearing(pose, place + s) for s in (step, -step))
        assert found.error_D_landmark[:, i] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"bearing_rad": 45.0}, "degrees"),
        ({"range_m": -1.0}, "above zero"),
        ({"weight": 0.0}, "above zero"),
        ({"range_m": np.nan}, "finite"),
    ],
)
def test_bad_factors_are_refused(wrong: dict[str, float], said: str) -> None:
    """Before GTSAM sees them."""
    good = {"range_m": 1.0, "bearing_rad": 0.1, "range_sigma": 0.1, "bearing_sigma": 0.1}
    with pytest.raises(ValueError, match=said):
        bearing_range_factor(0, 1, **{**good, **wrong})


@pytest.mark.parametrize("kernel", [LogKernel(5.0), CauchyKernel(), TruncatedKernel(3.7)])
def test_weights_leave_the_sigma_what_it_is(kernel: Kernel) -> None:
    """Their mean over normal noise is one."""
    t = np.sum(np.random.default_rng(0).standard_normal((100_000, 2)) ** 2, axis=1)
    weights = weights_of(kernel, t, np.full(len(t), 2.0))
    assert np.mean(weights) == pytest.approx(1.0, abs=0.01)
    assert information_scale(GaussianKernel(), 2) == 1.0


def smoothed(problem: SlamProblem, first: Values, kernel: Kernel) -> SlamEstimate:
    """Smooth by a kernel."""
    return smooth_landmarks(problem, NOISE, first, SmootherSettings(kernel))


def test_sound_observations_do_not_pay_for_gross_ones() -> None:
    """Where none are gross, and where a twentieth are; little is lost against who is told which."""
    problem, truth = small(np.random.default_rng(3), n_poses=400)
    measured = problem.measured.copy()
    measured[::20, 0] += 3.0
    spoilt = replace(problem, measured=measured)
    gross = np.arange(len(measured)) % 20 == 0
    told = problem.associated(np.where(gross, UNKNOWN, problem.landmark), problem.names)
    heavy, none = SmootherSettings(finds_tail=False), SmootherSettings(GaussianKernel())
    for log, without_gross in ((problem, problem), (spoilt, told)):
        best = smooth_landmarks(without_gross, NOISE, truth, none)
        away = [
            float(np.linalg.norm(smooth_landmarks(log, NOISE, truth, how).pose - best.pose))
            for how in (None, heavy)
        ]
        assert away[0] < 0.3 * away[1]


@pytest.mark.parametrize("too_small", [1.0, 3.0])
def test_what_student_makes_keeps_his_kernel(too_small: float) -> None:
    """Heavy tails are no gross errors, nor is noise that is three times what was stated."""
    rng = np.random.default_rng(4)
    normal = rng.standard_normal((3000, 2))
    errors = too_small * normal
    if too_small == 1.0:
        errors /= np.sqrt(rng.chisquare(5.0, 3000) / 5.0)[:, None]
    t = np.sum(errors**2, axis=1)
    lengths, ones = Lengths(t, np.zeros(len(t))), np.ones(len(t))
    assert tail_of(LogKernel(5.0), lengths, ones, np.full(len(t), 2)) == LogKernel(5.0)


def test_gross_observations_lose_their_weight() -> None:
    """A third of them anywhere, and the answer hardly moves; least squares is led astray."""
    rng = np.random.default_rng(3)
    problem, truth = small(rng)
    measured, gross = problem.measured.copy(), rng.random(60) < 0.3
    measured[gross] = rng.uniform([0.5, -1.5], [8.0, 1.5], (int(gross.sum()), 2))
    spoilt = SlamProblem(
        **{f: getattr(problem, f) for f in SlamProblem.__slots__} | {"measured": measured}
    )
    robust, plain = (smoothed(spoilt, truth, k) for k in (LogKernel(5.0), GaussianKernel()))
    off = [float(np.abs(a.landmarks - truth.landmarks).max()) for a in (robust, plain)]
    assert off[0] < 0.15
    assert off[1] > 3.0 * off[0]
    assert np.median(robust.weights[gross]) < 0.05
    assert np.median(robust.weights[~gross]) > 0.9


def test_a_range_or_a_bearing_alone() -> None:
    """Landmarks that were only heard, or only seen, are placed all the same."""
    problem, truth = small(np.random.default_rng(7))
    measured = problem.measured.copy()
    measured[problem.landmark == 0, 1] = np.nan
    measured[problem.landmark == 1, 0] = np.nan
    partial = SlamProblem(
        **{f: getattr(problem, f) for f in SlamProblem.__slots__} | {"measured": measured}
    )
    found = smoothed(partial, truth, LogKernel(5.0))
    off = np.abs(found.landmarks - truth.landmarks)
    sigma = np.sqrt(np.einsum("lii->li", found.landmark_cov))
    assert np.all(off < 4.0 * sigma)
    whole = smoothed(problem, truth, LogKernel(5.0))
    assert np.trace(found.landmark_cov[0]) > 1.05 * np.trace(whole.landmark_cov[0])


@pytest.mark.slow
@pytest.mark.parametrize("case", ["stated", "R3", "gross30"])
def test_noise_is_found(case: str) -> None:
    """Within 5 % of the observations' sigmas, 20 % of the controls', with a third of them gross."""
    path = path_of(1000)
    runs = simulate(path, Sigmas(), CASES[case], range(70, 71), reach_m=World().most_range_m)
    problem, ids = problem_of_run(path, runs, 0)
    stated = SlamNoise(Sigmas().control, Sigmas().observation)
    first = Values(path.pose.copy(), path.landmarks[ids].copy())
    found = estimate_noise(problem, stated, first, how=NoiseSettings())
    factor = CASES[case].observation_factor
    assert found.is_settled
    assert found.estimate.noise.observation == pytest.approx(
        factor * Sigmas().observation, rel=0.06
    )
    assert found.estimate.noise.control == pytest.approx(Sigmas().control, rel=0.3)
    assert found.sigmas[2].found.value in found.sigmas[2].found


def test_sigmas_of_nothing_are_refused() -> None:
    """Zero, negative and NaN."""
    for bad in (0.0, -1.0, np.nan):
        with pytest.raises(ConfigError, match="expected sigmas above 0"):
            SlamNoise(np.array([0.1, bad]), np.array([0.1, 0.1]))


def test_a_range_that_grows_and_repeats_itself_is_found() -> None:
    """Its law, how alike its errors are, and the sigma of bearings, from a constant guess."""
    rng = np.random.default_rng(3)
    problem, true = small(rng, n_poses=200, noise=FINE)
    every = replace(problem, time_s=0.2 * problem.time_s)
    seen = range_bearing(true.pose[every.keyframe], true.landmarks[every.landmark])
    errors = rng.standard_normal(seen.shape)
    for i in range(4, len(errors)):  # the landmark's sighting before this one
        errors[i, 0] = 0.7 * errors[i - 4, 0] + np.sqrt(1.0 - 0.7**2) * errors[i, 0]
    sigma = np.hypot(0.03, 0.05 * seen[:, 0])
    every = replace(
        every, measured=seen + errors * np.column_stack([sigma, np.full_like(sigma, 0.01)])
    )
    guess = SlamNoise(FINE.control, np.array([0.1, 0.02]))
    found = learn_observations(every, guess, true)
    of_range, bearing = found.sigmas
    middle = np.median(seen[:, 0])
    assert of_range.found.value == pytest.approx(np.hypot(0.03, 0.05 * middle), rel=0.15)
    assert bearing.found.value == pytest.approx(0.01, rel=0.1)  # 1 / sqrt(2 n) is 3.5 percent
    used = found.estimate.noise.observation[0] * found.problem.scales[:, 0]
    far, near = used[seen[:, 0] > 6.0].mean(), used[seen[:, 0] < 2.5].mean()
    assert far > 1.8 * near
    ratio = (used / sigma)[seen[:, 0] > 2.0]  # the part of no distance, from few, is hardly known
    assert ratio == pytest.approx(np.sqrt(1.7 / 0.3), rel=0.2)
    assert "successive errors of ranges" in found.notes[0]


def test_white_noise_of_three_times_the_stated_size_comes_back() -> None:
    """Within 5 percent: soft weights alone would leave it 12 percent too small."""
    stated = SlamNoise(FINE.control, NOISE.observation / 3.0)
    problem, true = small(np.random.default_rng(5), n_poses=200, noise=FINE)
    found = learn_observations(problem, stated, true)
    seen = range_bearing(true.pose[problem.keyframe], true.landmarks[problem.landmark])
    drawn = np.sqrt(np.mean(np.square(problem.measured - seen), axis=0))
    assert [one.found.value for one in found.sigmas] == pytest.approx(drawn, rel=0.05)


def test_too_few_observations_teach_nothing() -> None:
    """They keep what was stated, and that is said."""
    problem, true = small(np.random.default_rng(1), n_poses=6)
    found = learn_observations(problem, NOISE, true)
    assert found.sigmas == ()
    assert "too few to learn from" in found.notes[0]
    assert found.estimate.noise.observation == pytest.approx(NOISE.observation)
