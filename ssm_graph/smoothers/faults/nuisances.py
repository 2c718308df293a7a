"""Errors that every instrument has and that are nobody's fault, eliminated before all else.

*Of the inertial data* over the whole mission: scale factors, misalignments and sensitivity of the
gyros to force, 3 x 3 numbers each; and biases that wander for minutes. *Of beams and aids*: a part
of the noise correlated over seconds, as bottom tracking, waves and multipath make it. With white
noise alone all of these pass for faults. How wide they are the data say.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.evidence import Columns, Evidence, root_of
from ssm_graph.graph.aids.depth import DEPTH_DRIFT, DepthMeans
from ssm_graph.graph.aids.gnss import GNSS_DRIFT
from ssm_graph.imu.increments import MergedSamples
from ssm_graph.mission.calibration import DVL_DRIFT
from ssm_graph.mission.imu_variables import imu_columns
from ssm_graph.mission.problem import Problem
from ssm_graph.smoothers.faults.columns import BEAM, IMU, Channels, Linear

SLOW_BEAM = (0.7, 20.0)
"""Sigmas of a beam, and s, of the part of its noise that is correlated."""
SLOW_AIDS = {"depth": (0.5, 20.0)}
SLOW_AID = (0.5, 100.0)
"""The same of aids, by name, and of all others: swell at a pressure port, multipath of fixes."""
SLOW_BIAS = (0.6, 200.0)
"""Turn-on sigmas of the biases, and s."""

CLEARLY = 3.0
"""Logarithm of the likelihood by which narrower ones have to be better: a ratio of 20."""


DVL, ACCELEROMETERS, GYROS, ERRORS = "DVL", "accelerometers", "gyros", "errors of the IMU"
BEAMS_GROUP, AIDS_GROUP, IMU_GROUP = range(3)
WIDTHS = (0.5, 1.0)
"""Of what the sizes above say, how much there may be; the data choose."""
WIDER = (0.5, 1.0, 2.0, 4.0)
"""The same once faults are freed, which otherwise pass for noise."""


class Slow(NamedTuple):
    """What an instrument errs in slowly."""

    name: str
    sigma: float
    """SI"""
    correlation_s: float
    share: float = 0.0
    """Sigma by that of a reading, which is white otherwise"""
    spacing_s: float = np.inf
    """Of the readings"""

    def times(self, scale: float) -> Slow:
        """Return the same of another size."""
        return self._replace(sigma=scale * self.sigma, share=scale * self.share)

    @property
    def walk(self) -> float:
        """Random walk that goes as far within the time of correlation, SI/sqrt(s)."""
        return float(self.sigma * np.sqrt(2.0 / self.correlation_s))

    @property
    def inflation(self) -> float:
        """By how much larger the variance of a mean of many readings is than white noise says."""
        alike = max(2.0 * self.correlation_s / self.spacing_s - 1.0, 0.0)
        return 1.0 + self.share**2 * alike


class Nuisances:
    """Those of one linearised mission."""

    def __init__(self, linear: Linear, channels: Channels) -> None:
        self._linear, self._channels = linear, channels
        self.imu_columns = _imu_columns(linear, channels)
        """(K - 1, 15, 27) what errors of the inertial sensors do to whitened rows"""
        self.imu_sigma = _imu_sigmas(linear.problem)
        """(27,) of data sheets of the grade"""
        self.shared, self._is_own, self._own_score = self._shared()
        """Columns over the whole mission, of unit prior variance"""
        self._wandering = self._wander()

    def groups(self, n_coarse: int) -> dict[str, NDArray[np.intp]]:
        """Return which of the nuisances of so many coarse blocks belong to which instrument.

        Those of the whole mission that are not stated are :data:`ERRORS`.
        """
        names = [name for name, *_ in self._wandering]
        of_block = np.repeat(names, n_coarse)
        found = {name: np.flatnonzero(of_block == name) for name in dict.fromkeys(names)}
        return found | {ERRORS: len(of_block) + np.flatnonzero(~self._is_own)}

    @property
    def stated(self) -> frozenset[str]:
        """Of which instruments the mission states what they err in slowly."""
        problem = self._linear.problem
        extras, noise = problem.extras, problem.chain.noise
        is_stated = {
            DVL: DVL_DRIFT in extras,
            "GNSS": GNSS_DRIFT in extras,
            "depth": DEPTH_DRIFT in extras,
            ACCELEROMETERS: noise.accel_bias_instability > 0.0,
            GYROS: noise.gyro_bias_instability > 0.0,
            ERRORS: len(imu_columns(extras)) > 0,
        }
        return frozenset(name for name, stated in is_stated.items() if stated)

    def slow(self, name: str) -> Slow:
        """Return what an instrument errs in slowly, at its widest."""
        problem, channels = self._linear.problem, self._channels
        sigma, correlation_s = next((s, t) for own, _, s, t, _ in self._wandering if own == name)
        if name in (ACCELEROMETERS, GYROS):
            return Slow(name, sigma, correlation_s)
        if name == DVL:
            share, keyframe = SLOW_BEAM[0], np.unique(problem.beams.keyframe)
            D = channels.beams_d
            if np.linalg.matrix_rank(D) == 3:  # of a velocity along each axis of the instrument
                sigma *= float(np.sqrt(np.trace(np.linalg.inv(D.T @ D)) / 3.0))
        else:
            share, keyframe = SLOW_AIDS.get(name, SLOW_AID)[0], channels.aid_keyframe[name]
        time_s = problem.keyframe_s[keyframe]
        spacing_s = float(np.ptp(time_s)) / max(len(time_s) - 1, 1)
        return Slow(name, sigma, correlation_s, share, spacing_s)

    @property
    def score(self) -> Array:
        """What the priors of the shared columns (C,) say of their sizes."""
        return self._own_score

    def priors(self, coarse: NDArray[np.intp], middle_s: Array) -> Priors:
        """Return the nuisances of G coarse blocks, and their priors.

        Parameters
        ----------
        coarse : (G,) the first of the blocks in each.
        middle_s : (G,) s
        """
        apart_s = np.abs(middle_s[:, None] - middle_s[None, :])
        of_time: dict[float, Array] = {}
        columns, parts = [], []
        for _, column, sigma, correlation_s, group in self._wandering:
            if correlation_s not in of_time:
                covariance = np.exp(-apart_s / correlation_s) + 1e-6 * np.eye(len(middle_s))
                of_time[correlation_s] = np.asarray(np.linalg.inv(covariance))
            columns.append(column)
            parts.append((of_time[correlation_s] / sigma**2, group))
        return Priors(coarse, np.array(columns), parts, self._is_own)

    def _wander(self) -> list[tuple[str, int, float, float, int]]:
        """Return instrument, column, sigma, time of correlation (s) and group of each."""
        problem, channels, beams = self._linear.problem, self._channels, self._linear.problem.beams
        found = []
        for beam in np.unique(beams.beam).tolist():
            share, correlation_s = SLOW_BEAM
            sigma = share * float(np.median(beams.sigma[beams.beam == beam]))
            found.append(
                (DVL, channels.of(BEAM).columns.start + beam, sigma, correlation_s, BEAMS_GROUP)
            )
        for aid in self._linear.aids:
            if len(aid) == 0:
                continue
            share, correlation_s = SLOW_AIDS.get(aid.name, SLOW_AID)
            roots = np.diagonal(aid.root_information, axis1=1, axis2=2)
            first = channels.of(aid.name).columns.start
            for i, root in enumerate(np.median(roots, axis=0).tolist()):
                # A depth is the mean of some readings, whose slow part it has in full.
                sigma = aid.sigma if isinstance(aid, DepthMeans) else 1.0 / root
                found.append((aid.name, first + i, share * sigma, correlation_s, AIDS_GROUP))
        share, correlation_s = SLOW_BIAS
        first = channels.of(IMU).columns.start
        for i, sigma in enumerate(problem.imu_noise_bias_sigma.tolist()):
            name = ACCELEROMETERS if i < 3 else GYROS
            found.append((name, first + i, share * sigma, correlation_s, IMU_GROUP))
        return found

    def _shared(self) -> tuple[Columns, NDArray[np.bool_], Array]:
        """Return columns of unit prior variance, which are the problem's own, and its score."""
        linear, problem = self._linear, self._linear.problem
        own_sigma = problem.extras.sigma[problem.extras.n_walks :]
        sigma = self.imu_sigma
        between = np.zeros((*linear.between.missed.shape, len(sigma)))
        between[:, :STATE_DIM] = self.imu_columns * sigma
        columns = Columns(
            np.hstack(
                [linear.constants.own * own_sigma, np.zeros((len(linear.own.missed), len(sigma)))]
            ),
            np.concatenate([linear.constants.between * own_sigma, between], axis=2),
        )
        is_own = np.arange(len(own_sigma) + len(sigma)) < len(own_sigma)
        score = np.zeros(len(is_own))
        score[is_own] = -linear.states.constants[: len(own_sigma)] / own_sigma
        return columns, is_own, score


class Priors:
    """Information of the nuisances' priors, for any widths of their groups."""

    def __init__(
        self,
        coarse: NDArray[np.intp],
        columns: NDArray[np.intp],
        parts: list[tuple[Array, int]],
        is_own: NDArray[np.bool_],
    ) -> None:
        self._coarse, self._columns, self._parts, self._is_own = coarse, columns, parts, is_own

    def crossed(self, evidence: Evidence, width: int) -> Evidence:
        """Return scores (m,) of the nuisances, and their information (m, C) with all columns."""
        n_shared = len(self._is_own)
        n = len(evidence.score) - n_shared

        def summed(rows: Array) -> Array:
            own = rows[:n].reshape(n // width, width, -1).swapaxes(0, 1)[self._columns]
            if len(self._coarse) < n // width:
                own = np.add.reduceat(own, self._coarse, axis=1)
            return np.concatenate([own.reshape(-1, rows.shape[1]), rows[n:]])

        return Evidence(summed(evidence.score[:, None])[:, 0], summed(evidence.information))

    def among(self, crossed: Evidence, width: int) -> Array:
        """Return the information (m, m) of the nuisances among themselves."""
        by_columns = np.ascontiguousarray(crossed.information.T)
        turned = Evidence(np.zeros(len(by_columns)), by_columns)
        return self.crossed(turned, width).information

    def information(self, widths: tuple[float, ...]) -> Array:
        """Return it (m, m) for the widths of beams, aids and inertial data."""
        shared = np.where(self._is_own, 1.0, widths[IMU_GROUP] ** -2)
        parts = (part / widths[g] ** 2 for part, g in self._parts)
        return np.asarray(block_diag(*parts, np.diag(shared)))

    def width(self, widths: tuple[float, ...]) -> Array:
        """Return how wide each is (m,), by what it is at its widest."""
        shared = np.where(self._is_own, 1.0, widths[IMU_GROUP])
        each = [np.full(len(part), widths[group]) for part, group in self._parts]
        return np.concatenate([*each, shared])

    def log_det(self, widths: tuple[float, ...]) -> float:
        """Return the logarithm of its determinant, but for what no width changes."""
        counts = np.zeros(3)
        for part, group in self._parts:
            counts[group] += len(part)
        counts[IMU_GROUP] += np.sum(~self._is_own)
        return float(-2.0 * np.sum(counts * np.log(widths)))

    def fitted(
        self, score: Array, among: Array, *, choices: tuple[float, ...]
    ) -> tuple[float, ...]:
        """Return the widths that make the data likeliest, one group after the other.

        Of several that are as likely the widest are taken. ``score`` (m,) and ``among`` (m, m) are
        what the data say of the nuisances.
        """
        known: dict[tuple[float, ...], float] = {}

        def likelihood(widths: tuple[float, ...]) -> float:
            if widths not in known:
                root = root_of(among + self.information(widths))
                half = solve_triangular(root, score, lower=True, check_finite=False)
                spread = 2.0 * float(np.sum(np.log(np.diagonal(root))))
                known[widths] = 0.5 * (float(half @ half) - spread + self.log_det(widths))
            return known[widths]

        widths: tuple[float, ...] = (1.0, 1.0, 1.0)
        for group in (IMU_GROUP, BEAMS_GROUP, AIDS_GROUP):
            tried = [(*widths[:group], one, *widths[group + 1 :]) for one in choices]
            likeliest = max(likelihood(one) for one in tried)
            widths = max(one for one in tried if likelihood(one) > likeliest - CLEARLY)
        return widths


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
