"""The search for stretches in which one beam is off for long: biased, drifting, covered, stuck.

A kernel judges every ping by itself. Against a fault that lasts this is not enough: what is left of
its pull adds up, and one that begins slowly takes the trajectory with it, so that its residuals
stay small. Here all pings of a stretch are judged together and with the trajectory eliminated
(:mod:`ssm_graph.engine.beam_evidence`): for every beam and every stretch of whole blocks, how
significant is an offset of its own? The most significant stretch is let free, which shows what the
others look like without it, and so on, as in a step-wise regression. A stretch counts against a
beam if no other beam explains the data as well, or no other that is blamed nearby. What one
calibration error of the whole array would explain, scale or mounting, is nobody's fault.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.inertial import Intervals
from factors.similarity import WEIGHT_FLOOR, LogKernel
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.beam_evidence import ChainEvidence, Evidence, WhitenedBeams
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.reweighting import NEAR_SIGMAS
from ssm_graph.engine.states import States
from ssm_graph.graph.beam_rows import BeamRows, WaterRows
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.calibration import CALIBRATIONS, DRIFTS
from ssm_graph.mission.problem import Problem

Mask = NDArray[np.bool_]

KERNEL = LogKernel()
"""Weighs the pings while stretches are judged: single outliers must not make a fault."""
PIECE_BLOCKS = 360
"""Blocks that are judged together, an hour of 10 s; longer missions come in pieces that overlap by
half, and what is found counts in the middle of its piece."""
CALIBRATION_SIGMA = 0.05
"""Of the scale, and of each mounting angle in rad, that no beam is to be blamed for."""
FREE_INFORMATION = 1e-6
"""Of the offset of a stretch that is let free, and the least to judge one by: 1000 sigmas."""
FREE_LOOKS = 2
"""So often a search may take back what the one before it found."""
MAX_FOUND = 100
"""Stretches that are taken out of one piece."""


@dataclass(frozen=True, slots=True)
class FaultSearch:
    """Settings of the search."""

    block_s: float = 10.0
    """Stretches begin and end at multiples of this."""
    significance: float = 6.0
    """Sigmas by which an offset must differ from zero; an hour has 260 000 stretches to choose
    from."""
    margin: float = 12.0
    """By so much its chi-square must exceed that of any other beam for a beam to be blamed."""

    def __post_init__(self) -> None:
        for name in ("block_s", "significance", "margin"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ConfigError(f"{name}: expected a number above zero, got {value}")


class Stretch(NamedTuple):
    """One beam during whole blocks."""

    beam: int
    """From 0."""
    begin: int
    end: int
    """The first block after it."""
    is_blamed: bool
    """Whether the data say that it is this beam and no other."""


class Found(NamedTuple):
    """What a search found."""

    is_off: Mask
    """(M,) beam speeds in stretches with a fault of their beam."""
    doubtful_s: tuple[tuple[float, float], ...]
    """Begin and end of stretches in which some beam is off and it is not clear which."""


def find_beam_faults_steps(
    linearizer: GraphLinearizer,
    states: States,
    rows: BeamRows,
    search: FaultSearch,
    aid_weights: Array | None = None,
) -> Steps[Found]:
    """Search the whole mission, linearised at ``states`` near the answer.

    ``aid_weights`` are those of the further aids' measurements; all one when left out.
    """
    problem, beams = linearizer.problem, linearizer.problem.beams
    jacobian = rows.jacobian
    weights = KERNEL.weight((rows.error / beams.sigma) ** 2)
    linearizer.follow(states)
    yield 0.01 * problem.n_keyframes
    solution = yield from linearizer.solve_steps(states, rows, weights, aid_weights)
    missed = -rows.error - np.einsum("mi,mi->m", jacobian, solution.step[beams.keyframe])
    scale = np.sqrt(weights) / beams.sigma
    whitened = WhitenedBeams(
        beams.keyframe,
        jacobian * scale[:, None],
        missed * scale / _excess(beams.beam, weights, missed / beams.sigma),
    )
    evidence = ChainEvidence(solution, whitened)
    yield 0.015 * problem.n_keyframes
    own = np.zeros((len(scale), beams.n_beams))
    own[np.arange(len(scale)), beams.beam] = np.sqrt(weights)
    shared = calibration_columns(problem, states) * (CALIBRATION_SIGMA * scale[:, None])
    edges_s = np.arange(problem.keyframe_s[0], problem.keyframe_s[-1], search.block_s)
    edges_s = np.append(edges_s, np.inf)
    edges = np.searchsorted(problem.keyframe_s, edges_s).tolist()
    found: list[Stretch] = []
    for piece, middle in pieces_of(len(edges) - 1):
        judged = evidence.of(edges[piece.start : piece.stop + 1], own, shared)
        yield 0.01 * problem.n_keyframes
        for stretch in _search(without_shared(judged, shared.shape[1]), search, beams.n_beams):
            begin = max(stretch.begin + piece.start, middle.start)
            end = min(stretch.end + piece.start, middle.stop)
            if begin < end:
                found.append(stretch._replace(begin=begin, end=end))
    block = np.searchsorted(edges, beams.keyframe, side="right") - 1
    is_off = np.zeros(len(scale), dtype=bool)
    for beam, begin, end, is_blamed in found:
        is_off |= is_blamed & (beams.beam == beam) & (begin <= block) & (block < end)
    ends_s = np.append(edges_s[:-1], problem.keyframe_s[-1])
    doubtful = ((ends_s[f.begin], ends_s[f.end]) for f in found if not f.is_blamed)
    return Found(is_off, tuple(sorted({(float(a), float(b)) for a, b in doubtful})))


def _excess(beam: NDArray[np.intp], weights: Array, missed: Array) -> float:
    """Return how many times as large as their sigmas say weighted errors are, not below one.

    Sigmas stated too small would make faults of noise. Of the beams' mean squares the median
    counts: what one of them is off by must not hide itself.

    Parameters
    ----------
    beam, weights : (M,)
    missed : (M,) in stated sigmas.
    """
    square = np.bincount(beam, (weights * missed) ** 2)
    expected = np.bincount(beam, weights)
    ratio = square[expected > 0.0] / expected[expected > 0.0]
    return float(np.sqrt(max(np.median(ratio), 1.0))) if len(ratio) else 1.0


def calibration_columns(problem: Problem, states: States) -> Array:
    """Return what scale (1) and mounting angles (3, rad) do to the beam speeds (M, 4), m/s."""
    beams, k = problem.beams, problem.beams.keyframe
    R_nb, v_n = states.R_nb[k], states.v_n[k]
    water = WaterRows(beams, problem.extras, problem.frame)
    through = water.relative(v_n, p_n=states.p_n[k], walks=states.walks[k], rows=np.s_[:])
    v_n = v_n if through is None else through.v_n
    v_b = np.einsum("mij,mi->mj", R_nb, v_n)
    along = np.einsum("mi,mi->m", beams.beam_b, v_b)
    return np.column_stack([along, np.cross(v_b, beams.beam_b)])


def pieces_of(n_blocks: int) -> list[tuple[slice, slice]]:
    """Return the pieces of a mission, and of each the middle in which a finding counts."""
    half = PIECE_BLOCKS // 2
    begins = range(0, max(n_blocks - half, 1), half)
    pieces = []
    for begin in begins:
        end = min(begin + PIECE_BLOCKS, n_blocks)
        is_first, is_last = begin == 0, end == n_blocks
        middle = slice(
            0 if is_first else begin + half // 2, n_blocks if is_last else begin + half + half // 2
        )
        pieces.append((slice(begin, end), middle))
        if is_last:
            break
    return pieces


def without_shared(evidence: Evidence, n_shared: int) -> Evidence:
    """Return the evidence of all but the last columns, those of unit prior variance eliminated."""
    n = len(evidence.score) - n_shared
    score, information = _freed(evidence, np.arange(n, n + n_shared), 1.0)
    return Evidence(score[:n], information[:n, :n])


def _freed(evidence: Evidence, columns: NDArray[np.intp], information: float) -> Evidence:
    """Return the evidence once some columns may be of any size, of this prior information."""
    score, among = evidence
    crossed = among[:, columns]
    inner = among[np.ix_(columns, columns)] + information * np.eye(len(columns))
    explained = np.linalg.solve(inner, np.column_stack([crossed.T, score[columns]]))
    return Evidence(score - crossed @ explained[:, -1], among - crossed @ explained[:, :-1])


def _search(evidence: Evidence, search: FaultSearch, n_beams: int) -> list[Stretch]:
    """Take out the most significant stretch until none is significant any more."""
    n_blocks = len(evidence.score) // n_beams
    is_free, is_blamed = np.zeros((2, n_blocks, n_beams), dtype=bool)
    found: list[Stretch] = []
    while len(found) < MAX_FOUND:
        chi_sq = np.stack([stretch_chi_sq(evidence, beam, n_blocks) for beam in range(n_beams)])
        best, begin, end = (int(i) for i in np.unravel_index(np.argmax(chi_sq), chi_sq.shape))
        if chi_sq[best, begin, end] < search.significance**2:
            break
        beam = who_is_off(
            chi_sq[:, begin, end], is_blamed[max(begin - 1, 0) : end + 1], margin=search.margin
        )
        found.append(Stretch(best if beam is None else beam, begin, end, beam is not None))
        blocks = begin + np.flatnonzero(~is_free[begin:end, found[-1].beam])
        if len(blocks) == 0:
            break
        is_free[blocks, found[-1].beam] = True
        is_blamed[begin:end, found[-1].beam] |= found[-1].is_blamed
        evidence = _freed(evidence, blocks * n_beams + found[-1].beam, FREE_INFORMATION)
    return found


def who_is_off(chi_sq: Array, is_blamed: Mask, *, margin: float) -> int | None:
    """Return the beam to blame for a stretch, None if the data do not say.

    A fault that grew is plain in its later part before it is in its begin: of several beams that
    explain the stretch as well, one that is blamed right before, in or after it is taken.

    Parameters
    ----------
    chi_sq : (B,) of each beam for the stretch.
    is_blamed : (n, B) which were blamed before, from one block before the stretch to one after.
    """
    as_good = chi_sq > chi_sq.max() - margin
    for beams in (as_good, as_good & is_blamed.any(axis=0)):
        if np.count_nonzero(beams) == 1:
            return int(np.argmax(beams))
    return None


def stretch_chi_sq(evidence: Evidence, beam: int, n_blocks: int) -> Array:
    """Return the chi-square of an offset of one beam in every stretch, by begin and end block.

    (N + 1, N + 1), one degree of freedom; zero where the end is not after the begin, or where
    nothing can be said.
    """
    own = slice(beam, None, len(evidence.score) // n_blocks)
    score = np.concatenate([[0.0], np.cumsum(evidence.score[own])])
    summed = np.zeros((n_blocks + 1, n_blocks + 1))
    summed[1:, 1:] = evidence.information[own, own].cumsum(axis=0).cumsum(axis=1)
    corner = np.diagonal(summed)
    information = corner[:, None] + corner[None, :] - summed - summed.T
    square = (score[None, :] - score[:, None]) ** 2
    usable = np.triu(information > FREE_INFORMATION, 1)
    chi_sq: Array = np.divide(square, information, out=np.zeros_like(square), where=usable)
    return chi_sq


def _kept(extras: Extras) -> Extras:
    """Return the variables that the search carries along in the states of the chain.

    Those of the current and of the further aids: they are nothing of the DVL's, and hold what
    would be taken for a fault. Calibrations are held at their estimates.
    """
    return extras.without(CALIBRATIONS | DRIFTS).in_the_state()


class FaultWatch:
    """Keeps the beams out of a solution that the search finds, while it is iterated.

    It has no drifts among its variables, so it counts the noise of the ``problem`` as stated.
    """

    def __init__(self, problem: Problem, search: FaultSearch | None) -> None:
        self._search = search
        self._extras, self._kept = problem.extras, _kept(problem.extras)
        self._linearizer = None
        if search is not None:
            self._linearizer = GraphLinearizer(replace(problem, extras=self._kept))
        self._beams, self._time_s = problem.beams, problem.keyframe_s[problem.beams.keyframe]
        self._found = Found(np.zeros(len(self._time_s), dtype=bool), ())
        self._n_looks = 0

    def leave_out(self, weights: Array) -> Array:
        """Return the weights (M,) with the floor for what was found."""
        return np.where(self._found.is_off, WEIGHT_FLOOR, weights)

    def look_steps(
        self,
        states: States,
        rows: BeamRows,
        *,
        update_sigmas: float,
        is_settled: bool,
        aid_weights: Array | None = None,
        intervals: Intervals | None = None,
    ) -> Steps[bool]:
        """Search once the solution is near, and whenever it has settled; return what has changed.

        The first solution may be far off where a fault has not been left out yet: its findings are
        given up again where a later one disagrees. After ``FREE_LOOKS`` they only become more, so
        that there is an end to it. ``intervals`` are the inertial data without the errors that the
        solution finds in the sensors.
        """
        is_due = is_settled or (self._n_looks == 0 and update_sigmas < NEAR_SIGMAS)
        if self._search is None or self._linearizer is None or not is_due:
            return False
        self._n_looks += 1
        if intervals is not None:
            self._linearizer.take_inertial(intervals)
        alone, before = self._without_calibration(states, rows), self._found
        found = yield from find_beam_faults_steps(
            self._linearizer, *alone, self._search, aid_weights
        )
        if self._n_looks > FREE_LOOKS:
            found = found._replace(is_off=found.is_off | before.is_off)
        self._found = found
        return not np.array_equal(found.is_off, before.is_off)

    def _without_calibration(self, states: States, rows: BeamRows) -> tuple[States, BeamRows]:
        """Return both with the variables that are kept, all of them walks."""
        n_keyframes = len(states.p_n)
        walks = [np.zeros((n_keyframes, 0))]
        for block in self._kept.blocks:
            zero = np.zeros(len(block.sigma))
            value = self._extras.value(block.name, states.walks, states.constants, default=zero)
            walks.append(np.broadcast_to(value, (n_keyframes, len(zero))))
        alone = states._replace(walks=np.hstack(walks), constants=states.constants[:0])
        columns = self._extras.columns_of(self._kept)
        return alone, BeamRows(rows.error, rows.jacobian[:, columns])

    def notes(self, error: Array) -> tuple[str, ...]:
        """Say what was left out; ``error`` (M,) is what the answer misses, predicted - measured."""
        said = []
        for beam in range(self._beams.n_beams):
            rows = np.flatnonzero(self._beams.beam == beam)
            edges = np.diff(self._found.is_off[rows].astype(int), prepend=0, append=0)
            for begin, end in zip(
                np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True
            ):
                left_out = rows[begin:end]
                said.append(
                    f"beam {beam + 1} is off from {self._time_s[left_out[0]]:.1f} s to "
                    f"{self._time_s[left_out[-1]]:.1f} s, by {-np.mean(error[left_out]):+.3f} m/s "
                    "on average, and left out there"
                )
        said.extend(
            f"one of the beams is off between {begin_s:.0f} s and {end_s:.0f} s, and the data do "
            "not say which: nothing is left out there"
            for begin_s, end_s in self._found.doubtful_s
        )
        return tuple(said)
