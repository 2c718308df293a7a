"""The current of the water, and when a DVL tracks the water instead of the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.dvl import N_BEAMS
from ssm_graph.simulation._checks import (
    require,
    require_beams,
    require_not_negative,
    require_positive,
)
from ssm_graph.simulation.drifts import gauss_markov

_STEP_S = 1.0
"""The random part is drawn so often, and linear between."""


@dataclass(frozen=True, slots=True)
class CurrentSettings:
    """A current that is the same everywhere: steady, tidal and random parts add up."""

    steady_enu: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m/s along east, north, up."""
    tide: float = 0.0
    """Speed of a part that turns clockwise with the tide, m/s; where it begins is drawn."""
    tide_period_s: float = 44714.0
    """s; that of the moon's semidiurnal tide."""
    sigma: float = 0.0
    """Of a Gauss-Markov part along east and along north, m/s."""
    vertical_sigma: float = 0.0
    """Of one along up, m/s."""
    correlation_s: float = 21600.0
    """Of the Gauss-Markov parts, s."""
    stated: CurrentModel | None = None
    """What the mission says of the current; None for the truth's own variance and correlation."""

    def __post_init__(self) -> None:
        require(
            len(self.steady_enu) == 3 and all(math.isfinite(c) for c in self.steady_enu),
            "CurrentSettings.steady_enu",
            expected="three finite numbers, m/s",
            got=self.steady_enu,
            hint="axes are east, north, up",
        )
        for name in ("tide", "sigma", "vertical_sigma"):
            require_not_negative(f"CurrentSettings.{name}", getattr(self, name), hint="try 0.3 m/s")
        for name in ("tide_period_s", "correlation_s"):
            require_positive(f"CurrentSettings.{name}", getattr(self, name), hint="try 20000 s")

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
class WaterTrack:
    """A DVL that pings off the water where it has no bottom lock."""

    noise: float = 0.01
    """Standard deviation of a beam speed off the water, m/s."""
    beams: tuple[int, ...] = (0, 1, 2, 3)
    """Beams from 0 that the water returns."""
    every: int = 0
    """With bottom lock, each ping of this number is off the water nevertheless; 0 for none."""

    def __post_init__(self) -> None:
        require_positive("WaterTrack.noise", self.noise, hint="try 0.01 m/s")
        require_beams("WaterTrack.beams", self.beams, N_BEAMS)
        require(
            self.every == 0 or self.every >= 2,
            "WaterTrack.every",
            expected="0, or 2 and more",
            got=self.every,
            hint="4 makes every fourth ping one off the water",
        )

    def pings(self, lost: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which pings are off the water, of beams without bottom lock ``lost`` (N, 4)."""
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
        self._settings = settings or CurrentSettings()
        self._phase = 2.0 * math.pi * rng.random()
        self._time_s = np.arange(0.0, end_s + 2.0 * _STEP_S, _STEP_S)
        self._random = self._gauss_markov(rng)

    def at(self, time_s: Array) -> Array:
        """Return the current (N, 3) along east, north, up, m/s."""
        settings = self._settings
        turned = self._phase + 2.0 * math.pi * time_s / settings.tide_period_s
        tide = settings.tide * np.column_stack(
            [np.sin(turned), np.cos(turned), np.zeros(len(time_s))]
        )
        random = np.column_stack([np.interp(time_s, self._time_s, c) for c in self._random.T])
        return np.asarray(np.array(settings.steady_enu) + tide + random)

    def _gauss_markov(self, rng: np.random.Generator) -> Array:
        settings = self._settings
        sigma = np.array([settings.sigma, settings.sigma, settings.vertical_sigma])
        fresh = rng.standard_normal((len(self._time_s), 3))
        return np.asarray(sigma * gauss_markov(fresh, self._time_s, settings.correlation_s))
