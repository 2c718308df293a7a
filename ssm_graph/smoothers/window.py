"""The window of a fixed-lag smoother: what the lag leaves behind, and the iteration of the rest."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from factors.inertial import Intervals
from factors.similarity import Kernel, LogKernel, Similarity, expected_mahalanobis_sq
from ssm_graph.base.errors import ConfigError, SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps, at_once
from ssm_graph.base.times import MIN_SPACING_S
from ssm_graph.base.usual import LAG_S
from ssm_graph.engine.error_state import InitialMoments, Linearised
from ssm_graph.engine.marginal_prior import moved_chart
from ssm_graph.engine.reweighting import Anderson
from ssm_graph.engine.states import States
from ssm_graph.graph.first_weights import met_weights, updated_trust
from ssm_graph.graph.inertial_rows import Ahead, InertialRows
from ssm_graph.smoothers.keyframe import Keyframe, Sensors
from ssm_graph.smoothers.track import Stretch
from ssm_graph.smoothers.window_aids import SensorRows
from ssm_graph.smoothers.window_graph import WindowGraph, inertial_data


@dataclass(frozen=True, slots=True)
class FixedLagConfig:
    """Settings of the fixed-lag smoother."""

    lag_s: float = LAG_S
    """Keyframes older than this are marginalised; zero makes it the filter."""
    kernel: Kernel = field(default_factory=LogKernel)
    similarity: Similarity = Similarity.EXPECTED
    max_iterations: int = 50
    tolerance: float = 1e-8
    """Largest update, in its own posterior sigmas, at which a keyframe's iteration ends; not below
    1e-7 while the window has several."""
    linearised: Linearised = Linearised.EACH_PASS
    relinearise_sigmas: float = 1e-5
    """A keyframe of several is linearised anew once its attitude has moved by so many posterior
    sigmas, or anything else, which bends the measurements far less, by ten times as many."""
    relinearise_turn: float = 0.0
    """And only if its attitude has moved by so many rad, or its velocity by a hundred times as many
    m/s: what is less bends nothing, however certain."""
    reweigh: float = 1e-9
    """A weight, in a window of several keyframes, is renewed once that may move the answer, or its
    sigmas, by so many posterior sigmas; those of all later keyframes are renewed with it."""
    gate_sigmas: float = np.inf
    """A depth or GNSS fix further than this from what is predicted gets no weight, and keeps none:
    a height that little is known of would follow many of them, however far off."""
    first_estimates: bool = False
    """Keep the oldest keyframe where its prior was made, with the Jacobians of that point."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.lag_s) and self.lag_s >= 0.0):
            raise ConfigError(f"lag_s: expected zero or more seconds, got {self.lag_s}")
        if self.max_iterations < 1:
            raise ConfigError(f"max_iterations: expected 1 or more, got {self.max_iterations}")
        if not 0.0 < self.tolerance < 1.0:
            raise ConfigError(f"tolerance: expected a number in (0, 1), got {self.tolerance}")
        for name in ("relinearise_sigmas", "relinearise_turn", "reweigh"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ConfigError(f"{name}: expected a number in [0, 1), got {getattr(self, name)}")
        if self.linearised is Linearised.ONCE and self.lag_s > 0.0:
            raise ConfigError(f"linearised once: expected with lag_s zero, got {self.lag_s}")


_PACKED = ("step", "covariance", "innovation", "weights", "t", "trust")
RUNAWAY_SPEED = 100.0
"""m/s"""
BEAMS = "DVL"
"""What the beams are called among the sensors."""
ROUNDING = 1e-7
"""Posterior sigmas: updates of a window of several keyframes come down to a few 1e-8 and stay."""


def _largest(step: Array, covariance: Array) -> float:
    """Return the largest component of a step (K, n) in its posterior sigmas."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return float(np.max(np.abs(step) / sigma))


class Window:
    """The keyframes that are not yet settled, and the weights of their beams."""

    def __init__(
        self,
        sensors: Sensors,
        config: FixedLagConfig,
        first: Keyframe,
        start: InitialMoments,
        *,
        trust: Array | None = None,
    ) -> None:
        """``trust`` (B,) is what each beam was worth before, 0 to 1; all of them when left out."""
        self.config = config
        self._trust = np.ones(sensors.beams.n_beams) if trust is None else trust
        self._graph = WindowGraph(sensors, first, start)
        self._step = np.zeros((1, sensors.state_dim))
        """(K, n) off where each keyframe is linearised"""
        self._covariance = start.covariance[None]
        self._innovation = -self._graph.error
        self._weights, self._t = np.ones(len(self._innovation)), np.zeros(len(self._innovation))
        self._known: tuple[States, Array, States] | None = None
        """Where the newest keyframe was linearised, by which step it was moved, and where to"""

    def successor(self) -> Self:
        """Return a window that goes its own way from here, at full speed; this one rests, small.

        It still has all that is needed for another successor, if this way has to be left.
        """
        twin = copy.copy(self)
        twin._graph = self._graph.successor()
        return twin

    def pack(self) -> dict[str, Array]:
        """Return all that :meth:`unpack` needs to go on from here, as plain arrays."""
        own = {name: getattr(self, f"_{name}") for name in _PACKED}
        return {**self._graph.pack(), **own}

    @classmethod
    def unpack(
        cls,
        arrays: Mapping[str, Array],
        sensors: Sensors,
        config: FixedLagConfig,
        inertial: Callable[[float, float], Intervals],
    ) -> Self:
        """Return the window that was packed; ``inertial`` gives the data between two times."""
        window = cls.__new__(cls)
        window.config, window._known = config, None
        window._graph = WindowGraph.unpack(arrays, sensors, inertial)
        for name in _PACKED:
            setattr(window, f"_{name}", arrays[name])
        return window

    @property
    def keyframes(self) -> list[Keyframe]:
        """The keyframes, without what was left out of them."""
        return self._graph.keyframes

    @property
    def sensors(self) -> Sensors:
        """What is the same at all keyframes."""
        return self._graph.sensors

    @property
    def ahead(self) -> Ahead | None:
        """Where the inertial data led to the newest keyframe; None where it is the first."""
        return self._graph.ahead

    @property
    def inertial(self) -> InertialRows:
        """The model of the inertial data between keyframes."""
        return self._graph.inertial

    @property
    def trust(self) -> Array:
        """What each beam (B,) was worth in the last pings, the newest left out."""
        return self._trust

    @property
    def states(self) -> States:
        """The estimate of all keyframes."""
        return self._graph.at.moved(self._step)

    @property
    def newest(self) -> Stretch:
        """The newest keyframe."""
        return self._stretch(len(self.keyframes) - 1, len(self.keyframes))

    @property
    def newest_states(self) -> States:
        """The estimate (1, ...) of the newest keyframe."""
        at, step = self._graph.at, self._step
        if self._known is None or self._known[0] is not at or self._known[1] is not step:
            self._known = (at, step, at.take(np.s_[-1:]).moved(step[-1:]))
        return self._known[2]

    @property
    def newest_covariance(self) -> Array:
        """That of its error state and what it carries beside, (n, n)."""
        return np.asarray(self._covariance[-1])

    @property
    def newest_sigma(self) -> Array:
        """Standard deviations (n,) of the newest keyframe."""
        return np.asarray(np.sqrt(np.diagonal(self._covariance[-1])))

    @property
    def all(self) -> Stretch:
        """All keyframes."""
        return self._stretch(0, len(self.keyframes))

    def newest_rows(self) -> Iterator[SensorRows]:
        """Yield what each sensor measured at the newest keyframe, where the estimate is."""
        graph, k = self._graph, len(self.keyframes) - 1
        rows, step = slice(int(graph.first_row[k]), None), self._step[k]
        sigma, H = graph.beams.sigma[rows], graph.jacobian[rows]
        if len(sigma):
            error = (graph.error[rows] + H @ step) / sigma
            beam, weight = graph.beams.beam[rows], self._weights[rows]
            yield SensorRows(BEAMS, error, H / sigma[:, None], weight, beam)
        yield from graph.aids.rows_at(k, self._step)

    def _stretch(self, begin: int, end: int) -> Stretch:
        first = self._graph.first_row
        rows, at = slice(first[begin], first[end]), slice(begin, end)
        time_s = np.array([keyframe.time_s for keyframe in self.keyframes])
        return Stretch(
            time_s[at],
            self._graph.at.take(at).moved(self._step[at]),
            self._covariance[at],
            np.diff(first[begin : end + 1]).astype(float),
            self._graph.beams.beam[rows],
            self._innovation[rows],
            self._t[rows],
            self._weights[rows],
            self._graph.aids.judged(begin, end, time_s, self._step),
        )

    def advance(self, keyframe: Keyframe) -> Stretch:
        """Predict a new keyframe, marginalise what the lag leaves behind, and return that."""
        oldest_s = keyframe.time_s - self.config.lag_s - MIN_SPACING_S
        leaving = sum(known.time_s < oldest_s for known in self.keyframes)
        left, last = self._stretch(0, leaving), self.newest_states
        if self.config.lag_s > 0.0:  # the filter weighs all sensors by one kernel, as published
            self._graph.aids.find_tails(self.config.kernel, leaving)
        pinged = slice(int(self._graph.first_row[-2]), None)
        beam, weight = self._graph.beams.beam[pinged], self._weights[pinged]
        self._trust = updated_trust(self._trust, beam, weight)
        if leaving == len(self.keyframes):
            # Of a window that goes as a whole, the posterior of its end is all that counts.
            self._graph.keep_posterior(last)
            self._keep_newest(keyframes=1, rows=0)
            self._step = np.zeros_like(self._step)  # it is linearised where it is now
            leaving = 1
        self._append(keyframe, last)
        if leaving:
            self._graph.marginalise(leaving, self._weights)
            self._keep_newest(keyframes=len(self.keyframes), rows=len(self._graph.error))
        if len(self.keyframes) > 1 and keyframe.is_measured:
            self.meet_prediction()
        return left

    def _append(self, keyframe: Keyframe, last: States) -> None:
        graph, n_rows = self._graph, len(self._weights)
        graph.append(keyframe, last, self._step[-1])
        n_new = len(graph.error) - n_rows
        self._step = np.concatenate([self._step, np.zeros((1, graph.state_dim))])
        self._covariance = np.concatenate([self._covariance, self._covariance[-1:]])
        self._innovation = np.append(self._innovation, -graph.error[n_rows:])
        self._weights = np.append(self._weights, np.ones(n_new))
        self._t = np.append(self._t, np.zeros(n_new))

    def _keep_newest(self, *, keyframes: int, rows: int) -> None:
        self._step, self._covariance = self._step[-keyframes:], self._covariance[-keyframes:]
        first = len(self._weights) - rows
        self._innovation, self._weights, self._t = (
            column[first:] for column in (self._innovation, self._weights, self._t)
        )

    def meet_prediction(self) -> None:
        """Let what was measured at the newest keyframe meet what all before it predict.

        Beams start as they agree with that and with each other: with full weight one bad beam would
        throw the whole window off, which then takes many passes to come back.
        """
        graph = self._graph
        step, root_cov = graph.prediction(self._weights)
        k, row = len(self.keyframes) - 1, graph.first_row[-2]
        if np.isfinite(self.config.gate_sigmas):
            graph.aids.refuse_far(k, step, root_cov, sigmas=self.config.gate_sigmas)
        if graph.aids.meet_prediction(k, step, root_cov, self.config.kernel):
            graph.changed_from(k)
        H = graph.jacobian[row:]
        if len(H) == 0:
            return
        root = H @ root_cov
        weights = met_weights(
            -graph.error[row:] - H @ step,
            root @ root.T,
            graph.beams.sigma[row:] ** 2,
            self.config.kernel,
            trust=self._trust[graph.beams.beam[row:]],
        )
        self._weights = np.concatenate([self._weights[:row], weights])
        graph.changed_from(k)

    def predicted(self, keyframe: Keyframe) -> tuple[States, Array]:
        """Return where the inertial data lead from the newest keyframe, with the covariance."""
        ahead = self._graph.inertial.predict(inertial_data([keyframe]), self.newest_states)
        return ahead.states, ahead.covariance(self._covariance[-1])

    def require_sane(self) -> None:
        """Raise :class:`SolverError` for a newest state that no vehicle can have."""
        speed = float(np.linalg.norm(self.newest_states.v_n[0]))
        if not (speed < RUNAWAY_SPEED and np.all(np.isfinite(self.newest_covariance))):
            raise SolverError(f"the answer ran away, {speed:.3g} m/s")

    def iterate_steps(self) -> Steps[int]:
        """Reweight and solve until the window has settled; return the number of passes."""
        is_linear = self.config.linearised is Linearised.ONCE
        n_passes = self._reweigh() if is_linear else (yield from self._settle_steps())
        is_idle = len(self.keyframes) == 1 and not self.keyframes[0].is_measured
        return 0 if is_idle else n_passes

    iterate = at_once(iterate_steps)

    def _settle_steps(self) -> Steps[int]:
        """Solve and reweigh; what has moved is linearised anew at each pass."""
        config, n_keyframes = self.config, len(self.keyframes)
        tolerance = max(config.tolerance, ROUNDING) if n_keyframes > 1 else config.tolerance
        anderson: Anderson | None = None
        for number in range(1, config.max_iterations + 1):
            update = self._solve()
            self._relinearise()
            pull = self._judge()
            if _largest(update, self._covariance) < tolerance:
                break
            yield 0.8 + 0.1 * n_keyframes
            if number < config.max_iterations:
                settled = self._settled()
                # A single keyframe's weights are those of the filter, pass by pass.
                if n_keyframes > 1:
                    used = np.concatenate([self._weights, self._graph.aids.weights])
                    anderson = Anderson.after(anderson, used, settled)
                    settled = anderson.weights
                self._renew(settled, pull)
                if self._graph.is_eliminated:
                    break  # nothing has changed, another pass would find the same
        return number

    def _reweigh(self) -> int:
        """Solve and reweigh a single keyframe, linearised at its prediction only."""
        config, chain = self.config, self._graph.chain
        for number in range(1, config.max_iterations + 1):
            update = self._solve()
            pull = self._judge()
            if _largest(update, self._covariance) < config.tolerance:
                break
            if number < config.max_iterations:
                self._renew(self._settled(), pull)
        J = moved_chart(self._step[0])
        self._covariance = J @ self._covariance @ J.T
        chain.move(J)
        return number

    def _solve(self) -> Array:
        """Solve with the present weights and return by how much that moves (K, n)."""
        self._graph.eliminate(self._weights)
        solution = self._graph.chain.solve()
        step, self._covariance = solution.step, solution.conditional
        update, self._step = step - self._step, step
        return update

    def _relinearise(self) -> None:
        """Linearise the keyframes anew from the first to the last that has moved too far."""
        config, is_single = self.config, len(self.keyframes) == 1
        sigma = np.sqrt(np.diagonal(self._covariance, axis1=1, axis2=2))
        step = np.abs(self._step)
        threshold = 0.0 if is_single else config.relinearise_sigmas
        least = 0.0 if is_single else config.relinearise_turn
        bends = self._graph.bends
        is_far = (step * bends.share > threshold * sigma) & (step > least * bends.as_a_turn)
        moved = np.asarray(is_far.any(axis=1))
        if config.first_estimates and not is_single:
            moved[0] = False
        if moved.any():
            at = np.flatnonzero(moved)
            begin, end = int(at[0]), int(at[-1]) + 1
            self._graph.linearise(begin, end, self._step[begin:end])
            self._step = self._step.copy()
            self._step[begin:end] = 0.0

    def _renew(self, settled: Array, pull: Array) -> None:
        """Take the weights from the first keyframe on where one has changed enough."""
        n_beams, graph, config = len(self._weights), self._graph, self.config
        used = np.concatenate([self._weights, graph.aids.weights])
        first = 0
        if len(self.keyframes) > 1:
            keyframe = np.concatenate([graph.keyframe_of_row, graph.aids.keyframe_of_weight])
            changed = np.abs(settled - used) * pull > config.reweigh
            first = int(keyframe[changed].min(initial=len(self.keyframes)))
            settled = np.where(keyframe >= first, settled, used)
        self._weights = settled[:n_beams]
        graph.aids.renew(settled[n_beams:])
        graph.changed_from(first)

    def _settled(self) -> Array:
        """Return the weights that all beams, then all aids, are found to have."""
        kernel = self.config.kernel
        return np.concatenate([kernel.weight(self._t), self._graph.aids.settled(kernel)])

    def _judge(self) -> Array:
        """Find the ``t`` of all measurements at the present solution.

        Returns how many posterior sigmas the answer, or its sigmas, would move if their weights,
        the beams' first, changed by one.
        """
        graph = self._graph
        keyframe, seen, sigma = graph.keyframe_of_row, graph.seen_by_beams, graph.beams.sigma
        H = graph.jacobian[:, seen]
        error = graph.error + (H * self._step[:, seen][keyframe]).sum(axis=1)
        covariance = self._covariance[:, seen[:, None], seen]
        spread = ((H[:, None, :] @ covariance[keyframe])[:, 0] * H).sum(axis=1)
        is_plain = self.config.similarity is Similarity.PLAIN
        counted = np.zeros(len(error)) if is_plain else spread
        self._t = expected_mahalanobis_sq(error, counted, sigma=sigma)
        of_aids = graph.aids.judge(self._step, self._covariance, self.config.similarity)
        return np.concatenate([np.sqrt(self._t * spread) / sigma, of_aids])
