"""Noise that a filter learns on its way: laws by which R and Q follow innovations and residuals.

With the innovation ``d = z - h(x-)``, the residual ``e = z - h(x+)`` and ``H P H'`` before and
after the update, an optimal filter has ``E[d d'] = H P- H' + R`` and ``E[e e'] = R - H P+ H'``.
Noise of the control is scaled as a whole; that of observations is one covariance for all of a kind.
Every law follows B runs at once.

References
----------
.. [1] A. H. Mohamed, K. P. Schwarz, "Adaptive Kalman Filtering for INS/GPS", Journal of Geodesy 73,
   1999.
.. [2] W. Ding, J. Wang, C. Rizos, D. Kinlyside, "Improving Adaptive Kalman Estimation in GPS/INS
   Integration", Journal of Navigation 60, 2007.
.. [3] Z. Wang, S. Qin, Y. Liang, "Adaptive UKF-SLAM Algorithm Based on Noise Scaling", Computer
   Engineering 40(10), 2014: equations (9) to (16).
.. [4] A. P. Sage, G. W. Husa, "Adaptive Filtering with Unknown Prior Statistics", Joint Automatic
   Control Conference, 1969.
.. [5] S. Särkkä, A. Nummenmaa, "Recursive Noise Adaptive Kalman Filtering by Variational Bayesian
   Approximations", IEEE Transactions on Automatic Control 54, 2009.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple, final

import numpy as np

from ssm_graph.base import chi2
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array

LEAST_WINDOW: Final = 2
"""Steps; of one alone there is no covariance."""


class Evidence(NamedTuple):
    """What an update says of the noise: m observations of dimension d in each of B runs."""

    innovation: Array
    """(B, m, d)"""
    residual: Array
    """(B, m, d)"""
    before: Array
    """(B, m, d, d) ``H P- H'`` of each observation."""
    after: Array
    """(B, m, d, d) ``H P+ H'``"""
    weights: Array
    """(B, m) of each, zero where it was left out."""
    nis: Array
    """(B,) of all that were used together."""
    dof: Array
    """(B,) their number of rows."""


class Noise:
    """Covariances that the next step takes; a law changes them."""

    def __init__(self, control_sigma: Array, observation_sigma: Array, n_runs: int) -> None:
        """Begin at the stated sigmas, (q,) of the control and (d,) of an observation."""
        self.stated_control = np.diag(np.square(control_sigma))
        self.stated_observation = np.diag(np.square(observation_sigma))
        self.control = np.repeat(self.stated_control[None], n_runs, axis=0)
        """(B, q, q)"""
        self.observation = np.repeat(self.stated_observation[None], n_runs, axis=0)
        """(B, d, d)"""
        self.mean = np.zeros((n_runs, len(observation_sigma)))
        """(B, d) of the observations' noise."""

    def take(self, found: Evidence) -> None:
        """Learn from an update; stated noise learns nothing."""

    def revised(self, found: Evidence) -> Array | None:
        """Return the (B, d, d) with which the same update is made once more; None for none."""
        del found
        return None


class NoiseLaw(ABC):
    """How noise is learnt; what it has learnt is a `Noise` of its own."""

    @abstractmethod
    def begin(self, control_sigma: Array, observation_sigma: Array, n_runs: int) -> Noise:
        """Return the noise of runs that begin."""


@final
@dataclass(frozen=True, slots=True)
class StatedNoise(NoiseLaw):
    """Noise is what was stated."""

    def begin(self, control_sigma: Array, observation_sigma: Array, n_runs: int) -> Noise:  # noqa: D102
        return Noise(control_sigma, observation_sigma, n_runs)


class _Sums(NamedTuple):
    """Of one step, over its observations: B runs."""

    number: Array
    residual: Array
    residual_sq: Array
    innovation_sq: Array
    before: Array
    after: Array
    nis: Array
    dof: Array


def _sums(found: Evidence) -> _Sums:
    w = found.weights
    return _Sums(
        w.sum(axis=1),
        np.einsum("bm,bmi->bi", w, found.residual),
        np.einsum("bm,bmi,bmj->bij", w, found.residual, found.residual),
        np.einsum("bm,bmi,bmj->bij", w, found.innovation, found.innovation),
        np.einsum("bm,bmij->bij", w, found.before),
        np.einsum("bm,bmij->bij", w, found.after),
        found.nis,
        found.dof,
    )


class _Windowed(Noise):
    """Sums over the last steps that saw anything."""

    def __init__(self, window: int, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        if window < LEAST_WINDOW:
            raise ConfigError(
                f"window: expected {LEAST_WINDOW} steps or more, got {window}; without a window "
                "noise cannot be learnt: state it, or try 200"
            )
        self._steps: deque[_Sums] = deque(maxlen=window)
        self._total: list[Array] = []

    def _push(self, found: Evidence) -> bool:
        """Take a step; return whether the window is full."""
        new = _sums(found)
        if not self._total:
            self._total = [np.array(x) for x in new]
        elif len(self._steps) == self._steps.maxlen:
            gone = self._steps[0]
            self._total = [t + n - o for t, n, o in zip(self._total, new, gone, strict=True)]
        else:
            self._total = [t + n for t, n in zip(self._total, new, strict=True)]
        self._steps.append(new)
        return len(self._steps) == self._steps.maxlen

    @property
    def _window(self) -> _Sums:
        return _Sums(*self._total)


@final
@dataclass(frozen=True, slots=True)
class LiteralScaling(NoiseLaw):
    """Equations (9) to (16) of [3]_, of which the window is not told.

    ``R(k)`` is the covariance of the residuals in the window plus ``H P+ H'`` of the step; ``Q`` is
    multiplied by ``sqrt(beta)`` at every step, ``beta = tr(C_d - R) / tr(H P- H')``. Observations
    of all landmarks are pooled. Where ``beta`` is not positive ``Q`` stays; before the window is
    full all stays.
    """

    window: int = 30
    """Steps; 20 to 50 are usual."""
    scales_q: bool = True
    """False leaves Q as stated and learns R alone."""

    def begin(self, control_sigma: Array, observation_sigma: Array, n_runs: int) -> Noise:  # noqa: D102
        return _Literal(self, control_sigma, observation_sigma, n_runs)


class _Literal(_Windowed):
    def __init__(self, law: LiteralScaling, *arguments: object) -> None:
        super().__init__(law.window, *arguments)
        self._law = law

    def take(self, found: Evidence) -> None:
        if not self._push(found):
            return
        total, now = self._window, self._steps[-1]
        n = np.maximum(total.number, 1.0)[:, None, None]
        mean = total.residual / n[..., 0]
        spread = total.residual_sq / n - mean[:, :, None] * mean[:, None, :]  # eq. (10)
        n_now = np.maximum(now.number, 1.0)[:, None, None]
        is_known = (total.number >= LEAST_WINDOW) & (now.number > 0)
        observation = spread + now.after / n_now  # eq. (11)
        self.observation = np.where(is_known[:, None, None], observation, self.observation)
        if not self._law.scales_q:
            return
        matched = _trace(total.innovation_sq / n - self.observation)  # eq. (12)
        beta = matched / np.maximum(_trace(now.before / n_now), 1e-300)  # eq. (15)
        scale = np.sqrt(np.where(is_known & (beta > 0.0), beta, 1.0))
        self.control = self.control * scale[:, None, None]  # eq. (16)


@final
@dataclass(frozen=True, slots=True)
class GuardedScaling(NoiseLaw):
    """The same idea with a prior, limits, and no move without evidence.

    ``R`` is the mean of ``e e' + H P+ H'`` over the window, with the stated one as so many
    observations. ``Q`` moves only while the window's NIS lies outside its band, by a factor
    ``beta = tr(R^-1 (C_d - R)) / tr(R^-1 H P- H')`` to the power of one over the window, within
    limits; units do not mix.
    """

    window: int = 200
    prior_count: float = 50.0
    """Observations that the stated noise is worth."""
    band: float = 0.999
    """Of the windowed NIS in which Q stays."""
    step: tuple[float, float] = (0.8, 1.25)
    """Of the factor on the variances in ``Q`` in one step."""
    limits: tuple[float, float] = (1e-2, 4e2)
    """Of a variance to the stated one."""

    def begin(self, control_sigma: Array, observation_sigma: Array, n_runs: int) -> Noise:  # noqa: D102
        return _Guarded(self, control_sigma, observation_sigma, n_runs)


class _Guarded(_Windowed):
    def __init__(self, law: GuardedScaling, *arguments: object) -> None:
        super().__init__(law.window, *arguments)
        self._law = law
        self._scale = np.ones(len(self.control))

    def take(self, found: Evidence) -> None:
        law, is_full = self._law, self._push(found)
        total = self._window
        prior, n = law.prior_count, total.number[:, None, None]
        observation = (prior * self.stated_observation + total.residual_sq + total.after) / (
            prior + n
        )
        low, high = (limit * np.diag(self.stated_observation) for limit in law.limits)
        own = np.einsum("bii->bi", observation)
        within = np.sqrt(np.clip(own, low, high) / own)
        self.observation = observation * within[:, :, None] * within[:, None, :]
        if not is_full:
            return
        tail = 0.5 * (1.0 - law.band)
        dof = np.maximum(total.dof, 1.0)
        is_outside = (total.nis < chi2.ppf(tail, dof)) | (total.nis > chi2.ppf(1.0 - tail, dof))
        inverse = np.linalg.inv(self.observation)
        count = np.maximum(n, 1.0)
        matched = _trace(inverse @ (total.innovation_sq / count - self.observation))
        predicted = _trace(inverse @ (total.before / count))
        beta = np.clip(matched / np.maximum(predicted, 1e-300), law.step[0] ** 2, law.step[1] ** 2)
        # What the window saw, it saw with the Q of its whole length: a small step each time.
        scale = self._scale * np.where(is_outside, beta ** (1.0 / law.window), 1.0)
        self._scale = np.clip(scale, *law.limits)
        self.control = self._scale[:, None, None] * self.stated_control


@final
@dataclass(frozen=True, slots=True)
class SageHusa(NoiseLaw):
    """Mean and covariance of the observations' noise with fading memory [4]_.

    ``r = (1 - g) r + g (z - h(x-))``, ``R = (1 - g) R + g (d d' - H P- H')``, of which eigenvalues
    below a hundredth of the stated variance are raised to that.
    """

    memory: int = 500
    """Steps after which old ones count 1/e."""
    learns_mean: bool = True

    def begin(self, control_sigma: Array, observation_sigma: Array, n_runs: int) -> Noise:  # noqa: D102
        return _SageHusa(self, control_sigma, observation_sigma, n_runs)


class _SageHusa(Noise):
    def __init__(self, law: SageHusa, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        if law.memory < LEAST_WINDOW:
            raise ConfigError(
                f"memory: expected {LEAST_WINDOW} steps or more, got {law.memory}; try 500"
            )
        self._law = law

    def take(self, found: Evidence) -> None:
        new = _sums(found)
        n = np.maximum(new.number, 1.0)[:, None, None]
        g = np.where(new.number > 0, 1.0 / self._law.memory, 0.0)[:, None]
        if self._law.learns_mean:
            innovation = np.einsum("bm,bmi->bi", found.weights, found.innovation) / n[..., 0]
            self.mean = self.mean + g * innovation  # the innovation is free of the mean so far
        update = new.innovation_sq / n - new.before / n
        R = self.observation + g[..., None] * (update - self.observation)
        sigma = np.sqrt(np.diag(self.stated_observation))
        unit = R / sigma[:, None] / sigma
        values, vectors = np.linalg.eigh(0.5 * (unit + unit.mT))
        floored = (vectors * np.maximum(values, 0.01)[:, None, :]) @ vectors.mT
        self.observation = floored * sigma[:, None] * sigma


@final
@dataclass(frozen=True, slots=True)
class VariationalBayes(NoiseLaw):
    """Inverse-gamma beliefs of the variances of each component, with the state in turns [5]_."""

    forgetting: float = 0.998
    """By which what was known counts less from step to step."""
    prior_count: float = 50.0
    """Observations that the stated noise is worth at the start."""

    def begin(self, control_sigma: Array, observation_sigma: Array, n_runs: int) -> Noise:  # noqa: D102
        return _Variational(self, control_sigma, observation_sigma, n_runs)


class _Variational(Noise):
    def __init__(self, law: VariationalBayes, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        if not 0.0 < law.forgetting <= 1.0:
            raise ConfigError(
                f"forgetting: expected a number in (0, 1], got {law.forgetting}; try 0.998"
            )
        self._law = law
        stated = np.diag(self.stated_observation)
        self._shape = np.full((len(self.mean), 1), 0.5 * law.prior_count)
        self._scale = self._shape * stated

    def _belief(self, found: Evidence) -> tuple[Array, Array]:
        new, keep = _sums(found), self._law.forgetting
        squares = np.einsum("bii->bi", new.residual_sq + new.after)
        shape = keep * self._shape + 0.5 * new.number[:, None]
        return shape, keep * self._scale + 0.5 * squares

    def revised(self, found: Evidence) -> Array | None:
        shape, scale = self._belief(found)
        return np.asarray((scale / shape)[:, :, None] * np.eye(scale.shape[1]))

    def take(self, found: Evidence) -> None:
        self._shape, self._scale = self._belief(found)
        self.observation = (self._scale / self._shape)[:, :, None] * np.eye(self._scale.shape[1])


def _trace(matrices: Array) -> Array:
    return np.asarray(np.einsum("bii->b", matrices))
