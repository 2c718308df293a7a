"""The current of the water, and when a DVL tracks the water instead of the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.simulation import checked
from ssm_graph.simulation.randomness import gauss_markov

_STEP_S = 1.0
"""The random part is drawn so often, and linear between."""
_EVERY = checked.Rule(
    lambda n: n == 0 or n >= 2, "0, or 2 and more", "4 makes every fourth ping one off the water"
)


@dataclass(frozen=True, slots=True)
class CurrentSettings(checked.Settings):
    """A current that is the same everywhere: steady, tidal and random parts add up."""

    steady_enu: tuple[float, float, float] = checked.velocity((0.0, 0.0, 0.0))
    """m/s along east, north, up."""
    tide: float = checked.not_negative(0.0, hint="try 0.3 m/s")
    """Speed of a part that turns clockwise with the tide, m/s; where it begins is drawn."""
    tide_period_s: float = checked.positive(44714.0, hint="try 20000 s")
    """s; that of the moon's semidiurnal tide."""
    sigma: float = checked.not_negative(0.0, hint="try 0.3 m/s")
    """Of a Gauss-Markov part along east and along north, m/s."""
    vertical_sigma: float = checked.not_negative(0.0, hint="try 0.3 m/s")
    """Of one along up, m/s."""
    correlation_s: float = checked.positive(21600.0, hint="try 20000 s")
    """Of the Gauss-Markov parts, s."""
    stated: CurrentModel | None = None
    """What the mission says of the current; None for the truth's own variance and correlation."""

    @property
    def model(self) -> CurrentModel:
        """What the mission says of the current."""
        if self.stated is not None:
            return self.stated
        east, north, up = self.steady_enu
        level = math.hypot(self.sigma, math.hypot(east, north, self.tide) / math.sqrt(2.0))
        return CurrentModel(
            sigma=level or CurrentModel().sigma,
            correlation_s=self.correlation_s,
            vertical_sigma=math.hypot(self.vertical_sigma, up),
        )


@dataclass(frozen=True, slots=True)
class WaterTrack(checked.Settings):
    """A DVL that pings off the water where it has no bottom lock."""

    noise: float = checked.positive(0.01, hint="try 0.01 m/s")
    """Standard deviation of a beam speed off the water, m/s."""
    beams: tuple[int, ...] | None = checked.beams(None)
    """Beams from 0 that the water returns; None for all."""
    every: int = checked.field(_EVERY, 0)
    """With bottom lock, each ping of this number is off the water nevertheless; 0 for none."""

    def pings(self, lost: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which pings are off the water, of beams without bottom lock ``lost`` (N, B)."""
        is_water = np.asarray(lost.all(axis=1))
        if self.every:
            is_water[self.every - 1 :: self.every] = True
        return is_water


class Current:
    """The true current of one mission."""

    def __init__(
        self, settings: CurrentSettings | None, *, end_s: float, rng: np.random.Generator
    ) -> None:
        """Draw it from 0 to ``end_s``; there is none without settings."""
        self._settings = own = settings or CurrentSettings()
        self._phase = 2.0 * math.pi * rng.random()
        self._time_s = np.arange(0.0, end_s + 2.0 * _STEP_S, _STEP_S)
        fresh = rng.standard_normal((len(self._time_s), 3))
        sigma = np.array([own.sigma, own.sigma, own.vertical_sigma])
        self._random = sigma * gauss_markov(fresh, self._time_s, own.correlation_s)

    def at(self, time_s: Array) -> Array:
        """Return the current (N, 3) along east, north, up, m/s."""
        settings = self._settings
        turned = self._phase + 2.0 * math.pi * time_s / settings.tide_period_s
        tide = settings.tide * np.column_stack(
            [np.sin(turned), np.cos(turned), np.zeros(len(time_s))]
        )
        random = np.column_stack([np.interp(time_s, self._time_s, c) for c in self._random.T])
        return np.asarray(np.array(settings.steady_enu) + tide + random)
