"""How much better the data fit once a hypothesis is allowed for, of all stretches at once."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.error_state import POSITION
from ssm_graph.engine.evidence import ChainEvidence, Columns, Evidence, root_of
from ssm_graph.smoothers.faults.columns import IMU, Channels, Linear
from ssm_graph.smoothers.faults.grid import Grid
from ssm_graph.smoothers.faults.hypotheses import (
    AT_AN_END,
    LEAST_PER_NUMBER,
    PER_NUMBER,
    Course,
    Hypothesis,
)
from ssm_graph.smoothers.faults.nuisances import WIDER, WIDTHS, Nuisances, Priors
from ssm_graph.smoothers.faults.unstated import Unstated, unstated_of

LEAST_FORCE = 10.0
"""m/s^2, of a jump: it is no larger."""
MEDIAN_OF_THREE = 2.366
"""Of a chi-square with three degrees of freedom."""
STEADY = 0.02
"""Width of the nuisances of inertial data that is next to none."""
WORTH = 15.0
"""Chi-square of a constant from which on a sensor may be off by anything."""


class Candidate(NamedTuple):
    """A hypothesis over a stretch of blocks."""

    hypothesis: Hypothesis
    begin: int
    """Block"""
    end: int
    """The first block after it"""
    chi_sq: float
    merit: float
    """By which that exceeds its charge"""
    discount: float
    """Of what it needs, for the ends of the mission"""

    def n_numbers(self) -> int:
        """Return how many numbers it has."""
        is_anything = self.hypothesis.course is Course.ANYTHING
        return self.hypothesis.n_numbers * (self.end - self.begin if is_anything else 1)

    @property
    def is_significant(self) -> bool:
        """Whether it is no chance."""
        return self.chi_sq > self.hypothesis.least(self.n_numbers()) - self.discount


@dataclass(frozen=True, slots=True, eq=False)
class Fault:
    """A hypothesis over a stretch of keyframes."""

    hypothesis: Hypothesis
    begin: int
    """Keyframe"""
    end: int
    """The first keyframe after it"""
    chi_sq: float = 0.0
    """By which the data fit better"""
    merit: float = 0.0
    """By which that exceeds its charge"""
    rivals: tuple[Fault, ...] = ()
    """Others that explain the data as well"""
    onsets: tuple[Fault, ...] = ()
    """The same from other times on, or to others, at which it may have begun or ended"""
    sizes: Array | None = None
    """Of its numbers, taken off the rows already; None for what is new"""
    cost_m: float = 0.0
    """By how much the horizontal position moves between the explanations, m"""

    @property
    def is_allowed_for(self) -> bool:
        """Whether it is too little to be a fault, but may be one."""
        return self.hypothesis.is_usual and self.merit <= 0.0

    @property
    def n_constants(self) -> int:
        """Of the graph, none where its rows are left out instead."""
        is_anything = self.hypothesis.course is Course.ANYTHING
        return 0 if is_anything else self.hypothesis.n_numbers


class Apart(NamedTuple):
    """How far two answers are apart, at most."""

    sigmas: float
    level_m: float
    """Horizontally, m"""


class Judge:
    """Evidence of one linearised mission, on any grid and with any faults freed."""

    def __init__(self, linear: Linear, channels: Channels, nuisances: Nuisances) -> None:
        self.linear, self.channels, self._nuisances = linear, channels, nuisances
        self._chain = ChainEvidence(linear.solution, linear.own, linear.between)
        self._last: tuple[NDArray[np.intp], Evidence] | None = None

        self.widths: tuple[float, ...] = (1.0, 1.0, 1.0)
        """Of the nuisances of beams, aids and inertial data"""

    def fit(self, grid: Grid, faults: Sequence[Fault]) -> None:
        """Let the nuisances be as wide as the data ask for, once faults are freed."""
        priors, score, among = self._of_nuisances(grid, faults)
        self.widths = priors.fitted(score, among, choices=WIDER if faults else WIDTHS)

    def unstated(self, grid: Grid, faults: Sequence[Fault]) -> Unstated | None:
        """Return what instruments err in beyond what they state, once faults are freed."""
        priors, score, among = self._of_nuisances(grid, faults)
        prior, width = priors.information(self.widths), priors.width(self.widths)
        n_coarse = len(grid.coarse()[0])
        return unstated_of(self._nuisances, width, score, among, prior, n_coarse)

    def with_steady_biases(self) -> Judge:
        """Return the same with inertial data whose errors are as stated, and no more."""
        judge = copy.copy(self)
        judge.widths = (*self.widths[:-1], STEADY)
        return judge

    def _of_nuisances(self, grid: Grid, faults: Sequence[Fault]) -> tuple[Priors, Array, Array]:
        """Return their priors, scores and information among themselves, once faults are freed."""
        evidence, width = self._whole(grid), self.channels.width
        if faults:
            combined, prior = combined_of(faults, grid, self.channels)
            shared = np.zeros((len(evidence.score) - len(combined), combined.shape[1]))
            evidence = evidence.freed(np.vstack([combined, shared]), prior)
        priors = self._nuisances.priors(*grid.coarse())
        crossed = priors.crossed(evidence, width)
        return priors, crossed.score, priors.among(crossed, width)

    def on(self, grid: Grid) -> Judged:
        """Return the evidence on a grid, with nothing freed but the nuisances."""
        width = self.channels.width
        whole, n = self._whole(grid), grid.n_blocks * width
        priors = self._nuisances.priors(*grid.coarse())
        crossed = priors.crossed(whole, width)
        inner = priors.among(crossed, width) + priors.information(self.widths)
        blocks = Evidence(whole.score[:n], whole.information[:n, :n])
        left = blocks.without(crossed.score, crossed.information[:, :n], inner)
        return Judged(left, grid, self.channels)

    def jolts(self, grid: Grid) -> Array:
        """Return the chi-square of a jump of velocity within each block alone (N,).

        What begins or ends within it looks like one. It is for noise as usual in this mission.
        """
        columns = self.channels.columns
        first = self.channels.of(IMU).columns.start
        force = slice(first, first + 3)
        own = Columns(columns.own[:, force], columns.between[:, :, force])
        score, information = self._chain.each(grid.edges, own)
        least = LEAST_FORCE**-2 * np.eye(3)
        chi_sq = np.sum(
            score * np.linalg.solve(information + least, score[..., None])[..., 0], axis=1
        )
        return np.asarray(chi_sq / max(float(np.median(chi_sq)) / MEDIAN_OF_THREE, 1.0))

    def way_steps(self, judged: Judged, faults: Sequence[Fault]) -> Steps[Array]:
        """Return where the trajectory goes (K, 3), in body axes, m, if these are freed."""
        effect = -judged.restored
        effect += judged.combined(faults)[0] @ judged.sizes(faults)
        linear, columns = self.linear, self.channels.columns
        none = np.zeros((1, self.channels.width))  # before the blocks and after them
        of_block = np.concatenate([none, effect.reshape(judged.grid.n_blocks, -1), none])
        block = np.searchsorted(judged.grid.edges, np.arange(len(linear.states.R_nb)), side="right")
        own = np.einsum("rc,rc->r", columns.own, of_block[block[linear.own.keyframe]])
        between = np.einsum("kic,kc->ki", columns.between, of_block[block[:-1]])
        solution = yield from linear.solved_steps(own, between)
        return solution[:, POSITION]

    def apart(self, one: Array, other: Array) -> Apart:
        """Return how far two ways (K, 3) of :meth:`way_steps` are apart."""
        off_b, linear = one - other, self.linear
        P = linear.solution.covariance_of(POSITION)
        sigmas = np.sqrt(np.einsum("ki,ki->k", off_b, np.linalg.solve(P, off_b[..., None])[..., 0]))
        off_n = np.einsum("kij,kj->ki", linear.states.R_nb, off_b)
        return Apart(float(np.max(sigmas)), float(np.max(np.hypot(off_n[:, 0], off_n[:, 1]))))

    def _whole(self, grid: Grid) -> Evidence:
        if self._last is None or not np.array_equal(self._last[0], grid.edges):
            whole = self._chain.of(grid.edges, self.channels.columns, self._nuisances.shared)
            whole.score[grid.n_blocks * self.channels.width :] += self._nuisances.score
            self._last = grid.edges, whole
        return self._last[1]


class Judged:
    """Evidence of the channels' columns on the blocks of a grid."""

    def __init__(
        self, evidence: Evidence, grid: Grid, channels: Channels, restored: Array | None = None
    ) -> None:
        self.evidence, self.grid, self.channels = evidence, grid, channels
        self.restored = np.zeros(len(evidence.score)) if restored is None else restored
        """(C,) what is not taken off the rows here"""

    def restoring(self, faults: Iterable[Fault]) -> Judged:
        """Return what the data say if these had not been taken off the rows."""
        restored = self.restored.copy()
        for fault in faults:
            if fault.sizes is not None:
                restored += self.combined([fault])[0] @ fault.sizes
        score = self.evidence.score + self.evidence.information @ (restored - self.restored)
        return Judged(self.evidence._replace(score=score), self.grid, self.channels, restored)

    def with_freed(self, faults: Sequence[Fault]) -> Judged:
        """Return what is left once some faults may be of any size."""
        if not faults:
            return self
        evidence = self.evidence.freed(*self.combined(faults))
        return Judged(evidence, self.grid, self.channels, self.restored)

    def combined(self, faults: Sequence[Fault]) -> tuple[Array, Array]:
        """Return the columns of faults as sums of those here, and their prior information."""
        return combined_of(faults, self.grid, self.channels)

    def sizes(self, faults: Sequence[Fault]) -> Array:
        """Return how large faults are, one behind the other, if all of them are freed together."""
        return self.evidence.sizes(*self.combined(faults))

    def best_of(
        self,
        hypotheses: Iterable[Hypothesis],
        *,
        near: Fault | None = None,
        apart_from: Fault | None = None,
    ) -> list[Candidate]:
        """Return the best stretch of each hypothesis, the best ones first.

        ``near`` a fault, only stretches that overlap it are looked at; ``apart_from`` one, only
        those that do not.
        """
        found = []
        edges = self.grid.edges
        is_apart = np.zeros((len(edges), len(edges)), bool)
        if near is not None:
            is_apart = (edges[:, None] >= near.end) | (edges[None, :] <= near.begin)
        elif apart_from is not None:
            is_apart = (edges[:, None] < apart_from.end) & (edges[None, :] > apart_from.begin)
        discount = np.zeros((len(edges), len(edges)))
        discount[0] += AT_AN_END
        discount[:, -1] += AT_AN_END
        is_whole = np.zeros((len(edges), len(edges)), bool)
        is_whole[0, -1] = True
        best_so_far: dict[str, float] = {}
        for hypothesis in hypotheses:
            # Where no constant is worth a look in any stretch, there is nothing of another course.
            if (
                hypothesis.course is Course.ANYTHING
                and best_so_far.get(hypothesis.sensor, WORTH) < WORTH
            ):
                continue
            chi_sq, charge = self.table(hypothesis)
            largest = float(np.max(chi_sq))
            best_so_far[hypothesis.sensor] = max(best_so_far.get(hypothesis.sensor, 0.0), largest)
            merit = np.where(is_apart, -np.inf, chi_sq - charge + discount)
            if hypothesis.odds:
                merit[~is_whole] = -np.inf
            begin, end = np.unravel_index(int(np.argmax(merit)), merit.shape)
            own = (float(table[begin, end]) for table in (chi_sq, merit, discount))
            found.append(Candidate(hypothesis, int(begin), int(end), *own))
        return sorted(found, key=lambda candidate: -candidate.merit)

    def table(self, hypothesis: Hypothesis) -> tuple[Array, Array]:
        """Return chi-square and what it has to exceed, by begin and end block (N + 1, N + 1)."""
        if hypothesis.course is Course.ANYTHING:
            return self._table_of_anything(hypothesis)
        n = self.grid.n_blocks
        score, information = self._by_moments(hypothesis)
        d = score.shape[1]
        summed = np.zeros((n + 1, d, n + 1, d))
        summed[1:, :, 1:] = information.cumsum(axis=0).cumsum(axis=2)
        begin, end = np.triu_indices(n + 1, 1)
        swapped = summed.transpose(0, 2, 1, 3)
        inner = (
            swapped[end, end] + swapped[begin, begin] - swapped[begin, end] - swapped[end, begin]
        )
        summed_score = np.concatenate([np.zeros((1, d)), score.cumsum(axis=0)])
        of_stretch = summed_score[end] - summed_score[begin]
        if hypothesis.has_rate:
            inner, of_stretch = _from_begin(inner, of_stretch, self.grid.begin_since[begin])
        if hypothesis.course is Course.RAMP:
            d //= 2
            inner, of_stretch = inner[:, d:, d:], of_stretch[:, d:]
        prior = np.diag(1.0 / np.resize(hypothesis.sigma, d) ** 2)
        if d == 1:
            square = of_stretch[:, 0] ** 2 / (inner[:, 0, 0] + prior[0, 0])
        else:
            solved = np.linalg.solve(inner + prior, of_stretch[..., None])[..., 0]
            square = np.sum(solved * of_stretch, axis=1)
        chi_sq = np.full((n + 1, n + 1), -np.inf)
        chi_sq[begin, end] = square
        return chi_sq, np.full_like(chi_sq, hypothesis.charge(hypothesis.n_numbers))

    def _table_of_anything(self, hypothesis: Hypothesis) -> tuple[Array, Array]:
        n = self.grid.n_blocks
        score, information = self._projected(hypothesis)
        d = score.shape[1]
        flat = information.reshape(n * d, n * d) + np.diag(np.tile(1.0 / hypothesis.sigma**2, n))
        chi_sq = np.full((n + 1, n + 1), -np.inf)
        for begin in range(n):
            root = root_of(flat[begin * d :, begin * d :])
            half = np.linalg.solve(root, score[begin:].ravel())
            chi_sq[begin, begin + 1 :] = np.cumsum(np.sum(half.reshape(-1, d) ** 2, axis=1))
        count = np.maximum(np.arange(n + 1)[None, :] - np.arange(n + 1)[:, None], 0)
        ends_s = np.append(0.0, np.cumsum(self.grid.length_s))
        coarse = np.ceil((ends_s[None, :] - ends_s[:, None]) / self.grid.block_s - 0.1)
        needed = np.array([hypothesis.least(d * one) if one else np.inf for one in range(n + 1)])
        extra = (PER_NUMBER - LEAST_PER_NUMBER) * (d * np.maximum(coarse, 1.0) - 1.0)
        return chi_sq, needed[count] + extra

    def _by_moments(self, hypothesis: Hypothesis) -> tuple[Array, Array]:
        """Return the same as :meth:`_projected` with a rate behind, where there is one."""
        if not hypothesis.has_rate:
            return self._projected(hypothesis)
        channel, C, n = (
            self.channels.of(hypothesis.channel),
            hypothesis.combined,
            len(self.grid.edges) - 1,
        )
        if channel.rates is not None:
            return self._summed(np.r_[channel.columns, channel.rates], block_diag(C, C))
        score, information = self._projected(hypothesis)
        moments = np.column_stack([np.ones(n), self.grid.middle_since])
        d = 2 * score.shape[1]
        score = (moments[:, :, None] * score[:, None, :]).reshape(n, d)
        by_begin = moments[:, :, None, None, None, None] * information[:, None, :, :, None, :]
        return score, (by_begin * moments[:, :, None]).reshape(n, d, n, d)

    def _projected(self, hypothesis: Hypothesis) -> tuple[Array, Array]:
        """Return score (N, d) and information (N, d, N, d) of a hypothesis in each block."""
        own = self.channels.of(hypothesis.channel).columns
        return self._summed(np.r_[own], hypothesis.combined)

    def _summed(self, own: NDArray[np.intp], C: Array) -> tuple[Array, Array]:
        """Return score and information of sums (c, d) of some columns (c,) in each block."""
        n, width = self.grid.n_blocks, self.channels.width
        information = self.evidence.information.reshape(n, width, n, width)
        information = information[:, own][:, :, :, own]
        projected = np.einsum("ap,iajb,bq->ipjq", C, information, C, optimize=True)
        return self.evidence.score.reshape(n, width)[:, own] @ C, projected


def _from_begin(inner: Array, score: Array, since: Array) -> tuple[Array, Array]:
    """Return information (P, 2 d, 2 d) and score (P, 2 d) with rates from each begin on.

    ``since`` (P,) is what rates counted from the mission's begin on are there.
    """
    d = score.shape[1] // 2
    turned = np.tile(np.eye(2 * d), (len(since), 1, 1))
    turned[:, d:, :d] = -since[:, None, None] * np.eye(d)
    return turned @ inner @ turned.swapaxes(1, 2), (turned @ score[..., None])[..., 0]


def combined_of(faults: Sequence[Fault], grid: Grid, channels: Channels) -> tuple[Array, Array]:
    """Return the columns of faults (N w, m) as sums of those of a grid, and their prior (m, m)."""
    parts = [_combined_of(fault, grid, channels) for fault in faults]
    prior = np.diag(np.concatenate([sigma for _, sigma in parts]) ** -2.0)
    return np.hstack([part for part, _ in parts]), prior


def _combined_of(fault: Fault, grid: Grid, channels: Channels) -> tuple[Array, Array]:
    """Return the columns of a fault, and the sigmas of its numbers."""
    hypothesis, width = fault.hypothesis, channels.width
    channel, C = channels.of(hypothesis.channel), hypothesis.combined
    begin, end = np.searchsorted(grid.edges, [fault.begin, fault.end]).tolist()
    d = C.shape[1]
    made = np.zeros((grid.n_blocks, width, (end - begin) * d))
    if hypothesis.course is Course.ANYTHING:
        for block in range(begin, end):
            first = (block - begin) * d
            made[block, channel.columns, first : first + d] = C
    else:
        made = np.zeros((grid.n_blocks, width, 2 * d))
        made[begin:end, channel.columns, :d] = C
        # The rate counts from the begin of the stretch on.
        since = -np.full(end - begin, grid.begin_since[begin])
        if channel.rates is not None:
            made[begin:end, channel.rates, d:] = C
        else:
            since += grid.middle_since[begin:end]
        made[begin:end, channel.columns, d:] = since[:, None, None] * C
        if hypothesis.course is not Course.TREND:
            made = made[:, :, d:] if hypothesis.has_rate else made[:, :, :d]
    sigma = np.resize(hypothesis.sigma, made.shape[2])
    return made.reshape(grid.n_blocks * width, -1), sigma
