"""What a unit of each error that lasts does to the rows of a mission: channels of columns.

A channel is a sensor with the numbers that it may be off by: the beams each by itself, the ground
that moves, the array's scale and mounting, the fixes along each axis, depth, biases of the inertial
data. Hypotheses are sums of these over stretches (:mod:`ssm_graph.smoothers.faults.hypotheses`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from factors.similarity import WEIGHT_FLOOR, LogKernel
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.chain import ChainSolution
from ssm_graph.engine.error_state import ACCEL_BIAS, STATE_DIM
from ssm_graph.engine.evidence import BetweenRows, Columns, OwnRows
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.aid import Aid
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.freed import array_columns
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.graph.measurements import states_at
from ssm_graph.mission.problem import Problem

BEAM: Final = "beam"
BOTTOM: Final = "bottom"
SCALE: Final = "scale"
MOUNTING: Final = "mounting"
IMU: Final = "IMU"
CLOCK: Final = " clock"
"""Behind the name of an aid: its stamps are late, by a second."""

TREND_S = 100.0
"""s, in which the rate of a trend is counted here."""

KERNEL = LogKernel()
"""Weighs measurements by what they miss beside the running median: spikes must not make a fault,
and what lasts must not be weighed away."""
MEDIAN_OF = 7
"""Successive readings of one beam, or of one component of an aid."""
REACH_SQ = 25.0
"""Square of the sigmas up to which a reading counts for the noise of its beam."""
NOISIER = 1.6
"""Variance by that of the others, from which on a beam is noisier than these,"""
NOISIER_DEVIATIONS = 5.0
"""if by as many of its deviations: of four readings of 1 / n in the square, for a tail."""
NOISE_OVER = 61
"""Successive readings whose scatter is compared with that elsewhere, and"""
OTHER_NOISE = 1.3
"""by how much their sigma has to be another one: four deviations of that of so many."""
BESIDE_MEDIAN = 0.925
"""Variance of a Gaussian reading less the median of seven, of which it is one."""


class Channel(NamedTuple):
    """A sensor and the numbers that it may be off by."""

    name: str
    columns: slice
    """Among those of one block"""
    rates: slice | None = None
    """Those of the same numbers where they grow by one in :data:`TREND_S`, from the mission's begin
    on; without, a rate goes in steps from block to block"""


class Mode(NamedTuple):
    """A way of one number in which an aid may be off."""

    aid: str
    columns: Array
    """(M, d, 1) what a unit of it does to the whitened measurements"""


def beside_median(values: Array) -> Array:
    """Return readings (N, ...) less their running median, the ends mirrored.

    Of fewer than would fill half of it nothing lasts: they are returned as they are.
    """
    half = MEDIAN_OF // 2
    if len(values) <= half:
        return values
    padded = np.pad(values, [(half, half)] + [(0, 0)] * (values.ndim - 1), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, MEDIAN_OF, axis=0)
    return np.asarray(values - np.median(windows, axis=-1))


def spike_weights(whitened: Array) -> Array:
    """Return weights (N,) of successive readings (N, d) by how far they stick out.

    What sticks out is measured by what is usual here: sigmas stated too small would make faults of
    noise. So weights are below one throughout where readings scatter more than stated, and over
    stretches by how much these scatter, if that is not as elsewhere.
    """
    square, dim = _squares_beside_median(whitened), whitened.shape[1]
    excess = np.ones(len(square))
    for _ in range(4):
        weights = KERNEL.weight(square / excess, dim=dim)
        counted = np.stack([weights * square, weights * dim])
        within = uniform_filter1d(counted, NOISE_OVER, axis=1)
        here = np.maximum(within[0] / np.maximum(within[1], 1.0 / NOISE_OVER), 1.0)
        usual = np.median(here) if len(here) else 1.0
        is_usual = np.abs(np.log(here / usual)) < 2.0 * np.log(OTHER_NOISE)
        excess = np.where(is_usual, usual, here)
    return np.asarray(weights / excess)


def _squares_beside_median(whitened: Array) -> Array:
    off = beside_median(whitened) / np.sqrt(BESIDE_MEDIAN)
    return np.asarray(np.sum(off**2, axis=1))


def noisier_than_others(whitened: Array, beam: NDArray[np.intp], n_beams: int) -> Array:
    """Return the sigma of each beam by that of the others, 1.0 where it is no more than chance.

    It is that of three quarters of the time. A beam that is never heard is no noisier than others.

    Parameters
    ----------
    whitened : (M,) what beams miss, in their stated sigmas.
    beam : (M,) from 0.
    n_beams : of the instrument.
    """
    each = [_squares_beside_median(whitened[beam == b][:, None]) for b in range(n_beams)]
    each = [x[x < REACH_SQ] for x in each]  # gross errors are weighed away one by one
    within = [uniform_filter1d(x, NOISE_OVER // 3) for x in each]
    variance = np.array([np.quantile(x, 0.25) if len(x) else 0.0 for x in within])
    count = np.array([len(x) for x in each])
    factor = np.ones(n_beams)
    heard = np.flatnonzero(count)
    for b in heard if len(heard) > 2 else ():
        others = variance[heard[heard != b]]
        ratio = variance[b] / max(float(np.median(others)), 1e-12)
        chance = NOISIER_DEVIATIONS * np.sqrt(4.0 / count[b])
        if ratio > NOISIER and np.log(ratio) > chance and variance[b] > 1.0:
            factor[b] = np.sqrt(ratio)
    return factor


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """A problem linearised at its states, weighed, and solved for the trajectory alone."""

    states: States
    """With nothing freed"""
    beam_weights: Array
    beam_noise: Array
    """(B,) sigma of each beam by that of the others; 1.0 for one of its kind"""
    aids: tuple[Aid, ...]
    aid_weights: Mapping[str, Array]
    solution: ChainSolution
    own: OwnRows
    between: BetweenRows
    order: NDArray[np.intp]
    """(R,) rows of beams, then of each aid, in the order of their keyframes"""
    constants: Columns
    """The calibrations of the problem"""
    bare: GraphLinearizer

    @property
    def problem(self) -> Problem:
        """With nothing freed."""
        return self.bare.problem

    def inertial_rows(self, off: Array | float = 0.0) -> Array:
        """Return the rows (K - 1, n, 2 n + c + 1) of :attr:`solution`, which miss less by that."""
        missed = (self.between.missed - off)[:, :, None]
        return np.concatenate([self.between.jacobian, self.constants.between, missed], axis=2)

    def solved_steps(self, own: Array, between: Array) -> Steps[Array]:
        """Return the step (K, n) of the trajectory alone for errors (R,) and (K - 1, m) of rows."""
        solution = yield from self.bare.solve_rows_steps(
            self.states,
            self.own.keyframe,
            np.column_stack([self.own.jacobian, self.constants.own, self.own.missed - own]),
            self.inertial_rows(between),
        )
        return solution.step - solution.sensitivity @ solution.constants_step


def linear_of_steps(
    bare: GraphLinearizer,
    linearizer: GraphLinearizer,
    states: States,
    beams_out: NDArray[np.bool_],
    aids_out: NDArray[np.bool_],
) -> Steps[Linear]:
    """Weigh all measurements, solve for the trajectory, and return rows and what they miss.

    Parameters
    ----------
    bare : of the problem with nothing freed.
    linearizer : of the same with what was found freed, which is taken off what rows miss.
    states : of that, near the answer.
    beams_out, aids_out : (M,) and (A,) which measurements count for nothing.
    """
    problem = bare.problem
    n, width = problem.extras.state_dim, problem.extras.width
    beams = linearizer.beam_rows(states)
    beam_weights = _beam_weights(problem, beams)
    beam_weights[beams_out] = WEIGHT_FLOOR
    weighted = linearizer.weighted
    of_aids = [spike_weights(weighted.whitened(aid, states).error) for aid in weighted.all]
    weights = np.concatenate([np.zeros(0), *of_aids])
    weights[aids_out] = WEIGHT_FLOOR
    scale = np.sqrt(beam_weights) / problem.beams.sigma
    aid_keyframe, error, jacobian = weighted.rows(states, weights)
    own = np.concatenate(
        [
            np.column_stack([beams.jacobian[:, :width], -beams.error]) * scale[:, None],
            np.column_stack([jacobian[:, :width], -error]),
        ]
    )
    keyframe = np.concatenate([problem.beams.keyframe, aid_keyframe])
    order = np.argsort(keyframe, kind="stable")
    keyframe, own = keyframe[order], own[order]
    between = linearizer.inertial_rows(states)
    between = np.concatenate([between[:, :, : n + width], between[:, :, -1:]], axis=2)
    yield 0.025 * problem.n_keyframes
    states = states._replace(constants=states.constants[: problem.extras.n_constants])
    solution = yield from bare.solve_rows_steps(states, keyframe, own, between)
    step = solution.step - solution.sensitivity @ solution.constants_step
    missed = own[:, -1] - np.einsum("ri,ri->r", own[:, :n], step[keyframe])
    both = np.concatenate([step[:-1], step[1:]], axis=1)
    missed_between = between[:, :, -1] - np.einsum("kij,kj->ki", between[:, :, : 2 * n], both)
    return Linear(
        states=states,
        beam_weights=beam_weights,
        beam_noise=noisier_than_others(
            beams.error / problem.beams.sigma, problem.beams.beam, problem.beams.n_beams
        ),
        aids=weighted.all,
        aid_weights={aid.name: weighted.of(aid, weights) for aid in weighted.all},
        solution=solution,
        own=OwnRows(keyframe, own[:, :n], missed),
        between=BetweenRows(between[:, :, : 2 * n], missed_between),
        order=order,
        constants=Columns(own[:, n:-1], between[:, :, 2 * n : -1]),
        bare=bare,
    )


def _beam_weights(problem: Problem, beams: BeamRows) -> Array:
    weights = np.ones(len(beams.error))
    for beam in range(problem.beams.n_beams):
        own = problem.beams.beam == beam
        whitened = (beams.error / problem.beams.sigma)[own]
        weights[own] = spike_weights(whitened[:, None])
    return weights


def columns_of_biases(rows: Array, n: int) -> Array:
    """Return what a unit of each bias does to the whitened inertial rows (K - 1, 15, 6).

    ``rows`` (K - 1, r, 2 n or more) are those of two successive states of ``n`` numbers each.
    """
    # A bias at the begin acts on the motion and on the bias at the end, that at the end on the
    # latter alone, the other way round.
    begin, end = slice(ACCEL_BIAS.start, STATE_DIM), slice(n + ACCEL_BIAS.start, n + STATE_DIM)
    return np.asarray(rows[:, :STATE_DIM, begin] + rows[:, :STATE_DIM, end])


class Channels:
    """All channels of a linearised mission, and their columns."""

    def __init__(self, linear: Linear) -> None:
        self._linear = linear
        beams = linear.problem.beams
        sizes = {BEAM: beams.n_beams, BOTTOM: 3, SCALE: 1, MOUNTING: 3}
        sizes |= {aid.name: aid.dim for aid in linear.aids if len(aid)}
        sizes[IMU] = 6
        self.modes = dict(self._modes())
        """Ways of one number in which an aid may be off besides, by the names of their channels"""
        sizes |= dict.fromkeys(self.modes, 1)
        dims = {aid.name: aid.dim for aid in linear.aids if len(aid)}
        widths = [*sizes.values(), *dims.values()]
        slices = [
            slice(end - size, end)
            for size, end in zip(widths, np.cumsum(widths).tolist(), strict=True)
        ]
        rates = dict(zip(dims, slices[len(sizes) :], strict=True))
        self.all = tuple(
            Channel(name, own, rates.get(name)) for name, own in zip(sizes, slices, strict=False)
        )
        self.width = sum(widths)
        self.beams = self._beams()
        self.between = self._between()
        self.aids = {aid.name: aid.root_information for aid in linear.aids if len(aid)}
        self.aid_keyframe = {aid.name: aid.keyframe for aid in linear.aids if len(aid)}
        self.columns = self._columns()

    def of(self, name: str) -> Channel:
        """Return a channel by its name."""
        return next(channel for channel in self.all if channel.name == name)

    def of_aids(self) -> Iterator[tuple[str, dict[str, Array]]]:
        """Yield each aid with the columns (M, d, c) on its whitened rows, by their channels."""
        for name, root in self.aids.items():
            own = {of: mode.columns for of, mode in self.modes.items() if mode.aid == name}
            yield name, {name: root} | own

    def dim_of(self, name: str) -> int:
        """Return how many numbers a channel has."""
        own = self.of(name).columns
        return int(own.stop - own.start)

    @property
    def beam_noise(self) -> Array:
        """(B,) the sigma of each beam by that of the others; 1.0 for one of its kind."""
        return self._linear.beam_noise

    @property
    def beams_d(self) -> Array:
        """(B, 3) the mean direction of each beam in instrument axes."""
        beams = self._linear.problem.beams
        of_rows, mean = beams.beam_b @ beams.R_bd, np.zeros((beams.n_beams, 3))
        for beam in range(beams.n_beams):
            if np.any(beams.beam == beam):
                mean[beam] = of_rows[beams.beam == beam].mean(axis=0)
        return mean

    def _beams(self) -> Array:
        """Return what a unit of each channel does to the beam speeds (M, B), m/s."""
        linear, problem = self._linear, self._linear.problem
        beams, states = problem.beams, linear.states
        made = np.zeros((len(beams.speed), self.width))
        made[np.arange(len(made)), beams.beam] = 1.0
        R_nb = states.R_nb[beams.keyframe]
        along_n = np.einsum("mij,mj->mi", R_nb, beams.beam_b)
        made[:, self.of(BOTTOM).columns] = -along_n * ~beams.is_water[:, None]
        of_array = array_columns(problem, states, beams.beam_b)
        made[:, self.of(SCALE).columns] = of_array[:, :1]
        made[:, self.of(MOUNTING).columns] = of_array[:, 1:]
        # What gyros are off by turns the instrument about the vehicle's origin as well.
        made[:, self.of(IMU).columns][:, 3:] = -np.cross(beams.lever_arm_b, beams.beam_b)
        return made

    def _between(self) -> Array:
        return columns_of_biases(
            self._linear.between.jacobian, self._linear.problem.extras.state_dim
        )

    def _modes(self) -> Iterator[tuple[str, Mode]]:
        """Yield clocks of aids that move fast enough to tell, and what aids may err in besides."""
        linear = self._linear
        for aid in linear.aids:
            if len(aid) == 0:
                continue
            rate = aid.rate(states_at(linear.states, aid.keyframe, linear.problem.extras))
            off = {} if rate is None else {CLOCK: -rate}
            for name, size in (off | dict(aid.own_errors())).items():
                yield aid.name + name, Mode(aid.name, aid.root_information @ size[..., None])

    def _columns(self) -> Columns:
        linear = self._linear
        scale = np.sqrt(linear.beam_weights) / linear.problem.beams.sigma
        rows, keyframe_s = [self.beams * scale[:, None]], linear.problem.keyframe_s
        for aid in linear.aids:
            own = np.zeros((len(aid), aid.dim, self.width))
            if len(aid):
                root = self.aids[aid.name]
                channel = self.of(aid.name)
                own[:, :, channel.columns] = root
                since = (keyframe_s[aid.keyframe] - keyframe_s[0]) / TREND_S
                own[:, :, channel.rates] = root * since[:, None, None]
                for name, mode in self.modes.items():
                    if mode.aid == aid.name:
                        own[:, :, self.of(name).columns] = mode.columns
                own *= np.sqrt(linear.aid_weights[aid.name])[:, None, None]
            rows.append(own.reshape(-1, self.width))
        between = np.zeros((*linear.between.missed.shape, self.width))
        between[:, :STATE_DIM, self.of(IMU).columns] = self.between
        return Columns(np.concatenate(rows)[linear.order], between)
