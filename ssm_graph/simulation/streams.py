"""Independent random streams, one per source of error.

Changing one setting leaves every other source as it was, so that two missions of the same seed
differ only in what was changed.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True, slots=True)
class Streams:
    """One generator per source; new ones go to the end, so that old seeds keep their meaning."""

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


def spawn_streams(seed: int) -> Streams:
    """Return the streams of one seed."""
    children = np.random.SeedSequence(seed).spawn(len(fields(Streams)))
    return Streams(*(np.random.default_rng(child) for child in children))
