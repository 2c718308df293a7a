"""What instruments err in beyond what their mission states, as the data tell it.

Scale factors, misalignments and g-sensitivities of the IMU, of the sizes that data sheets of the
grade have, are freed as a fault is; of biases that wander more than stated the walk is widened, and
readings that err alike for a while count for less in the sigmas. All of it is judged once all
faults are taken off, each kind with the others free, by a chi-square whose mean and spread where
nothing is unstated are known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frames import MATRIX_PLACES
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEG_PER_H, MICRO_G
from ssm_graph.engine.error_state import ACCEL_BIAS, GYRO_BIAS
from ssm_graph.engine.evidence import root_of
from ssm_graph.imu.preintegration import InertialChain
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.sensors.imu import OF_INSTABILITY
from ssm_graph.sensors.imu_calibration import CALIBRATED, UNITS
from ssm_graph.smoothers.faults.nuisances import (
    ACCELEROMETERS,
    DVL,
    ERRORS,
    GYROS,
    Nuisances,
    Slow,
)

DEVIATIONS: Final = 6.0
"""Of the chi-square above its mean where nothing is unstated, to be no chance,"""
USUAL: Final = 2.0
"""and by that mean: low-pass filters and vibration make it 1.9 at MEMS grade,"""
BY_MEAN: Final = {DVL: 4.0}
"""and of beams a stated drift, alike along all axes, leaves as much."""
HINT: Final = 1.5
"""Deviations from which on others are allowed for, too, once one is sure: who states nothing of one
instrument states nothing of the next, but for those of which something is stated;"""
SEEN: Final = 3.0
"""or this mean of their chi-square: without, the data could not show how small they are."""
AS_LIKELY: Final = 2.0
"""Logarithm of the likelihood, two deviations."""
WIDER: Final = 2.0
"""Prior sigma by what data sheets of the grade have."""
BIASES: Final = {
    ACCELEROMETERS: ("accel_bias_instability_ug", MICRO_G),
    GYROS: ("gyro_bias_instability_deg_per_h", DEG_PER_H),
}
DRIFTS: Final = {
    DVL: ("drift_sigma_m_per_s", " m/s"),
    "GNSS": ("drift_sigma_m", " m"),
    "depth": ("drift_sigma_m", " m"),
}
"""Keys of ``mission.toml`` that state what wanders, and units."""
SCALES: Final = np.geomspace(1.0 / 64.0, 2.0, 15)
"""Of the sigma of biases that wander, which may be likeliest."""


@dataclass(frozen=True, slots=True, eq=False)
class Unstated:
    """What is found."""

    slow: tuple[Slow, ...]
    """Errors that change slowly"""
    errors_sigma: Array
    """(27,) of data sheets: gyros, accelerometers, gyros by force, 3 x 3 each; (0,) where the data
    do not ask for them"""
    errors_columns: Array
    """(K - 1, 15, 27 or 0) what they do to the whitened inertial rows"""
    chi_sq: dict[str, tuple[float, float]]
    """What it is and is where nothing is unstated, of each that is more, by name"""

    @property
    def has_wandering_biases(self) -> bool:
        """Whether biases of the inertial data are among it."""
        return any(slow.name in BIASES for slow in self.slow)

    def inflation_of(self, name: str) -> float:
        """Return by how much larger the variance of readings is than white noise says."""
        return next((slow.inflation for slow in self.slow if slow.name == name), 1.0)

    def widened(self, chain: InertialChain) -> InertialChain:
        """Return the chain with biases that walk as much."""
        walks = {slow.name: slow.walk for slow in self.slow}
        accel, gyro = (walks.get(name, 0.0) for name in (ACCELEROMETERS, GYROS))
        walk_sq = np.zeros(15)
        walk_sq[ACCEL_BIAS], walk_sq[GYRO_BIAS] = accel**2, gyro**2
        intervals, noise = chain.intervals, chain.noise
        covariance = intervals.covariance + np.diag(walk_sq) * intervals.span_s[:, None, None]
        root = np.linalg.cholesky(np.linalg.inv(covariance)).mT
        noise = replace(
            noise,
            accel_bias_density=float(np.hypot(noise.accel_bias_density, accel)),
            gyro_bias_density=float(np.hypot(noise.gyro_bias_density, gyro)),
        )
        source = chain.source
        if source is not None:
            source = source._replace(imu=replace(source.imu, noise=noise))
        wider = intervals._replace(covariance=covariance, root_information=root)
        return replace(chain, intervals=wider, noise=noise, source=source)

    def faults(self, sizes: Array, begin_s: float, end_s: float) -> Iterator[DetectedFault]:
        """Yield it as findings, with the sizes (27 or 0,) that the answer gives the errors."""

        def found(sensor: str, names: list[str], what: str, remedy: str) -> DetectedFault:
            chi_sq, dof = np.sum([self.chi_sq[name] for name in names], axis=0).tolist()
            widened = Treatment.WIDENED
            return DetectedFault(
                sensor, what, begin_s, end_s, chi_sq, round(dof), widened, remedy=remedy
            )

        imu, what, lines = [], [], []
        for slow in self.slow:
            if slow.name in BIASES:
                key, unit = BIASES[slow.name]
                imu.append(slow.name)
                what.append(f"biases of the {slow.name} wander")
                lines.append(f"{key} = {slow.walk / OF_INSTABILITY / unit:.2g}")
                continue
            white = np.sqrt(max(1.0 - slow.share**2, 0.1))
            key, shown = DRIFTS.get(slow.name, ("", ""))
            remedy = "state larger sigmas"
            if key:
                remedy = (
                    f"[{slow.name.lower()}] {key} = {slow.sigma:.2g}, "
                    f"drift_correlation_s = {slow.correlation_s:g}, drift_white_share = {white:.2g}"
                )
            chi_sq, mean = self.chi_sq[slow.name]
            errs = "errs" if chi_sq > mean else "may err"
            said = f"{errs} alike for {slow.correlation_s:g} s or so, by {slow.sigma:.2g}{shown}"
            yield found(slow.name, [slow.name], f"{said}, more than mission.toml states", remedy)
        if len(sizes):
            imu.append(ERRORS)
            what.append("scale factors, misalignments and g-sensitivities show")
            own, usual = _kinds(sizes), _kinds(self.errors_sigma)
            for name, numbers in own.items():
                size = max(_rms(numbers), _rms(usual[name])) / UNITS[name][1]
                lines.append(f"{CALIBRATED[name].sigma_key} = {size:.2g}")
        if imu:
            remedy = f"[imu] {', '.join(lines)}, or what its data sheet says"
            yield found("IMU", imu, f"{' and '.join(what)} more than mission.toml states", remedy)


@dataclass(frozen=True, slots=True)
class _Test:
    """Whether some nuisances are larger than by chance, all others being free."""

    chi_sq: float
    mean: float
    deviation: float
    scale: float
    """Of their prior sigma, the largest one that is as likely as any"""

    @classmethod
    def of(cls, own: NDArray[np.intp], score: Array, among: Array, prior: Array) -> _Test:
        """Test those of the indices ``own``; ``prior`` is the information of all (m, m)."""
        rest = np.setdiff1d(np.arange(len(score)), own)
        inner = (among + prior)[np.ix_(rest, rest)]
        crossed = among[np.ix_(rest, own)]
        solved = np.linalg.solve(inner, np.column_stack([crossed, score[rest]]))
        seen = among[np.ix_(own, own)] - crossed.T @ solved[:, :-1]
        left, known = score[own] - crossed.T @ solved[:, -1], prior[np.ix_(own, own)]
        share = np.linalg.solve(seen + known, seen)
        chi_sq = float(left @ np.linalg.solve(seen + known, left))
        mean, spread = float(np.trace(share)), float(np.sqrt(2.0 * np.sum(share * share.T)))
        likely = []
        for scale in SCALES:
            root = root_of(seen + known / scale**2)
            half = np.linalg.solve(root, left)
            size = np.sum(np.log(np.diagonal(root))) + len(own) * np.log(scale)
            likely.append(0.5 * float(half @ half) - float(size))
        widest = np.flatnonzero(np.array(likely) > max(likely) - AS_LIKELY)[-1]
        return cls(chi_sq, mean, spread, float(SCALES[widest]))

    @property
    def deviations(self) -> float:
        """By which the chi-square is above its mean."""
        return (self.chi_sq - self.mean) / max(self.deviation, 1e-9)

    def is_sure(self, by_mean: float) -> bool:
        """Whether they are, as such, with at least so many times its mean."""
        return self.deviations > DEVIATIONS and self.chi_sq > by_mean * self.mean


def unstated_of(
    nuisances: Nuisances, width: Array, score: Array, among: Array, prior: Array, n_coarse: int
) -> Unstated | None:
    """Return what is larger than by chance, None for nothing.

    Parameters
    ----------
    nuisances : of the mission.
    width : (m,) of each by what it is at its widest.
    score, among, prior : (m,), (m, m) and (m, m): what the data say of them, and their priors.
    n_coarse : blocks that each of those that change slowly has.
    """
    groups = nuisances.groups(n_coarse)
    stated = nuisances.stated
    tests = {name: _Test.of(own, score, among, prior) for name, own in groups.items()}
    if not any(test.is_sure(BY_MEAN.get(name, USUAL)) for name, test in tests.items()):
        return None
    more = {
        name: test
        for name, test in tests.items()
        if test.is_sure(BY_MEAN.get(name, USUAL)) or (name not in stated and _hints(name, test))
    }
    known = {name: (test.chi_sq, test.mean) for name, test in more.items()}
    slow = [
        nuisances.slow(name).times(float(width[groups[name][0]]) * test.scale)
        for name, test in more.items()
        if name != ERRORS
    ]
    n = 27 if ERRORS in known else 0
    sigma, columns = nuisances.imu_sigma[:n], nuisances.imu_columns[..., :n]
    return Unstated(tuple(slow), sigma, columns, known)


def _hints(name: str, test: _Test) -> bool:
    return test.deviations > HINT or (test.mean > SEEN and name != ERRORS)


def _kinds(numbers: Array) -> dict[str, Array]:
    """Return the numbers (27,) by the names of the calibrations."""
    gyro, accel, by_force = np.split(numbers, 3)
    return {
        "gyro_scale": gyro[np.array(MATRIX_PLACES[3])],
        "gyro_misalignment": gyro[np.array(MATRIX_PLACES[6])],
        "accel_scale": accel[np.array(MATRIX_PLACES[3])],
        "accel_misalignment": accel[np.array(MATRIX_PLACES[6])],
        "gyro_g_sensitivity": by_force,
    }


def _rms(numbers: Array) -> float:
    return float(np.sqrt(np.mean(numbers**2)))
