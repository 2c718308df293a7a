"""A log of odometry and observed landmarks, made here, smoothed, with a third of it spoilt.

Run: python examples/06_landmarks_of_your_own.py
"""

from __future__ import annotations

import numpy as np

from ssm_graph.systems.landmark_slam.filtered import filtered, first_values
from ssm_graph.systems.landmark_slam.noise import estimate_noise
from ssm_graph.systems.landmark_slam.problem import SlamNoise
from ssm_graph.systems.landmark_slam.simulator import CASES, Sigmas, World, simulate
from ssm_graph.systems.landmark_slam.smoother import smooth_landmarks
from ssm_graph.systems.landmark_slam.study import path_of, problem_of_run

N_STEPS = 400


def main() -> None:
    """Smooth one run with stated noise and with noise from the log."""
    path = path_of(N_STEPS)
    runs = simulate(path, Sigmas(), CASES["gross30"], range(1), reach_m=World().most_range_m)
    problem, ids = problem_of_run(path, runs, 0)
    stated = SlamNoise(Sigmas().control, Sigmas().observation)

    online = filtered(problem, stated, "ekf-weighted")
    first = first_values(problem, stated)
    smoothed = smooth_landmarks(problem, stated, first)
    learnt = estimate_noise(problem, stated, first)
    for name, answer in (("filter", online), ("smoother", smoothed), ("learnt", learnt.estimate)):
        error = np.linalg.norm(answer.pose[:, :2] - path.pose[:, :2], axis=1)
        places = np.linalg.norm(answer.landmarks - path.landmarks[ids], axis=1)
        rms = np.sqrt(np.mean(error**2))
        print(f"{name:9} path {rms:.3f} m, landmarks {np.median(places):.3f} m")
    for sigma in learnt.sigmas:
        found = sigma.found
        print(f"{sigma.label:15} {found.value:.4f} ({found.low:.4f} to {found.high:.4f})")


if __name__ == "__main__":
    main()
