"""Errors that every instrument has and that are nobody's fault: eliminated before anything is judged.

*Of the inertial data* over the whole mission: scale factors, misalignments and sensitivity of the
gyros to force, 3 x 3 numbers each; and biases that wander for minutes. *Of beams and depth*: half of
the noise correlated over seconds, as bottom tracking and waves make it. With white noise alone all
of these pass for faults.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.evidence import Columns
from ssm_graph.imu.increments import MergedSamples
from ssm_graph.mission.problem import Problem
from ssm_graph.smoothers.faults.columns import BEAM, IMU, Channels, Linear

SLOW_BEAM = (0.7, 20.0)
"""Sigmas of a beam, and s, of the part of its noise that is correlated."""
SLOW_AIDS = {"depth": (0.5, 20.0)}
"""The same of aids, by name."""
SLOW_BIAS = (0.3, 300.0)
"""Turn-on sigmas of the biases, and s."""
SCALE_OF_BIAS = 0.02
"""Scale factors and misalignments of the IMU: an accelerometer's error by 1 g is this many... """


class Nuisances:
    """Those of one linearised mission."""

    def __init__(self, linear: Linear, channels: Channels) -> None:
        self._linear, self._channels = linear, channels
        self.shared = self._shared()
        """Columns over the whole mission, their prior information, and its score"""

    def of_blocks(self, middle_s: Array) -> tuple[NDArray[np.intp], Array]:
        """Return which columns of N blocks wander, and the information of their priors."""
        width, columns, precisions = self._channels.width, [], []
        apart_s = np.abs(middle_s[:, None] - middle_s[None, :])
        for column, sigma, correlation_s in self._wandering():
            columns.append(np.arange(len(middle_s)) * width + column)
            covariance = np.exp(-apart_s / correlation_s) + 1e-6 * np.eye(len(middle_s))
            precisions.append(np.linalg.inv(covariance) / sigma**2)
        return np.concatenate(columns), block_diag(*precisions)

    def _wandering(self) -> list[tuple[int, float, float]]:
        """Return column, sigma and time of correlation (s) of each."""
        problem, channels = self._linear.problem, self._channels
        found = []
        beams = problem.beams
        for beam in range(beams.n_beams):
            own = beams.beam == beam
            if np.any(own):
                share, correlation_s = SLOW_BEAM
                found.append((channels.of(BEAM).columns.start + beam, share * float(np.median(beams.sigma[own])), correlation_s))
        for aid in self._linear.aids:
            if aid.name in SLOW_AIDS and len(aid):
                share, correlation_s = SLOW_AIDS[aid.name]
                root = aid.root_information
                sigma = problem.depths.sigma if problem.depths is not None and aid.name == "depth" else 1.0 / float(np.median(root[:, 0, 0]))
                for column in range(aid.dim):
                    found.append((channels.of(aid.name).columns.start + column, share * sigma, correlation_s))
        share, correlation_s = SLOW_BIAS
        for i, sigma in enumerate(problem.imu_noise_bias_sigma):
            found.append((channels.of(IMU).columns.start + i, share * float(sigma), correlation_s))
        return found

    def _shared(self) -> tuple[Columns, Array, Array]:
        linear, problem = self._linear, self._linear.problem
        extras = problem.extras
        own_sigma = extras.sigma[extras.n_walks :]
        of_imu = _imu_columns(linear, self._channels)
        sigma = _imu_sigmas(problem)
        between = np.zeros((*linear.between.missed.shape, len(sigma)))
        between[:, :STATE_DIM] = of_imu * sigma
        columns = Columns(
            np.hstack([linear.constants.own, np.zeros((len(linear.own.missed), len(sigma)))]),
            np.concatenate([linear.constants.between, between], axis=2),
        )
        prior = np.diag(np.concatenate([1.0 / own_sigma**2, np.ones(len(sigma))]))
        score = np.concatenate([-linear.states.constants[: len(own_sigma)] / own_sigma**2, np.zeros(len(sigma))])
        return columns, prior, score


def _imu_columns(linear: Linear, channels: Channels) -> Array:
    """Return what gyro matrix (9), force matrix (9) and g-sensitivity (9) do (K - 1, 15, 27).

    Each is an error of the readings that is a bias within an interval.
    """
    samples = linear.problem.chain.samples
    bias = linear.states.bias[:-1]
    gyro_b = _means(samples, samples.gyro_b) - bias[:, 3:]
    force_b = _means(samples, samples.accel_b) - bias[:, :3]
    by_force, by_rate = channels.between[:, :, :3], channels.between[:, :, 3:]
    made = [
        (by[:, :, :, None] * of[:, None, None, :]).reshape(*by.shape[:2], 9)
        for by, of in ((by_rate, gyro_b), (by_force, force_b), (by_rate, force_b))
    ]
    return np.concatenate(made, axis=2)


def _means(samples: MergedSamples, values: Array) -> Array:
    """Return the means (K - 1, 3) over each interval."""
    total = np.add.reduceat(values * samples.dt[:, None], samples.first[:-1], axis=0)
    return np.asarray(total / np.add.reduceat(samples.dt, samples.first[:-1])[:, None])


def _imu_sigmas(problem: Problem) -> Array:
    """Return prior sigmas (27,) by the grade that the biases tell of."""
    accel, gyro = problem.imu_noise_bias_sigma[0], problem.imu_noise_bias_sigma[3]
    # Data sheets: scale and misalignment go with the turn-on bias, roughly as its root.
    of_gyro = 1e-4 * np.sqrt(gyro / 5e-8)
    of_force = 2e-4 * np.sqrt(accel / 5e-4)
    by_force = 0.3 * gyro / 9.8
    return np.repeat([of_gyro, of_force, by_force], 9)
