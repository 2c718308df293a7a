"""A magnetometer on a vehicle of iron; off unless it is asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.sensors.magnetometer import EarthField, MagneticErrors, MagnetometerLog
from ssm_graph.simulation import checked
from ssm_graph.simulation.aids import GrossErrors, Mask, gross_errors, regular_times
from ssm_graph.simulation.randomness import Streams, gauss_markov
from ssm_graph.simulation.trajectory import Trajectory

NORTH_ATLANTIC = EarthField(math.radians(-2.0), math.radians(65.0), 49.5e-6)
"""About that of the British Isles in 2025."""


@dataclass(frozen=True, slots=True)
class MagnetometerSettings(checked.Settings):
    """A magnetometer; field and iron are off what the mission states as its sigmas say."""

    rate_hz: float = checked.positive(5.0, hint="try 5 Hz")
    sigma: float = checked.positive(0.3e-6, hint="try 3e-7 T")
    """Of each axis, T."""
    earth: EarthField = NORTH_ATLANTIC
    """As the mission states it."""
    errors: MagneticErrors = MagneticErrors()
    gross: GrossErrors = GrossErrors(size=(5e-6, 50e-6))
    """Iron near by, T."""
    gross_s: float = checked.positive(3.0, hint="try 3 s")
    """It is passed in so long, s."""

    def read(
        self, trajectory: Trajectory, *, end_s: float, streams: Streams, noisy: bool
    ) -> tuple[MagnetometerLog, Mask]:
        """Return the readings over ``(0, end_s]``, and which are taken near iron."""
        rng, errors = streams.of("magnetometer"), self.errors
        time_s = regular_times(self.rate_hz, end_s)
        field_off, hard_b = rng.standard_normal((2, 3))
        xx, yy, zz, xy, xz, yz = float(noisy) * errors.soft_iron_sigma * rng.standard_normal(6)
        soft = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        steps, noise = rng.standard_normal((2, len(time_s), 3))
        field_enu = self.earth.enu + float(noisy) * errors.field_sigma * field_off
        true_b = _in_the_body(trajectory, time_s, field_enu)
        read_b = true_b + true_b @ soft + float(noisy) * errors.hard_iron_sigma * hard_b
        if noisy:
            walk = gauss_markov(steps, time_s, errors.correlation_s)
            read_b = read_b + self.sigma * noise + errors.walk_sigma * walk
        n_events = math.ceil(end_s / self.gross_s)
        event = np.minimum((time_s / self.gross_s).astype(int), n_events - 1)
        size, is_gross = gross_errors(self.gross, n_events, rng=rng)
        towards = rng.standard_normal((n_events, 3))
        towards *= (size / np.linalg.norm(towards, axis=1))[:, None]
        log = MagnetometerLog(
            sigma=self.sigma,
            earth=self.earth,
            time_s=time_s,
            field_b=read_b + towards[event],
            errors=errors,
        )
        return log, is_gross[event]


def _in_the_body(trajectory: Trajectory, time_s: Array, field_enu: Array) -> Array:
    """Return a field (3,) along east, north, up as the body (N, 3) turns in it."""
    from scipy.spatial.transform import Rotation

    roll, pitch, heading = trajectory.truth(time_s).roll_pitch_heading.T
    body = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll]))  # of local NED
    east, north, up = field_enu
    return np.asarray(body.inv().apply(np.array([north, east, -up])))
