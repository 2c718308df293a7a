"""Random numbers: a stream for every source of error, and errors that change slowly.

Changing one setting leaves every other source as it was, so that two missions of the same seed
differ only in what was changed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.sensors.drift import Drift
from ssm_graph.simulation import checked


@dataclass(frozen=True, slots=True)
class Streams:
    """One generator per source, which keeps its meaning; new sources go by their name."""

    seed: int
    gyro_bias: np.random.Generator
    gyro_noise: np.random.Generator
    gyro_walk: np.random.Generator
    accel_bias: np.random.Generator
    accel_noise: np.random.Generator
    accel_walk: np.random.Generator
    initial: np.random.Generator
    ping_time: np.random.Generator
    beam_noise: np.random.Generator
    outliers: np.random.Generator
    dropouts: np.random.Generator
    depth: np.random.Generator
    gnss: np.random.Generator
    usbl: np.random.Generator
    ranges: np.random.Generator
    heading: np.random.Generator
    current: np.random.Generator
    dvl_drift: np.random.Generator
    gnss_drift: np.random.Generator

    def of(self, source: str) -> np.random.Generator:
        """Return the stream of a source that goes by its name, from its begin."""
        return np.random.default_rng([self.seed, *source.encode()])


def spawn_streams(seed: int) -> Streams:
    """Return the streams of one seed."""
    children = np.random.SeedSequence(seed).spawn(len(fields(Streams)) - 1)
    return Streams(seed, *(np.random.default_rng(child) for child in children))


@dataclass(frozen=True, slots=True)
class DriftSettings(checked.Settings):
    """How large an error is that changes slowly, and how slowly."""

    sigma: float = checked.not_negative(hint="try 0.006 m/s or 0.5 m")
    """Standard deviation at any time, of each component."""
    correlation_s: float = checked.positive(hint="try 60 s")
    """Time after which 1/e of it is left in the mean, s."""


@dataclass(frozen=True, slots=True)
class SlowPart(checked.Settings):
    """The part of an instrument's noise that changes slowly, as a Gauss-Markov process does."""

    share: float = checked.fraction(hint="write an eighth as 0.125")
    """Of the variance, which stays what it is."""
    correlation_s: float = checked.positive(hint="try 20 s")
    """Time after which 1/e of it is left in the mean, s."""

    def drift(self, sigma: float) -> Drift:
        """Return what a mission states of it, beside noise of so much."""
        white = math.sqrt(1.0 - self.share)
        return Drift(math.sqrt(self.share) * sigma, self.correlation_s, white)


def with_slow_part(
    unit: Array, time_s: Array, slow: SlowPart | None, rng: np.random.Generator
) -> Array:
    """Return white noise of variance 1, (N, d), with a part of it slow; None leaves it white."""
    if slow is None:
        return unit
    process = gauss_markov(rng.standard_normal(unit.shape), time_s, slow.correlation_s)
    return np.asarray(np.sqrt(1.0 - slow.share) * unit + np.sqrt(slow.share) * process)


def draw_drift(settings: DriftSettings, time_s: Array, rng: np.random.Generator) -> Array:
    """Return three independent components (N, 3) at increasing times (N,)."""
    unit = rng.standard_normal((len(time_s), 3))
    return settings.sigma * gauss_markov(unit, time_s, settings.correlation_s)


def gauss_markov(unit: Array, time_s: Array, correlation_s: float) -> Array:
    """Return processes of variance 1, (N, d), at increasing times (N,).

    ``unit`` (N, d) are the standard normal numbers that drive them.
    """
    kept = np.exp(-np.diff(time_s) / correlation_s)
    fresh = np.sqrt(1.0 - kept**2)[:, None] * unit[1:]
    process = unit.copy()
    for k in range(len(kept)):
        process[k + 1] = kept[k] * process[k] + fresh[k]
    return process


def regular_gauss_markov(unit: Array, step_s: float, correlation_s: float) -> Array:
    """Return the same as :func:`gauss_markov` at regular times, to rounding, but fast."""
    from scipy.signal import lfilter

    kept = np.exp(-step_s / correlation_s)
    drive = np.sqrt(1.0 - kept**2) * unit
    drive[:1] = unit[:1]
    return np.asarray(lfilter([1.0], [1.0, -kept], drive, axis=0))
